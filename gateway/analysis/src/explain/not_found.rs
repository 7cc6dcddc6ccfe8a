//! Why a capture has nothing to explain.

use thiserror::Error;

/// Why there is nothing to explain.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum NotFound {
    /// No bus of the capture is one of the skin's.
    #[error("none of its buses ({capture}) is one of the skin's ({skin})")]
    Buses {
        /// Those of the capture.
        capture: String,
        /// Those of the skin.
        skin: String,
    },
    /// There are no joints at all.
    #[error("there are no joints on {buses}, and cells answer nothing else")]
    Joints {
        /// The skin's buses that are in the capture.
        buses: String,
    },
    /// The joints are those of another robot.
    #[error("{}", another_robot(bus, *came, *chain))]
    Robot {
        /// The bus.
        bus: String,
        /// Joints that came.
        came: usize,
        /// Joints of the skin's chain.
        chain: usize,
    },
    /// The epoch is not there, or not so often, or not so late.
    #[error("there are no joints {requested}; there are {runs}")]
    Epoch {
        /// The requested joints.
        requested: String,
        /// Epochs that are there, in their order, and from when to when.
        runs: String,
    },
}

/// Says that a skin is of another robot than a bus' joints.
#[must_use]
pub fn another_robot(bus: &str, came: usize, chain: usize) -> String {
    format!(
        "the joints on {bus} are {came}, and the skin's chain there has {chain}: it is the skin of another robot, name the right one"
    )
}
