//! The topics of a recording, as its player plays it: the messages of the file, unchanged, up to the player's position.

use std::path::PathBuf;
use std::sync::Arc;

use trace::capture::{CaptureError, MessageReader, RecordedMessage};

use super::hub::MessageHub;
use super::server::FoxgloveServer;

/// The time before a position whose messages are published after a jump, in ns, so that viewers show the state there.
/// Every topic has messages in it, except latched ones and notes.
const JUMP_HISTORY_NS: u64 = 500_000_000;
/// The time by which the position may advance at once, in ns: a step of playback at the maximum speed. More is a jump.
const MAX_STEP_NS: u64 = 10_000_000_000;
/// The number of messages at the beginning of a recording among which the latched ones are.
const MAX_FIRST_MESSAGES: usize = 4_096;

/// Publishes the messages of a recording that is played.
#[derive(Debug)]
pub(crate) struct PlayedTopics {
    hub: Arc<MessageHub>,
    reader: MessageReader,
    /// The number in the hub of each channel of the reader.
    channels: Vec<u32>,
    /// The position up to which messages were published, in ns since 1970; `None` if no viewer needed them.
    position: Option<u64>,
    /// The number of the player's jumps when messages were last published.
    jumps: u64,
    has_failed: bool,
}

impl PlayedTopics {
    /// Announces the topics of a recording to the viewers of a server.
    ///
    /// # Errors
    /// Returns [`CaptureError`] if the recording cannot be read.
    pub(crate) fn open(server: &FoxgloveServer, paths: &[PathBuf]) -> Result<Self, CaptureError> {
        let mut topics = Self {
            hub: server.hub(),
            reader: MessageReader::open(paths)?,
            channels: Vec::new(),
            position: None,
            jumps: 0,
            has_failed: false,
        };
        topics.announce_channels();
        topics.publish_first_latched_messages()?;
        Ok(topics)
    }

    /// Publishes the messages up to the player's position, in ns since 1970; at the end of the recording also those
    /// after the last frame. `jumps` is the number of the player's jumps so far.
    pub(crate) fn publish_until(&mut self, at: u64, is_end: bool, jumps: u64) {
        if self.has_failed {
            return;
        }
        let Err(error) = self.try_publish_until(at, is_end, jumps) else { return };
        // The pages tell of damage, too.
        self.has_failed = true;
        self.hub.warn(&format!("no more messages are sent: {error}"));
    }

    fn try_publish_until(&mut self, at: u64, is_end: bool, jumps: u64) -> Result<(), CaptureError> {
        if !self.hub.has_subscribers() {
            self.position = None;
            self.hub.publish_time(at);
            return Ok(());
        }
        let is_step = self.position.is_some_and(|from| from <= at && at - from <= MAX_STEP_NS);
        if !is_step || self.jumps != jumps {
            if self.position.is_some() {
                self.hub.clear_messages();
            }
            self.hub.publish_time(at);
            self.reader.seek(at.saturating_sub(JUMP_HISTORY_NS))?;
        }
        self.jumps = jumps;
        let until = if is_end { u64::MAX } else { at };
        while let Some(RecordedMessage { channel, log_nanos, message }) = self.reader.next_until(until)? {
            if let Some(known) = self.channels.get(channel) {
                self.hub.publish(*known, log_nanos, message);
            } else {
                let message = message.to_vec();
                self.announce_channels();
                if let Some(known) = self.channels.get(channel) {
                    self.hub.publish(*known, log_nanos, &message);
                }
            }
        }
        self.position = Some(at);
        self.hub.publish_time(at);
        Ok(())
    }

    fn announce_channels(&mut self) {
        for described in self.reader.channels().iter().skip(self.channels.len()) {
            self.channels.push(self.hub.add_channel(described.clone()));
        }
    }

    /// Publishes the latched messages at the beginning, such as the robot's description. A position may be far after
    /// them.
    fn publish_first_latched_messages(&mut self) -> Result<(), CaptureError> {
        let is_latched: Vec<_> = self.reader.channels().iter().map(|known| known.is_latched).collect();
        for _ in 0..MAX_FIRST_MESSAGES {
            let Some(RecordedMessage { channel, log_nanos, message }) = self.reader.next_until(u64::MAX)?
            else {
                break;
            };
            if let Some(known) = self.channels.get(channel).filter(|_| is_latched.get(channel) == Some(&true))
            {
                self.hub.publish(*known, log_nanos, message);
            }
        }
        Ok(())
    }
}
