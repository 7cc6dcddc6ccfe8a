//! An exchange: packets followed by a sync, and the cell's packets until it answers the sync.

use protocol::can::Frame;
use protocol::message::{Heartbeat, Message, State};
use protocol::packet::Epoch;
use protocol::time::{Micros, Span};

use super::{ANSWER_TIMEOUT, CellPacket, SYNC_ANSWER_GRACE, Session};
use crate::bus::StopReason;

/// The packets and heartbeats that a cell sent during an exchange.
#[derive(Clone, Debug)]
pub(crate) struct Exchange {
    /// The time at which the bench's first packet was completely on the bus.
    pub(crate) at: Micros,
    /// The cell's packets, without heartbeats.
    pub(crate) answers: Vec<CellPacket>,
    /// The number of heartbeats that came.
    pub(crate) beats: usize,
    /// The heartbeat that answers the sync, and its epoch byte.
    pub(crate) beat: Option<(Heartbeat, Epoch)>,
}

impl Exchange {
    /// Returns true if the cell answered only the sync.
    pub(crate) fn is_silent(&self) -> bool {
        self.answers.is_empty()
    }

    pub(crate) fn state(&self) -> State {
        self.beat.map(|(beat, _)| beat.state).unwrap_or_default()
    }
}

impl Session<'_> {
    /// Sends frames and then a sync, and collects packets until the sync is answered.
    pub(crate) fn exchange_frames(&mut self, frames: &[Frame]) -> Result<Exchange, StopReason> {
        self.begin_exchange();
        let at = self.send(frames)?;
        self.finish_exchange(at)
    }

    /// Sends packets and then a sync, and collects packets until the sync is answered.
    pub(crate) fn exchange_messages(&mut self, messages: &[Message]) -> Result<Exchange, StopReason> {
        self.begin_exchange();
        let at = self.send_messages(messages)?;
        self.finish_exchange(at)
    }

    /// Sends a sync, and returns the result of the exchange.
    fn finish_exchange(&mut self, at: Micros) -> Result<Exchange, StopReason> {
        let sync = self.send_messages(&[Message::Sync])?;
        let is_answer = |heard: &CellPacket| heard.heartbeat_and_epoch().is_some() && heard.at >= sync;
        let answered = self.wait_for_answer(sync)?;
        self.check("CMD-3", answered, || {
            "the cell must answer a sync with a heartbeat, but it sent none".to_owned()
        });
        let beats =
            |it: &Self| it.answers().iter().filter(|heard| heard.heartbeat_and_epoch().is_some()).count();
        if self.answers().len() == beats(self) || self.known.senses {
            // A regular heartbeat may have come between, and a faulty cell may answer later.
            self.receive_for(SYNC_ANSWER_GRACE)?;
        }
        let first = self.answers().iter().find(|heard| is_answer(heard)).copied();
        if let (Some(first), 1) = (first, beats(self)) {
            self.record_answer_time("heartbeat to sync", sync, first.at);
        }
        let torque = self.answers().iter().rposition(|heard| heard.torque().is_some());
        if let Some(torque) = torque {
            let after = |it: &Self| {
                it.answers().iter().skip(torque).any(|heard| heard.heartbeat_and_epoch().is_some())
            };
            if !after(self) {
                self.receive_for(Span::from_millis(20))?;
            }
            let is_after = after(self);
            self.check("CMD-3", is_after, || {
                "the heartbeat that answers a sync must follow the torque message, but the cell sent it first"
                    .to_owned()
            });
        }
        let beat = self
            .answers()
            .iter()
            .rev()
            .find_map(|heard| heard.heartbeat_and_epoch().map(|(beat, epoch)| (*beat, epoch)));
        let came = beats(self);
        let answers =
            self.answers().iter().filter(|heard| heard.heartbeat_and_epoch().is_none()).copied().collect();
        self.mark_packets_expected();
        let exchange = Exchange { at, answers, beats: came, beat };
        self.check_reported_state(&exchange);
        Ok(exchange)
    }

    /// Waits for the heartbeat that answers a sync, and returns true if one comes. Waits for another one if the first
    /// may be a regular one.
    fn wait_for_answer(&mut self, sync: Micros) -> Result<bool, StopReason> {
        let until = sync + ANSWER_TIMEOUT;
        loop {
            let epoch = self.known.epoch.filter(|_| !self.clock.other_epochs);
            let beats = self
                .answers()
                .iter()
                .filter(|heard| heard.at >= sync)
                .filter_map(CellPacket::heartbeat_and_epoch);
            let (mut any, mut right) = (false, false);
            for (_, of) in beats {
                // A heartbeat that was due before the cell processed the joints has the previous epoch.
                (any, right) = (true, right || epoch.is_none_or(|epoch| of.0 == epoch));
            }
            if right && !self.life.accounts.is_heartbeat_missing(self.bus.now()) {
                return Ok(true);
            }
            if self.bus.now() >= until {
                // Missing heartbeats are not awaited again.
                self.life.accounts.excuse_missing_heartbeats(self.bus.now());
                self.clock.other_epochs |= any && !right;
                return Ok(any);
            }
            self.process_next_frame(until)?;
        }
    }
}
