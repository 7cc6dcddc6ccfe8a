//! Counters of a bus: frames by kind, and unusable frames by cause.

use protocol::id::Kind;
use protocol::packet::PacketError;

/// An unusual property of a received frame. Each has a counter and a name.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
#[repr(usize)]
pub enum FrameEvent {
    /// Wrong length or format.
    Length,
    /// Wrong CRC.
    Crc,
    /// A kind, page, command or count that does not exist.
    Meaning,
    /// The first segment of a classic packet without the second.
    Incomplete,
    /// A remote frame, a 29-bit identifier, or a frame with an unused identifier that is not a packet.
    Foreign,
    /// The driver's report of a bus error.
    ErrorFrame,
    /// A frame from a node that the skin does not have, or of a kind that this bus does not use.
    UnknownNode,
    /// A torque for an epoch that has passed.
    StaleTorque,
    /// A second torque of one cell for one epoch.
    RepeatedTorque,
    /// A torque with a saturated word; it is used all the same.
    Saturated,
    /// A cell reports another cell with its node id.
    Duplicate,
    /// A frame of another gateway.
    OtherGateway,
    /// A write by another sender of a cell's replies or mode.
    OtherWriter,
}

impl From<PacketError> for FrameEvent {
    fn from(error: PacketError) -> Self {
        match error {
            PacketError::Length { .. } => Self::Length,
            PacketError::Crc { .. } => Self::Crc,
            PacketError::Incomplete | PacketError::Ambiguous => Self::Incomplete,
            PacketError::Foreign => Self::Foreign,
        }
    }
}

impl FrameEvent {
    /// All events, in the order of their counters.
    pub const ALL: [Self; 13] = [
        Self::Length,
        Self::Crc,
        Self::Meaning,
        Self::Incomplete,
        Self::Foreign,
        Self::ErrorFrame,
        Self::UnknownNode,
        Self::StaleTorque,
        Self::RepeatedTorque,
        Self::Saturated,
        Self::Duplicate,
        Self::OtherGateway,
        Self::OtherWriter,
    ];

    /// Returns the name of the event in tables and summaries.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Length => "wrong length",
            Self::Crc => "wrong CRC",
            Self::Meaning => "no meaning",
            Self::Incomplete => "incomplete packet",
            Self::Foreign => "foreign",
            Self::ErrorFrame => "error frame",
            Self::UnknownNode => "unknown node",
            Self::StaleTorque => "stale torque",
            Self::RepeatedTorque => "repeated torque",
            Self::Saturated => "saturated",
            Self::Duplicate => "duplicate number",
            Self::OtherGateway => "second gateway",
            Self::OtherWriter => "switched by others",
        }
    }
}

/// All counters of a bus.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Counters {
    received: [u64; Kind::ALL.len()],
    sent: [u64; Kind::ALL.len()],
    events: [u64; FrameEvent::ALL.len()],
    /// Number of epochs that have ended.
    pub epochs: u64,
    /// Number of ended epochs in which some reply was due.
    pub epochs_due: u64,
    /// Number of ended epochs in which replies were due and all of them arrived in time.
    pub epochs_complete: u64,
}

impl Counters {
    pub(super) fn count_frame(&mut self, kind: Kind, own: bool) {
        let counters = if own { &mut self.sent } else { &mut self.received };
        if let Some(counter) = counters.get_mut(kind as usize) {
            *counter += 1;
        }
    }

    pub(super) fn count_event(&mut self, event: FrameEvent) {
        if let Some(counter) = self.events.get_mut(event as usize) {
            *counter += 1;
        }
    }

    pub(super) const fn count_epoch(&mut self, due: bool, complete: bool) {
        self.epochs += 1;
        self.epochs_due += due as u64;
        self.epochs_complete += (due && complete) as u64;
    }

    /// Returns the number of packets of a kind that other senders sent.
    #[must_use]
    pub fn received_count(&self, kind: Kind) -> u64 {
        self.received.get(kind as usize).copied().unwrap_or(0)
    }

    /// Returns the number of packets of a kind that this gateway sent, as read back from the bus.
    #[must_use]
    pub fn sent_count(&self, kind: Kind) -> u64 {
        self.sent.get(kind as usize).copied().unwrap_or(0)
    }

    /// Returns the number of occurrences of an event.
    #[must_use]
    pub fn event_count(&self, event: FrameEvent) -> u64 {
        self.events.get(event as usize).copied().unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn epochs_and_packets_are_counted_by_what_they_are() {
        let mut counters = Counters::default();
        [(false, false), (true, false), (true, true), (false, true)]
            .into_iter()
            .for_each(|(due, complete)| counters.count_epoch(due, complete));
        assert_eq!((counters.epochs, counters.epochs_due, counters.epochs_complete), (4, 2, 1));
        counters.count_frame(Kind::Torque, false);
        counters.count_frame(Kind::Torque, false);
        counters.count_frame(Kind::Command, true);
        let of = |kind| (counters.received_count(kind), counters.sent_count(kind));
        assert_eq!([Kind::Torque, Kind::Command].map(of), [(2, 0), (0, 1)]);
    }
}
