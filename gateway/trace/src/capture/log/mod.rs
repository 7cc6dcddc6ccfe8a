//! Reading and writing captures as candump text.

mod clock;
mod console;
mod read;
mod write;

pub(super) use clock::Clock;
pub use clock::Remark;
pub use read::MAX_LINE_BYTES;
pub(super) use read::{LogReader, known_time};
#[cfg(test)]
mod tests;

pub use write::{LogStyle, LogWriter, OmittedProperties, TimeDigits, WriteOutcome};
