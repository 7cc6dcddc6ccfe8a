//! A bus in virtual time with one cell on it, which may be faulty.

use std::collections::VecDeque;

use cell_node::flash::FlashState;
use cell_node::identity::Identity;
use cell_node::node::Node;
use conformance::bus::{ObservedFrame, StopReason, TestBus};
use protocol::can::{Format, Frame};
use protocol::id::CellId;
use protocol::packet::Packet;
use protocol::time::{Micros, Span};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// The time between two frames on the bus.
const FRAME_INTERVAL: Span = Span(20);
/// The time that a cell needs for a frame or a timer.
const THINKS: Span = Span(30);
/// The time that the cell is off in a restart.
const OFF_TIME: Span = Span::from_millis(40);

/// A fault of a cell: it changes the cell's input and output.
pub(crate) trait Mutant {
    /// Returns the frames that the cell receives instead of an arriving one, with their ages.
    fn change_input(&mut self, _now: Micros, age: Span, frame: Frame) -> Vec<(Span, Frame)> {
        vec![(age, frame)]
    }

    /// Returns the packets that are sent instead of one of the cell's, with their delays.
    fn change_output(&mut self, _now: Micros, packet: Packet) -> Vec<(Span, Packet)> {
        vec![(Span(0), packet)]
    }

    /// Returns additional packets, after each call of the cell.
    fn additional_packets(&mut self, _now: Micros) -> Vec<(Span, Packet)> {
        Vec::new()
    }

    /// Returns the frames of a packet.
    fn frames(&mut self, packet: &Packet, format: Format) -> Vec<Frame> {
        packet.frames(format).collect()
    }

    /// Returns the content that flash keeps.
    fn stores(&mut self, flash: FlashState) -> FlashState {
        flash
    }

    /// Returns the flash with which the cell is switched on.
    fn starts(&mut self, _now: Micros, flash: FlashState) -> FlashState {
        flash
    }

    /// Returns the time at which it must be called, independently of the cell.
    fn wakes(&self) -> Option<Micros> {
        None
    }

    /// Returns true if it goes silent when the cell gave way.
    fn obeys_claims(&self) -> bool {
        true
    }
}

/// A cell without a fault.
pub(crate) struct FaultlessCell;

impl Mutant for FaultlessCell {}

/// A cell that sometimes has to wait for its processor.
struct Starved {
    dice: Pcg64Mcg,
    /// The time of the next wait.
    at: Micros,
    /// True if the bench notices, with its lateness.
    is_seen: bool,
    late: Span,
}

/// The bus.
pub(crate) struct VirtualBus {
    now: Micros,
    format: Format,
    identity: Identity,
    test_mode: bool,
    node: Option<Node>,
    flash: FlashState,
    mutant: Box<dyn Mutant>,
    /// Frames in order, each on the bus from its time on, and marked as the bench's own or not.
    wire: VecDeque<ObservedFrame>,
    /// The time from which the bus is free.
    free: Micros,
    /// Frames for the cell, with their arrival times.
    inbox: VecDeque<(Micros, Frame)>,
    /// The time until which the cell is busy.
    busy: Micros,
    /// Frames that wait to be sent by the cell.
    later: Vec<(Micros, Frame)>,
    restart: Option<Micros>,
    restarts: bool,
    starved: Option<Starved>,
    /// The time between two frames on the bus.
    frame: Span,
    /// The duration of a commit.
    stores: Span,
    cuts: Cuts,
}

/// The times at which restarts end a life of the cell: each a step later after its command than the one before.
#[derive(Default)]
struct Cuts {
    step: Span,
    /// The delay after which the steps begin again.
    longest: Span,
    next: Span,
    /// The end of the present life.
    at: Option<Micros>,
    restarts: usize,
    /// The number of restarts that kept a frame of the cell from the bus.
    torn: usize,
}

impl VirtualBus {
    pub(crate) fn new(format: Format, number: u8, mutant: Box<dyn Mutant>) -> Self {
        let identity =
            Identity { cell: CellId::new(number.into()).ok(), serial: 100_000 + u32::from(number) };
        let mut bus = Self {
            now: Micros(1_000_000),
            format,
            identity,
            test_mode: true,
            node: None,
            flash: FlashState::Empty,
            mutant,
            wire: VecDeque::new(),
            free: Micros(0),
            inbox: VecDeque::new(),
            busy: Micros(0),
            later: Vec::new(),
            restart: None,
            restarts: true,
            starved: None,
            frame: FRAME_INTERVAL,
            stores: Span(0),
            cuts: Cuts::default(),
        };
        bus.start();
        bus
    }

    /// Makes it a cell that measures when it is switched on.
    pub(crate) fn measuring(mut self) -> Self {
        self.test_mode = false;
        self.start();
        self
    }

    /// Makes the cell wait for a processor for up to 90 ms, about once a second; the bench notices that only on its own
    /// computer.
    pub(crate) fn starved(mut self, seed: u64, is_seen: bool) -> Self {
        let dice = Pcg64Mcg::seed_from_u64(seed);
        self.starved = Some(Starved { dice, at: self.now, is_seen, late: Span(0) });
        self
    }

    /// Takes the processor from the cell, if it is time for that.
    fn starve(&mut self) {
        let Some(starved) = self.starved.as_mut().filter(|starved| starved.at <= self.now) else { return };
        let span = Span(starved.dice.random_range(5_000..90_000));
        starved.late = starved.late.max(span);
        starved.at = self.now + Span(starved.dice.random_range(200_000..1_800_000));
        self.busy = self.busy.max(self.now + span);
    }

    /// Makes a bus on which a classic frame takes as long as at 1 Mbit/s, with a cell whose commits take 1 ms and which
    /// lives for a while after the command of a restart: from `first` to `longest`, each time a `step` longer.
    pub(crate) fn cut(mut self, first: Span, step: Span, longest: Span) -> Self {
        self.frame = Span(120);
        self.stores = Span(1_000);
        self.cuts = Cuts { step, longest, next: first, ..Cuts::default() };
        self
    }

    /// Returns the number of restarts, and the number of those that kept a frame of the cell from the bus.
    pub(crate) fn restarted(&self) -> (usize, usize) {
        (self.cuts.restarts, self.cuts.torn)
    }

    /// Switches the cell off: frames that are not completely on the bus are lost.
    fn cut_off(&mut self, at: Micros) {
        self.now = self.now.max(at);
        self.cuts.at = None;
        self.cuts.restarts += 1;
        self.node = None;
        let before = self.wire.len() + self.later.len();
        self.later.clear();
        self.wire.retain(|seen| seen.own || seen.at <= at);
        self.cuts.torn += usize::from(self.wire.len() < before);
        self.restart = Some(at + OFF_TIME);
    }

    pub(crate) fn without_restart(mut self) -> Self {
        self.restarts = false;
        self
    }

    fn start(&mut self) {
        self.flash = self.mutant.starts(self.now, self.flash);
        self.node = Some(Node::new(self.identity, self.format, &self.flash, self.test_mode, self.now));
        self.busy = self.now;
        self.inbox.clear();
    }

    /// Puts the cell's packets on the bus, and its committed values into flash.
    fn collect(&mut self, at: Micros) {
        let Some(node) = &mut self.node else { return };
        let mut stored = Span(0);
        if let Some(kept) = node.poll_store() {
            self.flash = self.mutant.stores(kept.parameters.map_or(FlashState::Empty, FlashState::Valid));
            node.handle_stored(true);
            stored = self.stores;
        }
        let at = at + stored;
        self.busy = self.busy.max(at);
        let mut out = Vec::new();
        while let Some(packet) = node.poll_transmit() {
            out.extend(self.mutant.change_output(at, *packet));
        }
        out.extend(self.mutant.additional_packets(at));
        for (delay, packet) in out {
            let frames = self.mutant.frames(&packet, self.format);
            self.later.extend(frames.into_iter().map(|frame| (at + delay, frame)));
        }
        self.later.sort_by_key(|(at, _)| *at);
        if node.other_owner().is_some() && self.mutant.obeys_claims() {
            self.node = None;
            self.inbox.clear();
        }
    }

    fn put(&mut self, at: Micros, frame: Frame, own: bool) {
        let at = at.max(self.free + self.frame);
        self.free = at;
        let place = self.wire.iter().rposition(|seen| seen.at <= at).map_or(0, |place| place + 1);
        self.wire.insert(place, ObservedFrame { at, frame, own });
        if own {
            self.inbox.push_back((at, frame));
        }
    }

    /// Returns the next event of the cell, if there is one by then.
    fn next(&self, until: Micros) -> Option<(Micros, Event)> {
        let heard = self.inbox.front().filter(|_| self.node.is_some());
        let heard = heard.map(|(at, _)| ((*at).max(self.busy) + THINKS, Event::Hears));
        let wake = self.node.as_ref().map(|node| (node.poll_timeout().max(self.busy), Event::Wakes));
        let own =
            self.mutant.wakes().filter(|_| self.node.is_some()).map(|at| (at.max(self.busy), Event::Wakes));
        let start = self.restart.map(|at| (at, Event::Starts));
        let sends = self.later.first().map(|(at, _)| (*at, Event::Sends));
        let end = self.cuts.at.map(|at| (at, Event::Ends));
        let all = [end, sends, heard, wake, own, start].into_iter().flatten();
        all.min_by_key(|(at, _)| *at).filter(|(at, _)| *at <= until)
    }

    fn do_next(&mut self, at: Micros, event: Event) {
        match event {
            Event::Sends => {
                let (at, frame) = self.later.remove(0);
                self.put(at, frame, false);
            }
            Event::Ends => self.cut_off(at),
            Event::Starts => {
                self.restart = None;
                self.now = at;
                self.start();
            }
            Event::Wakes => {
                self.busy = at + Span(1);
                if let Some(node) = &mut self.node {
                    node.handle_timeout(at);
                }
                self.collect(at);
            }
            Event::Hears => {
                self.busy = at;
                let Some((came, frame)) = self.inbox.pop_front() else { return };
                for (age, frame) in self.mutant.change_input(at, at.elapsed_since(came), frame) {
                    if let Some(node) = &mut self.node {
                        node.handle_frame(at, age, &frame);
                    }
                    self.collect(at);
                }
            }
        }
    }
}

#[derive(Clone, Copy, Debug)]
enum Event {
    Sends,
    Hears,
    Wakes,
    Starts,
    Ends,
}

impl TestBus for VirtualBus {
    fn now(&self) -> Micros {
        self.now
    }

    fn supports_format(&self, _: Format) -> bool {
        true
    }

    fn send(&mut self, frames: &[Frame]) -> Result<(), StopReason> {
        for frame in frames {
            // A real bus does the same, one frame at a time.
            self.put(self.now, *frame, true);
        }
        Ok(())
    }

    fn receive(&mut self, until: Micros) -> Result<Option<ObservedFrame>, StopReason> {
        loop {
            self.starve();
            let seen = self.wire.front().map(|seen| seen.at);
            let limit = seen.map_or(until, |at| at.min(until));
            if let Some((at, event)) = self.next(limit) {
                self.do_next(at, event);
                continue;
            }
            if seen.is_some_and(|at| at <= until)
                && let Some(seen) = self.wire.pop_front()
            {
                self.now = self.now.max(seen.at);
                return Ok(Some(seen));
            }
            self.now = self.now.max(until);
            return Ok(None);
        }
    }

    fn bench_lateness(&mut self) -> Span {
        let seen = self.starved.as_mut().filter(|starved| starved.is_seen);
        seen.map_or(Span(0), |starved| core::mem::take(&mut starved.late))
    }

    fn ignore_signals(&mut self) {}

    fn can_restart(&self) -> bool {
        self.restarts
    }

    fn begin_restart(&mut self) -> Result<(), StopReason> {
        let Cuts { step, longest, next, .. } = self.cuts;
        self.cuts.at = Some(self.now + next);
        self.cuts.next = if next.0 + step.0 > longest.0 {
            Span(next.0 + step.0 - longest.0)
        } else {
            Span(next.0 + step.0)
        };
        Ok(())
    }

    fn is_restarting(&mut self) -> Result<bool, StopReason> {
        Ok(self.cuts.at.is_some() || self.restart.is_some())
    }
}
