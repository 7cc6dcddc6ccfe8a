//! Collects the facts about this machine that the [`doctor`](crate::doctor) assesses. Changes nothing.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::thread::{self, ScopedJoinHandle};
use std::time::{Duration, Instant};

use protocol::bus::embedded::{
    default_directory, open_directory, seqpacket_socket, socket_address, socket_name,
};
use protocol::bus::{self, BusError, BusKind, BusOptions, GATEWAY_RECEIVE_BUFFER_BYTES, Inbox, KindChoice};
use protocol::can::Format;
use protocol::id::{CellId, Command, Id, Kind, Node};
use protocol::usage::shell_quoted_os;
use rustix::fs::Access;
use rustix::net::{AddressFamily, SocketFlags, SocketType};
use rustix::thread::{CapabilitySet, capabilities};
use serde::Serialize;

use crate::doctor::{BusFacts, MachineFacts, ObservedTraffic, Program, User};
use crate::kernel::Kernel;
use crate::link::Interface;
use crate::plan::InterfaceTarget;

/// The time for which each bus is observed. It is long enough, because a gateway sends joints many times a second and a
/// cell sends a heartbeat at least every half second.
const OBSERVATION_TIME: Duration = Duration::from_millis(600);

/// Collects all facts that determine whether a bench would run on these buses. `present` are the interfaces of the
/// machine.
#[must_use]
pub fn collect_facts(
    mut buses: Vec<BusFacts>,
    choice: KindChoice,
    no_spawn: bool,
    present: &[Interface],
) -> MachineFacts {
    for bus in &mut buses {
        bus.interface = present.iter().find(|interface| interface.name == bus.target.name).cloned();
    }
    let all_heard = observe_all_buses(&buses, choice);
    for (bus, heard) in buses.iter_mut().zip(all_heard) {
        if let Some(heard) = heard {
            bus.traffic = heard;
        }
    }
    MachineFacts {
        choice,
        no_spawn,
        program: own_program_command(),
        kernel: Kernel::detect(),
        user: User { root: rustix::process::geteuid().is_root(), admin: is_admin() },
        receive_buffer: granted_receive_buffer_bytes().ok(),
        backlog: fs::read_to_string("/proc/sys/net/core/netdev_max_backlog")
            .ok()
            .and_then(|text| text.trim().parse().ok()),
        cell_node: find_cell_node(),
        embedded: embedded_directory(),
        buses,
        present: present.iter().filter(|interface| interface.is_can()).cloned().collect(),
    }
}

fn is_usable(target: &InterfaceTarget, interface: &Interface) -> bool {
    interface.is_can() && interface.up && target.fits_mtu(interface.mtu)
}

/// Observes all buses that can be opened, at the same time. Returns the result for each bus, in their order.
fn observe_all_buses(
    buses: &[BusFacts],
    choice: KindChoice,
) -> Vec<Option<Result<Option<ObservedTraffic>, String>>> {
    let kind_of = |bus: &BusFacts| match (choice, &bus.interface) {
        (KindChoice::Only(kind), _) => kind,
        (KindChoice::Auto, Some(_)) => BusKind::SocketCan,
        (KindChoice::Auto, None) => BusKind::Embedded,
    };
    let is_open = |bus: &&BusFacts| {
        !kind_of(bus).is_interface() || bus.interface.as_ref().is_some_and(|it| is_usable(&bus.target, it))
    };
    thread::scope(|scope| {
        let begin = |bus: &'_ BusFacts| {
            let (target, kind) = (bus.target.clone(), kind_of(bus));
            is_open(&bus)
                .then(|| thread::Builder::new().spawn_scoped(scope, move || observe_bus(&target, kind)))
        };
        let begun: Vec<_> = buses.iter().map(begin).collect();
        let end = |thread: io::Result<ScopedJoinHandle<'_, _>>| match thread.map(ScopedJoinHandle::join) {
            Ok(Ok(heard)) => heard,
            Ok(Err(_)) => Err("the thread that listened on the bus crashed".to_owned()),
            Err(error) => Err(format!("cannot start a thread: {error}")),
        };
        begun.into_iter().map(|thread| thread.map(end)).collect()
    })
}

/// Observes a bus and returns the gateway and the cells that send on it. Returns `None` if the embedded bus is not
/// served.
fn observe_bus(target: &InterfaceTarget, kind: BusKind) -> Result<Option<ObservedTraffic>, String> {
    let options = BusOptions { fd: target.format == Format::Fd, ..BusOptions::default() };
    let until = Instant::now() + OBSERVATION_TIME;
    let hear = || {
        let bus = bus::Bus::open(&target.name, KindChoice::Only(kind), &options)?;
        let (mut inbox, mut heard) = (Inbox::new(), ObservedTraffic::default());
        while let Some(unchanged) = until.checked_duration_since(Instant::now()) {
            if bus.wait(Some(unchanged))? {
                bus.receive(&mut inbox)?;
                let data = inbox.frames().filter(|it| !it.frame.is_extended() && !it.frame.is_error());
                for id in data.filter_map(|it| u16::try_from(it.frame.id()).ok()).map(Id::from_bits) {
                    heard.record_sender(id);
                }
            }
        }
        Ok(heard)
    };
    match hear() {
        Ok(heard) => Ok(Some(heard)),
        Err(BusError::NotServed { .. }) => Ok(None),
        Err(error) => Err(error.to_string()),
    }
}

impl ObservedTraffic {
    /// Records which node sent a frame with this identifier.
    pub fn record_sender(&mut self, id: Id) {
        let node = Node::from_byte(id.node);
        match id.kind {
            // Only joints show that a gateway runs. A user may send the other commands from a shell.
            Kind::Command => self.gateway |= Command::from_byte(id.node) == Some(Command::Joints),
            Kind::Network if node == Node::Gateway => self.gateway = true,
            Kind::Sum | Kind::Torque | Kind::Sensors | Kind::Network | Kind::Configured => {
                self.cells.extend(CellId::new(i64::from(id.node)));
            }
            Kind::Configure | Kind::Stimulus => {}
        }
    }
}

/// Returns the size of the receive buffer that the kernel grants if a gateway requests its usual size, in bytes. The
/// kernel grants the same to all kinds of sockets.
fn granted_receive_buffer_bytes() -> io::Result<usize> {
    let socket =
        rustix::net::socket_with(AddressFamily::UNIX, SocketType::DGRAM, SocketFlags::CLOEXEC, None)?;
    bus::set_receive_buffer(&socket, GATEWAY_RECEIVE_BUFFER_BYTES as usize)
}

/// Returns a command by which `sudo` finds this program: its name, or its path if it is not in a folder of the system,
/// because `sudo` searches only these.
#[must_use]
pub fn own_program_command() -> String {
    let own = std::env::current_exe().unwrap_or_default();
    let system = ["/usr/local/sbin", "/usr/local/bin", "/usr/sbin", "/usr/bin", "/sbin", "/bin"];
    if own.as_os_str().is_empty() || system.iter().any(|directory| own.parent() == Some(Path::new(directory)))
    {
        return "vcan-setup".to_owned();
    }
    let called = std::env::args_os().next().filter(|called| called.as_encoded_bytes().contains(&b'/'));
    shell_quoted_os(&called.unwrap_or_else(|| own.into_os_string()))
}

/// Returns true if this process has the permission to change network interfaces.
#[must_use]
pub fn is_admin() -> bool {
    capabilities(None).is_ok_and(|sets| sets.effective.contains(CapabilitySet::NET_ADMIN))
}

/// Returns the cell program: `SKINBUS_CELL_NODE`, or the file `cell-node` beside this program.
fn find_cell_node() -> Program {
    if let Some(path) = std::env::var_os("SKINBUS_CELL_NODE").filter(|path| !path.is_empty()) {
        let path = PathBuf::from(path);
        return Program { there: path.is_file(), path };
    }
    let own = std::env::current_exe().ok();
    let path = own.as_deref().and_then(Path::parent).unwrap_or_else(|| Path::new(".")).join("cell-node");
    Program { there: path.is_file(), path }
}

/// Returns the directory for embedded buses, or an error text if no bus can be served in it.
fn embedded_directory() -> Result<PathBuf, String> {
    let directory = default_directory();
    socket_address(&directory, "a23456789012345").map_err(|error| error.to_string())?;
    match open_directory(&directory) {
        Ok(_) => {}
        // A missing directory is not an error, because it is created when a bus is served.
        Err(error) if error.is_absent() => {
            let parent = directory.parent().unwrap_or_else(|| Path::new("/"));
            rustix::fs::access(parent, Access::WRITE_OK | Access::EXEC_OK).map_err(|errno| {
                let (directory, why) = (directory.display(), io::Error::from(errno));
                format!(
                    "cannot create {directory} for embedded buses: {why}; set SKINBUS_DIR to a directory of \
                     your own"
                )
            })?;
        }
        Err(error) => return Err(error.to_string()),
    }
    Ok(directory)
}

/// An embedded bus of this user.
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
pub struct EmbeddedBus {
    /// The name of the bus.
    pub name: String,
    /// The path of its socket.
    pub path: String,
    /// True if a server listens on the socket. A server that was killed leaves its socket behind.
    pub served: bool,
}

/// Returns the embedded buses whose sockets are in this user's directory.
#[must_use]
pub fn embedded_buses() -> Vec<EmbeddedBus> {
    let directory = default_directory();
    if open_directory(&directory).is_err() {
        return Vec::new();
    }
    let names = fs::read_dir(&directory).into_iter().flatten().flatten().filter_map(|entry| {
        let name = entry.file_name().into_string().ok()?;
        name.strip_suffix(".bus").map(str::to_owned)
    });
    let mut buses: Vec<_> = names
        .map(|name| EmbeddedBus {
            path: directory.join(socket_name(&name)).display().to_string(),
            served: is_served(&directory, &name),
            name,
        })
        .collect();
    buses.sort_by(|a, b| a.name.cmp(&b.name));
    buses
}

/// Returns true if a server listens on the socket of a bus. Connecting is refused only if none does.
fn is_served(directory: &Path, name: &str) -> bool {
    let socket = seqpacket_socket(SocketFlags::NONBLOCK);
    let (Ok(socket), Ok(address)) = (socket, socket_address(directory, name)) else { return false };
    matches!(rustix::net::connect(&socket, &address), Ok(()) | Err(rustix::io::Errno::AGAIN))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gateway_is_known_by_what_nobody_types_at_a_shell() {
        let heard = |id| {
            let mut heard = ObservedTraffic::default();
            heard.record_sender(id);
            (heard.gateway, heard.cells.len())
        };
        let cell = Node::Cell(CellId::new(7).unwrap());
        assert_eq!(heard(Id::command(Command::Joints)), (true, 0));
        assert_eq!(heard(Id::new(Kind::Network, Node::Gateway)), (true, 0));
        for command in [Command::Halt, Command::Sync, Command::Resume, Command::Report] {
            assert_eq!(heard(Id::command(command)), (false, 0), "{command:?}");
        }
        for kind in [Kind::Configure, Kind::Stimulus] {
            assert_eq!(heard(Id::new(kind, cell)), (false, 0), "{kind:?}");
        }
        for kind in [Kind::Sum, Kind::Torque, Kind::Sensors, Kind::Network, Kind::Configured] {
            assert_eq!(heard(Id::new(kind, cell)), (false, 1), "{kind:?}");
        }
    }
}
