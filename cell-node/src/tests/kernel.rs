//! Tests that compare the kernels with torques of other programs, with Eq. 8 in real numbers, and with each other.

#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a test may stop")]

use crate::contact::{Force, MAX_JACOBIAN_STEPS, Torque};
use crate::kernel::oracle::{CountingWord, PaperWord, Projection};
use crate::kernel::{Kernel, Operations, Wrench};
use proptest::prelude::*;
use protocol::fixed::{Q1_14, Q3_12, TorqueFormat};
use protocol::parameters::{MAX_JOINTS, MAX_ROWS, Parameters, Pose, Row, RowKind};

mod oracle;

use oracle::{Case, Errors, equation_8, per_joint};

// J-1
#[test]
fn the_wrench_kernel_errs_less_than_its_bars_on_a_ur5() {
    let errors = Errors::of_words(|parameters, joints| Wrench::new(parameters).jacobian(joints));
    assert!(errors.mean <= 1.2e-4 && errors.max <= 1.5e-3, "{errors:?}");
    assert_eq!((errors.torques, errors.omitted), (1_048, 0));
}

#[test]
fn the_bound_of_j_is_little_more_than_an_arms_reach_and_of_a_slide_not_known() {
    let length = |words: &[Q1_14]| words.iter().map(|word| word.to_f64().powi(2)).sum::<f64>().sqrt();
    for case in Case::all().into_iter().filter(|case| case.joint == 6) {
        let mut parameters = case.parameters();
        let links: f64 = parameters.rows_to_cell().iter().map(|row| length(&[row.a, row.d])).sum();
        let reach = links + length(&parameters.pose.position);
        let bound = f64::from(Wrench::<Q1_14>::new(&parameters).jacobian_bound()) / 16_384.0;
        assert!(bound <= 1.02 * reach, "{bound} m for an arm of {reach} m");
        parameters.rows[2].kind = RowKind::Prismatic;
        assert_eq!(Wrench::<Q1_14>::new(&parameters).jacobian_bound(), MAX_JACOBIAN_STEPS);
    }
}

#[test]
fn a_pressed_cell_lets_the_joint_give_way() {
    // A link of length 0 with a cell at x = 0.5 m that faces +y: a push on it turns the joint backwards.
    let pose =
        Pose { position: [0.5, 0.0, 0.0].map(Q1_14::nearest), normal: [0.0, 1.0, 0.0].map(Q1_14::nearest) };
    let parameters = Parameters { joint: 1, joints: 1, pose, ..Parameters::default() };
    for position in [0.0, 0.3, -1.7].map(Q1_14::nearest) {
        let joints = [position; MAX_JOINTS];
        let jacobian = Wrench::<Q1_14>::new(&parameters).jacobian(&joints);
        assert_eq!(jacobian, per_joint(&[-0.5]).map(Q1_14::nearest));
        let torque = Torque::new(&jacobian, Force::from_steps(2 << 16));
        assert_eq!(torque.torque_words(TorqueFormat::Q3_12)[0], Q3_12::nearest(-1.0).to_bits(), "tau = -r F");
    }
}

#[test]
fn the_projection_kernel_errs_less_than_the_papers_0_0054_nm_on_a_ur5() {
    let errors = Errors::of_words(|parameters, joints| Projection::new(parameters).jacobian(joints));
    assert!(errors.mean <= 1.4e-4 && errors.max <= 1.5e-3, "{errors:?}");

    let with_the_papers_sine = Errors::of_words(|parameters, joints| {
        Projection::<PaperWord>::new(parameters).jacobian(joints).map(|PaperWord(row)| row)
    });
    assert!(with_the_papers_sine.mean <= 1e-3, "{with_the_papers_sine:?}");
}

// J-3
#[test]
fn words_of_j_err_by_2_steps_at_most_on_a_ur5() {
    for case in Case::all() {
        let (parameters, joints) = (case.parameters(), case.words());
        let exact = equation_8(&parameters, &joints);
        let steps = [
            steps_apart::<Wrench>(&parameters, &joints, exact),
            steps_apart::<Projection>(&parameters, &joints, exact),
        ];
        assert!(steps.into_iter().all(|steps| steps <= 2), "{steps:?}");
    }
}

#[test]
fn a_slide_is_pushed_along_its_axis() {
    // A prismatic joint along z, then an arm of 0.5 m that turns about z, with a cell that faces up.
    let mut parameters = Parameters {
        joint: 2,
        joints: 2,
        row: 2,
        table_rows: 2,
        pose: Pose {
            position: [0.1, 0.0, 0.0].map(Q1_14::nearest),
            normal: [0.0, 0.0, 1.0].map(Q1_14::nearest),
        },
        ..Parameters::default()
    };
    parameters.rows[0] = Row { kind: RowKind::Prismatic, d: Q1_14::nearest(0.25), ..Row::default() };
    parameters.rows[1] = Row { a: Q1_14::nearest(0.5), ..Row::default() };
    let joints = per_joint(&[0.3, 0.4]).map(Q1_14::nearest);
    let jacobian = Wrench::<Q1_14>::new(&parameters).jacobian(&joints);
    assert_eq!(jacobian, per_joint(&[-1.0, 0.0]).map(Q1_14::nearest), "1 N pushes the lift down with 1 N");
    assert_eq!(Projection::<Q1_14>::new(&parameters).jacobian(&joints), jacobian);
}

// J-2
#[test]
fn an_arm_longer_than_q1_14_saturates_and_does_not_wrap() {
    // Two links of 1.5 m, stretched out, and a cell at the end that faces up or down.
    let link = Row { a: Q1_14::nearest(1.5), ..Row::default() };
    let zero = Q1_14::ZERO;
    for (up, expected) in [(-1.0, Q1_14::MAX), (1.0, Q1_14::MIN)] {
        let pose = Pose { position: [zero; 3], normal: [zero, Q1_14::nearest(up), zero] };
        let parameters =
            Parameters { joint: 2, joints: 2, pose, rows: [link; MAX_ROWS], ..Parameters::default() };
        let wrench = Wrench::<Q1_14>::new(&parameters).jacobian(&[zero; MAX_JOINTS]);
        let projection = Projection::<Q1_14>::new(&parameters).jacobian(&[zero; MAX_JOINTS]);
        assert_eq!(wrench[..2], [expected, Q1_14::nearest(-1.5 * up)]);
        // Here the position saturates before the product with the force; the last step may differ.
        assert!(projection[0].to_bits().unsigned_abs() >= 0x7FFF);
        assert_eq!(projection[0].to_bits() < 0, expected == Q1_14::MIN);
        assert_eq!(projection[1..], wrench[1..]);
    }
}

#[test]
fn an_offset_is_added_to_the_position_and_wraps() {
    let mut case = Case::all().into_iter().find(|case| case.joint == 6).unwrap().parameters();
    let joints = per_joint(&[-0x7000, 0x7000, 0x1234, -0x4321, 0x6543, -1]).map(Q1_14::from_bits);
    let expected = in_words::<Wrench>(&case, &joints);
    let shift = Q1_14::from_bits(0x5A5A);
    for row in &mut case.rows {
        row.theta_offset = shift;
    }
    let shifted = joints.map(|position| Q1_14::from_bits(position.to_bits().wrapping_sub(shift.to_bits())));
    assert!(apart(in_words::<Wrench>(&case, &shifted), expected) == 0.0);
    assert!(apart(in_words::<Projection>(&case, &shifted), expected) < 2e-4);
}

/// Returns the operation counts for the UR5 and a cell on its last link.
fn operations<K: Kernel<CountingWord>>() -> Operations {
    let last = Case::all().into_iter().find(|case| case.joint == 6).unwrap();
    let kernel = K::new(&last.parameters());
    Operations::count_operations(|| kernel.jacobian(&last.words())).1
}

#[test]
fn the_operations_on_a_ur5_are_what_the_docs_say() {
    let wrench = operations::<Wrench<CountingWord>>();
    assert_eq!((wrench.multiplications, wrench.additions, wrench.sines, wrench.cosines), (40, 24, 5, 5));
    let projection = operations::<Projection<CountingWord>>();
    assert_eq!(
        (projection.multiplications, projection.additions, projection.sines, projection.cosines),
        (103, 56, 6, 6)
    );
}

#[test]
fn unused_components_are_not_computed_behind_an_odd_twist_either() {
    // J_1 = sin(alpha) m_y + cos(alpha) m_z, and m_y takes two products after the turn of joint 2.
    let mut parameters = Case::all().into_iter().find(|case| case.joint == 2).unwrap().parameters();
    parameters.rows[0] = Row { alpha: Q1_14::nearest(0.3), ..Row::default() };
    let kernel = Wrench::<CountingWord>::new(&parameters);
    let (_, done) = Operations::count_operations(|| kernel.jacobian(&[Q1_14::nearest(0.7); MAX_JOINTS]));
    assert_eq!((done.multiplications, done.additions, done.sines, done.cosines), (4, 2, 1, 1));
}

/// Generates any arm of 1 to 6 joints, in which quarter turns and zeros are more frequent than by chance.
fn any_arm() -> impl Strategy<Value = Parameters> {
    let length = prop_oneof![1 => Just(0), 3 => any::<i16>()];
    let alpha = prop_oneof![
        2 => Just(0), 1 => Just(0x4000), 1 => Just(-0x4000), 1 => Just(i16::MIN), 2 => any::<i16>()
    ];
    let offset = prop_oneof![Just(0), any::<i16>()];
    let row = (length.clone(), length.clone(), alpha, offset).prop_map(|(a, d, alpha, theta_offset)| Row {
        a: Q1_14::from_bits(a),
        d: Q1_14::from_bits(d),
        alpha: Q1_14::from_bits(alpha),
        theta_offset: Q1_14::from_bits(theta_offset),
        kind: RowKind::Revolute,
    });
    let position = [length.clone(), length.clone(), length];
    (prop::collection::vec(row, MAX_ROWS), 1_u8..=6, position, any::<[i16; 3]>()).prop_map(
        |(rows, joint, position, normal)| Parameters {
            joint,
            joints: 6,
            pose: Pose { position: position.map(Q1_14::from_bits), normal: normal.map(Q1_14::from_bits) },
            rows: rows.try_into().unwrap(),
            ..Parameters::default()
        },
    )
}

/// Generates any chain of up to 14 joints in up to 32 rows of all kinds.
fn any_chain() -> impl Strategy<Value = Parameters> {
    let kinds = prop_oneof![
        3 => Just(RowKind::Revolute), 1 => Just(RowKind::Prismatic), 2 => Just(RowKind::Fixed)
    ];
    (any_arm(), prop::collection::vec(kinds, 1..=MAX_ROWS), any::<prop::sample::Index>())
        .prop_map(|(mut parameters, kinds, carries)| {
            let mut joints = 0;
            for (row, kind) in parameters.rows.iter_mut().zip(&kinds) {
                row.kind = if joints == MAX_JOINTS { RowKind::Fixed } else { *kind };
                joints += usize::from(row.has_joint());
            }
            let row = carries.index(kinds.len()) + 1;
            let joint = parameters.rows[..row].iter().filter(|row| row.has_joint()).count();
            let byte = |number: usize| u8::try_from(number).unwrap();
            let (joint, joints, row, table_rows) = (byte(joint), byte(joints), byte(row), byte(kinds.len()));
            Parameters { joint, joints, row, table_rows, ..parameters }
        })
        .prop_filter("a joint moves the cell", |parameters| parameters.joint > 0)
}

/// Generates a chain whose rows, prismatic travel and cell position add up to less than 2 m, together with joint
/// positions.
fn chain_in_reach() -> impl Strategy<Value = (Parameters, [Q1_14; MAX_JOINTS])> {
    let positions = any::<[i16; MAX_JOINTS]>();
    (in_reach(any_chain()), positions).prop_map(|(mut parameters, positions)| {
        let slides = parameters.rows_to_cell().iter().filter(|row| row.kind == RowKind::Prismatic).count();
        let moving: Vec<RowKind> =
            parameters.all_rows().iter().filter(|row| row.has_joint()).map(|row| row.kind).collect();
        let mut positions = positions.map(Q1_14::from_bits);
        if slides > 0 {
            // Half of the length is for the prismatic joints.
            for row in &mut parameters.rows {
                (row.a, row.d) = (half(row.a), half(row.d));
            }
            parameters.pose.position = parameters.pose.position.map(half);
            for (position, kind) in positions.iter_mut().zip(moving) {
                if kind == RowKind::Prismatic {
                    *position = Q1_14::nearest(position.to_f64() / 2.0 / slides as f64);
                }
            }
        }
        (parameters, positions)
    })
}

fn half(word: Q1_14) -> Q1_14 {
    Q1_14::from_bits(word.to_bits() / 2)
}

/// Generates an arm of any shape whose rows and cell position add up to less than 2 m.
fn arm_in_reach() -> impl Strategy<Value = Parameters> {
    in_reach(any_arm())
}

fn in_reach(any: impl Strategy<Value = Parameters>) -> impl Strategy<Value = Parameters> {
    let direction = (-1.0..1.0_f64, -1.0..1.0_f64, -1.0..1.0_f64)
        .prop_filter("has a direction", |(x, y, z)| (0.1..1.0).contains(&(x * x + y * y + z * z)));
    (any, direction, 0.1..2.0_f64).prop_map(|(mut parameters, (x, y, z), reach)| {
        let rows = parameters.rows_to_cell().iter().flat_map(|row| [row.a, row.d]);
        let all: f64 = rows.chain(parameters.pose.position).map(|word| word.to_f64().abs()).sum();
        let scale = if all > reach { reach / all } else { 1.0 };
        let shorter = |word: Q1_14| Q1_14::nearest((f64::from(word.to_bits()) * scale).trunc() / 16_384.0);
        for row in &mut parameters.rows {
            (row.a, row.d) = (shorter(row.a), shorter(row.d));
        }
        let length = (x * x + y * y + z * z).sqrt();
        let normal = [x, y, z].map(|n| Q1_14::nearest(n / length));
        let position = parameters.pose.position.map(shorter);
        Parameters { pose: Pose { position, normal }, ..parameters }
    })
}

/// Returns the largest absolute difference between the elements of two Jacobians.
fn apart(lhs: [f64; MAX_JOINTS], rhs: [f64; MAX_JOINTS]) -> f64 {
    lhs.iter().zip(rhs).map(|(l, r)| (l - r).abs()).fold(0.0, f64::max)
}

/// Requirement J-3: the maximum difference between a cell's J and the nearest word of the exact value, in steps of
/// 2^-14 m. Each row beyond six allows one more step.
const STEPS_OF_J: u32 = 8;

fn steps_of_j(parameters: &Parameters) -> u32 {
    STEPS_OF_J + u32::try_from(parameters.rows_to_cell().len().saturating_sub(6)).unwrap()
}

/// Returns the largest difference between a kernel's J and the nearest word of the exact value, in steps of 2^-14.
fn steps_apart<K: Kernel>(
    parameters: &Parameters,
    joints: &[Q1_14; MAX_JOINTS],
    exact: [f64; MAX_JOINTS],
) -> u32 {
    let words = K::new(parameters).jacobian(joints);
    let apart = |(word, exact): (Q1_14, f64)| {
        i32::from(word.to_bits()).abs_diff(Q1_14::nearest(exact).to_bits().into())
    };
    words.into_iter().zip(exact).map(apart).max().unwrap()
}

fn in_words<K: Kernel>(parameters: &Parameters, joints: &[Q1_14; MAX_JOINTS]) -> [f64; MAX_JOINTS] {
    K::new(parameters).jacobian(joints).map(Q1_14::to_f64)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 1_024, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn both_kernels_are_equation_8_in_real_numbers(parameters in any_arm(), joints: [i16; MAX_JOINTS]) {
        let joints = joints.map(Q1_14::from_bits);
        let expected = equation_8(&parameters, &joints);
        let wrench = Wrench::<f64>::new(&parameters).jacobian(&joints);
        let projection = Projection::<f64>::new(&parameters).jacobian(&joints);
        prop_assert!(apart(wrench, expected) <= 1e-9, "{wrench:?} is not {expected:?}");
        prop_assert!(apart(projection, expected) <= 1e-9, "{projection:?} is not {expected:?}");
    }

    // J-3
    #[test]
    fn words_of_j_err_by_8_steps_at_most(parameters in arm_in_reach(), joints: [i16; MAX_JOINTS]) {
        let joints = joints.map(Q1_14::from_bits);
        let exact = equation_8(&parameters, &joints);
        prop_assert!(steps_apart::<Wrench>(&parameters, &joints, exact) <= STEPS_OF_J);
        prop_assert!(steps_apart::<Projection>(&parameters, &joints, exact) <= STEPS_OF_J);
    }

    #[test]
    fn both_kernels_are_equation_8_for_chains_of_all_kinds_of_rows(
        (parameters, joints) in chain_in_reach(),
    ) {
        prop_assert_eq!(Parameters { pose: Pose { normal: parameters.pose.normal, ..parameters.pose }, period_us: 1, ..parameters }.check(), Ok(()));
        let exact = equation_8(&parameters, &joints);
        let wrench = Wrench::<f64>::new(&parameters).jacobian(&joints);
        let projection = Projection::<f64>::new(&parameters).jacobian(&joints);
        prop_assert!(apart(wrench, exact) <= 1e-9, "{wrench:?} is not {exact:?}");
        prop_assert!(apart(projection, exact) <= 1e-9, "{projection:?} is not {exact:?}");
        // J-3
        let steps = steps_apart::<Wrench>(&parameters, &joints, exact);
        prop_assert!(steps <= steps_of_j(&parameters), "{steps} steps in {} rows", parameters.rows_to_cell().len());
    }

    #[test]
    fn no_j_is_beyond_the_bound_that_the_wrench_kernel_names(
        parameters in prop_oneof![arm_in_reach(), any_arm(), any_chain()], joints: [i16; MAX_JOINTS],
    ) {
        let kernel = Wrench::<Q1_14>::new(&parameters);
        for row in kernel.jacobian(&joints.map(Q1_14::from_bits)) {
            prop_assert!(row.to_bits().unsigned_abs() <= kernel.jacobian_bound(), "{row:?} is beyond {}", kernel.jacobian_bound());
        }
    }

    #[test]
    fn no_words_of_a_chain_panic(parameters in any_chain(), row: u8, joints: [i16; MAX_JOINTS]) {
        let parameters = Parameters { row, ..parameters };
        let joints = joints.map(Q1_14::from_bits);
        let _ = Wrench::<Q1_14>::new(&parameters).jacobian(&joints);
        let _ = Projection::<Q1_14>::new(&parameters).jacobian(&joints);
    }

    #[test]
    fn no_words_panic_whether_they_make_sense_or_not(
        parameters in any_arm(), joint: u8, joints: [i16; MAX_JOINTS], steps: i64,
    ) {
        let parameters = Parameters { joint, ..parameters };
        let joints = joints.map(Q1_14::from_bits);
        let _ = Torque::new(&Wrench::<Q1_14>::new(&parameters).jacobian(&joints), Force::from_steps(steps));
        let _ = Projection::<Q1_14>::new(&parameters).jacobian(&joints);
    }
}
