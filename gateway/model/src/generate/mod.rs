//! `skinbus skin generate`: describes a skin of hexagonal cells on a robot's arm.
//!
//! The cells lie in rings around the upper arm and the forearm, each ring turned by half a cell against the next, so
//! that a cell's neighbours are those of a hexagonal grid. The result is the text of a `skin.toml`.

mod arm;
mod text;

pub use protocol::can::Format;
use protocol::document::DocumentError;
use protocol::id::CellId;
use protocol::skin::Skin;
use thiserror::Error;

/// The robot, the size and the timing of a skin to generate.
#[derive(Clone, Debug, PartialEq)]
pub struct SkinRequest {
    /// The robot that wears the skin.
    pub robot: RobotModel,
    /// Number of cells, 1 to 254 per bus.
    pub cells: usize,
    /// Number of buses; the cells of one bus are adjacent.
    pub buses: usize,
    /// Joint broadcasts per second; must divide the control loop's 500 Hz.
    pub broadcast_hz: f64,
    /// Kind of reply that the cells send to joints.
    pub reply: ReplyMode,
    /// Frame format of the cells' packets.
    pub format: Format,
}

impl Default for SkinRequest {
    fn default() -> Self {
        Self {
            robot: RobotModel::Ur5,
            cells: 253,
            buses: 1,
            broadcast_hz: 62.5,
            reply: ReplyMode::Torque,
            format: Format::Fd,
        }
    }
}

/// A robot with a known arm.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum RobotModel {
    /// Universal Robots UR5
    Ur5,
}

/// The kind of reply that the cells send to joints.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum ReplyMode {
    /// Each cell its own torque
    Torque,
    /// Sums along the tree
    Sum,
}

/// The error for a skin that cannot be generated.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum GenerateError {
    /// There are more cells than the buses have node ids.
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
        /// Number of buses needed.
        needed: usize,
    },
    /// There are fewer cells than buses, or no cells or buses.
    #[error("{cells} cells are too few for {buses} buses: every bus needs at least one cell")]
    TooFew {
        /// Requested cells.
        cells: usize,
        /// Requested buses.
        buses: usize,
    },
    /// There are more cells than fit on the arm.
    #[error("{cells} cells do not fit on the arm, even at a spacing of {min_mm} mm: use fewer cells")]
    NoRoom {
        /// Requested cells.
        cells: usize,
        /// The minimum distance in mm.
        min_mm: usize,
    },
    /// The generated text is not a valid skin: a requested number is out of range.
    #[error(transparent)]
    Skin(#[from] DocumentError),
}

/// Returns the text of a `skin.toml`; equal targets give equal texts.
///
/// # Errors
/// Returns [`GenerateError`] if the cells do not fit on the buses or on the arm, or if a requested number is out of
/// range.
pub fn generate(target: &SkinRequest) -> Result<String, GenerateError> {
    let (cells, buses) = (target.cells, target.buses);
    if buses == 0 || cells < buses {
        return Err(GenerateError::TooFew { cells, buses });
    }
    let needed = cells.div_ceil(CellId::COUNT);
    if needed > buses {
        // An error that more buses would not fix is reported first.
        generate(&SkinRequest { buses: needed, ..*target })?;
        return Err(GenerateError::TooMany { cells, buses, needed });
    }
    let arm = match target.robot {
        RobotModel::Ur5 => arm::place_cells(&arm::UR5, cells, buses)?,
    };
    let text = text::skin_toml(target, &arm);
    Skin::parse("generated skin", &text)?;
    Ok(text)
}

#[cfg(test)]
mod tests;
