//! Reading and writing captures as candump text.

mod clock;
mod console;
mod read;
mod write;

pub(super) use clock::Clock;
pub use clock::LogRemark;
pub use read::MAX_LINE_BYTES;
pub(super) use read::{LogReader, frame_time_in_line};
#[cfg(test)]
mod tests;

pub use write::{LogStyle, LogWriter, OmittedProperties, TimeDigits, WriteOutcome};
