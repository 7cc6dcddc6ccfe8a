//! Collects the answers of the cells on a running bench to one request.

use std::collections::BTreeSet;
use std::time::Duration;

use model::decode::Decoded;
use protocol::bus::BusError;
use protocol::id::CellId;
use protocol::message::{Answer, Message, NetworkPage, State};

use crate::bus::listen::Listener;

/// Answers received from the cells that a request addresses, and the cells that are present.
#[derive(Debug)]
pub struct ReceivedAnswers {
    only: Option<CellId>,
    tag: Option<u8>,
    present: BTreeSet<CellId>,
    received: Vec<(CellId, Answer)>,
}

impl ReceivedAnswers {
    /// Collects answers of one cell (`only`) or of all cells. `tag` is the tag of the request, or `None` if the packet
    /// asks for no answer.
    #[must_use]
    pub const fn new(only: Option<CellId>, tag: Option<u8>) -> Self {
        Self { only, tag, present: BTreeSet::new(), received: Vec::new() }
    }

    /// Waits up to 20 ms for packets and records them.
    ///
    /// # Errors
    /// Returns [`BusError`] if the bus is down, gone or closed.
    pub fn receive(&mut self, listener: &mut Listener) -> Result<(), BusError> {
        listener.receive(Duration::from_millis(20))?;
        for (_, decoded) in listener.decoded_frames() {
            if let Decoded::Message(message) = decoded {
                self.record_message(&message);
            }
        }
        Ok(())
    }

    /// Records the sender of a packet as present. Keeps the packet if it answers the request.
    pub fn record_message(&mut self, message: &Message) {
        let Some(from) = message.sender().filter(|&from| self.only.is_none_or(|only| only == from)) else {
            return;
        };
        if let Message::Network { page: NetworkPage::Heartbeat(heartbeat), .. } = message
            && heartbeat.state.has(State::CLAIMING_NODE_ID)
        {
            // A claiming cell does not own its node id yet.
            return;
        }
        if let Message::Configured { tag, answer, .. } = *message
            && self.tag == Some(tag)
        {
            self.received.push((from, answer));
        }
        self.present.insert(from);
    }

    /// The cells that are present, including those that have not answered.
    #[must_use]
    pub const fn present_cells(&self) -> &BTreeSet<CellId> {
        &self.present
    }

    /// The answers, in the order of arrival.
    #[must_use]
    pub fn received_answers(&self) -> &[(CellId, Answer)] {
        &self.received
    }

    /// Returns the cells that have not answered, out of the present cells and the addressed cell.
    #[must_use]
    pub fn missing_cells(&self) -> BTreeSet<CellId> {
        let answered = |cell: &CellId| self.received.iter().any(|(from, _)| from == cell);
        self.present.iter().copied().chain(self.only).filter(|cell| !answered(cell)).collect()
    }
}
