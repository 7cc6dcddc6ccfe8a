//! The interface between the topics of a recording and their destination: a file of a recording, or viewers that are
//! connected.

use std::io::{self, Write};

use super::file::{Channel, FileWriter};
use super::window::ReorderWindow;
use crate::ros2::Message;

/// A destination that topics are added to.
pub trait ChannelSink {
    /// Adds a channel for messages of a type, with metadata.
    ///
    /// # Errors
    /// Returns an error if a file cannot be written.
    fn add_channel<M: Message>(&mut self, topic: &str, facts: &[(&str, &str)]) -> io::Result<Channel>;
}

/// A destination of messages.
pub trait MessageSink {
    /// Adds a message that is sorted by the time `at` instead of its own time `nanos`, both in ns since 1970.
    fn write_sorted_at<M: Message>(&mut self, channel: &mut Channel, at: u64, nanos: u64, message: &M);

    /// Returns the latest position in time of a channel's messages, in ns since 1970; 0 without messages.
    fn latest_ns(&self, channel: &Channel) -> u64;

    /// Adds a message of a channel with its own time, in ns since 1970.
    fn write<M: Message>(&mut self, channel: &mut Channel, nanos: u64, message: &M) {
        self.write_sorted_at(channel, nanos, nanos, message);
    }
}

impl<W: Write> ChannelSink for FileWriter<W> {
    fn add_channel<M: Message>(&mut self, topic: &str, facts: &[(&str, &str)]) -> io::Result<Channel> {
        self.channel::<M>(topic, facts)
    }
}

impl MessageSink for ReorderWindow {
    fn write_sorted_at<M: Message>(&mut self, channel: &mut Channel, at: u64, nanos: u64, message: &M) {
        Self::write_sorted_at(self, channel, at, nanos, message);
    }

    fn latest_ns(&self, channel: &Channel) -> u64 {
        Self::latest_ns(self, channel)
    }
}
