//! Captures as candump text.

mod read;
mod write;

pub use read::LONGEST;
pub(super) use read::LogReader;
pub use write::{Digits, LogWriter, Style, Wrote};
