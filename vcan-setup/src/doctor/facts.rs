//! The facts about a machine and its buses that the doctor assesses.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::path::PathBuf;

use protocol::bus::KindChoice;
use protocol::id::CellId;
use protocol::skin::{Skin, SkinReply};

use crate::kernel::Kernel;
use crate::link::Interface;
use crate::plan::InterfaceTarget;

/// The facts about a machine and its buses that [`assess`](super::assess_machine) needs.
#[derive(Clone, Debug)]
pub struct MachineFacts {
    /// The kind of bus that the user requested.
    pub choice: KindChoice,
    /// True if the cells already run, as with `skinbus run --no-spawn`.
    pub no_spawn: bool,
    /// The path or name by which `sudo` finds this program.
    pub program: String,
    /// The properties of the kernel that concern CAN.
    pub kernel: Kernel,
    /// The user who runs the doctor.
    pub user: User,
    /// The size of the receive buffer that a gateway would get, in bytes.
    pub receive_buffer: Option<usize>,
    /// The maximum number of frames in the kernel's backlog queue; `None` if it is unknown.
    pub backlog: Option<usize>,
    /// The program that simulates a cell.
    pub cell_node: Program,
    /// The directory of this user's embedded buses, or the reason why it cannot be used.
    pub embedded: Result<PathBuf, String>,
    /// The buses that the user named, directly or by a skin.
    pub buses: Vec<BusFacts>,
    /// The CAN interfaces that exist.
    pub present: Vec<Interface>,
}

/// The user who runs the doctor.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct User {
    /// True if the user is root.
    pub root: bool,
    /// True if the user may create interfaces (`CAP_NET_ADMIN`).
    pub admin: bool,
}

/// A program that a bench needs.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Program {
    /// The expected path.
    pub path: PathBuf,
    /// True if the file exists.
    pub there: bool,
}

/// A bus that the user named, with what was found out about it.
#[derive(Clone, Debug)]
pub struct BusFacts {
    /// The name of the interface, and what the bus requires of it.
    pub target: InterfaceTarget,
    /// The cells of the bus according to the skin; `None` without a skin.
    pub cells: Option<BTreeSet<CellId>>,
    /// True if the cells send sums along a tree (`reply = "sum"`).
    pub sums: bool,
    /// The interface of this name; `None` if it does not exist.
    pub interface: Option<Interface>,
    /// The nodes that sent during the observation. `None` if the bus was not opened, or an error text if it could not
    /// be.
    pub traffic: Result<Option<ObservedTraffic>, String>,
}

impl BusFacts {
    /// Returns the buses of a skin.
    #[must_use]
    pub fn from_skin(file: &OsStr, skin: &Skin) -> Vec<Self> {
        let of = |(index, target): (usize, InterfaceTarget)| Self {
            cells: Some(skin.cells_on_bus(index).map(|cell| cell.node).collect()),
            sums: skin.buses.get(index).is_some_and(|bus| bus.reply != SkinReply::Torque),
            ..Self::new(target)
        };
        InterfaceTarget::from_skin(file, skin).into_iter().enumerate().map(of).collect()
    }

    /// Returns a bus that was named without a skin.
    #[must_use]
    pub fn named(name: &str) -> Self {
        Self::new(InterfaceTarget::named(name))
    }

    /// Returns a bus whose interface and traffic have not been examined yet.
    const fn new(target: InterfaceTarget) -> Self {
        Self { target, cells: None, sums: false, interface: None, traffic: Ok(None) }
    }
}

/// The nodes that sent on a bus while it was observed.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct ObservedTraffic {
    /// True if another gateway sends on the bus.
    pub gateway: bool,
    /// The cells that send on the bus.
    pub cells: BTreeSet<CellId>,
}
