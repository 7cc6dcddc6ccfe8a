//! The cells of a running bench that are there, and their answers to a request.

use std::collections::BTreeSet;
use std::time::Duration;

use model::decode::Decoded;
use protocol::bus::BusError;
use protocol::id::CellId;
use protocol::message::{Answer, Message, NetworkPage, State};

use crate::bus::listen::Listener;

/// What was received of the cells that a packet is for.
#[derive(Debug)]
pub struct Answers {
    only: Option<CellId>,
    tag: Option<u8>,
    present: BTreeSet<CellId>,
    received: Vec<(CellId, Answer)>,
}

impl Answers {
    /// Of one cell, or of all; `tag` is that of the request, none if the packet asks for no answer.
    #[must_use]
    pub const fn new(only: Option<CellId>, tag: Option<u8>) -> Self {
        Self { only, tag, present: BTreeSet::new(), received: Vec::new() }
    }

    /// Waits a moment for packets, and takes them.
    ///
    /// # Errors
    /// When the bus is down, gone or closed.
    pub fn hear(&mut self, listener: &mut Listener) -> Result<(), BusError> {
        listener.hear(Duration::from_millis(20))?;
        for (_, decoded) in listener.decoded() {
            if let Decoded::Message(message) = decoded {
                self.take(&message);
            }
        }
        Ok(())
    }

    /// Takes one packet.
    pub fn take(&mut self, message: &Message) {
        let Some(from) = message.sender().filter(|&from| self.only.is_none_or(|only| only == from)) else {
            return;
        };
        if let Message::Network { page: NetworkPage::Heartbeat(heartbeat), .. } = message
            && heartbeat.state.has(State::CLAIMING)
        {
            // It has not got that node id yet.
            return;
        }
        if let Message::Configured { tag, answer, .. } = *message
            && self.tag == Some(tag)
        {
            self.received.push((from, answer));
        }
        self.present.insert(from);
    }

    /// The cells that are there, whether they answered or not.
    #[must_use]
    pub const fn present(&self) -> &BTreeSet<CellId> {
        &self.present
    }

    /// The answers, in the order of their arrival.
    #[must_use]
    pub fn received(&self) -> &[(CellId, Answer)] {
        &self.received
    }

    /// Those that are there and have not answered, or the one that is asked.
    #[must_use]
    pub fn missing(&self) -> BTreeSet<CellId> {
        let answered = |cell: &CellId| self.received.iter().any(|(from, _)| from == cell);
        self.present.iter().copied().chain(self.only).filter(|cell| !answered(cell)).collect()
    }
}
