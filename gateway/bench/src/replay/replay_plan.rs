//! From the frames of a capture to what is sent, and when.
//!
//! ```text
//!   frames ──> take ──> [ order by time ] ──> [ what is it? ] ──> picked? ──> Step, Step, ... ──> player
//!                                └── joints, replies ──> comparator
//! ```

use std::collections::{BTreeMap, VecDeque};
use std::ops::ControlFlow;

use protocol::can::Frame;
use protocol::candump::Record;
use protocol::id::Id;
use protocol::message::{Joints, Message};
use protocol::packet::{Epoch, PacketError, data_id};
use protocol::time::Micros;

use super::comparator::Comparator;
use super::survey::{Survey, is_input, is_joints};
use model::decode::Decoded;
use model::decode::settle::Settler;
use trace::order::{Order, Ordered};

/// Recorded replies are taken in for so long after the end of the part, in ns: they answer joints in it.
const LATE_REPLIES_NS: u64 = 1_000_000_000;
/// The minimum time from one pass to the next, in ns.
const MIN_GAP_NS: u64 = 1_000_000;

/// Whose frames are sent.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum Only {
    /// Everybody's, foreign ones too.
    #[default]
    All,
    /// Commands, configuration and stimuli.
    Inputs,
    /// What cells sent.
    Replies,
}

/// What is sent.
#[derive(Clone, Debug)]
pub struct Selection {
    /// The filter by sender.
    pub only: Only,
    /// By the capture's buses: where a bus' frames go, if they go anywhere.
    pub bus_links: Vec<Option<usize>>,
    /// Whether packets are read: joints are numbered, and replies handed on.
    pub reads: bool,
}

/// What is to be done next.
#[derive(Clone, Debug, PartialEq)]
pub enum Step {
    /// A frame is to be sent.
    Frame(Due),
    /// A pass begins: the latched state is restored, bus by bus.
    Restore(Vec<(usize, Vec<Message>)>),
}

/// A frame and its time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Due {
    /// When, in ns after the first one, by the capture's clock and over all passes.
    pub at: u64,
    /// On which bus.
    pub bus_link: usize,
    /// What.
    pub frame: Frame,
    /// What it means for the order of things.
    pub role: Role,
    /// It is older than what was sent before it, and is sent at once.
    pub is_late: bool,
}

/// What a frame means for the order of things.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Role {
    /// Nothing.
    Plain,
    /// The first segment of joints.
    SegmentOfJoints,
    /// Joints.
    Joints(Open),
}

/// Joints that cells answer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Open {
    /// Their epoch.
    pub epoch: Epoch,
    /// Their positions.
    pub joints: Joints,
    /// Which ones they are on their bus, if they are compared.
    pub round: Option<u64>,
}

/// What a replay plan has counted.
#[derive(Clone, Debug, Default)]
pub struct PlanSummary {
    /// Frames that were not sent, by reason.
    pub skipped: BTreeMap<&'static str, u64>,
    /// Frames that were older than one sent before them.
    pub late: u64,
}

/// One pass over a capture, or several.
#[derive(Debug)]
pub struct ReplayPlan<'a> {
    survey: &'a Survey,
    selection: &'a Selection,
    /// Frames that wait for their place, with their buses.
    order: Order<(usize, Frame)>,
    settler: Settler<Ordered<(usize, Frame)>>,
    steps: VecDeque<Step>,
    plan_summary: PlanSummary,
    /// When this pass begins, in ns after the first one.
    offset: u64,
    /// The times of the first and the last frame of this pass that are sent.
    sent: Option<(u64, u64)>,
    /// Frames and joints of this pass that are sent.
    counts: (u64, u64),
}

impl<'a> ReplayPlan<'a> {
    /// Of a capture that has been looked through.
    #[must_use]
    pub fn new(survey: &'a Survey, selection: &'a Selection) -> Self {
        Self {
            survey,
            selection,
            order: Order::default(),
            settler: Settler::new(None),
            steps: VecDeque::new(),
            plan_summary: PlanSummary::default(),
            offset: 0,
            sent: None,
            counts: (0, 0),
        }
    }

    /// Takes the capture's next frame; breaks off when what follows is of no interest.
    pub fn take(&mut self, record: &Record<'_>, comparator: &mut Comparator) -> ControlFlow<()> {
        let Some(bus) = self.survey.bus_named(record.interface) else {
            self.skip(reason::NEW);
            return ControlFlow::Continue(());
        };
        self.order.push(bus, record.time.nanos, (bus, record.frame));
        while let Some(next) = self.order.pop() {
            self.settle(next);
            self.place_settled(comparator)?;
        }
        ControlFlow::Continue(())
    }

    /// What is to be done next, as far as that is known.
    pub fn next_step(&mut self) -> Option<Step> {
        self.steps.pop_front()
    }

    /// Finds out what a frame is.
    fn settle(&mut self, next: Ordered<(usize, Frame)>) {
        let (bus, frame) = next.item;
        let name = self.survey.buses.get(bus).map_or("", |bus| bus.name.as_str());
        self.settler.push(Micros(next.nanos / 1_000), name, &frame, next);
    }

    /// Frames whose turn has come, as far as it is known what they are.
    fn place_settled(&mut self, comparator: &mut Comparator) -> ControlFlow<()> {
        while let Some((next, decoded)) = self.settler.pop() {
            self.place(&next, &decoded, comparator)?;
        }
        ControlFlow::Continue(())
    }

    /// Takes in that the capture, or the part of interest, has ended; another pass may follow.
    pub fn end_pass(&mut self, comparator: &mut Comparator) {
        while let Some(next) = self.order.pop_last() {
            self.settle(next);
        }
        self.settler.finish();
        let _ = self.place_settled(comparator);
        self.order = Order::default();
        self.settler = Settler::new(None);
        if let Some((first, last)) = self.sent.take() {
            let (frames, joints) = self.counts;
            let steps = if joints > 1 { joints } else { frames }.saturating_sub(1).max(1);
            let gap = ((last - first).checked_div(steps)).unwrap_or(0).max(MIN_GAP_NS);
            self.offset += last - first + gap;
        }
        self.counts = (0, 0);
    }

    /// The messages that restore the state where the part begins.
    #[must_use]
    pub fn restoring(&self) -> Step {
        let bounds = self.survey.bounds();
        let of = |(bus, bus_link): (&super::survey::Bus, &Option<usize>)| {
            let there: Vec<_> = bus.cells_in(bounds).map(|(cell, _)| cell).collect();
            Some(((*bus_link)?, bus.state.restoring(|cell| there.contains(&cell), bus.first_joints)))
        };
        Step::Restore(self.survey.buses.iter().zip(&self.selection.bus_links).filter_map(of).collect())
    }

    /// Its counts.
    #[must_use]
    pub fn into_summary(self) -> PlanSummary {
        self.plan_summary
    }

    /// Counts something that is not sent.
    pub fn skip(&mut self, reason: &'static str) {
        *self.plan_summary.skipped.entry(reason).or_default() += 1;
    }

    /// A frame's turn has come.
    fn place(
        &mut self,
        next: &Ordered<(usize, Frame)>,
        decoded: &Decoded,
        comparator: &mut Comparator,
    ) -> ControlFlow<()> {
        let (from, to) = self.survey.bounds();
        if next.at >= to.saturating_add(LATE_REPLIES_NS) {
            return ControlFlow::Break(());
        }
        let (bus, frame) = next.item;
        let unwanted = if next.nanos < from {
            Some(reason::BEFORE)
        } else if next.nanos >= to {
            Some(reason::AFTER)
        } else {
            self.unwanted(bus, &frame, decoded)
        };
        let bus_link = self.bus_link(bus);
        let role = bus_link.filter(|_| self.selection.reads).map_or(Role::Plain, |bus_link| {
            let is_in_part = (from..to).contains(&next.nanos);
            read(bus_link, next.nanos, decoded, unwanted.is_none(), is_in_part, comparator)
        });
        if let Some(reason) = unwanted {
            self.skip(reason);
            return ControlFlow::Continue(());
        }
        let Some(bus_link) = bus_link else { return ControlFlow::Continue(()) };
        self.plan_summary.late += u64::from(next.is_late);
        let (first, last) = self.sent.get_or_insert((next.at, next.at));
        *last = next.at;
        let at = self.offset + (next.at - *first);
        self.counts.0 += 1;
        self.counts.1 += u64::from(matches!(role, Role::Joints(_)) && bus_link == 0);
        self.steps.push_back(Step::Frame(Due { at, bus_link, frame, role, is_late: next.is_late }));
        ControlFlow::Continue(())
    }

    /// Where a bus' frames go.
    fn bus_link(&self, bus: usize) -> Option<usize> {
        self.selection.bus_links.get(bus).copied().flatten()
    }

    /// Why a frame of the part is not sent.
    fn unwanted(&self, bus: usize, frame: &Frame, decoded: &Decoded) -> Option<&'static str> {
        let picked = self.bus_link(bus).is_some();
        if frame.is_error() {
            return Some(reason::ERROR);
        }
        if matches!(decoded, Decoded::Wire(..)) {
            return Some(reason::WIRE);
        }
        // Cells received damaged frames as well.
        let id = data_id(frame).ok().filter(|_| !matches!(decoded, Decoded::Foreign(_)));
        match self.selection.only {
            _ if !picked => Some(reason::NOT_PICKED),
            Only::Inputs if !id.is_some_and(is_input) => Some(reason::NO_INPUT),
            Only::Replies if id.and_then(Id::sender).is_none() => Some(reason::NO_REPLY),
            Only::All | Only::Inputs | Only::Replies => None,
        }
    }
}

/// Decodes a frame, as far as that is of interest.
fn read(
    bus_link: usize,
    nanos: u64,
    decoded: &Decoded,
    is_sent: bool,
    is_in_part: bool,
    comparator: &mut Comparator,
) -> Role {
    if let Decoded::Message(Message::Joints { epoch, joints }) = *decoded {
        return Role::Joints(Open {
            epoch,
            joints,
            round: comparator.record_joints(bus_link, nanos, epoch, is_sent),
        });
    }
    if let Decoded::Message(message) = decoded {
        comparator.record(bus_link, message, is_in_part);
    }
    match *decoded {
        Decoded::Segment { id } | Decoded::Damaged { id, fault: PacketError::Incomplete }
            if is_joints(id) =>
        {
            Role::SegmentOfJoints
        }
        Decoded::Segment { .. }
        | Decoded::Message(_)
        | Decoded::Foreign(_)
        | Decoded::Wire(..)
        | Decoded::Damaged { .. }
        | Decoded::Meaningless { .. } => Role::Plain,
    }
}

/// Why frames are not sent.
pub mod reason {
    /// Before `--from`.
    pub const BEFORE: &str = "before --from";
    /// At `--to` or after it.
    pub const AFTER: &str = "after --to";
    /// Left out by `--kind`, `--node` or `--bus`.
    pub const NOT_PICKED: &str = "not picked";
    /// No command, configuration or stimulus.
    pub const NO_INPUT: &str = "no input";
    /// Not sent by a cell.
    pub const NO_REPLY: &str = "no reply";
    /// An error frame is a message of a driver, and was never on a bus.
    pub const ERROR: &str = "error frame";
    /// Cells send their own messages over their wires now; and wires are on no real bus.
    pub const WIRE: &str = "simulated wire";
    /// Of a bus that the capture did not have when it was first read.
    pub const NEW: &str = "bus came later";
    /// What stands between frames.
    pub const NOTE: &str = "note";
}

#[cfg(test)]
mod tests;
