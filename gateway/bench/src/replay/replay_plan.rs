//! Replay plan: turns the frames of a capture into steps with their times.
//!
//! ```text
//!   frames ──> add_frame ──> [ order by time ] ──> [ classify_frame ] ──> selected? ──> steps ──> player
//!                                                         └── joints, replies ──> comparator
//! ```

use std::collections::{BTreeMap, VecDeque};
use std::ops::ControlFlow;

use protocol::can::Frame;
use protocol::candump::Record;
use protocol::id::Id;
use protocol::message::{Joints, Message};
use protocol::packet::{Epoch, PacketError, data_frame_id};
use protocol::time::Micros;

use super::comparator::Comparator;
use super::survey::{Survey, is_from_gateway_side, is_joints};
use model::decode::Decoded;
use model::decode::settle::OrderedDecoder;
use trace::order::{BusMerger, ReleasedFrame};

/// Time in ns after the end of the replayed part during which recorded replies are still read, because they answer
/// joints in the part.
const LATE_REPLY_WINDOW_NS: u64 = 1_000_000_000;
/// Minimum time in ns between two passes.
const MIN_PASS_GAP_NS: u64 = 1_000_000;

/// Filter of the sent frames by sender.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum SenderFilter {
    /// Frames of all senders, including foreign ones.
    #[default]
    All,
    /// Commands, configuration and stimuli.
    Inputs,
    /// Replies of cells: all frames from cells.
    Replies,
}

/// Selection of the frames to send.
#[derive(Clone, Debug)]
pub struct FrameSelection {
    /// Selection of the frames by their sender.
    pub only: SenderFilter,
    /// Destination of each bus of the capture; `None` for a bus that is not replayed.
    pub destinations: Vec<Option<usize>>,
    /// True if packets are decoded, so that joints are numbered and replies compared.
    pub reads: bool,
}

/// Next step of a replay.
#[derive(Clone, Debug, PartialEq)]
pub enum PlayerStep {
    /// Sends a frame.
    Frame(DueFrame),
    /// Starts a pass: restores the latched state, bus by bus.
    Restore(Vec<(usize, Vec<Message>)>),
}

/// A frame that is due at a certain time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DueFrame {
    /// Time in ns at which the frame is due, after the first frame, by the capture's clock and over all passes.
    pub at: u64,
    /// Index of the bus.
    pub bus_index: usize,
    /// The frame to send.
    pub frame: Frame,
    /// Role of the frame in lockstep and comparison.
    pub role: FrameRole,
    /// True if the frame is older than a frame sent before it. It is sent at once.
    pub is_late: bool,
}

/// Role of a frame in lockstep and comparison.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FrameRole {
    /// The frame has no effect on lockstep or comparison.
    Plain,
    /// The frame is the first segment of a joint packet.
    SegmentOfJoints,
    /// The frame completes a joint packet.
    Joints(AwaitedJoints),
}

/// Joints whose answers from the cells are awaited or compared.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AwaitedJoints {
    /// Epoch of the joints.
    pub epoch: Epoch,
    /// Positions of the joints.
    pub joints: Joints,
    /// Number of the joints' round on the bus, if replies to them are compared.
    pub round: Option<u64>,
}

/// Counts over all passes of a replay plan.
#[derive(Clone, Debug, Default)]
pub struct PlanSummary {
    /// Number of frames that were not sent, by reason.
    pub skipped: BTreeMap<&'static str, u64>,
    /// Number of frames that were older than a frame sent before them.
    pub late: u64,
}

/// Plans one or several passes over a capture.
#[derive(Debug)]
pub struct ReplayPlan<'a> {
    survey: &'a Survey,
    selection: &'a FrameSelection,
    /// Frames waiting to be sorted, with their buses.
    order: BusMerger<(usize, Frame)>,
    settler: OrderedDecoder<ReleasedFrame<(usize, Frame)>>,
    steps: VecDeque<PlayerStep>,
    plan_summary: PlanSummary,
    /// Start of this pass in ns after the first one.
    offset: u64,
    /// Times of the first and the last sent frame of this pass.
    sent: Option<(u64, u64)>,
    /// Numbers of sent frames and joints of this pass.
    counts: (u64, u64),
}

impl<'a> ReplayPlan<'a> {
    /// Creates the plan of a surveyed capture.
    #[must_use]
    pub fn new(survey: &'a Survey, selection: &'a FrameSelection) -> Self {
        Self {
            survey,
            selection,
            order: BusMerger::default(),
            settler: OrderedDecoder::new(None),
            steps: VecDeque::new(),
            plan_summary: PlanSummary::default(),
            offset: 0,
            sent: None,
            counts: (0, 0),
        }
    }

    /// Adds the capture's next frame. Returns [`ControlFlow::Break`] as soon as all later frames are after the replayed
    /// part.
    pub fn add_frame(&mut self, record: &Record<'_>, comparator: &mut Comparator) -> ControlFlow<()> {
        let Some(bus) = self.survey.bus_named(record.interface) else {
            self.count_skipped(reason::BUS_ADDED_LATER);
            return ControlFlow::Continue(());
        };
        self.order.push(bus, record.time.nanos, (bus, record.frame));
        while let Some(next) = self.order.pop() {
            self.push_to_decoder(next);
            self.plan_decoded_frames(comparator)?;
        }
        ControlFlow::Continue(())
    }

    /// Returns the next planned step, if any.
    pub fn next_step(&mut self) -> Option<PlayerStep> {
        self.steps.pop_front()
    }

    /// Passes a frame to the decoder, which classifies it.
    fn push_to_decoder(&mut self, next: ReleasedFrame<(usize, Frame)>) {
        let (bus, frame) = next.item;
        let name = self.survey.buses.get(bus).map_or("", |bus| bus.name.as_str());
        self.settler.push(Micros(next.nanos / 1_000), name, &frame, next);
    }

    /// Plans all frames whose order and meaning are settled.
    fn plan_decoded_frames(&mut self, comparator: &mut Comparator) -> ControlFlow<()> {
        while let Some((next, decoded)) = self.settler.pop() {
            self.plan_frame(&next, &decoded, comparator)?;
        }
        ControlFlow::Continue(())
    }

    /// Notes the end of the capture or of the part. Another pass may follow.
    pub fn end_pass(&mut self, comparator: &mut Comparator) {
        while let Some(next) = self.order.pop_without_waiting() {
            self.push_to_decoder(next);
        }
        self.settler.finish();
        let _ = self.plan_decoded_frames(comparator);
        self.order = BusMerger::default();
        self.settler = OrderedDecoder::new(None);
        if let Some((first, last)) = self.sent.take() {
            let (frames, joints) = self.counts;
            let steps = if joints > 1 { joints } else { frames }.saturating_sub(1).max(1);
            let gap = ((last - first).checked_div(steps)).unwrap_or(0).max(MIN_PASS_GAP_NS);
            self.offset += last - first + gap;
        }
        self.counts = (0, 0);
    }

    /// Returns the step that restores the state at the start of the replayed part.
    #[must_use]
    pub fn restore_step(&self) -> PlayerStep {
        let bounds = self.survey.part_bounds_ns();
        let of = |(bus, bus_link): (&super::survey::SurveyedBus, &Option<usize>)| {
            let there: Vec<_> = bus.cells_active_in(bounds).map(|(cell, _)| cell).collect();
            Some(((*bus_link)?, bus.state.restoring_messages(|cell| there.contains(&cell), bus.first_joints)))
        };
        PlayerStep::Restore(
            self.survey.buses.iter().zip(&self.selection.destinations).filter_map(of).collect(),
        )
    }

    /// Ends the plan, and returns the counts of all passes.
    #[must_use]
    pub fn into_summary(self) -> PlanSummary {
        self.plan_summary
    }

    /// Counts a frame or note that is not sent.
    pub fn count_skipped(&mut self, reason: &'static str) {
        *self.plan_summary.skipped.entry(reason).or_default() += 1;
    }

    /// Plans one frame: sends it, or counts it as skipped.
    fn plan_frame(
        &mut self,
        next: &ReleasedFrame<(usize, Frame)>,
        decoded: &Decoded,
        comparator: &mut Comparator,
    ) -> ControlFlow<()> {
        let (from, to) = self.survey.part_bounds_ns();
        if next.send_nanos >= to.saturating_add(LATE_REPLY_WINDOW_NS) {
            return ControlFlow::Break(());
        }
        let (bus, frame) = next.item;
        let unwanted = if next.nanos < from {
            Some(reason::BEFORE_PART)
        } else if next.nanos >= to {
            Some(reason::AFTER_PART)
        } else {
            self.skip_reason(bus, &frame, decoded)
        };
        let bus_link = self.destination_bus(bus);
        let role = bus_link.filter(|_| self.selection.reads).map_or(FrameRole::Plain, |bus_link| {
            let is_in_part = (from..to).contains(&next.nanos);
            classify_frame(bus_link, next.nanos, decoded, unwanted.is_none(), is_in_part, comparator)
        });
        if let Some(reason) = unwanted {
            self.count_skipped(reason);
            return ControlFlow::Continue(());
        }
        let Some(bus_link) = bus_link else { return ControlFlow::Continue(()) };
        self.plan_summary.late += u64::from(next.is_late);
        let (first, last) = self.sent.get_or_insert((next.send_nanos, next.send_nanos));
        *last = next.send_nanos;
        let at = self.offset + (next.send_nanos - *first);
        self.counts.0 += 1;
        self.counts.1 += u64::from(matches!(role, FrameRole::Joints(_)) && bus_link == 0);
        self.steps.push_back(PlayerStep::Frame(DueFrame {
            at,
            bus_index: bus_link,
            frame,
            role,
            is_late: next.is_late,
        }));
        ControlFlow::Continue(())
    }

    /// Returns the index of the bus that receives the frames of a bus of the capture, if any.
    fn destination_bus(&self, bus: usize) -> Option<usize> {
        self.selection.destinations.get(bus).copied().flatten()
    }

    /// Returns the reason why a frame in the replayed part is not sent, or `None` if it is sent.
    fn skip_reason(&self, bus: usize, frame: &Frame, decoded: &Decoded) -> Option<&'static str> {
        let picked = self.destination_bus(bus).is_some();
        if frame.is_error() {
            return Some(reason::ERROR_FRAME);
        }
        if matches!(decoded, Decoded::Wire(..)) {
            return Some(reason::SIMULATED_WIRE);
        }
        // Damaged frames are sent too, because the cells received them in the recording.
        let id = data_frame_id(frame).ok().filter(|_| !matches!(decoded, Decoded::Foreign(_)));
        match self.selection.only {
            _ if !picked => Some(reason::BUS_NOT_SELECTED),
            SenderFilter::Inputs if !id.is_some_and(is_from_gateway_side) => Some(reason::NO_INPUT),
            SenderFilter::Replies if id.and_then(Id::sender).is_none() => Some(reason::NO_REPLY),
            SenderFilter::All | SenderFilter::Inputs | SenderFilter::Replies => None,
        }
    }
}

/// Determines the role of a frame, and passes its message to the comparator.
fn classify_frame(
    bus_index: usize,
    nanos: u64,
    decoded: &Decoded,
    is_sent: bool,
    is_in_part: bool,
    comparator: &mut Comparator,
) -> FrameRole {
    if let Decoded::Message(Message::Joints { epoch, joints }) = *decoded {
        return FrameRole::Joints(AwaitedJoints {
            epoch,
            joints,
            round: comparator.expect_joints(bus_index, nanos, epoch, is_sent),
        });
    }
    if let Decoded::Message(message) = decoded {
        comparator.expect_message(bus_index, message, is_in_part);
    }
    match *decoded {
        Decoded::Segment { id } | Decoded::Damaged { id, fault: PacketError::Incomplete }
            if is_joints(id) =>
        {
            FrameRole::SegmentOfJoints
        }
        Decoded::Segment { .. }
        | Decoded::Message(_)
        | Decoded::Foreign(_)
        | Decoded::Wire(..)
        | Decoded::Damaged { .. }
        | Decoded::Meaningless { .. } => FrameRole::Plain,
    }
}

/// Reasons why frames are not sent.
pub mod reason {
    /// The reason for not sending a frame: it was recorded before `--from`.
    pub const BEFORE_PART: &str = "before --from";
    /// The reason for not sending a frame: it was recorded at `--to` or later.
    pub const AFTER_PART: &str = "after --to";
    /// Frame of a bus that is not replayed (`--bus`).
    pub const BUS_NOT_SELECTED: &str = "not picked";
    /// Frame that is neither a command nor configuration nor a stimulus.
    pub const NO_INPUT: &str = "no input";
    /// Frame that was not sent by a cell.
    pub const NO_REPLY: &str = "no reply";
    /// Error frame: a message of a driver, never on a bus.
    pub const ERROR_FRAME: &str = "error frame";
    /// Frame of a simulated wire: cells send their own wire messages now, and real buses have no wire frames.
    pub const SIMULATED_WIRE: &str = "simulated wire";
    /// Frame of a bus that the capture did not have when it was first read.
    pub const BUS_ADDED_LATER: &str = "bus came later";
    /// Note between frames.
    pub const NOTE_BETWEEN_FRAMES: &str = "note";
}

#[cfg(test)]
mod tests;
