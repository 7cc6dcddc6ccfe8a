//! One bus: its frames in order, the model, and figures.

use std::collections::VecDeque;

use hdrhistogram::Histogram;
use protocol::can::{Format, Frame};
use protocol::id::{Command, Id, Kind};
use protocol::packet::{Epoch, Half, Packet, Paired, data_id};
use protocol::time::Micros;
use protocol::wire_time::{BitRates, Bits};

use super::load::{Busy, Window};
use super::report::{BusShadow, Delays, KindDelays, Loads, Most, Replies};
use super::told::Told;
use super::{WINDOW_FRAMES, WINDOW_NS};
use crate::bus_model::{Attempt, BitErrors, BusModel, Priority, Request};

/// Frames that may wait on a bus: some minutes of a full one. Beyond them frames are refused, as by a full transmit queue.
pub const GREATEST_QUEUE: usize = 1 << 22;
/// A bus without a pause for so long, in ns, is saturated: from joints to joints, as mostly set.
pub const SATURATED_NS: u64 = 16_000_000;
/// The longer span in which the load is looked at, in ns.
const SECOND_NS: u64 = 1_000_000_000;
/// Identifiers of 11 bits.
const IDS: usize = 0x800;

/// What is known of a frame while it is in the model: its place in the file and what it says, in one word.
#[derive(Clone, Copy, Debug)]
struct Tag {
    place: u64,
    /// None of one with 29 bits.
    id: Option<u16>,
    what: What,
}

/// What matters of what a frame says.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum What {
    Other,
    Joints(Epoch),
    /// An answer to joints, and whether later ones had been sent before it.
    Reply(Epoch, bool),
}

impl Tag {
    fn pack(self) -> u64 {
        let (kind, epoch) = match self.what {
            What::Other => (0, 0),
            What::Joints(epoch) => (1, epoch.0),
            What::Reply(epoch, false) => (2, epoch.0),
            What::Reply(epoch, true) => (3, epoch.0),
        };
        let id = self.id.map_or(0, |id| u64::from(id) | 0x800);
        self.place << 22 | id << 10 | u64::from(epoch) << 2 | kind
    }

    fn unpack(word: u64) -> Self {
        let id = u16::try_from(word >> 10 & 0xFFF).unwrap_or(0);
        let epoch = Epoch((word >> 2).to_le_bytes()[0]);
        let what = match word & 3 {
            1 => What::Joints(epoch),
            2 => What::Reply(epoch, false),
            3 => What::Reply(epoch, true),
            _ => What::Other,
        };
        Self { place: word >> 22, id: (id & 0x800 != 0).then_some(id & 0x7FF), what }
    }
}

/// A frame that waits for those that may come before it.
#[derive(Clone, Copy, Debug)]
struct Pending {
    at: u64,
    priority: Priority,
    bits: Bits,
    tag: Tag,
}

/// How long something took.
#[derive(Debug)]
struct Delay {
    histogram: Histogram<u64>,
    most: u64,
}

impl Delay {
    fn new() -> Self {
        Self { histogram: Histogram::new(3).expect("three digits are possible"), most: 0 }
    }

    fn record(&mut self, nanos: u64) {
        self.histogram.record(nanos).expect("it grows as it has to");
        self.most = self.most.max(nanos);
    }

    fn report(&self) -> Delays {
        Delays::of(&self.histogram, self.most)
    }
}

/// One bus.
#[derive(Debug)]
pub(super) struct Lane {
    pub(super) name: String,
    pub(super) wires: u64,
    pub(super) error_frames: u64,
    pub(super) missing: u64,
    model: BusModel,
    pending: VecDeque<Pending>,
    frames: u64,
    /// The first and the last time in the capture.
    span: Option<(u64, u64)>,
    /// The time of the newest frame that is in the model.
    released: u64,
    out_of_order: u64,
    too_late_to_sort: u64,
    no_room: u64,
    sent: u64,
    damaged: u64,
    asked: u64,
    windows: [Window; 2],
    busy: Busy,
    all: Delay,
    kinds: [Delay; 8],
    /// Data frames with 11 bits, and those of them that were sound packets.
    candidates: u64,
    packets: u64,
    halves: Vec<Half>,
    /// The newest joints, and when the joints of each epoch were to go out.
    newest: Option<Epoch>,
    joints: Vec<u64>,
    replies: Replies,
    after_joints: Delay,
    queue_at: u64,
    queued: Vec<u32>,
    queue_of_one: (u32, u16, u64),
}

impl Lane {
    pub(super) fn new(name: &str, rates: BitRates, errors: Option<BitErrors>) -> Self {
        let model = BusModel::new(rates);
        Self {
            name: name.to_owned(),
            wires: 0,
            error_frames: 0,
            missing: 0,
            model: errors.into_iter().fold(model, BusModel::with_errors),
            pending: VecDeque::new(),
            frames: 0,
            span: None,
            released: 0,
            out_of_order: 0,
            too_late_to_sort: 0,
            no_room: 0,
            sent: 0,
            damaged: 0,
            asked: 0,
            windows: [SATURATED_NS, SECOND_NS].map(Window::new),
            busy: Busy::default(),
            all: Delay::new(),
            kinds: std::array::from_fn(|_| Delay::new()),
            candidates: 0,
            packets: 0,
            halves: Vec::new(),
            newest: None,
            joints: vec![0; 256],
            replies: Replies::default(),
            after_joints: Delay::new(),
            queue_at: 0,
            queued: vec![0; IDS],
            queue_of_one: (0, 0, 0),
        }
    }

    /// A frame of any kind was there.
    pub(super) fn count(&mut self, nanos: u64) {
        self.frames += 1;
        let (first, last) = self.span.unwrap_or((nanos, nanos));
        self.span = Some((first.min(nanos), last.max(nanos)));
    }

    /// Takes a frame that a real bus would carry.
    pub(super) fn take(
        &mut self,
        nanos: u64,
        frame: &Frame,
        bits: Bits,
        place: u64,
        told: Option<&mut Told>,
    ) {
        let id = (!frame.is_extended()).then(|| u16::try_from(frame.id()).unwrap_or(0));
        let tag = Tag { place, id, what: self.what(nanos, frame) };
        let pending = Pending { at: nanos, priority: Priority::of(frame), bits, tag };
        match self.pending.back() {
            Some(last) if last.at > nanos => {
                self.out_of_order += 1;
                let index = self.pending.partition_point(|it| it.at <= nanos);
                self.pending.insert(index, pending);
            }
            _ => {
                self.out_of_order += u64::from(nanos < self.released);
                self.pending.push_back(pending);
            }
        }
        let newest = self.pending.back().map_or(nanos, |last| last.at);
        let waits = |first: &Pending, count: usize| newest - first.at <= WINDOW_NS && count <= WINDOW_FRAMES;
        let mut told = told;
        while let Some(first) =
            self.pending.front().filter(|first| !waits(first, self.pending.len())).copied()
        {
            self.pending.pop_front();
            self.enter(first, told.as_deref_mut());
        }
    }

    /// There is no more.
    pub(super) fn finish(&mut self, mut told: Option<&mut Told>) {
        while let Some(first) = self.pending.pop_front() {
            self.enter(first, told.as_deref_mut());
        }
        self.model.finish();
        self.drain(told);
    }

    /// What a frame says, and whether this bus speaks the protocol at all.
    fn what(&mut self, nanos: u64, frame: &Frame) -> What {
        let Ok(id) = data_id(frame) else { return What::Other };
        self.candidates += 1;
        let packet = match frame.format() {
            Format::Fd => Packet::from_fd(frame).ok(),
            Format::Classic => {
                if self.halves.is_empty() {
                    self.halves.resize(IDS, Half::NONE);
                }
                let half = self.halves.get_mut(usize::from(id.to_bits()));
                match half.map(|half| half.push(Micros(nanos / 1_000), id, frame.data())) {
                    Some(Ok(Paired::Whole(packet))) => Some(packet),
                    _ => None,
                }
            }
        };
        let Some(packet) = packet else { return What::Other };
        // Both frames of a pair were sound.
        self.packets += if frame.format() == Format::Fd { 1 } else { 2 };
        match id.kind {
            Kind::Command if id == Id::command(Command::Joints) => What::Joints(packet.epoch),
            Kind::Torque | Kind::Sum => What::Reply(packet.epoch, false),
            Kind::Command
            | Kind::Sensors
            | Kind::Network
            | Kind::Configure
            | Kind::Configured
            | Kind::Stimulus => What::Other,
        }
    }

    /// The next frame in order of time wants to go out.
    fn enter(&mut self, pending: Pending, mut told: Option<&mut Told>) {
        let Pending { at, priority, bits, mut tag } = pending;
        self.too_late_to_sort += u64::from(at < self.released);
        let at = at.max(self.released);
        self.released = at;
        self.model.run_until(at);
        self.drain(told.as_deref_mut());
        match &mut tag.what {
            What::Other => {}
            What::Joints(epoch) => {
                self.newest = Some(*epoch);
                self.joints.get_mut(usize::from(epoch.0)).into_iter().for_each(|of| *of = at);
            }
            What::Reply(epoch, late) => *late = self.newest.is_some_and(|newest| newest != *epoch),
        }
        let took = bits.nanoseconds(self.model.rates());
        self.asked += took;
        self.windows.iter_mut().for_each(|window| window.ask(at, took));
        if self.model.waiting() >= GREATEST_QUEUE {
            self.no_room += 1;
            told.into_iter().for_each(|told| told.sent(tag.place, None));
            return;
        }
        if self.model.waiting() >= self.model.most_waiting() {
            self.queue_at = at;
        }
        if let (Some(id), Some(queued)) = (tag.id, tag.id.and_then(|id| self.queued.get_mut(usize::from(id))))
        {
            *queued += 1;
            if *queued > self.queue_of_one.0 {
                self.queue_of_one = (*queued, id, at);
            }
        }
        self.model.request(Request { at, priority, bits, queue: None, tag: tag.pack() });
    }

    /// Takes in what has ended on the wire.
    fn drain(&mut self, mut told: Option<&mut Told>) {
        while let Some(attempt) = self.model.poll() {
            let Attempt { tag, at, start, end, is_damaged } = attempt;
            self.busy.take(start, end, SATURATED_NS);
            if is_damaged {
                self.damaged += 1;
                continue;
            }
            self.sent += 1;
            let Tag { place, id, what } = Tag::unpack(tag);
            self.all.record(end - at);
            if let Some(id) = id {
                let kind = self.kinds.get_mut(Id::from_bits(id).kind as usize);
                kind.into_iter().for_each(|kind| kind.record(end - at));
                self.queued.get_mut(usize::from(id)).into_iter().for_each(|queued| *queued -= 1);
            }
            if let What::Reply(epoch, was_late) = what {
                self.answered(epoch, was_late, end);
            }
            if let Some(told) = &mut told {
                told.sent(place, Some((start, end)));
            }
        }
    }

    /// An answer has come to its end.
    fn answered(&mut self, epoch: Epoch, was_late: bool, end: u64) {
        let Some(newest) = self.newest else { return };
        self.replies.count += 1;
        if was_late {
            self.replies.late_before += 1;
            return;
        }
        self.replies.late += u64::from(newest != epoch);
        let joints = self.joints.get(usize::from(epoch.0)).copied().unwrap_or(end);
        self.after_joints.record(end.saturating_sub(joints));
    }

    pub(super) fn report(&self) -> BusShadow {
        let (first, last) = self.span.unwrap_or_default();
        let (duration, until) = (last - first, self.busy.end().max(last));
        let share = |part: u64, whole: u64| (whole > 0).then(|| part as f64 / whole as f64);
        let [short, long] =
            self.windows.each_ref().map(Window::most).map(|(value, at_ns)| Most { value, at_ns });
        // Chance makes a packet of one frame in 65 536.
        let is_ours = self.packets * 2 > self.candidates;
        let kinds = Kind::ALL.into_iter().zip(&self.kinds).filter(|(_, delay)| !delay.histogram.is_empty());
        let kinds = kinds.map(|(kind, delay)| KindDelays { kind: kind.name(), delay_us: delay.report() });
        let replies = Replies { after_joints_us: self.after_joints.report(), ..self.replies };
        BusShadow {
            bus: self.name.clone(),
            rates: self.model.rates(),
            frames: self.frames,
            first_ns: first,
            duration_s: duration as f64 / 1e9,
            sent: self.sent,
            wires: self.wires,
            error_frames: self.error_frames,
            missing: self.missing,
            out_of_order: self.out_of_order,
            too_late_to_sort: self.too_late_to_sort,
            no_room: self.no_room,
            damaged: self.damaged,
            load: Loads {
                mean: share(self.asked, duration),
                worst_16_ms: short,
                worst_1_s: long,
                busy: share(self.busy.total, until - first),
            },
            stretches: self.busy.stretches(SATURATED_NS),
            delay_us: self.all.report(),
            kinds: if is_ours { kinds.collect() } else { Vec::new() },
            replies: Some(replies).filter(|replies| is_ours && replies.count > 0),
            queue: Most { value: self.model.most_waiting() as f64, at_ns: self.queue_at },
            queue_of_one: Most { value: f64::from(self.queue_of_one.0), at_ns: self.queue_of_one.2 },
            queue_of_one_id: u32::from(self.queue_of_one.1),
        }
    }
}
