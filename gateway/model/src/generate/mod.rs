//! `skinbus skin generate`: describes a skin of hexagonal cells on a robot's arm.
//!
//! The cells lie in rings around the upper arm and the forearm, each ring turned by half a cell against
//! the next, so that neighbours are a hexagon's neighbours. The result is the text of a `skin.toml`.

mod arm;
mod text;

pub use protocol::can::Format;
use protocol::document::DocumentError;
use protocol::id::CellId;
use protocol::skin::Skin;
use thiserror::Error;

/// What to describe.
#[derive(Clone, Debug, PartialEq)]
pub struct Target {
    /// The robot that wears the skin.
    pub robot: Robot,
    /// How many cells, 1 to 254 a bus.
    pub cells: usize,
    /// How many buses; cells of one bus lie together.
    pub buses: usize,
    /// Joint broadcasts in a second; must divide the 500 Hz of the control loop.
    pub broadcast_hz: f64,
    /// What the cells answer with.
    pub reply: Reply,
    /// What their packets travel in.
    pub format: Format,
}

impl Default for Target {
    fn default() -> Self {
        Self {
            robot: Robot::Ur5,
            cells: 253,
            buses: 1,
            broadcast_hz: 62.5,
            reply: Reply::Torque,
            format: Format::Fd,
        }
    }
}

/// A robot whose arm is known.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Robot {
    /// Universal Robots UR5
    Ur5,
}

/// What the cells answer with.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Reply {
    /// Each cell its own torque
    Torque,
    /// Sums along the tree
    Sum,
}

/// Why a skin cannot be described.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum GenerateError {
    /// More cells than the buses have node ids for.
    #[error(
        "{cells} cells do not fit on {}: a bus has {most} node ids; use --buses {needed}",
        if *.buses == 1 { "one bus".to_owned() } else { format!("{buses} buses") },
        most = CellId::COUNT
    )]
    TooMany {
        /// Requested cells.
        cells: usize,
        /// Requested buses.
        buses: usize,
        /// Buses that this takes.
        needed: usize,
    },
    /// Fewer cells than buses, or none.
    #[error("{cells} cells on {buses} buses: every bus needs at least one")]
    TooFew {
        /// Requested cells.
        cells: usize,
        /// Requested buses.
        buses: usize,
    },
    /// More cells than there is room for.
    #[error("{cells} cells do not fit on the arm, not even {min_mm} mm apart: ask for fewer")]
    NoRoom {
        /// Requested cells.
        cells: usize,
        /// The minimum distance in mm.
        min_mm: usize,
    },
    /// What came out is no skin: a number that was asked for cannot be.
    #[error(transparent)]
    Skin(#[from] DocumentError),
}

/// The text of a `skin.toml`; the same for the same target.
///
/// # Errors
/// When the cells do not fit on the buses or on the arm, or a number that was asked for cannot be.
pub fn generate(target: &Target) -> Result<String, GenerateError> {
    let (cells, buses) = (target.cells, target.buses);
    if buses == 0 || cells < buses {
        return Err(GenerateError::TooFew { cells, buses });
    }
    let needed = cells.div_ceil(CellId::COUNT);
    if needed > buses {
        // What would be refused with so many buses too is reported first.
        generate(&Target { buses: needed, ..*target })?;
        return Err(GenerateError::TooMany { cells, buses, needed });
    }
    let arm = match target.robot {
        Robot::Ur5 => arm::cover(&arm::UR5, cells, buses)?,
    };
    let text = text::toml(target, &arm);
    Skin::parse("generated skin", &text)?;
    Ok(text)
}

#[cfg(test)]
mod tests;
