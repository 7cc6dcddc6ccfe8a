//! Calibration: finds the places of cells on a robot from the readings of their accelerometers while the robot moves.
//!
//! ```text
//!   plan ─> motion ─> a robot, real or simulated ─> joints and sensors pages ─> observe ─> calibrate ─> result
//! ```
//!
//! | module | content |
//! |---|---|
//! | [`plan`], [`motion`] | the choice of a motion, and the positions of the joints during it |
//! | [`simulate`] | a skin of accelerometers in virtual time |
//! | [`observe`] | joint positions and readings, collected from the messages of a bus |
//! | [`mod@calibrate`] | the estimate of every cell, and the marks on doubtful ones |
//! | [`refusal`] | the reasons to refuse a recording |
//! | [`zero`] | zero offsets of the robot's joints |
//! | [`help`] | the motion that would determine a pose that the recorded motion did not |
//! | [`neighbors`] | positions improved by the distance of neighbours |
//! | [`result`], [`mod@write`] | the results, and a skin file with them |

pub mod calibrate;
mod cell;
mod each;
mod estimate;
pub mod help;
mod lag;
pub mod motion;
pub mod neighbors;
pub mod observe;
pub mod plan;
pub mod refusal;
pub mod result;
mod rounded;
mod settings;
mod shifts;
pub mod simulate;
mod smooth;
mod sums;
mod table;
pub mod write;
pub mod zero;

pub use calibrate::{Settings, calibrate};
pub use refusal::Refusal;
pub use result::Calibration;

#[cfg(test)]
mod tests;
