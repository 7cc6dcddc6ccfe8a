//! Finds out whether this machine's kernel supports CAN, and how missing modules can be installed.

use std::fs;
use std::path::Path;

use protocol::bus::has_socketcan;

/// The availability of a kernel module.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum ModuleState {
    /// The module is built in or loaded.
    Available,
    /// The module is on the disk and can be loaded.
    Loadable,
    /// The module is neither built in nor among the modules on the disk.
    Missing,
    /// The state is unknown, because the modules of the running kernel are not on this disk.
    Unknown,
}

/// The properties of a kernel that concern CAN.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Kernel {
    /// The release, as in `uname -r`.
    pub release: String,
    /// The machine, as in `uname -m`.
    pub machine: String,
    /// The names of the distribution from os-release: `ID` and `ID_LIKE`.
    pub distribution: String,
    /// True if `CAN_RAW` sockets can be opened.
    pub has_can: bool,
    /// The module for `CAN_RAW` sockets.
    pub can_raw: ModuleState,
    /// The module for virtual buses.
    pub vcan: ModuleState,
    /// The module for pairs of virtual interfaces.
    pub vxcan: ModuleState,
}

impl Kernel {
    /// Examines the running kernel.
    #[must_use]
    pub fn detect() -> Self {
        let uname = rustix::system::uname();
        let release = uname.release().to_string_lossy().into_owned();
        let lists = ModuleLists::read(&release);
        // Opening such a socket makes the kernel load the module, if it has one.
        let has_can = has_socketcan();
        let loaded = |name: &str| Path::new("/sys/module").join(name).exists();
        let os_release = fs::read_to_string("/etc/os-release").unwrap_or_default();
        Self {
            machine: uname.machine().to_string_lossy().into_owned(),
            distribution: distribution(&os_release),
            has_can,
            can_raw: lists.find_module_state("can_raw", has_can),
            vcan: lists.find_module_state("vcan", loaded("vcan")),
            vxcan: lists.find_module_state("vxcan", loaded("vxcan")),
            release,
        }
    }

    /// Returns the state of the module for a kind of virtual interface, `vcan` or `vxcan`.
    #[must_use]
    pub fn module_state(&self, kind: &str) -> ModuleState {
        if kind == "vxcan" { self.vxcan } else { self.vcan }
    }

    /// Returns shell commands by which CAN or `vcan` can be made available, each with a comment; the simplest comes
    /// first.
    #[must_use]
    pub fn setup_hints(&self, module: ModuleState) -> Vec<String> {
        let modprobe = "sudo modprobe -a can_raw vcan vxcan";
        let here = match module {
            ModuleState::Available => None,
            ModuleState::Loadable => Some(modprobe.to_owned()),
            ModuleState::Missing => Some(self.other_kernel_hint(modprobe)),
            ModuleState::Unknown => {
                Some(format!("{modprobe}  # in a container: run this on the host, which has the modules"))
            }
        };
        let lab = "tests/lab/run COMMAND  # in the project's folder: runs COMMAND in a virtual machine that has vcan";
        here.into_iter().chain([lab.to_owned()]).collect()
    }

    fn other_kernel_hint(&self, modprobe: &str) -> String {
        let is = |name: &str| self.distribution.split_whitespace().any(|word| word == name);
        let architecture = match self.machine.as_str() {
            "x86_64" => "amd64",
            "aarch64" => "arm64",
            other => other,
        };
        let release = &self.release;
        // The packages of a distribution contain modules only for the kernels of that distribution.
        if is("ubuntu")
            && ["-generic", "-virtual", "-kvm", "-aws", "-azure", "-gcp"]
                .iter()
                .any(|end| release.ends_with(end))
        {
            return format!("sudo apt install linux-modules-extra-{release} && {modprobe}");
        }
        if is("debian") && release.ends_with(architecture) {
            let cloud = if release.contains("cloud") {
                "a generic kernel instead of a cloud kernel"
            } else {
                "a newer kernel"
            };
            return format!(
                "sudo apt install linux-image-{architecture}  # {cloud}: boot it, then run {modprobe}"
            );
        }
        "# boot a kernel with CONFIG_CAN_RAW and CONFIG_CAN_VCAN".to_owned()
    }
}

/// The lists in which the kernel names its modules.
struct ModuleLists {
    built_in: Option<String>,
    on_disk: Option<String>,
    /// True if the kernel can load modules.
    takes_modules: bool,
}

impl ModuleLists {
    fn read(release: &str) -> Self {
        let directory = Path::new("/lib/modules").join(release);
        let read = |name| fs::read_to_string(directory.join(name)).ok();
        let takes_modules = Path::new("/proc/modules").exists();
        Self { built_in: read("modules.builtin"), on_disk: read("modules.dep"), takes_modules }
    }

    fn find_module_state(&self, name: &str, works: bool) -> ModuleState {
        let lists = |list: &Option<String>| list.as_deref().is_some_and(|list| lists_module(list, name));
        if works || lists(&self.built_in) {
            ModuleState::Available
        } else if lists(&self.on_disk) {
            ModuleState::Loadable
        } else if self.on_disk.is_some() || !self.takes_modules {
            ModuleState::Missing
        } else {
            ModuleState::Unknown
        }
    }
}

/// Returns true if a list of the kernel contains the module. A line is a path and its dependencies:
/// `kernel/net/can/can-raw.ko.xz: kernel/net/can/can.ko.xz`.
fn lists_module(list: &str, module: &str) -> bool {
    list.lines().any(|line| {
        let path = line.split(':').next().unwrap_or_default();
        let file = path.rsplit('/').next().unwrap_or_default();
        file.split_once(".ko").is_some_and(|(name, _)| name.replace('-', "_") == module)
    })
}

/// Returns the values of `ID` and `ID_LIKE` in an os-release file.
fn distribution(os_release: &str) -> String {
    let values = os_release.lines().filter_map(|line| {
        let (key, value) = line.split_once('=')?;
        ["ID", "ID_LIKE"].contains(&key).then(|| value.trim_matches('"'))
    });
    values.collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    const DEP: &str = "kernel/drivers/net/can/vcan.ko: kernel/drivers/net/can/dev/can-dev.ko\n\
                       kernel/net/can/can-raw.ko.xz: kernel/net/can/can.ko.xz\n";

    #[test]
    fn a_module_is_found_by_its_own_file_and_not_by_what_needs_it() {
        assert!(lists_module(DEP, "vcan") && lists_module(DEP, "can_raw"));
        assert!(!lists_module(DEP, "can") && !lists_module(DEP, "can_dev") && !lists_module(DEP, "vxcan"));
    }

    #[test]
    fn where_a_module_is() {
        let lists = ModuleLists {
            built_in: Some("kernel/net/can/can.ko\n".into()),
            on_disk: Some(DEP.into()),
            takes_modules: true,
        };
        assert_eq!(lists.find_module_state("can", false), ModuleState::Available);
        assert_eq!(lists.find_module_state("vcan", false), ModuleState::Loadable);
        assert_eq!(lists.find_module_state("vcan", true), ModuleState::Available);
        assert_eq!(lists.find_module_state("vxcan", false), ModuleState::Missing);
        let none = |takes_modules| ModuleLists { built_in: None, on_disk: None, takes_modules };
        assert_eq!(none(true).find_module_state("vcan", false), ModuleState::Unknown);
        assert_eq!(none(false).find_module_state("vcan", false), ModuleState::Missing);
    }

    fn first(release: &str, os_release: &str, module: ModuleState) -> String {
        let kernel = Kernel {
            release: release.into(),
            machine: "x86_64".into(),
            distribution: distribution(os_release),
            has_can: false,
            can_raw: module,
            vcan: module,
            vxcan: module,
        };
        kernel.setup_hints(module).remove(0)
    }

    #[test]
    fn the_hint_fits_the_kernel_and_the_distribution() {
        let debian = "PRETTY_NAME=\"Debian\"\nID=debian\nVERSION_ID=\"12\"\n";
        assert_eq!(
            first("6.1.0-30-cloud-amd64", debian, ModuleState::Missing),
            "sudo apt install linux-image-amd64  # a generic kernel instead of a cloud kernel: boot it, then \
             run sudo modprobe -a can_raw vcan vxcan"
        );
        let mint = "NAME=\"Linux Mint\"\nID=linuxmint\nID_LIKE=\"ubuntu debian\"\n";
        assert_eq!(
            first("6.8.0-50-generic", mint, ModuleState::Missing),
            "sudo apt install linux-modules-extra-6.8.0-50-generic && sudo modprobe -a can_raw vcan vxcan"
        );
        let strange = "# boot a kernel with CONFIG_CAN_RAW and CONFIG_CAN_VCAN";
        assert!(first("6.12.1", "ID=arch\n", ModuleState::Missing).starts_with(strange));
        assert!(first("5.15.0-microsoft-WSL2", debian, ModuleState::Missing).starts_with(strange));
        assert_eq!(first("6.1.0", debian, ModuleState::Loadable), "sudo modprobe -a can_raw vcan vxcan");
        assert!(first("6.1.0", debian, ModuleState::Available).starts_with("tests/lab/run "));
    }
}
