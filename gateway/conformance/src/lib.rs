//! Conformance tests: check one cell, of any author and on any hardware, against the requirements of the documents.
//!
//! ```text
//!   checks ──> Session ──> Bus ─┬─ Live: a socket, the kernel's time stamps
//!      |          |             └─ a cell in virtual time (tests)
//!      '─ Findings: passed, failed with frames, not applicable, not tested
//! ```
//!
//! Checks send packets and compare the cell's packets with expected values. The expected values follow the documents:
//! torques bit for bit, and J computed in floating point. This crate does not use any code of a cell.

mod arm;
pub mod bus;
mod checks;
pub mod findings;
pub mod live;
pub mod requirements;
mod saved;
mod session;
pub mod survey;
mod timing;
mod timings;

pub use checks::run;
pub use saved::SavedCell;
pub use session::Session;
