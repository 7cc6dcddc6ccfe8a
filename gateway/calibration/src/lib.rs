//! Where cells sit, from what their accelerometers feel while the robot moves.
//!
//! ```text
//!   plan ─> motion ─> a robot, real or simulated ─> joints and sensors pages ─> observe ─> calibrate ─> result
//! ```
//!
//! | module | what |
//! |---|---|
//! | [`plan`], [`motion`] | which motion to make, and where the joints are in it at a time |
//! | [`simulate`] | a skin of accelerometers in virtual time |
//! | [`observe`] | what is kept of the messages of a bus |
//! | [`mod@calibrate`] | the estimate of every cell, and which of them to distrust |
//! | [`refusal`] | why a recording says nothing that can be trusted |
//! | [`zero`] | zero offsets of the robot's joints |
//! | [`help`] | which motion would tell what was not determined |
//! | [`neighbors`] | positions made better by the distance of neighbours |
//! | [`result`], [`mod@write`] | what came out, and a skin file with it |

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
