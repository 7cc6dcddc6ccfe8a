//! The facts that the doctor assesses.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::path::PathBuf;

use protocol::bus::KindChoice;
use protocol::id::CellId;
use protocol::skin::{SkinReply, Skin};

use crate::kernel::Kernel;
use crate::link::Interface;
use crate::plan::InterfaceTarget;

/// The facts that the doctor assesses.
#[derive(Clone, Debug)]
pub struct Facts {
    /// The requested kind of bus.
    pub choice: KindChoice,
    /// True if the cells are already present, as with `skinbus run --no-spawn`.
    pub no_spawn: bool,
    /// The name of this program under which `sudo` finds it.
    pub program: String,
    /// The kernel.
    pub kernel: Kernel,
    /// The user who runs the doctor.
    pub user: User,
    /// The size of a receive buffer that the kernel grants to a request like the gateway's, in bytes.
    pub receive_buffer: Option<usize>,
    /// The maximum number of frames that wait in the kernel's backlog; `None` if it is unknown.
    pub backlog: Option<usize>,
    /// The cell program.
    pub cell_node: Program,
    /// The directory of this user's embedded buses, or the reason why it cannot be used.
    pub embedded: Result<PathBuf, String>,
    /// The named buses.
    pub buses: Vec<BusFacts>,
    /// The present CAN interfaces.
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

/// A named bus.
#[derive(Clone, Debug)]
pub struct BusFacts {
    /// The requirements.
    pub target: InterfaceTarget,
    /// The expected cells; `None` without a skin.
    pub cells: Option<BTreeSet<CellId>>,
    /// True if its cells answer with tree sums.
    pub sums: bool,
    /// The interface of this name.
    pub interface: Option<Interface>,
    /// The observed traffic; `None` if the bus was not opened, or the reason why it could not be.
    pub traffic: Result<Option<ObservedTraffic>, String>,
}

impl BusFacts {
    /// Returns the buses of a skin.
    #[must_use]
    pub fn of_skin(file: &OsStr, skin: &Skin) -> Vec<Self> {
        let of = |(index, target): (usize, InterfaceTarget)| Self {
            cells: Some(skin.cells_on_bus(index).map(|cell| cell.node).collect()),
            sums: skin.buses.get(index).is_some_and(|bus| bus.reply != SkinReply::Torque),
            ..Self::new(target)
        };
        InterfaceTarget::of_skin(file, skin).into_iter().enumerate().map(of).collect()
    }

    /// Returns the bus of this name.
    #[must_use]
    pub fn named(name: &str) -> Self {
        Self::new(InterfaceTarget::named(name))
    }

    /// Returns a bus that has not been examined yet.
    const fn new(target: InterfaceTarget) -> Self {
        Self { target, cells: None, sums: false, interface: None, traffic: Ok(None) }
    }
}

/// The traffic observed on a bus.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct ObservedTraffic {
    /// True if another gateway sends on the bus.
    pub gateway: bool,
    /// The cells that send on the bus.
    pub cells: BTreeSet<CellId>,
}
