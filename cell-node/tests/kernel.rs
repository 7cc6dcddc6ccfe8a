//! The kernels against torques that were computed elsewhere, against Eq. 8 in real numbers, and against
//! each other.

#![allow(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    clippy::print_stdout,
    reason = "a test may stop, and speak"
)]

use cell_node::contact::{Force, Torque};
use cell_node::kernel::witness::{Counted, Operations};
use cell_node::kernel::{Kernel, Wrench};
use proptest::prelude::*;
use protocol::fixed::{Q1_14, Q3_12};
use protocol::parameters::{MAX_JOINTS, Parameters, Pose, Row};

mod witness;

use witness::{Case, equation_8};

/// Mean and greatest error in Nm of the torques of loaded joints, over the cases.
fn errors(jacobian: impl Fn(&Parameters, &[Q1_14; 6]) -> [Q1_14; 6]) -> (f64, f64) {
    let (mut sum, mut count, mut greatest) = (0.0, 0.0, 0.0_f64);
    for case in Case::all() {
        if case.torques.iter().any(|torque| torque.abs() >= Q3_12::MAX.to_f64()) {
            continue;
        }
        let force = Force::from_steps((case.force * 65_536.0) as i64);
        let torque = Torque::new(&jacobian(&case.parameters(), &case.words()), force);
        let words = torque.words();
        let (loaded, beyond) = words.split_at(usize::from(case.joint));
        for (word, wanted) in loaded.iter().zip(case.torques) {
            let error = (word.to_f64() - wanted).abs();
            sum += error;
            count += 1.0;
            greatest = greatest.max(error);
        }
        assert!(beyond.iter().all(|&word| word == Q3_12::ZERO), "joints beyond the cell's bear no load");
    }
    (sum / count, greatest)
}

#[test]
fn the_wrench_kernel_errs_less_than_its_bars_on_a_ur5() {
    let (mean, greatest) = errors(|parameters, joints| Wrench::<Q1_14>::new(parameters).jacobian(joints));
    println!("wrench: mean {mean:.3e} Nm, greatest {greatest:.3e} Nm");
    assert!(mean <= 1.2e-4 && greatest <= 1.5e-3);
}

#[test]
fn a_pressed_cell_lets_the_joint_give_way() {
    // A link of 0 m with a cell at x = 0.5 m that looks along +y: pressing it turns the joint back.
    let pose =
        Pose { position: [0.5, 0.0, 0.0].map(Q1_14::nearest), normal: [0.0, 1.0, 0.0].map(Q1_14::nearest) };
    let parameters = Parameters { joint: 1, joints: 1, pose, ..Parameters::default() };
    for position in [0.0, 0.3, -1.7].map(Q1_14::nearest) {
        let joints = [position; MAX_JOINTS];
        let jacobian = Wrench::<Q1_14>::new(&parameters).jacobian(&joints);
        assert_eq!(jacobian.map(Q1_14::to_f64), [-0.5, 0.0, 0.0, 0.0, 0.0, 0.0]);
        let torque = Torque::new(&jacobian, Force::from_steps(2 << 16));
        assert_eq!(torque.words()[0].to_f64(), -1.0, "tau = -r F");
    }
}

#[test]
fn the_wrench_kernel_does_what_it_says_on_a_ur5() {
    let last = Case::all().into_iter().find(|case| case.joint == 6).unwrap();
    let kernel = Wrench::<Counted>::new(&last.parameters());
    let (_, done) = Operations::count(|| kernel.jacobian(&last.words()));
    println!("{done:?}");
    assert_eq!((done.multiplications, done.additions, done.sines, done.cosines), (40, 24, 5, 5));
}
