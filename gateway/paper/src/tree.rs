//! Computes torque sums along a tree with the cells' own arithmetic but without a bus, and compares the sums at the
//! roots with the central computation for the same touch.

use std::collections::VecDeque;

use cell_node::contact::{Force, Torque};
use cell_node::kernel::{Kernel, Wrench};
use cell_node::sum::{EpochStart, SubtreeSum};
use protocol::fixed::{Accumulator, Q1_14};
use protocol::id::CellId;
use protocol::message::SkinSensors;
use protocol::packet::Epoch;
use protocol::parameters::MAX_JOINTS;
use protocol::parameters::SumSchedule;
use protocol::skin::Skin;
use protocol::time::{Micros, Span};

use model::central::CentralComputation;

/// The number of fraction bits of a cell's exact torque that Q7.8 does not have.
const DROPPED_FRACTION_BITS: u32 = 30 - 8;
/// The interval between joint broadcasts, in µs.
const JOINTS_INTERVAL_US: u64 = 16_000;

/// A cell, the number of wires from it to the root, and its children, each with the port to it.
#[derive(Clone, Debug)]
struct Branch {
    cell: usize,
    depth: u8,
    children: Vec<(usize, usize)>,
}

/// A skin on one bus whose cells send sums along the shortest paths to the nearest root.
#[derive(Clone, Debug)]
pub struct SumTree {
    skin: Skin,
    central: CentralComputation,
    sums: Vec<SubtreeSum>,
    /// The cells, sorted so that each comes after its children.
    order: Vec<Branch>,
    kernels: Vec<Wrench>,
    epoch: Epoch,
}

/// The sums of one epoch and the torques to compare them with, in Nm.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EpochSums {
    /// The torque that the central computation yields in double precision.
    pub central: [f64; MAX_JOINTS],
    /// The sum that arrives at the roots, in Q7.8.
    pub sum: [f64; MAX_JOINTS],
    /// The sum of the torques of all active cells, each truncated to Q7.8.
    pub truncated: [f64; MAX_JOINTS],
    /// The number of joints that active cells load, counted from the base.
    pub loaded: usize,
    /// The number of cells whose torques are in the sum.
    pub count: usize,
}

impl SumTree {
    /// Creates a tree for a skin. With `carry`, each cell adds its rounding error to its next torque. Cells without a
    /// path to a root are left out.
    #[must_use]
    pub fn new(skin: &Skin, carry: bool) -> Self {
        let place = |node: CellId| skin.cells.iter().position(|cell| cell.node == node);
        let mut reached = vec![false; skin.cells.len()];
        let mut next = VecDeque::new();
        for ((at, cell), reached) in skin.cells.iter().enumerate().zip(&mut reached) {
            if cell.root {
                *reached = true;
                next.push_back((at, 0_u8));
            }
        }
        let mut order = Vec::new();
        while let Some((cell, depth)) = next.pop_front() {
            let mut children = Vec::new();
            let neighbors = skin.cells.get(cell).map(|cell| cell.neighbors).unwrap_or_default();
            for (port, child) in neighbors.iter().enumerate() {
                let Some(child) = child.and_then(place) else { continue };
                if reached.get_mut(child).is_some_and(|reached| !core::mem::replace(reached, true)) {
                    children.push((port, child));
                    next.push_back((child, depth.saturating_add(1)));
                }
            }
            order.push(Branch { cell, depth, children });
        }
        order.reverse();
        let deepest = order.first().map_or(0, |branch| branch.depth);
        let mut sums = vec![SubtreeSum::default(); skin.cells.len()];
        for sum in &mut sums {
            sum.set_schedule(Some(SumSchedule { slot_us: 600, deepest, carry }));
        }
        let kernels = skin.cells.iter().map(|cell| Wrench::new(&skin.parameters(cell))).collect();
        Self {
            central: CentralComputation::new(skin),
            skin: skin.clone(),
            sums,
            order,
            kernels,
            epoch: Epoch(0),
        }
    }

    /// Returns the number of cells that have a path to a root.
    #[must_use]
    pub fn cells(&self) -> usize {
        self.order.len()
    }

    /// Runs one epoch with the joint positions `q` in rad. `touch` are the cells in contact, by index, with their
    /// sensor values.
    pub fn run_epoch(&mut self, q: &[f64; MAX_JOINTS], touch: &[(usize, SkinSensors)]) -> EpochSums {
        let words = q.map(|q| Q1_14::from_radians(q).unwrap_or_default());
        let frames = self.central.link_frames(&words);
        let mut came = EpochSums::default();
        let mut own = vec![None; self.sums.len()];
        for (place, sensors) in touch {
            let (Some(cell), Some(kernel)) = (self.skin.cells.get(*place), self.kernels.get(*place)) else {
                continue;
            };
            let force = self.central.cell_force(*place, sensors);
            add_torque(&mut came.central, self.central.cell_torque(*place, &frames, force));
            let force = Force::fuse(sensors.contact, sensors.proximity, &self.skin.parameters(cell).contact);
            let exact = Torque::new(&kernel.jacobian(&words), force).exact_torques();
            add_torque(&mut came.truncated, exact.map(truncate_to_q7_8_nm));
            came.loaded = came.loaded.max(cell.joint.into());
            if let Some(own) = own.get_mut(*place) {
                *own = Some(exact);
            }
        }
        self.epoch = self.epoch.next();
        let mut said = vec![None; self.sums.len()];
        for Branch { cell, depth, children } in &self.order {
            let Some(sum) = self.sums.get_mut(*cell) else { continue };
            let begin = EpochStart {
                epoch: self.epoch,
                at: Micros(0),
                period: Span(JOINTS_INTERVAL_US),
                depth: Some(*depth),
                may_send: true,
                children: children.iter().map(|(port, _)| 1 << port).sum(),
            };
            sum.begin_epoch(&begin, own.get(*cell).and_then(Option::as_ref));
            for (port, child) in children {
                if let Some((epoch, words, restarted)) = said.get(*child).copied().flatten() {
                    if restarted {
                        sum.handle_state_message(Micros(0), *port, epoch);
                    }
                    sum.receive_sum(Micros(0), *port, epoch, words);
                }
            }
            let says = sum.poll_sum(Micros(JOINTS_INTERVAL_US));
            if let (0, Some((_, words, _))) = (depth, &says) {
                add_torque(&mut came.sum, words.torque.map(|word| word.to_f64()));
                came.count += usize::from(words.count);
            }
            if let Some(said) = said.get_mut(*cell) {
                *said = says;
            }
        }
        came
    }
}

fn add_torque(sum: &mut [f64; MAX_JOINTS], more: [f64; MAX_JOINTS]) {
    for (sum, more) in sum.iter_mut().zip(more) {
        *sum += more;
    }
}

/// Returns the torque in Nm after the bits below those of Q7.8 were dropped.
#[expect(clippy::cast_precision_loss, reason = "a torque has far fewer than 2^53 steps")]
fn truncate_to_q7_8_nm(exact: Accumulator<30>) -> f64 {
    (exact.steps() >> DROPPED_FRACTION_BITS) as f64 / 256.0
}
