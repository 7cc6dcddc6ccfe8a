//! The errors for a capture that does not contain the joints to explain.

use thiserror::Error;

/// The reason why the joints to explain were not found.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum JointsNotFound {
    /// The capture has none of the skin's buses.
    #[error(
        "the skin has none of the capture's buses ({capture}), only {skin}: name the skin of this capture"
    )]
    Buses {
        /// Names of the buses in the capture.
        capture: String,
        /// Names of the skin's buses.
        skin: String,
    },
    /// The capture has no joints on the skin's buses.
    #[error(
        "the capture contains no joints message on {buses}: record while a gateway runs the control loop"
    )]
    Joints {
        /// Names of the skin's buses that are in the capture.
        buses: String,
    },
    /// The joints belong to another robot.
    #[error("{}", other_robot_text(bus, *came, *chain))]
    Robot {
        /// Name of the bus.
        bus: String,
        /// Number of joints in the packet.
        came: usize,
        /// Number of joints of the skin's chain.
        chain: usize,
    },
    /// The requested epoch does not occur, occurs less often than requested, or occurs only before the requested time.
    #[error("the capture contains no joints message {requested}; it contains {runs}")]
    Epoch {
        /// Description of the requested joints.
        requested: String,
        /// The runs of epochs in the capture, in order, with their times.
        runs: String,
    },
}

/// Returns the text of the error for joints of `came` values, on a bus whose chain has `chain` joints.
#[must_use]
pub fn other_robot_text(bus: &str, came: usize, chain: usize) -> String {
    format!(
        "joints messages on {bus} have {came} positions, but the skin's chain on this bus has {chain} joints: name \
         the skin of this robot"
    )
}
