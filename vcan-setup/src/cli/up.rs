//! The commands `vcan-setup up` and `vcan-setup down`.

use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::io;
use std::os::unix::fs::MetadataExt;

use clap::Args;
use protocol::bus::is_plain_name;
use protocol::usage::{Failure, print_text, shell_quoted_os};
use rustix::io::Errno;
use vcan_setup::kernel::{Kernel, ModuleState};
use vcan_setup::look;
use vcan_setup::namespace::{Namespace, NamespaceError};
use vcan_setup::netlink::Netlink;
use vcan_setup::plan::{self, OtherNamespace, Plan, Step, StepAction, TargetPair};

use super::{BusArgument, parse_argument, query_error, query_interfaces, targets_from_arguments};

/// Make virtual CAN interfaces, and bring them up
///
/// Makes missing interfaces with MTU 72 for CAN FD, and marks them with the alias "skinbus". Suitable interfaces that
/// exist stay unchanged, so the command may be repeated. It changes only interfaces that it has made. For a real
/// interface in a skin, it only checks the bit rates, unless --set-bit-rates is given. Needs root, unless there is
/// nothing to change.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vcan-setup up --dry-run skin.toml                           print what would be done
  sudo vcan-setup up skin.toml                                all buses of a skin
  sudo vcan-setup up vcan0 vcan1
  sudo vcan-setup up vcan0 --peer vcan0 --namespace blue      a pair that leads into a namespace
  sudo vcan-setup up skin.toml --set-bit-rates                also set the bit rates of real interfaces")]
pub(crate) struct UpOptions {
    /// Names of interfaces, or skin files (an argument that ends in .toml or contains a '/')
    #[arg(required = true, value_name = "SKIN.toml|NAME")]
    what: Vec<OsString>,
    /// Print the steps and commands, but do not execute them
    #[arg(long)]
    dry_run: bool,
    /// Make a vxcan pair instead of a vcan: NAME is one end, PEER the other
    #[arg(long, value_name = "PEER")]
    peer: Option<String>,
    /// Network namespace of the PEER end: a name, a path, or a process id
    #[arg(long, value_name = "NAME|PATH|PID", requires = "peer")]
    namespace: Option<OsString>,
    /// Set the bit rates of CAN hardware to those of the skin; takes the interface down for a moment
    #[arg(long, conflicts_with = "peer")]
    set_bit_rates: bool,
}

/// Remove the virtual CAN interfaces that `up` has made
///
/// Removes only interfaces with the alias "skinbus". Other interfaces of a skin stay unchanged, but naming one on the
/// command line is an error.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  sudo vcan-setup down skin.toml
  vcan-setup down --dry-run vcan0")]
pub(crate) struct DownOptions {
    /// Names of interfaces, or skin files (an argument that ends in .toml or contains a '/')
    #[arg(required = true, value_name = "SKIN.toml|NAME")]
    what: Vec<OsString>,
    /// Print the steps and commands, but do not execute them
    #[arg(long)]
    dry_run: bool,
}

impl UpOptions {
    pub(crate) fn run(self) -> Result<(), Failure> {
        if let Some(peer) = &self.peer {
            return self.make_pair(peer);
        }
        let target = targets_from_arguments(&self.what)?;
        for name in target.iter().map(|target| &target.name) {
            check_plain_name(name)?;
        }
        let (mut netlink, present) = query_interfaces()?;
        let plan = plan::plan_up(&target, &present, self.set_bit_rates)?;
        PlanRunner { netlink: &mut netlink, there: None }.execute_or_print(&plan, self.dry_run)
    }

    fn make_pair(&self, peer: &str) -> Result<(), Failure> {
        let [given] = self.what.as_slice() else {
            return Err(Failure::usage_error("--peer makes one pair of interfaces: give exactly one NAME"));
        };
        let BusArgument::Name(name) = parse_argument(given)? else {
            return Err(Failure::usage_error(format!(
                "--peer needs the NAME of an interface, but {} is a skin",
                shell_quoted_os(given)
            )));
        };
        check_plain_name(&name)?;
        check_plain_name(peer)?;
        let (mut netlink, present) = query_interfaces()?;
        let mut other = self.namespace.as_deref().map(open_namespace).transpose()?.flatten();
        let there = match &mut other {
            Some((namespace, file, inside)) => {
                let id = netlink.namespace_id(file).map_err(query_error)?;
                let present = inside.interfaces().map_err(query_error)?;
                Some(OtherNamespace { name: namespace.clone(), id, present })
            }
            None => None,
        };
        let plan = plan::plan_pair_up(&TargetPair { name: &name, peer, there: there.as_ref() }, &present)?;
        let there = other.as_mut().map(|(_, file, inside)| (&*file, inside));
        PlanRunner { netlink: &mut netlink, there }.execute_or_print(&plan, self.dry_run)
    }
}

impl DownOptions {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let target = targets_from_arguments(&self.what)?;
        let (mut netlink, present) = query_interfaces()?;
        let plan = plan::plan_down(&target, &present)?;
        PlanRunner { netlink: &mut netlink, there: None }.execute_or_print(&plan, self.dry_run)
    }
}

/// Checks that a name is allowed by the kernel, and needs no quotes in a shell.
fn check_plain_name(name: &str) -> Result<(), Failure> {
    super::parse_bus_name(name).map_err(Failure::usage_error)?;
    if !is_plain_name(name) || name.starts_with(['-', '.']) {
        return Err(Failure::usage_error(format!(
            "{name:?} is not a valid name of an interface: use letters, digits, '-', '_' and '.', as in vcan0"
        )));
    }
    Ok(())
}

/// Opens the network namespace that an argument names. Returns `None` if that is the current one.
fn open_namespace(word: &OsStr) -> Result<Option<(Namespace, File, Netlink)>, Failure> {
    let namespace = Namespace::parse(word);
    let not_allowed = || permission_error(&format!("enter the network namespace {namespace}"));
    let denied = |error: &NamespaceError| matches!(error, NamespaceError::Io { source, .. } if source.kind() == io::ErrorKind::PermissionDenied);
    let file = namespace
        .open()
        .map_err(|error| if denied(&error) { not_allowed() } else { Failure::usage_error(error) })?;
    let same = |file: &File| {
        let (there, here) = (file.metadata()?, std::fs::metadata("/proc/thread-self/ns/net")?);
        Ok::<_, io::Error>((there.dev(), there.ino()) == (here.dev(), here.ino()))
    };
    if same(&file).unwrap_or(false) {
        return Ok(None);
    }
    let inside = Netlink::open_in(&file).map_err(|error| {
        let path = namespace.path();
        match Errno::from_io_error(&error) {
            Some(Errno::PERM) => not_allowed(),
            Some(Errno::INVAL) => Failure::usage_error(format!(
                "{} is not a network namespace: give a name that `ip netns` lists, a process id, or a file \
                 like /proc/1/ns/net",
                path.display()
            )),
            _ => {
                Failure::run_error(format!("cannot enter the network namespace {}: {error}", path.display()))
            }
        }
    })?;
    Ok(Some((namespace, file, inside)))
}

fn permission_error(what: &str) -> Failure {
    if rustix::process::geteuid().is_root() {
        return Failure::run_error(format!(
            "not allowed to {what}: root has no CAP_NET_ADMIN here; in a container, start the container with `--cap-add \
             NET_ADMIN`"
        ));
    }
    let again: Vec<_> = std::iter::once(look::own_program_command())
        .chain(std::env::args_os().skip(1).map(|word| shell_quoted_os(&word)))
        .collect();
    let again = again.join(" ");
    Failure::run_error(format!("not allowed to {what}, which needs root: `sudo {again}`"))
}

/// Executes the steps of a plan, or prints them.
struct PlanRunner<'a> {
    netlink: &'a mut Netlink,
    there: Option<(&'a File, &'a mut Netlink)>,
}

impl PlanRunner<'_> {
    /// Prints which interfaces stay unchanged, and executes the plan. With `dry_run`, prints its steps instead.
    fn execute_or_print(mut self, plan: &Plan, dry_run: bool) -> Result<(), Failure> {
        let mut text = String::new();
        for line in &plan.unchanged {
            text += &format!("{line}\n");
        }
        if dry_run {
            for step in &plan.steps {
                text += &format!("would {step}\n    {}\n", step.command());
            }
            if plan.steps.is_empty() {
                text += "nothing would be done\n";
            }
            return print_text(&text);
        }
        print_text(&text)?;
        let mut undo = Vec::new();
        for step in &plan.steps {
            let there = self.there.as_mut().map(|(file, inside)| (*file, &mut **inside));
            match self.netlink.execute_step(step, there) {
                Ok(done) => undo.extend(done),
                Err(error) => {
                    let mut failure = explain_step_failure(step, &error);
                    for done in undo.iter().rev() {
                        if let Err(error) = self.netlink.undo(done) {
                            failure =
                                failure.append(format_args!("undoing the earlier steps failed: {error}"));
                        }
                    }
                    return Err(failure);
                }
            }
        }
        // The steps are printed at the end, because they are undone if a later one fails.
        print_text(&plan.steps.iter().map(|step| format!("{}\n", step.done_message())).collect::<String>())
    }
}

/// Returns an error that explains why a step failed and how to fix the cause.
fn explain_step_failure(step: &Step, error: &io::Error) -> Failure {
    let kind = match step.action {
        StepAction::MakeVcan => Some("vcan"),
        StepAction::MakePair { .. } => Some("vxcan"),
        StepAction::BringUp { .. }
        | StepAction::Widen { .. }
        | StepAction::SetRates { .. }
        | StepAction::Remove { .. } => None,
    };
    let doing = step.short_description();
    let unknown = |kind: &str, kernel: &Kernel| {
        let hints = kernel.setup_hints(kernel.module_state(kind));
        let nearest = hints.first().map_or("", String::as_str);
        // A hint consists of a command and a comment.
        let (command, why) = nearest.split_once("# ").unwrap_or((nearest, ""));
        let command = if command.is_empty() { String::new() } else { format!("`{}`", command.trim()) };
        let why = match (command.is_empty(), why) {
            (_, "") => String::new(),
            (true, why) => why.to_owned(),
            (false, why) => format!(" ({why})"),
        };
        let release = &kernel.release;
        Failure::run_error(format!(
            "cannot {doing}: the kernel ({release}) has no {kind}: {command}{why}; or use the embedded bus, which does \
             not need it"
        ))
    };
    let data = if let StepAction::SetRates { rates, .. } = step.action { rates.data_bitrate } else { None };
    match (Errno::from_io_error(error), kind) {
        (Some(Errno::OPNOTSUPP), None) if data.is_some() => Failure::run_error(format!(
            "cannot {doing}: this hardware has no CAN FD; in the skin, set format = \"classic\" for the bus \
             and remove data_bitrate"
        )),
        (Some(Errno::OPNOTSUPP), Some(kind)) => unknown(kind, &Kernel::detect()),
        (Some(Errno::PERM | Errno::ACCESS), kind) => {
            // This error does not depend on permissions: root would get it too.
            let kernel = Kernel::detect();
            let missing = kind.filter(|kind| kernel.module_state(kind) == ModuleState::Missing);
            missing.map_or_else(|| permission_error(&doing), |kind| unknown(kind, &kernel))
        }
        (Some(Errno::OPNOTSUPP), None) => {
            Failure::run_error(format!("cannot {doing}: this hardware does not support it ({error})"))
        }
        (Some(Errno::INVAL), None) => {
            Failure::run_error(format!("cannot {doing}: its driver rejects these settings ({error})"))
        }
        (Some(Errno::EXIST), Some(_)) => Failure::run_error(format!(
            "cannot {doing}: another interface now has this name or altname; `ip link show` lists them"
        )),
        _ => Failure::run_error(format!("cannot {doing}: {error}")),
    }
}
