//! Captures as candump text.

mod read;
mod write;

pub use read::LONGEST;
pub(super) use read::LogReader;
pub(crate) use read::read_some;
pub use write::{Digits, LogWriter, Style, Wrote};
