//! The inputs of a timing analysis of one bus (rates, cells, answers), and the worst-case load and times computed from
//! them.

use protocol::can::Format;
use protocol::message::SensorPage;
use protocol::packet::Length;
use protocol::parameters::Sensing;
use protocol::skin::{Skin, SkinReply};
use protocol::wire_time::{BitRates, FrameCoding, FrameShape};

use super::response::{FrameStream, ResponseTime, response_time};

/// Period of heartbeats, in ns.
const HEARTBEAT_NS: u64 = 250_000_000;
/// With sensors on, the pages other than the skin's follow every fourth heartbeat.
const NON_SKIN_PAGES_PERIOD_NS: u64 = 4 * HEARTBEAT_NS;
/// Number of these pages.
#[expect(clippy::cast_possible_truncation, reason = "a few pages")]
const NON_SKIN_PAGE_COUNT: u32 = SensorPage::SIMULATED_PAGE_NAMES.len() as u32 - 1;
/// Share of the period that `skinbus skin generate` gives to slots, in percent.
const SLOTS_SHARE_PERCENT: u64 = 75;

/// The answers of a bus's cells to joints, if all cells are in contact.
#[derive(Clone, Debug, Eq, PartialEq)]
pub enum AnswerPlan {
    /// Each cell sends its own torque.
    Torques {
        /// Number of cells on the bus.
        cells: u32,
    },
    /// Each cell on the bus sends one sum.
    Sums {
        /// Number of cells at each distance from a root, in wires; roots first.
        by_depth: Vec<u32>,
        /// Duration of a slot in ns: the time that each level of the tree has to send its sums.
        slot_ns: u64,
        /// True if cells below the roots send their sums on this bus, too; false if they send them over wires of their
        /// own.
        shared: bool,
    },
}

impl AnswerPlan {
    /// Returns the number of cells on the bus, each of which answers.
    #[must_use]
    pub fn cells(&self) -> u32 {
        match self {
            Self::Torques { cells } => *cells,
            Self::Sums { by_depth, shared: true, .. } => by_depth.iter().sum(),
            Self::Sums { by_depth, shared: false, .. } => by_depth.first().copied().unwrap_or(0),
        }
    }

    /// Returns the same kind of answers for another number of cells; the tree of sums keeps its shape.
    #[must_use]
    pub fn with_cells(&self, cells: u32) -> Self {
        match self {
            Self::Torques { .. } => Self::Torques { cells },
            Self::Sums { by_depth, slot_ns, shared } => {
                let (all, mut given, mut before) = (u64::from(self.cells().max(1)), 0, 0);
                let scaled = by_depth.iter().map(|&here| {
                    before += u64::from(here);
                    let so_far = (before * u64::from(cells)).div_ceil(all);
                    let here = so_far - given;
                    given = so_far;
                    u32::try_from(here).unwrap_or(u32::MAX)
                });
                Self::Sums { by_depth: scaled.collect(), slot_ns: *slot_ns, shared: *shared }
            }
        }
    }
}

/// A bus with its rates and cells, as the input of a timing analysis.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct BusCase {
    /// The frame format: one FD frame per packet, or several classic ones.
    pub format: Format,
    /// The length of joints and answers.
    pub length: Length,
    /// Bit rates of the bus.
    pub rates: BitRates,
    /// Period of the joint broadcast in ns.
    pub period_ns: u64,
    /// The longest time that a cell needs from the end of the joints to its answer, in ns.
    pub computation_ns: u64,
    /// The rates at which cells send sensors frames on their own.
    pub sensing: Sensing,
    /// The answers of the cells.
    pub answers: AnswerPlan,
}

/// Shares of a bus's time by kind of frame, if each frame has its maximum length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BusLoad {
    /// Share of joints.
    pub joints: f64,
    /// Share of torques or sums.
    pub answers: f64,
    /// Share of sensors frames.
    pub sensors: f64,
    /// Share of heartbeats.
    pub heartbeats: f64,
}

impl BusLoad {
    /// Returns the sum of all shares.
    #[must_use]
    pub fn total(&self) -> f64 {
        self.joints + self.answers + self.sensors + self.heartbeats
    }
}

/// Upper bounds of times on a bus; `None` if a time is unbounded.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct WorstCaseTimes {
    /// From the time at which the joints should be sent to their end on the bus, in ns.
    pub joints_ns: Option<u64>,
    /// From the time at which the joints should be sent to the end of the last answer, in ns: the sum of blocking,
    /// joints, computation, blocking, and all answers.
    pub chain_ns: Option<u64>,
    /// Bound of the same time as in `chain_ns`, by response-time analysis; only for torques.
    pub response_ns: Option<ResponseTime>,
    /// From the time at which a heartbeat should be sent to its end, in ns. Cells may send it up to a period of the
    /// joints early.
    pub heartbeat_ns: Option<u64>,
}

impl WorstCaseTimes {
    /// Returns the smaller of the two bounds of the last answer, in ns.
    #[must_use]
    pub fn last_answer_ns(&self) -> Option<u64> {
        self.chain_ns.into_iter().chain(self.response_ns.map(|it| it.worst_ns)).min()
    }
}

impl BusCase {
    /// Returns the timing inputs of one bus as the skin describes it, with these rates; `None` if a cell that answers
    /// with sums is unreachable.
    #[must_use]
    pub fn from_skin(
        skin: &Skin,
        bus: usize,
        format: Format,
        rates: BitRates,
        computation_ns: u64,
    ) -> Option<Self> {
        let described = skin.buses.get(bus)?;
        let period_ns = u64::from(skin.timing.ticks_per_broadcast) * skin.timing.tick_nanos();
        let answers = match described.reply {
            SkinReply::Torque => torques_of_bus(skin, bus),
            SkinReply::Sum { slot_us, .. } => sums_of_tree(skin, bus, period_ns, Some(slot_us), true)?,
        };
        Some(Self {
            format,
            length: skin.packet_length(bus),
            rates,
            period_ns,
            computation_ns,
            sensing: described.sensing,
            answers,
        })
    }

    /// Returns the longest time of a frame of joints or of an answer; on a classic bus, of any frame.
    #[must_use]
    pub fn longest_frame_ns(&self) -> u64 {
        self.frame_time_ns(self.length)
    }

    fn frame_time_ns(&self, length: Length) -> u64 {
        let (coding, len) = match self.format {
            Format::Fd => (FrameCoding::FdSwitched, u8::try_from(length.bytes()).unwrap_or(u8::MAX)),
            Format::Classic => (FrameCoding::Classic, 8),
        };
        FrameShape { coding, extended: false, len }.max_bits().nanoseconds(self.rates)
    }

    /// Returns the number of frames that a packet of this length takes.
    fn frames_per_packet(&self, length: Length) -> u32 {
        match self.format {
            Format::Fd => 1,
            Format::Classic => u32::try_from(length.segments()).unwrap_or(u32::MAX),
        }
    }

    /// Returns the longest time of the frames of joints or of an answer. A classic packet of three frames ends with one
    /// of 4 bytes, which counts as 8.
    #[must_use]
    pub fn longest_packet_ns(&self) -> u64 {
        u64::from(self.frames_per_packet(self.length)) * self.longest_frame_ns()
    }

    /// Returns the time that the answers of this number of cells take on the bus, in ns.
    fn answers_time_ns(&self, cells: u32) -> u64 {
        self.longest_packet_ns().saturating_mul(u64::from(cells))
    }

    /// Returns the duration of an arbitration bit in ns, rounded up.
    fn bit_time_ns(&self) -> u64 {
        1_000_000_000_u64.div_ceil(u64::from(self.rates.nominal_rate()))
    }

    /// Returns the periodic streams on the bus, highest priority first: joints, answers, sensors (page 0, page 1),
    /// heartbeats.
    ///
    /// Heartbeats, and pages that follow them, may be sent up to a period of the joints early.
    fn streams(&self, answers_jitter_ns: u64) -> [FrameStream; 5] {
        let (cells, early_ns) = (self.answers.cells(), self.period_ns);
        let of = |length, senders: u32, period_ns, jitter_ns| {
            let count = senders.saturating_mul(self.frames_per_packet(length));
            FrameStream { count, period_ns, jitter_ns, frame_ns: self.frame_time_ns(length) }
        };
        let stream = |senders, period_ns, jitter_ns| of(Length::Six, senders, period_ns, jitter_ns);
        let none = stream(0, NON_SKIN_PAGES_PERIOD_NS, early_ns);
        let others = stream(cells.saturating_mul(NON_SKIN_PAGE_COUNT), NON_SKIN_PAGES_PERIOD_NS, early_ns);
        let [page_0, others] = match self.sensing {
            Sensing::Off => [none; 2],
            Sensing::Continuous { period_ms } => {
                let period_ns = u64::from(period_ms) * 1_000_000;
                let early_ns = if period_ns > self.period_ns { early_ns } else { 0 };
                [stream(cells, period_ns, early_ns), others]
            }
            Sensing::Event => [stream(cells, HEARTBEAT_NS, early_ns), others],
        };
        [
            of(self.length, 1, self.period_ns, 0),
            of(self.length, cells, self.period_ns, answers_jitter_ns),
            page_0,
            others,
            stream(cells, HEARTBEAT_NS, early_ns),
        ]
    }

    /// Returns the load of the bus. Sensors that send on changes count with the rate at which they send without
    /// changes.
    #[must_use]
    pub fn load(&self) -> BusLoad {
        let [joints, answers, page_0, others, heartbeats] = self.streams(0).map(|it| it.load());
        BusLoad { joints, answers, sensors: page_0 + others, heartbeats }
    }

    /// Returns the worst-case times.
    #[must_use]
    pub fn times(&self) -> WorstCaseTimes {
        let joints_ns = self.joints_response_ns();
        // A heartbeat may be sent a period before it is due; its time counts from then.
        let heartbeat = response_time(&self.streams(self.answer_jitter_ns(joints_ns)), 4, self.bit_time_ns());
        WorstCaseTimes {
            joints_ns,
            chain_ns: joints_ns.and_then(|it| self.additive_last_answer_ns(it)),
            response_ns: self.answer_response(joints_ns),
            heartbeat_ns: heartbeat.map(|it| it.worst_ns.saturating_sub(self.period_ns)),
        }
    }

    /// Returns true if one of the bounds proves that the last answer is complete by [`BusCase::deadline_ns`].
    #[must_use]
    pub fn is_in_time(&self) -> bool {
        let joints_ns = self.joints_response_ns();
        let is_early = |last_ns: u64| last_ns <= self.deadline_ns();
        joints_ns.and_then(|it| self.additive_last_answer_ns(it)).is_some_and(is_early)
            || self.answer_response(joints_ns).is_some_and(|it| is_early(it.worst_ns))
    }

    fn joints_response_ns(&self) -> Option<u64> {
        response_time(&self.streams(0), 0, self.bit_time_ns()).map(|it| it.worst_ns)
    }

    /// Returns the maximum delay in ns of the time at which cells begin to answer, after the joints should be sent.
    fn answer_jitter_ns(&self, joints_ns: Option<u64>) -> u64 {
        joints_ns.unwrap_or(0).saturating_add(self.computation_ns)
    }

    fn answer_response(&self, joints_ns: Option<u64>) -> Option<ResponseTime> {
        match self.answers {
            AnswerPlan::Torques { .. } => {
                response_time(&self.streams(self.answer_jitter_ns(joints_ns)), 1, self.bit_time_ns())
            }
            // The releases of sums depend on each other, which response-time analysis does not cover.
            AnswerPlan::Sums { .. } => None,
        }
    }

    /// Returns the time from when the joints should be sent to the end of the last answer in ns, as a sum of terms:
    ///
    /// ```text
    ///   torques         blocking + joints + computation + blocking + N * reply
    ///   sums            blocking + joints + (computation + blocking) * (deepest + 1) + N * reply
    ///   roots' alone    blocking + joints + slot * deepest + computation + blocking + N * reply
    /// ```
    ///
    /// A frame of lower priority can block twice: once the joints, and, because the bus is idle while cells compute,
    /// once the answers. From then on the bus sends only answers until all are sent. With sums, the bus is idle only
    /// while every cell that has not sent yet waits for one that computes; this happens at most once per level of the
    /// tree. Returns `None` if the time exceeds a period: the remaining frames would delay the next answers.
    fn additive_last_answer_ns(&self, joints_ns: u64) -> Option<u64> {
        // Answers that are ready when the joints end leave no gap for other frames.
        let blocking_ns = if self.computation_ns > 0 { self.longest_frame_ns() } else { 0 };
        let step_ns = self.computation_ns.saturating_add(blocking_ns);
        let ready_ns = match &self.answers {
            AnswerPlan::Torques { .. } => step_ns,
            AnswerPlan::Sums { by_depth, shared: true, .. } => {
                let deep = by_depth.iter().rposition(|&here| here > 0).unwrap_or(0);
                step_ns.saturating_mul(u64::try_from(deep).unwrap_or(u64::MAX).saturating_add(1))
            }
            AnswerPlan::Sums { by_depth, slot_ns, shared: false } => {
                let deepest = u64::try_from(by_depth.len().saturating_sub(1)).unwrap_or(u64::MAX);
                slot_ns.saturating_mul(deepest).saturating_add(step_ns)
            }
        };
        let last_ns =
            joints_ns.checked_add(ready_ns)?.checked_add(self.answers_time_ns(self.answers.cells()))?;
        (last_ns <= self.period_ns).then_some(last_ns)
    }

    /// Returns the deadline of the last answer, in ns from the broadcast: the next broadcast for torques; for sums 7/8
    /// of the period, for which a cell waits for other sums.
    #[must_use]
    pub const fn deadline_ns(&self) -> u64 {
        match self.answers {
            AnswerPlan::Torques { .. } => self.period_ns,
            AnswerPlan::Sums { .. } => self.period_ns / 8 * 7,
        }
    }

    /// Returns the same bus with this number of cells.
    #[must_use]
    pub fn with_cells(&self, cells: u32) -> Self {
        Self { answers: self.answers.with_cells(cells), ..self.clone() }
    }
}

fn torques_of_bus(skin: &Skin, bus: usize) -> AnswerPlan {
    AnswerPlan::Torques { cells: u32::try_from(skin.cells_on_bus(bus).count()).unwrap_or(u32::MAX) }
}

/// Returns the sums for the tree that the wires of a bus allow; `None` if a cell is unreachable. If the skin gives no
/// slot duration, that of `skinbus skin generate` is used.
pub(super) fn sums_of_tree(
    skin: &Skin,
    bus: usize,
    period_ns: u64,
    slot_us: Option<u32>,
    shared: bool,
) -> Option<AnswerPlan> {
    let depths = skin.wires(bus).cell_depths();
    let mut by_depth = Vec::new();
    for cell in skin.cells_on_bus(bus) {
        let depth = usize::from((*depths.get(cell.node.index())?)?);
        if by_depth.len() <= depth {
            by_depth.resize(depth + 1, 0);
        }
        *by_depth.get_mut(depth)? += 1;
    }
    let slots = u64::try_from(by_depth.len().max(1)).unwrap_or(u64::MAX);
    let slot_ns =
        slot_us.map_or_else(|| period_ns * SLOTS_SHARE_PERCENT / 100 / slots, |us| u64::from(us) * 1_000);
    Some(AnswerPlan::Sums { by_depth, slot_ns, shared })
}
