//! Observations: the positions of the joints at each broadcast, and the reading of each cell.
//!
//! Speeds and accelerations follow from positions at regular times, so the time of each broadcast is compared with that
//! of the previous one. Where a control loop skipped ticks, or frames are missing, a gap without positions remains, and
//! no polynomial is fitted across it.

use model::central::CentralComputation;
use protocol::fixed::Q;
use protocol::id::CellId;
use protocol::message::{Message, SensorPage};
use protocol::packet::Epoch;
use protocol::parameters::{MAX_JOINTS, RowKind};
use protocol::skin::Skin;
use protocol::time::Micros;

/// The word from which on a reading counts as saturated.
const MIN_SATURATED_WORD: i16 = i16::MAX - 8;
/// The allowed jitter of the receive time of a broadcast, in periods.
const MAX_JITTER_PERIODS: f64 = 0.25;
/// The number of consecutive broadcasts over which the period is measured.
const PERIOD_MEASURING_BROADCASTS: usize = 8;
/// The maximum number of later broadcasts before a reading arrives.
const MAX_READING_DELAY_BROADCASTS: u32 = 100;

/// The observations on all buses of a skin.
#[derive(Clone, Debug)]
pub struct Observations {
    /// The observations on each bus.
    pub buses: Vec<BusObservations>,
    /// The readings of each cell of the skin, in the order of time.
    pub cells: Vec<Vec<Reading>>,
}

/// The broadcasts of joints on one bus.
#[derive(Clone, Debug)]
pub struct BusObservations {
    /// The positions at each broadcast in rad or m; `None` for a missing broadcast and at irregular times.
    pub joints: Vec<Option<[f64; MAX_JOINTS]>>,
    /// The gaps after which the next broadcast was not in time, in the order of time.
    pub gaps: Vec<BroadcastGap>,
    /// The number of joints in the frames, if it differs from that of the chain.
    pub(crate) other_joints: Option<u8>,
    reference: CentralComputation,
    revolute: Vec<bool>,
    nodes: Vec<Option<usize>>,
    /// The newest broadcast with each epoch number.
    epochs: Vec<Option<u32>>,
    /// The times of consecutive broadcasts.
    times: Vec<Micros>,
    /// The durations of [`PERIOD_MEASURING_BROADCASTS`] periods, in us.
    spans: Vec<u64>,
    period_us: f64,
    first: Option<Micros>,
    last: Option<(Epoch, Micros)>,
}

/// A gap in the broadcasts of a bus, after which the next one did not come in time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BroadcastGap {
    /// The time of the broadcast before the gap, in s since the first broadcast.
    pub at_s: f64,
    /// The time from that broadcast to the next one, in ms.
    pub took_ms: f64,
    /// The entry without positions that stands for the gap, as an index into [`BusObservations::joints`].
    pub(crate) place: usize,
}

/// A reading of a cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reading {
    /// The broadcast that the reading answers, as an index into [`BusObservations::joints`].
    pub epoch: u32,
    /// The reading of each axis, in g.
    pub g: [f64; 3],
}

impl Observations {
    /// Creates empty observations.
    #[must_use]
    pub fn new(skin: &Skin) -> Self {
        let bus = |bus: usize| {
            let mut nodes = vec![None; CellId::COUNT + 1];
            for (index, cell) in skin.cells.iter().enumerate().filter(|(_, cell)| cell.bus == bus) {
                if let Some(node) = nodes.get_mut(usize::from(cell.node.get())) {
                    *node = Some(index);
                }
            }
            let rows = skin.chain(bus).rows.iter().map(|row| row.kind);
            BusObservations {
                joints: Vec::new(),
                gaps: Vec::new(),
                other_joints: None,
                reference: CentralComputation::without_quantisation(&skin.with_cells_of_bus(bus)),
                revolute: rows
                    .filter(|kind| *kind != RowKind::Fixed)
                    .map(|kind| kind == RowKind::Revolute)
                    .collect(),
                nodes,
                epochs: vec![None; 256],
                times: Vec::new(),
                spans: Vec::new(),
                period_us: 1e6 / skin.timing.broadcast_hz(),
                first: None,
                last: None,
            }
        };
        Self { buses: (0..skin.buses.len()).map(bus).collect(), cells: vec![Vec::new(); skin.cells.len()] }
    }

    /// Records the next message of a bus, given as an index into [`Skin::buses`], with the time at which it was on the
    /// bus.
    pub fn record(&mut self, bus: usize, at: Micros, message: &Message) {
        let Some(bus) = self.buses.get_mut(bus) else { return };
        if let Message::Joints { epoch, joints } = message {
            if usize::from(joints.in_use) != bus.revolute.len() {
                bus.other_joints = Some(joints.in_use);
            }
            bus.add_broadcast(*epoch, at, &joints.positions);
        } else if let Message::Sensors { from, epoch, page: SensorPage::Acceleration(words) } = message {
            let cell = bus.nodes.get(usize::from(from.get())).copied().flatten();
            let cell = cell.and_then(|cell| self.cells.get_mut(cell));
            let full = words
                .iter()
                .any(|word| word.to_bits() > MIN_SATURATED_WORD || word.to_bits() < -MIN_SATURATED_WORD);
            if let (Some(cell), Some(epoch), false) = (cell, bus.broadcast_index(*epoch), full) {
                // A page that repeats the reading for the same joints adds no information.
                if cell.last().is_none_or(|last| last.epoch < epoch) {
                    cell.push(Reading { epoch, g: words.map(Q::to_f64) });
                }
            }
        }
    }
}

impl BusObservations {
    fn add_broadcast(&mut self, epoch: Epoch, at: Micros, words: &[protocol::fixed::Q1_14]) {
        if let Some((last, before)) = self.last {
            let periods = as_f64(at.0.saturating_sub(before.0)) / self.period_us;
            let steps = epoch.epochs_since(last);
            // Epoch numbers repeat after 256 broadcasts.
            if steps < 1 && periods < f64::from(MAX_READING_DELAY_BROADCASTS) {
                // A repeated or an old broadcast.
                return;
            }
            let is_regular = steps >= 1 && (periods - f64::from(steps)).abs() <= MAX_JITTER_PERIODS;
            if is_regular {
                self.joints.extend((1..steps).map(|_| None));
                self.measure_period(at, steps == 1);
            } else {
                let (at_s, took_ms) = (self.seconds_since_first(before), periods * self.period_us * 1e-3);
                self.gaps.push(BroadcastGap { at_s, took_ms, place: self.joints.len() });
                self.joints.push(None);
                self.measure_period(at, false);
            }
        }
        let mut positions = self.reference.joint_positions(words);
        // Words of angles wrap around at half a turn; joints do not.
        if let Some(before) = self.joints.iter().rev().find_map(Option::as_ref) {
            for ((position, before), revolute) in positions.iter_mut().zip(before).zip(&self.revolute) {
                if *revolute {
                    *position +=
                        ((before - *position) / core::f64::consts::TAU).round() * core::f64::consts::TAU;
                }
            }
        }
        if let (Some(place), Ok(index)) =
            (self.epochs.get_mut(usize::from(epoch.0)), u32::try_from(self.joints.len()))
        {
            *place = Some(index);
        }
        self.joints.push(Some(positions));
        self.first.get_or_insert(at);
        self.last = Some((epoch, at));
    }

    /// Measures the period over consecutive broadcasts.
    fn measure_period(&mut self, at: Micros, is_next: bool) {
        if !is_next {
            self.times.clear();
        }
        self.times.push(at);
        let before = self
            .times
            .len()
            .checked_sub(PERIOD_MEASURING_BROADCASTS + 1)
            .and_then(|index| self.times.get(index));
        self.spans.extend(before.map(|before| at.0.saturating_sub(before.0)));
    }

    /// Returns the period of broadcasts on the bus, in s, or `None` if too few were consecutive.
    pub(crate) fn period_s(&self) -> Option<f64> {
        let mut spans = self.spans.clone();
        spans.sort_unstable();
        let middle = spans.get(spans.len() / 2)?;
        Some(as_f64(*middle) * 1e-6 / f64::from(u8::try_from(PERIOD_MEASURING_BROADCASTS).unwrap_or(1)))
    }

    /// Returns the time since the first broadcast, in s.
    fn seconds_since_first(&self, at: Micros) -> f64 {
        as_f64(at.0.saturating_sub(self.first.map_or(at.0, |first| first.0))) * 1e-6
    }

    /// Returns the newest broadcast with this epoch number.
    fn broadcast_index(&self, epoch: Epoch) -> Option<u32> {
        let index = self.epochs.get(usize::from(epoch.0)).copied().flatten()?;
        let last = u32::try_from(self.joints.len()).ok()?;
        (last - index <= MAX_READING_DELAY_BROADCASTS).then_some(index)
    }
}

#[expect(clippy::cast_precision_loss, reason = "2^53 us are 285 years")]
const fn as_f64(us: u64) -> f64 {
    us as f64
}
