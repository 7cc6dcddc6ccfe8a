//! The stage of a real replay: the machine's clock and open buses.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use protocol::bus::{BusError, SendError};
use protocol::can::Frame;
use protocol::message::{Message, State as Flags};
use protocol::packet::Epoch;

use super::hall::Hall;
use super::meet::mode;
use super::player::{Pace, Stage};
use super::reel::Open;
use super::report::Lockstep;
use super::start::Lane;
use super::{Options, ReplayError};
use crate::run::realtime;
use crate::setup::names;

/// How often it is looked whether somebody has said stop.
const LOOK_NS: u64 = 100_000_000;
/// How long it is waited for the next step, or an interface that is down.
const PAUSE: Duration = Duration::from_micros(100);
const DOWN: Duration = Duration::from_millis(50);
/// Cells of which none has answered for so long are asked again, for a frame may have been lost; and given up.
const REMIND: Duration = Duration::from_millis(500);
const PATIENCE: Duration = Duration::from_secs(3);
/// Joints are asked again so often when cells were too late for them.
const ASK_AGAIN: u32 = 16;
/// So often after joints for which that was in vain: then lateness is hardly the reason.
const ASK_AGAIN_IN_VAIN: u32 = 2;
/// The answers to that are waited for, so long the first time, before cells have a heartbeat to say as well.
const ANSWERS: Duration = Duration::from_millis(100);
/// So many times as long at most.
const LONGEST: u32 = 4;

/// The machine's clock, and buses.
#[derive(Debug)]
pub(super) struct Live {
    pub(super) lanes: Arc<Vec<Lane>>,
    pub(super) hall: Arc<Hall>,
    /// For people.
    pub(super) voice: Sender<String>,
    /// Cells that did not answer, and joints that were asked again.
    pub(super) lockstep: Lockstep,
    /// The buses on which to ask again was in vain the last time.
    pub(super) in_vain: BTreeSet<usize>,
    pub(super) down: BTreeSet<usize>,
}

impl Stage for Live {
    fn now(&self) -> u64 {
        realtime::now()
    }

    fn wait_until(&mut self, at: u64) {
        let asleep =
            at.saturating_sub(u64::try_from(self.hall.checks.options.spin.as_nanos()).unwrap_or(u64::MAX));
        while !self.hall.is_over() {
            let now = realtime::now();
            if now >= asleep {
                break;
            }
            realtime::sleep_until(asleep.min(now + LOOK_NS));
        }
        while realtime::now() < at && !self.hall.is_over() {
            core::hint::spin_loop();
        }
    }

    fn pause(&mut self) {
        std::thread::sleep(PAUSE);
    }

    fn is_over(&self) -> bool {
        self.hall.is_over()
    }

    fn announce(&mut self, lane: usize, round: Option<u64>, epoch: Epoch) {
        self.hall.judge().announce(lane, round, epoch);
    }

    fn send(&mut self, index: usize, frames: &[Frame]) -> Result<(), SendError> {
        let Some(lane) = self.lanes.get(index) else { return Ok(()) };
        let sent = lane.bus.send(frames);
        let taken = sent.as_ref().map_or_else(|error| error.sent, |()| frames.len());
        self.hall.sent.fetch_add(taken as u64, Ordering::Relaxed);
        if taken > 0 && self.down.remove(&index) {
            self.say(format!("{} works again", lane.bus.name()));
        }
        if let Err(SendError { cause: error @ BusError::Down(_), .. }) = &sent {
            if self.down.insert(index) {
                self.hall.judge().is_down(index);
                self.say(format!("{error}; what is due meanwhile is lost, and counted"));
            }
            // With a clock something is lost by waiting.
            let Options { pace, lockstep, .. } = self.hall.checks.options;
            if pace == Pace::Max || lockstep {
                std::thread::sleep(DOWN);
            }
        }
        sent
    }

    fn was_not_sent(&mut self, lane: usize, round: u64) {
        self.hall.judge().was_not_sent(lane, round);
    }

    fn wait_for_answers(&mut self, lane: usize, open: &Open) {
        self.wait_until_done(lane);
        let Some(round) = open.round.filter(|_| self.hall.checks.options.expect) else { return };
        // A cell skips joints that it comes to later than one period after them, and says nothing: on a machine that
        // is slower than that. They are asked again under the epoch before, and then under their own; and the sync
        // comes later, because on such a machine it is the heartbeats of some that keep others waiting.
        let tries = if self.in_vain.contains(&lane) { ASK_AGAIN_IN_VAIN } else { ASK_AGAIN };
        for again in 0.. {
            if self.hall.is_over() {
                return;
            }
            if self.hall.judge().unanswered(lane, round) == 0 {
                if again > 0 {
                    self.in_vain.remove(&lane);
                }
                return;
            }
            if again == tries {
                self.in_vain.insert(lane);
                return;
            }
            let epoch = if again % 2 == 0 { open.epoch.plus(u8::MAX) } else { open.epoch };
            self.lockstep.asked_again += 1;
            self.hall.judge().announce(lane, Some(round), epoch);
            let joints = Message::Joints { epoch, joints: open.joints };
            if self.tell(lane, &[joints]).is_err() {
                return;
            }
            let give_up = Instant::now() + ANSWERS * (again + 1).min(LONGEST);
            let mut judge = self.hall.judge();
            while judge.unanswered(lane, round) > 0 && Instant::now() < give_up && !self.hall.is_over() {
                judge = self.hall.wait(judge, Duration::from_millis(5));
            }
            drop(judge);
            if self.tell(lane, &[Message::Sync]).is_err() {
                return;
            }
            self.wait_until_done(lane);
        }
    }

    fn restore(&mut self, states: &[(usize, Vec<Message>)]) -> Result<(), ReplayError> {
        for (lane, messages) in states {
            self.finish(*lane, &[Message::Sync])?;
            self.hall.judge().mute(true);
            let mut all = self.forgetting(*lane);
            all.extend_from_slice(messages);
            for message in &all {
                if let Message::Joints { epoch, .. } = *message {
                    self.hall.judge().announce(*lane, None, epoch);
                }
                self.tell(*lane, core::slice::from_ref(message))?;
            }
            self.finish(*lane, &[Message::Sync])?;
            self.hall.judge().mute(false);
        }
        Ok(self.hall.checks.hashes(&self.hall.judge())?)
    }

    fn show(&mut self, at: u64) {
        self.hall.at.store(at, Ordering::Relaxed);
    }
}

impl Live {
    /// What makes the cells of a bus that are there forget what they felt, and obey what comes.
    fn forgetting(&self, lane: usize) -> Vec<Message> {
        let judge = self.hall.judge();
        let obeying = judge.settled(lane).filter(|(_, cell)| cell.claim.says(Flags::TEST_MODE));
        obeying.map(|(cell, _)| mode(cell, true)).collect()
    }

    fn tell(&self, lane: usize, messages: &[Message]) -> Result<(), BusError> {
        self.lanes.get(lane).map_or(Ok(()), |lane| lane.send(messages))
    }

    /// Says something to people; nobody listens any more at the end.
    fn say(&self, text: String) {
        let _ = self.voice.send(text);
    }

    /// Waits until the cells of a bus have done all that was sent so far, and this.
    fn finish(&mut self, lane: usize, last: &[Message]) -> Result<(), BusError> {
        self.hall.judge().announce_again(lane);
        self.tell(lane, last)?;
        self.wait_until_done(lane);
        Ok(())
    }

    /// Asks for counters, and waits for them.
    pub(super) fn report(&mut self, lane: usize) -> Result<(), BusError> {
        self.finish(lane, &[Message::Report, Message::Sync])
    }

    fn wait_until_done(&mut self, lane: usize) {
        let (mut done, mut progress, mut reminded) = (0, Instant::now(), Instant::now());
        let mut judge = self.hall.judge();
        while !judge.is_done(lane) && !self.hall.is_over() {
            let now = judge.done(lane);
            if now != done {
                (done, progress, reminded) = (now, Instant::now(), Instant::now());
            }
            if reminded.elapsed() > REMIND {
                reminded = Instant::now();
                // A bus that takes nothing says so at the next frame.
                let _ = self.tell(lane, &[Message::Sync]);
            }
            if progress.elapsed() > PATIENCE {
                let late = judge.give_up(lane);
                let name = self.hall.checks.lane(lane);
                self.lockstep.silent_cells.extend(late.iter().map(|cell| format!("{cell} on {name}")));
                let (plural, verb) = if late.len() == 1 { ("", "does") } else { ("s", "do") };
                self.say(format!(
                    "cell{plural} {} on {name} {verb} not answer within {} s: the replay goes on without",
                    names(&late, ""),
                    PATIENCE.as_secs()
                ));
                return;
            }
            judge = self.hall.wait(judge, Duration::from_millis(20));
        }
    }
}
