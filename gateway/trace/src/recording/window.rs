//! Orders messages by time: each waits briefly before it is written.
//!
//! ```text
//! topics ──> write ──> [ waiting ] ──> release ──> file, in order of log_time
//! ```
//!
//! Receivers and the loop deliver messages in turn, so only the messages of one topic arrive in order. The `log_time`
//! of a message is its own time, or later if the file has already passed that, so that a file is always ordered by
//! `log_time`. The message's own time is its `publish_time`. The order of one topic is never changed.

use std::io::{self, Write};

use super::account::MessageCount;
use super::file::{Channel, FileWriter};
use crate::ros2::Message;

/// The time for which a message waits for older ones, in ns.
pub const WINDOW_NS: u64 = 40_000_000;
/// The maximum number of waiting messages: more than a second of three full buses.
const MESSAGES: usize = 65_536;
/// The maximum size of waiting messages, in bytes.
const BYTES: usize = 16 << 20;
/// The initial size of each buffer, in bytes. Growth while a file was blocked is given back.
const INITIAL_BYTES: usize = 1 << 20;

/// A waiting message.
#[derive(Clone, Copy, Debug)]
struct WaitingMessage {
    /// The position in the order of the file, in ns since 1970.
    log_nanos: u64,
    /// The message's own time.
    nanos: u64,
    /// The range of its bytes in the buffer.
    begin: usize,
    end: usize,
    channel: u16,
    sequence: u32,
    is_frame: bool,
}

/// Messages that wait to be written, for one file after the other.
#[derive(Debug)]
pub struct ReorderWindow {
    waiting: Vec<WaitingMessage>,
    bytes: Vec<u8>,
    /// The latest position of each channel.
    latest: Vec<u64>,
    /// The recorder's time.
    now: u64,
    /// The position of the last written message.
    released: u64,
    /// The number of messages that arrived after later ones were written.
    late: u64,
    buffers: (Vec<u8>, Vec<u8>),
}

impl Default for ReorderWindow {
    /// Returns an empty window. Its memory is written to once, so that a recorder occupies it from its start on, and
    /// not when it is late for the first time.
    fn default() -> Self {
        let bytes = || {
            let mut bytes = vec![1; INITIAL_BYTES];
            bytes.clear();
            bytes
        };
        let none = WaitingMessage { log_nanos: 1, nanos: 1, begin: 0, end: 0, channel: 0, sequence: 0, is_frame: false };
        let mut waiting = vec![none; INITIAL_BYTES / size_of::<WaitingMessage>()];
        waiting.clear();
        Self {
            waiting,
            bytes: bytes(),
            latest: Vec::new(),
            now: 0,
            released: 0,
            late: 0,
            buffers: (Vec::new(), bytes()),
        }
    }
}

impl ReorderWindow {
    /// Begins the order of another file at `now`, in ns since 1970. Waiting messages are dropped; the buffers stay
    /// allocated.
    pub fn begin(&mut self, now: u64) {
        self.waiting.clear();
        self.bytes.clear();
        self.latest.clear();
        (self.now, self.released) = (now, 0);
    }

    /// Adds a message with its own time, in ns since 1970.
    pub fn write<M: Message>(&mut self, channel: &mut Channel, nanos: u64, message: &M) {
        self.write_at(channel, nanos, nanos, message);
    }

    /// Adds a message whose position in the file, `at`, differs from its own time.
    pub fn write_at<M: Message>(&mut self, channel: &mut Channel, at: u64, nanos: u64, message: &M) {
        let id = usize::from(channel.id());
        if self.latest.len() <= id {
            self.latest.resize(id + 1, 0);
        }
        // Without this limit, a time in the future would delay all other messages.
        let mut at = at.min(self.now.saturating_add(WINDOW_NS));
        if let Some(latest) = self.latest.get_mut(id) {
            at = at.max(*latest);
            *latest = at;
        }
        message.encode_into(&mut self.buffers.0);
        let begin = self.bytes.len();
        self.bytes.extend_from_slice(&self.buffers.0);
        let end = self.bytes.len();
        let (channel, sequence, is_frame) = channel.next();
        self.waiting.push(WaitingMessage { log_nanos: at, nanos, begin, end, channel, sequence, is_frame });
    }

    /// Returns the latest position of a channel's messages; 0 without messages.
    #[must_use]
    pub fn latest(&self, channel: &Channel) -> u64 {
        self.latest.get(usize::from(channel.id())).copied().unwrap_or_default()
    }

    /// Returns the number of waiting messages.
    #[must_use]
    pub fn count(&self) -> MessageCount {
        count(&self.waiting)
    }

    /// Returns the number of messages that arrived after later ones were written.
    #[must_use]
    pub const fn late(&self) -> u64 {
        self.late
    }

    /// Sets the time. If the clock was set back, all waiting messages are written first, and a new order begins.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written, as all methods below do.
    pub fn set_time<W: Write>(&mut self, now: u64, file: &mut FileWriter<W>) -> io::Result<MessageCount> {
        let written = if now < self.now {
            let written = self.release_all(file)?;
            self.latest.clear();
            self.released = 0;
            written
        } else {
            MessageCount::default()
        };
        self.now = now;
        Ok(written)
    }

    /// Writes the messages that have waited long enough, and the older half if too many wait. Returns their number.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn release<W: Write>(&mut self, file: &mut FileWriter<W>) -> io::Result<MessageCount> {
        self.sort();
        let until = self.now.saturating_sub(WINDOW_NS);
        let due = self.waiting.partition_point(|it| it.log_nanos <= until);
        let due = if self.is_full() { due.max(self.waiting.len() / 2) } else { due };
        self.write_out(due, file)
    }

    /// Returns true if a limit is reached.
    #[must_use]
    pub const fn is_full(&self) -> bool {
        self.waiting.len() >= MESSAGES || self.bytes.len() >= BYTES
    }

    /// Writes all waiting messages. Returns their number.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn release_all<W: Write>(&mut self, file: &mut FileWriter<W>) -> io::Result<MessageCount> {
        self.sort();
        self.write_out(self.waiting.len(), file)
    }

    /// Sorts the messages. Those of the same position keep their order of arrival.
    fn sort(&mut self) {
        self.waiting.sort_by_key(|it| it.log_nanos);
    }

    /// Writes the first `due` messages.
    fn write_out<W: Write>(&mut self, due: usize, file: &mut FileWriter<W>) -> io::Result<MessageCount> {
        let Self { waiting, bytes, released, late, buffers: (_, kept), .. } = self;
        let written = waiting.get(..due).unwrap_or_default();
        for it in written {
            *late += u64::from(it.log_nanos < *released);
            *released = it.log_nanos.max(*released);
            let data = bytes.get(it.begin..it.end).unwrap_or_default();
            file.put((it.channel, it.sequence), (*released, it.nanos), data)?;
        }
        let written = count(written);
        waiting.drain(..due);
        kept.clear();
        for it in waiting.iter_mut() {
            let begin = kept.len();
            kept.extend_from_slice(bytes.get(it.begin..it.end).unwrap_or_default());
            (it.begin, it.end) = (begin, kept.len());
        }
        std::mem::swap(bytes, kept);
        if bytes.len() < INITIAL_BYTES {
            kept.clear();
            kept.shrink_to(INITIAL_BYTES);
            bytes.shrink_to(INITIAL_BYTES);
            waiting.shrink_to(INITIAL_BYTES / size_of::<WaitingMessage>());
        }
        Ok(written)
    }
}

fn count(messages: &[WaitingMessage]) -> MessageCount {
    let frames = messages.iter().filter(|it| it.is_frame).count() as u64;
    MessageCount { frames, others: messages.len() as u64 - frames }
}

#[cfg(test)]
mod tests;
