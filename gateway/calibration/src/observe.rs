//! What a calibration is made from: the positions of the joints at each broadcast, and what each cell showed then.

use model::central::Central;
use protocol::fixed::Q;
use protocol::id::CellId;
use protocol::message::{Message, SensorPage};
use protocol::packet::Epoch;
use protocol::parameters::{MAX_JOINTS, RowKind};
use protocol::skin::Skin;

/// Readings at this value are at the end of their word.
const FULL: i16 = i16::MAX - 8;

/// What all buses of a skin carried.
#[derive(Clone, Debug)]
pub struct Observations {
    /// By bus.
    pub buses: Vec<BusObservations>,
    /// By cell of the skin, in the order of time.
    pub cells: Vec<Vec<Reading>>,
}

/// The joints of one bus.
#[derive(Clone, Debug)]
pub struct BusObservations {
    /// By broadcast, the positions in rad or m; `None` for one that is missing.
    pub joints: Vec<Option<[f64; MAX_JOINTS]>>,
    reference: Central,
    revolute: Vec<bool>,
    nodes: Vec<Option<usize>>,
    last: Option<Epoch>,
}

/// What a cell showed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reading {
    /// The broadcast, as an index into [`BusObservations::joints`].
    pub epoch: u32,
    /// Its axes, in g.
    pub g: [f64; 3],
}

impl Observations {
    /// Nothing yet.
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
                reference: Central::unquantised(&skin.part_on(bus)),
                revolute: rows
                    .filter(|kind| *kind != RowKind::Fixed)
                    .map(|kind| kind == RowKind::Revolute)
                    .collect(),
                nodes,
                last: None,
            }
        };
        Self { buses: (0..skin.buses.len()).map(bus).collect(), cells: vec![Vec::new(); skin.cells.len()] }
    }

    /// Takes the next message of a bus, given as an index into [`Skin::buses`], in the order of time.
    pub fn take(&mut self, bus: usize, message: &Message) {
        let Some(bus) = self.buses.get_mut(bus) else { return };
        if let Message::Joints { epoch, joints } = message {
            bus.broadcast(*epoch, &joints.positions);
        } else if let Message::Sensors { from, epoch, page: SensorPage::Acceleration(words) } = message {
            let cell = bus.nodes.get(usize::from(from.get())).copied().flatten();
            let cell = cell.and_then(|cell| self.cells.get_mut(cell));
            let full = words.iter().any(|word| word.to_bits() > FULL || word.to_bits() < -FULL);
            if let (Some(cell), Some(epoch), false) = (cell, bus.index_of(*epoch), full) {
                // A page that repeats what an earlier one said of these joints says nothing new.
                if cell.last().is_none_or(|last| last.epoch < epoch) {
                    cell.push(Reading { epoch, g: words.map(Q::to_f64) });
                }
            }
        }
    }
}

impl BusObservations {
    fn broadcast(&mut self, epoch: Epoch, words: &[protocol::fixed::Q1_14]) {
        let steps = self.last.map_or(1, |last| epoch.since(last));
        if steps < 1 {
            // The same one again, or an old one.
            return;
        }
        self.joints.extend((1..steps).map(|_| None));
        let mut positions = self.reference.positions(words);
        // Words of angles wrap around at half a turn; joints do not.
        if let Some(before) = self.joints.iter().rev().find_map(Option::as_ref) {
            for ((position, before), revolute) in positions.iter_mut().zip(before).zip(&self.revolute) {
                if *revolute {
                    *position +=
                        ((before - *position) / core::f64::consts::TAU).round() * core::f64::consts::TAU;
                }
            }
        }
        self.joints.push(Some(positions));
        self.last = Some(epoch);
    }

    /// Which broadcast an epoch is: the newest one with this number.
    fn index_of(&self, epoch: Epoch) -> Option<u32> {
        let age = usize::try_from(self.last?.since(epoch)).ok()?;
        u32::try_from(self.joints.len().checked_sub(1 + age)?).ok()
    }
}
