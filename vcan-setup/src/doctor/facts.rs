//! What the judgement rests on.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::path::PathBuf;

use protocol::bus::Choice;
use protocol::id::CellId;
use protocol::skin::{Reply, Skin};

use crate::kernel::Kernel;
use crate::link::Interface;
use crate::plan::Target;

/// All that the judgement rests on.
#[derive(Clone, Debug)]
pub struct Facts {
    /// Which kind of bus is requested.
    pub choice: Choice,
    /// Whether the cells are there already, as `skinbus run --no-spawn` has it.
    pub no_spawn: bool,
    /// How this program is called so that `sudo` finds it.
    pub program: String,
    /// The kernel.
    pub kernel: Kernel,
    /// The user who runs the doctor.
    pub user: User,
    /// Bytes of a receive buffer that the kernel grants to a request like the gateway's.
    pub receive_buffer: Option<usize>,
    /// Frames that may wait in the kernel until they are handed on; `None` when it is unknown.
    pub backlog: Option<usize>,
    /// The program of the cells.
    pub cell_node: Program,
    /// Where the embedded buses of this user are, or why none can be used.
    pub embedded: Result<PathBuf, String>,
    /// The buses that were named.
    pub buses: Vec<Bus>,
    /// The CAN interfaces that there are.
    pub present: Vec<Interface>,
}

/// The user who runs the doctor.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct User {
    /// Whether it is root.
    pub root: bool,
    /// Whether it may make interfaces (`CAP_NET_ADMIN`).
    pub admin: bool,
}

/// A program that a bench needs.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Program {
    /// Where it should be.
    pub path: PathBuf,
    /// Whether it is there.
    pub there: bool,
}

/// A bus that was named.
#[derive(Clone, Debug)]
pub struct Bus {
    /// What is required of it.
    pub target: Target,
    /// Its cells; `None` without a skin.
    pub cells: Option<BTreeSet<CellId>>,
    /// Whether its cells are to answer with sums.
    pub sums: bool,
    /// The interface of its name.
    pub interface: Option<Interface>,
    /// What was received on it; `None` when it was not opened, or why it could not be.
    pub heard: Result<Option<Heard>, String>,
}

impl Bus {
    /// The buses of a skin.
    #[must_use]
    pub fn of_skin(file: &OsStr, skin: &Skin) -> Vec<Self> {
        let of = |(index, target): (usize, Target)| Self {
            cells: Some(skin.cells_of(index).map(|cell| cell.node).collect()),
            sums: skin.buses.get(index).is_some_and(|bus| bus.reply != Reply::Torque),
            ..Self::of(target)
        };
        Target::of_skin(file, skin).into_iter().enumerate().map(of).collect()
    }

    /// A bus that was named.
    #[must_use]
    pub fn named(name: &str) -> Self {
        Self::of(Target::named(name))
    }

    /// One that has not been looked at yet.
    const fn of(target: Target) -> Self {
        Self { target, cells: None, sums: false, interface: None, heard: Ok(None) }
    }
}

/// What was received on a bus.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct Heard {
    /// Whether another gateway sends on it.
    pub gateway: bool,
    /// Which cells do.
    pub cells: BTreeSet<CellId>,
}
