//! Packets with a sync after them: what came until the sync is answered.

use protocol::can::Frame;
use protocol::message::{Heartbeat, Message, State};
use protocol::packet::Epoch;
use protocol::time::{Micros, Span};

use super::{Heard, LINGER, PATIENT, Session};
use crate::bus::Stop;

/// What came of some packets with a sync after them.
#[derive(Clone, Debug)]
pub(crate) struct Exchange {
    /// When the first of our packets was on the bus as a whole.
    pub(crate) at: Micros,
    /// What the cell sent, but for heartbeats.
    pub(crate) answers: Vec<Heard>,
    /// How many heartbeats came.
    pub(crate) beats: usize,
    /// The heartbeat to the sync, and its epoch byte.
    pub(crate) beat: Option<(Heartbeat, Epoch)>,
}

impl Exchange {
    /// Whether the cell answered nothing but the sync.
    pub(crate) fn is_silent(&self) -> bool {
        self.answers.is_empty()
    }

    pub(crate) fn state(&self) -> State {
        self.beat.map(|(beat, _)| beat.state).unwrap_or_default()
    }
}

impl Session<'_> {
    /// Sends frames and then a sync, and collects what comes until the sync is answered.
    pub(crate) fn exchange(&mut self, frames: &[Frame]) -> Result<Exchange, Stop> {
        self.mark();
        let at = self.send(frames)?;
        self.finish(at)
    }

    /// The same with packets.
    pub(crate) fn exchange_all(&mut self, messages: &[Message]) -> Result<Exchange, Stop> {
        self.mark();
        let at = self.say(messages)?;
        self.finish(at)
    }

    /// A sync, and what came since the exchange began.
    fn finish(&mut self, at: Micros) -> Result<Exchange, Stop> {
        let sync = self.say(&[Message::Sync])?;
        let is_answer = |heard: &Heard| heard.beat().is_some() && heard.at >= sync;
        let answered = self.wait_for_answer(sync)?;
        self.check("CMD-3", answered, || "no heartbeat after a sync".to_owned());
        let beats = |it: &Self| it.answers().iter().filter(|heard| heard.beat().is_some()).count();
        if self.answers().len() == beats(self) || self.known.senses {
            // A regular heartbeat may have come between, and a cell that is wrong may answer later.
            self.idle(LINGER)?;
        }
        let first = self.answers().iter().find(|heard| is_answer(heard)).copied();
        if let (Some(first), 1) = (first, beats(self)) {
            self.note_time("heartbeat to sync", sync, first.at);
        }
        let torque = self.answers().iter().rposition(|heard| heard.torque().is_some());
        if let Some(torque) = torque {
            let after = |it: &Self| it.answers().iter().skip(torque).any(|heard| heard.beat().is_some());
            if !after(self) {
                self.idle(Span::from_millis(20))?;
            }
            let is_after = after(self);
            self.check("CMD-3", is_after, || "the heartbeat to a sync came before the torque".to_owned());
        }
        let beat =
            self.answers().iter().rev().find_map(|heard| heard.beat().map(|(beat, epoch)| (*beat, epoch)));
        let came = beats(self);
        let answers = self.answers().iter().filter(|heard| heard.beat().is_none()).copied().collect();
        self.consume();
        let exchange = Exchange { at, answers, beats: came, beat };
        self.look_at_state(&exchange);
        Ok(exchange)
    }

    /// Whether a heartbeat comes after a sync; if a regular one may have come instead, waits for another.
    fn wait_for_answer(&mut self, sync: Micros) -> Result<bool, Stop> {
        let until = sync + PATIENT;
        loop {
            let epoch = self.known.epoch.filter(|_| !self.clock.other_epochs);
            let beats = self.answers().iter().filter(|heard| heard.at >= sync).filter_map(Heard::beat);
            let (mut any, mut right) = (false, false);
            for (_, of) in beats {
                // One that was due before the cell came to the joints has the epoch before.
                (any, right) = (true, right || epoch.is_none_or(|epoch| of.0 == epoch));
            }
            if right && !self.life.accounts.is_one_missing(self.bus.now()) {
                return Ok(true);
            }
            if self.bus.now() >= until {
                // Others are not waited for again.
                self.life.accounts.give_up(self.bus.now());
                self.clock.other_epochs |= any && !right;
                return Ok(any);
            }
            self.pump(until)?;
        }
    }
}
