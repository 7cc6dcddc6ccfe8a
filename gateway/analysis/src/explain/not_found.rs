//! The errors of a capture that has nothing to explain.

use thiserror::Error;

/// The reason why there is nothing to explain.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum NotFound {
    /// The capture has none of the skin's buses.
    #[error("none of its buses ({capture}) is one of the skin's ({skin})")]
    Buses {
        /// The buses of the capture.
        capture: String,
        /// The buses of the skin.
        skin: String,
    },
    /// The capture has no joints.
    #[error("there are no joints on {buses}, and cells answer only joints")]
    Joints {
        /// The skin's buses that are in the capture.
        buses: String,
    },
    /// The joints belong to another robot.
    #[error("{}", another_robot(bus, *came, *chain))]
    Robot {
        /// The bus.
        bus: String,
        /// Number of joints in the packet.
        came: usize,
        /// Number of joints of the skin's chain.
        chain: usize,
    },
    /// The requested epoch does not occur, or not often or late enough.
    #[error("there are no joints {requested}; there are {runs}")]
    Epoch {
        /// The requested joints.
        requested: String,
        /// The epochs that occur, in order, with their times.
        runs: String,
    },
}

/// Returns the text for a skin and a bus' joints that belong to different robots.
#[must_use]
pub fn another_robot(bus: &str, came: usize, chain: usize) -> String {
    format!(
        "{bus} carries {came} joints, but the skin's chain on it has {chain}: the skin is of another robot, name the right one"
    )
}
