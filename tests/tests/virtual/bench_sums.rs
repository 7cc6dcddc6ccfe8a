//! The error of sums along a tree against the central computation: with rounding, with carrying, and by the paper's
//! method.

#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a test may stop")]
#![allow(clippy::print_stdout, reason = "the figures are worth a look")]

use std::path::Path;

use paper::tree::{EpochSums, SumTree};
use protocol::fixed::Q5_10;
use protocol::message::SkinSensors;
use protocol::parameters::MAX_JOINTS;
use protocol::skin::Skin;
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// The number of cells that are touched.
const ACTIVE: usize = 20;
/// The number of epochs over which a constant touch is averaged.
const AVERAGED: usize = 32;

/// Returns the paper's arm, whose cells add up along the shortest ways to the root.
fn tree(carry: bool) -> SumTree {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../gateway/examples/ur5-253.toml");
    let skin = Skin::read(&path).unwrap();
    let tree = SumTree::new(&skin, carry);
    assert_eq!(tree.cells(), skin.cells.len(), "one tree");
    tree
}

/// Runs one epoch, whose sum contains every touched cell.
fn turn(tree: &mut SumTree, q: &[f64; MAX_JOINTS], touch: &[(usize, SkinSensors)]) -> EpochSums {
    let came = tree.run_epoch(q, touch);
    assert_eq!(came.count, touch.len());
    came
}

fn touched(dice: &mut Pcg64Mcg, cells: usize) -> Vec<(usize, SkinSensors)> {
    let contact_state = |dice: &mut Pcg64Mcg| SkinSensors {
        contact: [0; 3].map(|_| Q5_10::nearest(dice.random_range(0.2..2.0))),
        ..SkinSensors::default()
    };
    let mut places: Vec<usize> = (0..cells).collect();
    places.shuffle(dice);
    places.into_iter().take(ACTIVE).map(|place| (place, contact_state(dice))).collect()
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

fn difference(a: &[f64; MAX_JOINTS], b: &[f64; MAX_JOINTS]) -> [f64; MAX_JOINTS] {
    core::array::from_fn(|joint| a[joint] - b[joint])
}

/// Returns the mean absolute errors of single epochs while the arm moves: of sums, and of truncation.
fn moving(carry: bool) -> (f64, f64) {
    let mut dice = Pcg64Mcg::seed_from_u64(1);
    let (mut sums, mut truncated) = (Mean::default(), Mean::default());
    let mut tree = tree(carry);
    for _ in 0..20 {
        let touch = touched(&mut dice, tree.cells());
        let phase: [f64; MAX_JOINTS] = core::array::from_fn(|_| dice.random_range(0.0..6.0));
        for step in 0..50_u32 {
            let q = phase.map(|phase| (phase + f64::from(step) * 0.016).sin());
            let came = turn(&mut tree, &q, &touch);
            sums.add(&difference(&came.sum, &came.central)[..came.loaded]);
            truncated.add(&difference(&came.truncated, &came.central)[..came.loaded]);
        }
    }
    (sums.mean(), truncated.mean())
}

/// Returns the mean absolute error of the average over some epochs of a constant touch on an arm that stands.
fn constant(carry: bool) -> f64 {
    let mut dice = Pcg64Mcg::seed_from_u64(2);
    let mut errors = Mean::default();
    for _ in 0..60 {
        let mut tree = tree(carry);
        let touch = touched(&mut dice, tree.cells());
        let q: [f64; MAX_JOINTS] = core::array::from_fn(|_| dice.random_range(-1.5..1.5));
        let mut average = [0.0; MAX_JOINTS];
        let mut expected = ([0.0; MAX_JOINTS], 0);
        for _ in 0..AVERAGED {
            let came = turn(&mut tree, &q, &touch);
            for (average, sum) in average.iter_mut().zip(came.sum) {
                *average += sum / 32.0;
            }
            expected = (came.central, came.loaded);
        }
        errors.add(&difference(&average, &expected.0)[..expected.1]);
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
