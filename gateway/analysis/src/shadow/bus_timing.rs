//! Models one bus: sorts the frames by time, simulates their transmission, and computes the figures of the bus.

use std::collections::VecDeque;
use std::num::NonZeroU32;

use protocol::can::{Format, Frame};
use protocol::packet::Epoch;
use protocol::wire_time::{BitRates, FrameBits};

use super::epochs::EpochTracker;
use super::phase::{BusPhase, ByPhase, PhaseFigures, PhaseTracker};
use super::report::{BusShadow, BusyStretches, DelayQuantiles, FrameCounts, Loads, Peak};
use super::reported::FrameTimings;
use super::{MAX_WAITING_FRAMES, REORDER_WINDOW_NS, SATURATED_NS};
use crate::fit;
use crate::fit::verdict::{AnsweringCells, FitSummary};
use bus_model::traffic::{ClassifiedFrame, RunEvent, TrafficClassifier};
use bus_model::{Attempt, BitErrors, BusFrame, NodeBus, Priority, QueueOrder, TransmitQueue};

/// The transmit queue of all senders on a bus: some minutes of a bus at full load. Every frame takes part in
/// arbitration.
const TRANSMIT_QUEUE: TransmitQueue =
    TransmitQueue { order: QueueOrder::Priority, depth: NonZeroU32::new(1 << 22).expect("a depth above 0") };
/// The number of identifiers of 11 bits.
const IDENTIFIER_COUNT: usize = 0x800;

/// The data that the model keeps with a frame until it is sent.
#[derive(Clone, Copy, Debug)]
struct FrameTag {
    /// Index of the frame in the capture.
    place: u64,
    /// Identifier of the frame; `None` for one of 29 bits.
    id: Option<u16>,
    phase: BusPhase,
    /// The epoch that the frame answers, and true if later joints had been sent before it; `None` for other frames.
    answer: Option<(Epoch, bool)>,
}

/// A frame that waits until no frame with an earlier time can follow.
#[derive(Clone, Copy, Debug)]
struct PendingFrame {
    at: u64,
    on_bus: BusFrame,
    place: u64,
    /// Identifier of the frame; `None` for one of 29 bits.
    id: Option<u16>,
    sorted: ClassifiedFrame,
}

/// Properties of a bus that the caller gives.
#[derive(Clone, Debug)]
pub(super) struct BusProperties {
    pub(super) rates: BitRates,
    /// Number of the skin's cells on the bus; `None` without a skin.
    pub(super) cells: Option<u32>,
    /// The worst case of the bus, with all these cells answering.
    pub(super) worst_case: Option<FitSummary>,
    /// True to include frames that only a bench sends.
    pub(super) bench_traffic: bool,
    /// True if time stamps are the ends of frames.
    pub(super) is_timed: bool,
}

/// The model and the figures of one bus.
#[derive(Debug)]
pub(super) struct BusTiming {
    pub(super) name: String,
    pub(super) counts: FrameCounts,
    known: BusProperties,
    model: NodeBus<FrameTag>,
    pending: VecDeque<PendingFrame>,
    frames: u64,
    /// Earliest and latest time of a frame in the capture, in ns.
    span: Option<(u64, u64)>,
    /// The time in ns of the newest frame that was passed to the model.
    released: u64,
    /// The end of the last transmission, in ns.
    wire_end: u64,
    traffic: TrafficClassifier,
    has_fd: bool,
    phases: PhaseTracker,
    figures: ByPhase<PhaseFigures>,
    epochs: EpochTracker,
    queued: Vec<u32>,
}

impl BusTiming {
    pub(super) fn new(name: &str, known: BusProperties, errors: Option<BitErrors>) -> Self {
        Self {
            name: name.to_owned(),
            counts: FrameCounts { bench_omitted: !known.bench_traffic, ..FrameCounts::default() },
            model: NodeBus::new(known.rates, TRANSMIT_QUEUE, errors),
            known,
            pending: VecDeque::new(),
            frames: 0,
            span: None,
            released: 0,
            wire_end: 0,
            traffic: TrafficClassifier::default(),
            has_fd: false,
            phases: PhaseTracker::default(),
            figures: ByPhase::default(),
            epochs: EpochTracker::default(),
            queued: vec![0; IDENTIFIER_COUNT],
        }
    }

    /// Handles a packet from before the start of the capture, which still has an effect.
    pub(super) fn receive_latched(&mut self, nanos: u64, frame: &Frame) {
        match self.traffic.classify(nanos, frame).says {
            RunEvent::Joints(_) => self.phases.beginning.is_mid_run = true,
            says @ (RunEvent::Halt | RunEvent::Resume) => _ = self.epochs.record_event(nanos, says, None),
            RunEvent::Answer(_) | RunEvent::Preparation | RunEvent::Other => {}
        }
    }

    /// Returns true if time stamps are the ends of frames.
    pub(super) const fn is_timed(&self) -> bool {
        self.known.is_timed
    }

    /// Counts a frame of any kind and its time.
    pub(super) fn count_frame(&mut self, nanos: u64) {
        self.frames += 1;
        let (first, last) = self.span.unwrap_or((nanos, nanos));
        self.span = Some((first.min(nanos), last.max(nanos)));
    }

    /// Handles a frame that a real CAN bus could carry.
    pub(super) fn receive_frame(
        &mut self,
        nanos: u64,
        frame: &Frame,
        bits: FrameBits,
        place: u64,
        reported: Option<&mut FrameTimings>,
    ) {
        let id = (!frame.is_extended()).then(|| u16::try_from(frame.id()).unwrap_or(0));
        let sorted = self.traffic.classify(nanos, frame);
        self.has_fd |= frame.format() == Format::Fd;
        if sorted.bench.is_some() && sorted.ends_pair {
            // The previous frame with its identifier, which is near the end of the queue.
            let first = self.pending.iter_mut().rev().find(|it| it.id == id);
            first.into_iter().for_each(|first| first.sorted.bench = sorted.bench);
        }
        self.phases.beginning.record_event(nanos, sorted.says);
        let pending = PendingFrame {
            at: nanos,
            on_bus: BusFrame { priority: Priority::from_frame(frame), bits },
            place,
            id,
            sorted,
        };
        match self.pending.back() {
            Some(last) if last.at > nanos => {
                self.counts.out_of_order += 1;
                let index = self.pending.partition_point(|it| it.at <= nanos);
                self.pending.insert(index, pending);
            }
            _ => {
                self.counts.out_of_order += u64::from(nanos < self.released);
                self.pending.push_back(pending);
            }
        }
        let newest = self.pending.back().map_or(nanos, |last| last.at);
        let waits = |first: &PendingFrame, count: usize| {
            newest - first.at <= REORDER_WINDOW_NS && count <= MAX_WAITING_FRAMES
        };
        let mut reported = reported;
        while let Some(first) =
            self.pending.front().filter(|first| !waits(first, self.pending.len())).copied()
        {
            self.pending.pop_front();
            self.request_frame(first, reported.as_deref_mut());
        }
    }

    /// Ends the input: all waiting frames are sent.
    pub(super) fn finish(&mut self, mut reported: Option<&mut FrameTimings>) {
        while let Some(first) = self.pending.pop_front() {
            self.request_frame(first, reported.as_deref_mut());
        }
        self.model.finish();
        self.collect_sent_frames(reported);
    }

    /// Passes the next frame in order of time to the model, which requests its transmission.
    fn request_frame(&mut self, pending: PendingFrame, mut reported: Option<&mut FrameTimings>) {
        let PendingFrame { at, on_bus, place, id, sorted } = pending;
        let ClassifiedFrame { says, bench, from, .. } = sorted;
        if let Some(bench) = bench {
            self.counts.bench.count_frames(bench, 1);
            if !self.known.bench_traffic {
                reported.into_iter().for_each(|reported| reported.mark_omitted(place));
                return;
            }
        }
        self.counts.too_late_to_sort += u64::from(at < self.released);
        let at = at.max(self.released);
        self.released = at;
        self.model.advance(at);
        self.collect_sent_frames(reported.as_deref_mut());
        let phase = self.phases.phase_at(at, says, self.traffic.is_skin_traffic());
        let answer = self.epochs.record_event(at, says, from);
        let took = on_bus.bits.nanoseconds(self.model.rates());
        if self.known.is_timed {
            self.record_ended(at, took, phase, answer);
            reported
                .into_iter()
                .for_each(|reported| reported.record_sent(place, Some((at - took.min(at), at))));
            return;
        }
        let figures = self.figures.get_mut(phase);
        figures.record_request(at, took);
        let tag = FrameTag { place, id, phase, answer };
        if self.model.request(at, 0, on_bus, tag).is_err() {
            self.counts.no_room += 1;
            reported.into_iter().for_each(|reported| reported.record_sent(place, None));
            return;
        }
        let queued = id.and_then(|id| Some((self.queued.get_mut(usize::from(id))?, id)));
        let of_one = queued.map(|(queued, id)| {
            *queued += 1;
            (*queued, id)
        });
        figures.record_queue(at, self.model.waiting(), of_one);
    }

    /// Records a frame of a timed bus, which ended `at` and took `took` ns.
    fn record_ended(&mut self, at: u64, took: u64, phase: BusPhase, answer: Option<(Epoch, bool)>) {
        // With bit rates below the real ones, frames would overlap.
        let start = at.saturating_sub(took).max(self.wire_end);
        self.wire_end = at;
        let figures = self.figures.get_mut(phase);
        figures.record_request(start, took);
        figures.busy.record_transmission(start, at, SATURATED_NS);
        self.counts.sent += 1;
        if let Some((epoch, _)) = answer {
            // The time at which the answer was ready is unknown: it counts as early.
            self.epochs.record_answer(epoch, false, (0, at));
        }
    }

    /// Takes completed transmissions from the model and records them.
    fn collect_sent_frames(&mut self, mut reported: Option<&mut FrameTimings>) {
        while let Some(sent) = self.model.poll() {
            let Attempt { tag: FrameTag { place, id, phase, answer }, at, start, end, is_damaged } = sent;
            self.wire_end = end;
            self.figures.get_mut(self.phases.current_phase()).busy.record_transmission(
                start,
                end,
                SATURATED_NS,
            );
            if is_damaged {
                self.counts.damaged += 1;
                continue;
            }
            self.counts.sent += 1;
            self.figures.get_mut(phase).record_sent(id, end - at);
            let queued = id.and_then(|id| self.queued.get_mut(usize::from(id)));
            queued.into_iter().for_each(|queued| *queued -= 1);
            if let Some((epoch, was_late)) = answer {
                self.epochs.record_answer(epoch, was_late, (at, end));
            }
            if let Some(reported) = &mut reported {
                reported.record_sent(place, Some((start, end)));
            }
        }
    }

    /// Returns the format and the bit rates of the bus as text. The format is the skin's, or else that of the frames.
    fn rates_text(&self) -> String {
        if let Some(worst) = &self.known.worst_case {
            return worst.rates.clone();
        }
        let rates = self.known.rates;
        match BitRates::classic(rates.nominal_rate()) {
            Ok(classic) if !self.has_fd => fit::rates_name(Format::Classic, classic),
            _ => fit::rates_name(Format::Fd, rates),
        }
    }

    pub(super) fn to_bus_shadow(&self, has_times: bool) -> BusShadow {
        let (first, last) = self.span.unwrap_or_default();
        let timed = self.timed_bus_shadow(first, last);
        if has_times && first < last {
            return timed;
        }
        // With fewer than two different times, timing figures are meaningless.
        BusShadow {
            this_run: None,
            start_up: None,
            load: Loads::default(),
            stretches: BusyStretches::default(),
            delay_us: DelayQuantiles::default(),
            kinds: Vec::new(),
            replies: None,
            queue: Peak::default(),
            queue_of_one: Peak::default(),
            queue_of_one_id: 0,
            ..timed
        }
    }

    fn timed_bus_shadow(&self, first: u64, last: u64) -> BusShadow {
        let ByPhase { start_up, operation } = &self.figures;
        let span = self.phases.spans.operation;
        let overrun = self.wire_end.saturating_sub(self.released);
        let load = operation.loads(span, overrun);
        let is_ours = self.traffic.is_skin_traffic();
        let answering = self.epochs.answering_counts(self.known.cells);
        let replies = self.epochs.replies();
        let this_run = (operation.frames > 0).then(|| {
            let who = if is_ours { answering.cells() } else { AnsweringCells::Foreign };
            let late = replies.late - replies.late_when_ready;
            FitSummary::for_run(load.worst_1_s.value, late, self.rates_text(), who)
        });
        BusShadow {
            bus: self.name.clone(),
            name: self.rates_text(),
            rates: self.known.rates,
            is_timed: self.known.is_timed,
            frames: self.frames,
            first_ns: first,
            zero_ns: first,
            duration_s: (last - first) as f64 / 1e9,
            operation_s: span as f64 / 1e9,
            worst_case: self.known.worst_case.clone(),
            this_run,
            answering: is_ours.then_some(answering),
            start_up: start_up.start_up(self.phases.spans.start_up),
            counts: self.counts,
            load,
            stretches: operation.busy.stretches(SATURATED_NS),
            delay_us: DelayQuantiles::from_times(&operation.all),
            kinds: if is_ours { operation.kind_delays() } else { Vec::new() },
            replies: Some(replies).filter(|replies| is_ours && replies.count > 0),
            queue: operation.queue,
            queue_of_one: operation.queue_of_one,
            queue_of_one_id: operation.queue_of_one_id.into(),
        }
    }
}
