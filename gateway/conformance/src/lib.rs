//! Takes one cell through the requirements of its documents: whoever wrote it, and wherever it runs.
//!
//! ```text
//!   checks ──> Session ──> Bus ─┬─ Live: a socket, the kernel's time stamps
//!      |          |             └─ a cell in virtual time (tests)
//!      '─ Findings: passed, failed with frames, not applicable, not tested
//! ```
//!
//! Checks send packets and look at what comes; expected values come from the documents, torques to the bit, J from a
//! computation in floating point. Nothing here uses the code of a cell.

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
pub use saved::Saved;
pub use session::Session;
