//! Sorts messages by time: each message waits a short time for older ones before it is written.
//!
//! ```text
//! topics ──> write ──> [ waiting ] ──> write_due ──> file, in order of log_time
//! ```
//!
//! The receivers of the buses and the loop deliver messages in turn, so only the messages of one topic arrive in order.
//! The `publish_time` of a message is its own time. Its `log_time` is the same, unless messages of later times were
//! already written: then it is the time of the last one. A file is therefore always ordered by `log_time`, and the
//! order within a topic never changes.

use std::io::{self, Write};

use super::account::MessageCount;
use super::file::{Channel, FileWriter};
use crate::ros2::Message;

/// The time for which a message waits for older ones, in ns.
pub const REORDER_WINDOW_NS: u64 = 40_000_000;
/// The maximum number of waiting messages: those of three full buses in more than a second.
const MAX_MESSAGES: usize = 65_536;
/// The maximum size of waiting messages, in bytes.
const MAX_BYTES: usize = 16 << 20;
/// The initial size of each buffer, in bytes. A buffer that grew while the file was blocked is shrunk to it again.
const INITIAL_BYTES: usize = 1 << 20;

/// A waiting message.
#[derive(Clone, Copy, Debug)]
struct WaitingMessage {
    /// The time by which the message is sorted in the file, in ns since 1970.
    log_nanos: u64,
    /// The message's own time.
    nanos: u64,
    /// The range of the encoded message in the buffer.
    begin: usize,
    end: usize,
    channel: u16,
    sequence: u32,
    is_frame: bool,
}

/// The messages that wait to be written to a file. When a file ends, the next one uses the same window.
#[derive(Debug)]
pub struct ReorderWindow {
    waiting: Vec<WaitingMessage>,
    bytes: Vec<u8>,
    /// The latest position in time of each channel's messages, in ns since 1970.
    latest: Vec<u64>,
    /// The time of the recorder, in ns since 1970.
    now: u64,
    /// The position in time of the message that was written last, in ns since 1970.
    released: u64,
    /// The number of messages that arrived after messages of later times had been written.
    late: u64,
    buffers: (Vec<u8>, Vec<u8>),
}

impl Default for ReorderWindow {
    /// Returns an empty window. All of its memory is written to at once, so that the memory is allocated when the
    /// recorder starts and not when many messages wait for the first time.
    fn default() -> Self {
        let bytes = || {
            let mut bytes = vec![1; INITIAL_BYTES];
            bytes.clear();
            bytes
        };
        let none = WaitingMessage {
            log_nanos: 1,
            nanos: 1,
            begin: 0,
            end: 0,
            channel: 0,
            sequence: 0,
            is_frame: false,
        };
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
    /// Begins another file at the time `now`, in ns since 1970. Waiting messages are dropped. The buffers stay
    /// allocated.
    pub fn begin(&mut self, now: u64) {
        self.waiting.clear();
        self.bytes.clear();
        self.latest.clear();
        (self.now, self.released) = (now, 0);
    }

    /// Adds a message of a channel with its own time, in ns since 1970.
    pub fn write<M: Message>(&mut self, channel: &mut Channel, nanos: u64, message: &M) {
        self.write_sorted_at(channel, nanos, nanos, message);
    }

    /// Adds a message that is sorted in the file by the time `at` instead of its own time `nanos`, both in ns since
    /// 1970.
    pub fn write_sorted_at<M: Message>(&mut self, channel: &mut Channel, at: u64, nanos: u64, message: &M) {
        let id = usize::from(channel.id());
        if self.latest.len() <= id {
            self.latest.resize(id + 1, 0);
        }
        // Without this limit, a message with a time in the future would delay all later messages of its channel.
        let mut at = at.min(self.now.saturating_add(REORDER_WINDOW_NS));
        if let Some(latest) = self.latest.get_mut(id) {
            at = at.max(*latest);
            *latest = at;
        }
        message.encode_into(&mut self.buffers.0);
        let begin = self.bytes.len();
        self.bytes.extend_from_slice(&self.buffers.0);
        let end = self.bytes.len();
        let (channel, sequence, is_frame) = channel.next_message();
        self.waiting.push(WaitingMessage { log_nanos: at, nanos, begin, end, channel, sequence, is_frame });
    }

    /// Returns the latest position in time of a channel's messages, in ns since 1970; 0 without messages.
    #[must_use]
    pub fn latest_ns(&self, channel: &Channel) -> u64 {
        self.latest.get(usize::from(channel.id())).copied().unwrap_or_default()
    }

    /// Returns the number of waiting messages.
    #[must_use]
    pub fn waiting_count(&self) -> MessageCount {
        count_messages(&self.waiting)
    }

    /// Returns the number of messages that arrived after messages of later times had been written.
    #[must_use]
    pub const fn late_messages(&self) -> u64 {
        self.late
    }

    /// Sets the time of the recorder. If the clock was set back, all waiting messages are written first, and sorting
    /// begins anew.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written, as all methods below do.
    pub fn set_time<W: Write>(&mut self, now: u64, file: &mut FileWriter<W>) -> io::Result<MessageCount> {
        let written = if now < self.now {
            let written = self.write_all(file)?;
            self.latest.clear();
            self.released = 0;
            written
        } else {
            MessageCount::default()
        };
        self.now = now;
        Ok(written)
    }

    /// Writes the messages that have waited long enough, and the older half of the others if too many wait. Returns the
    /// number of written messages.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn write_due<W: Write>(&mut self, file: &mut FileWriter<W>) -> io::Result<MessageCount> {
        self.sort();
        let until = self.now.saturating_sub(REORDER_WINDOW_NS);
        let due = self.waiting.partition_point(|it| it.log_nanos <= until);
        let due = if self.is_full() { due.max(self.waiting.len() / 2) } else { due };
        self.write_sorted(due, file)
    }

    /// Returns true if the number or the size of the waiting messages has reached its limit.
    #[must_use]
    pub const fn is_full(&self) -> bool {
        self.waiting.len() >= MAX_MESSAGES || self.bytes.len() >= MAX_BYTES
    }

    /// Writes all waiting messages. Returns their number.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn write_all<W: Write>(&mut self, file: &mut FileWriter<W>) -> io::Result<MessageCount> {
        self.sort();
        self.write_sorted(self.waiting.len(), file)
    }

    /// Sorts the waiting messages by their time. Messages with the same time keep the order in which they arrived.
    fn sort(&mut self) {
        self.waiting.sort_by_key(|it| it.log_nanos);
    }

    /// Writes the first `due` of the sorted messages.
    fn write_sorted<W: Write>(&mut self, due: usize, file: &mut FileWriter<W>) -> io::Result<MessageCount> {
        let Self { waiting, bytes, released, late, buffers: (_, kept), .. } = self;
        let written = waiting.get(..due).unwrap_or_default();
        for it in written {
            *late += u64::from(it.log_nanos < *released);
            *released = it.log_nanos.max(*released);
            let data = bytes.get(it.begin..it.end).unwrap_or_default();
            file.write_encoded((it.channel, it.sequence), (*released, it.nanos), data)?;
        }
        let written = count_messages(written);
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

fn count_messages(messages: &[WaitingMessage]) -> MessageCount {
    let frames = messages.iter().filter(|it| it.is_frame).count() as u64;
    MessageCount { frames, others: messages.len() as u64 - frames }
}

#[cfg(test)]
mod tests;
