//! How far sums along a tree are from the central computation: rounding, carrying, and what the paper did.

#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a test may stop")]
#![allow(clippy::print_stdout, reason = "the figures are worth a look")]

use std::path::Path;

use cell_node::contact::{Force, Torque};
use cell_node::kernel::{Kernel, Wrench};
use cell_node::sum::{Begin, Sum};
use gateway::central::Central;
use protocol::fixed::{Q1_14, Q5_10};
use protocol::message::SkinSensors;
use protocol::packet::{Epoch, WORDS};
use protocol::parameters::Slots;
use protocol::skin::Skin;
use protocol::time::{Micros, Span};
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// Cells that are touched.
const ACTIVE: usize = 20;
/// Epochs over which a constant touch is averaged.
const AVERAGED: usize = 32;

/// A cell, its depth, and its children with their ports.
type Branch = (usize, u8, Vec<(usize, usize)>);

/// A skin whose cells add up along the shortest ways to the root.
struct Tree {
    skin: Skin,
    central: Central,
    sums: Vec<Sum>,
    /// From the leaves to the root.
    order: Vec<Branch>,
    kernels: Vec<Wrench>,
    epoch: Epoch,
}

/// What came out of one epoch, in Nm.
struct Came {
    central: [f64; WORDS],
    sum: [f64; WORDS],
    truncated: [f64; WORDS],
    loaded: usize,
}

impl Tree {
    fn new(carry: bool) -> Self {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../gateway/examples/ur5-253.toml");
        let skin = Skin::read(&path).unwrap();
        let place = |node| skin.cells.iter().position(|cell| cell.node == node).unwrap();
        let root = skin.cells.iter().position(|cell| cell.root).unwrap();
        let mut depths = vec![None; skin.cells.len()];
        let mut order = Vec::new();
        let mut next = std::collections::VecDeque::from([(root, 0_u8)]);
        depths[root] = Some(0_u8);
        let mut children = vec![Vec::new(); skin.cells.len()];
        while let Some((at, depth)) = next.pop_front() {
            order.push((at, depth));
            for (port, node) in skin.cells[at].neighbors.iter().enumerate() {
                let Some(child) = node.map(place).filter(|&child| depths[child].is_none()) else { continue };
                depths[child] = Some(depth + 1);
                children[at].push((port, child));
                next.push_back((child, depth + 1));
            }
        }
        assert_eq!(order.len(), skin.cells.len(), "one tree");
        let deepest = order.last().unwrap().1;
        let order = order.into_iter().rev().map(|(at, depth)| (at, depth, children[at].clone())).collect();
        let mut sums = vec![Sum::default(); skin.cells.len()];
        for sum in &mut sums {
            sum.set_slots(Some(Slots { slot_us: 600, deepest, carry }));
        }
        let kernels = skin.cells.iter().map(|cell| Wrench::new(&skin.parameters(cell))).collect();
        Self { central: Central::new(&skin), skin, sums, order, kernels, epoch: Epoch(0) }
    }

    /// One epoch in which some cells feel something.
    fn turn(&mut self, q: &[f64; WORDS], touch: &[(usize, SkinSensors)]) -> Came {
        let words = q.map(|q| Q1_14::from_radians(q).unwrap());
        let frames = self.central.frames(&words);
        let mut came = Came { central: [0.0; WORDS], sum: [0.0; WORDS], truncated: [0.0; WORDS], loaded: 0 };
        let mut own = vec![None; self.sums.len()];
        for (place, felt) in touch {
            let force = self.central.force(*place, felt);
            for (sum, torque) in came.central.iter_mut().zip(self.central.torque(*place, &frames, force)) {
                *sum += torque;
            }
            came.loaded = came.loaded.max(self.skin.cells[*place].joint.into());
            let parameters = self.skin.parameters(&self.skin.cells[*place]);
            let force = Force::fuse(felt.contact, felt.proximity, &parameters.contact);
            let torque = Torque::new(&self.kernels[*place].jacobian(&words), force);
            for (sum, exact) in came.truncated.iter_mut().zip(torque.exact()) {
                *sum += f64::from(i32::try_from(exact.steps() >> 22).unwrap()) / 256.0;
            }
            own[*place] = Some(torque.exact());
        }
        self.epoch = self.epoch.next();
        let mut said = vec![None; self.sums.len()];
        let end = Micros(16_000);
        for (at, depth, children) in &self.order {
            let sum = &mut self.sums[*at];
            let begin = Begin {
                epoch: self.epoch,
                at: Micros(0),
                period: Span(16_000),
                depth: Some(*depth),
                speaks: true,
                children: children.iter().map(|(port, _)| 1 << port).sum(),
            };
            sum.begin(&begin, own[*at].as_ref());
            for (port, child) in children {
                if let Some((epoch, words, anew)) = said[*child] {
                    if anew {
                        sum.state(Micros(0), *port, epoch);
                    }
                    sum.take(Micros(0), *port, epoch, words);
                }
            }
            said[*at] = sum.say(end);
        }
        let root = self.order.last().unwrap().0;
        let (_, words, _) = said[root].expect("somebody is touched");
        assert_eq!(usize::from(words.count), touch.len());
        came.sum = words.torque.map(|word| word.to_f64());
        came
    }
}

fn touched(dice: &mut Pcg64Mcg, cells: usize) -> Vec<(usize, SkinSensors)> {
    let felt = |dice: &mut Pcg64Mcg| SkinSensors {
        contact: [0; 3].map(|_| Q5_10::nearest(dice.random_range(0.2..2.0))),
        ..SkinSensors::default()
    };
    let mut places: Vec<usize> = (0..cells).collect();
    places.shuffle(dice);
    places.into_iter().take(ACTIVE).map(|place| (place, felt(dice))).collect()
}

#[derive(Default)]
struct Mean {
    sum: f64,
    count: u32,
}

impl Mean {
    fn add(&mut self, errors: &[f64]) {
        self.sum += errors.iter().map(|error| error.abs()).sum::<f64>();
        self.count += u32::try_from(errors.len()).unwrap();
    }

    fn mean(&self) -> f64 {
        self.sum / f64::from(self.count)
    }
}

fn difference(a: &[f64; WORDS], b: &[f64; WORDS]) -> [f64; WORDS] {
    core::array::from_fn(|joint| a[joint] - b[joint])
}

/// Mean absolute errors of single epochs while the arm moves: of sums, and of truncation.
fn moving(carry: bool) -> (f64, f64) {
    let mut dice = Pcg64Mcg::seed_from_u64(1);
    let (mut sums, mut truncated) = (Mean::default(), Mean::default());
    let mut tree = Tree::new(carry);
    for _ in 0..20 {
        let touch = touched(&mut dice, tree.sums.len());
        let phase: [f64; WORDS] = core::array::from_fn(|_| dice.random_range(0.0..6.0));
        for step in 0..50_u32 {
            let q = phase.map(|phase| (phase + f64::from(step) * 0.016).sin());
            let came = tree.turn(&q, &touch);
            sums.add(&difference(&came.sum, &came.central)[..came.loaded]);
            truncated.add(&difference(&came.truncated, &came.central)[..came.loaded]);
        }
    }
    (sums.mean(), truncated.mean())
}

/// Mean absolute error of the average over some epochs of a constant touch on an arm that stands.
fn constant(carry: bool) -> f64 {
    let mut dice = Pcg64Mcg::seed_from_u64(2);
    let mut errors = Mean::default();
    for _ in 0..60 {
        let mut tree = Tree::new(carry);
        let touch = touched(&mut dice, tree.sums.len());
        let q: [f64; WORDS] = core::array::from_fn(|_| dice.random_range(-1.5..1.5));
        let mut average = [0.0; WORDS];
        let mut wanted = ([0.0; WORDS], 0);
        for _ in 0..AVERAGED {
            let came = tree.turn(&q, &touch);
            for (average, sum) in average.iter_mut().zip(came.sum) {
                *average += sum / 32.0;
            }
            wanted = (came.central, came.loaded);
        }
        errors.add(&difference(&average, &wanted.0)[..wanted.1]);
    }
    errors.mean()
}

#[test]
fn sums_of_twenty_cells_are_near_the_central_torque_and_nearer_on_average() {
    let ((rounded, truncated), (carried, _)) = (moving(false), moving(true));
    let (rounded_average, carried_average) = (constant(false), constant(true));
    println!("mean absolute error of the sum of {ACTIVE} active cells of 253, loaded joints, Nm");
    println!("  truncated                        {truncated:.5}   (paper 0.0356)");
    println!("  rounded                          {rounded:.5}");
    println!("  carried, single epochs           {carried:.5}");
    println!("  rounded, average of {AVERAGED} epochs    {rounded_average:.5}");
    println!("  carried, average of {AVERAGED} epochs    {carried_average:.5}");
    assert!(rounded <= 0.005, "{rounded}");
    assert!(carried <= 0.0065, "{carried}");
    assert!(carried_average <= 0.0005, "{carried_average}");
    assert!(truncated > 4.0 * rounded && rounded_average > 2.0 * carried_average);
}
