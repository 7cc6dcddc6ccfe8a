use super::*;
use proptest::prelude::*;
use protocol::fixed::Q5_10;

use crate::testing::{ONE_CELL_SKIN_TOML, one_cell_skin};

fn pressed(contact: f64, proximity: f64) -> SkinSensors {
    SkinSensors {
        contact: [Q5_10::nearest(contact), Q5_10::ZERO, Q5_10::ZERO],
        proximity: Q1_14::nearest(proximity),
        ..SkinSensors::default()
    }
}

/// The expected torques were computed by an independent program, which agrees with a rigid-body library on the same
/// URDF.
#[test]
fn torques_agree_with_the_table_of_another_program() {
    let table = include_str!("../../../tests/vectors/ur5_torque.csv");
    let mut central = CentralComputation::without_quantisation(&one_cell_skin());
    let mut worst = 0.0_f64;
    for line in table.lines().skip(1) {
        let row: Vec<f64> = line.split(',').map(|field| field.parse().unwrap()).collect();
        let [joint, q @ .., f_z, _, _, _, _, _, _] = row.as_slice() else { panic!("{line}") };
        let [q1, q2, q3, q4, q5, q6, tx, ty, tz, nx, ny, nz] = *q else { panic!("{line}") };
        let joint = (1..=6_u8).find(|&k| f64::from(k) == *joint).unwrap().into();
        // In the table, n is the direction of the force: inwards.
        central.cells = vec![CellGeometry {
            row: joint,
            position: [tx, ty, tz].into(),
            normal: [-nx, -ny, -nz].into(),
            contact: Contact::default(),
        }];
        let torque = central.cell_torque(0, &central.frames_at_positions(&[q1, q2, q3, q4, q5, q6]), *f_z);
        for (got, target) in torque.iter().zip(&row[14..]) {
            worst = worst.max((got - target).abs());
        }
    }
    assert_eq!(table.lines().count(), 301);
    assert!(worst <= 1e-9, "{worst}");
}

#[test]
fn words_and_numbers_agree_within_what_words_can_hold() {
    let skin = one_cell_skin();
    let (words, numbers) = (CentralComputation::new(&skin), CentralComputation::without_quantisation(&skin));
    let q = [0.3, -1.2, 1.0, -1.4, -1.57, 0.2];
    let joints = q.map(|angle| Q1_14::from_radians(angle).unwrap());
    let coarse = words.cell_torque(0, &words.link_frames(&joints), 5.0);
    let fine = numbers.cell_torque(0, &numbers.frames_at_positions(&q), 5.0);
    for (coarse, fine) in coarse.iter().zip(fine) {
        assert!((coarse - fine).abs() < 5.0 * 5e-4, "{coarse} is not near {fine}");
    }
    assert_ne!(coarse, fine);
    assert!(coarse[3..].iter().all(|&torque| torque == 0.0), "no torque about joints above the cell's");
}

#[test]
fn an_offset_turns_the_joint() {
    let turned =
        ONE_CELL_SKIN_TOML.replacen("d = 0.10915, theta_offset = 0.0", "d = 0.10915, theta_offset = 0.75", 1);
    let turned = turned.replacen("joint = 3", "joint = 4", 1);
    let straight = ONE_CELL_SKIN_TOML.replacen("joint = 3", "joint = 4", 1);
    let [turned, straight] = [turned, straight].map(|text| Skin::parse("skin.toml", &text).unwrap());
    let (q, moved) = ([0.0, -1.2, 1.0, 0.25, 0.0, 0.0], [0.0, -1.2, 1.0, 1.0, 0.0, 0.0]);
    let offset = CentralComputation::without_quantisation(&turned);
    let plain = CentralComputation::without_quantisation(&straight);
    assert_eq!(
        offset.cell_torque(0, &offset.frames_at_positions(&q), 1.0),
        plain.cell_torque(0, &plain.frames_at_positions(&moved), 1.0)
    );
    let (offset, plain) = (CentralComputation::new(&turned), CentralComputation::new(&straight));
    let [q, moved] = [q, moved].map(|q| q.map(|angle| Q1_14::from_radians(angle).unwrap()));
    for (a, b) in offset.cell_torque(0, &offset.link_frames(&q), 1.0).iter().zip(plain.cell_torque(
        0,
        &plain.link_frames(&moved),
        1.0,
    )) {
        assert!((a - b).abs() < 1e-3, "{a} is not near {b}");
    }
}

#[test]
fn contact_and_proximity_are_fused_above_their_thresholds() {
    let central = CentralComputation::new(&one_cell_skin());
    let force = |contact, proximity| central.cell_force(0, &pressed(contact, proximity));
    assert_eq!(force(3.0, 0.0), 3.0);
    assert_eq!(force(3.0, 0.5), 4.0);
    assert_eq!(force(3.0, 0.2), 3.0, "proximity below its threshold");
    assert_eq!(force(0.05, 0.5), 1.0, "contact below its threshold");
    assert_eq!(force(0.2, 0.0), 0.0, "the sum below its threshold");
    assert_eq!(force(-3.0, 0.0), 0.0, "pulling is no touch");
    let all = SkinSensors { contact: [Q5_10::MAX; 3], ..SkinSensors::default() };
    assert_eq!(central.cell_force(0, &all), 3.0 * 32_767.0 / 1_024.0, "three full words do not overflow");
    assert_eq!(central.cell_force(9, &all), 0.0, "no such cell");
}

#[test]
fn the_torque_of_the_skin_is_the_sum_of_its_active_cells() {
    let mut skin = one_cell_skin();
    let cell = skin.cells[0].clone();
    skin.cells = vec![cell; 3];
    let central = CentralComputation::new(&skin);
    let frames = central.link_frames(&[Q1_14::nearest(0.3); 6]);
    let reference_torque =
        central.total_torque(&frames, &[pressed(2.0, 0.0), pressed(0.0, 0.0), pressed(1.0, 0.0)]);
    assert_eq!(reference_torque.active, 2);
    for (got, target) in reference_torque.torque.iter().zip(central.cell_torque(0, &frames, 3.0)) {
        assert!((got - target).abs() < 1e-12);
    }
}

proptest! {
    /// The principle of virtual work, with a finite difference as the oracle: the torque of a joint is the force times
    /// the displacement of the cell per joint angle, with the sign by which a pressed joint yields.
    #[test]
    fn the_torque_is_the_work_of_the_force_per_angle(q in any::<[i16; 6]>(), k in 1_u8..=6) {
        let mut skin = one_cell_skin();
        (skin.cells[0].joint, skin.cells[0].row) = (k, k);
        let central = CentralComputation::without_quantisation(&skin);
        let q = q.map(|bits| Q1_14::from_bits(bits).to_radians());
        let place = central.cells[0];
        let at = |q: &[f64; 6]| central.frames_at_positions(q).frames[usize::from(k)] * place.position;
        let force = central.frames_at_positions(&q).frames[usize::from(k)].rotation * place.normal * -2.0;
        let torque = central.cell_torque(0, &central.frames_at_positions(&q), 2.0);
        for joint in 0..6 {
            let (mut less, mut more) = (q, q);
            less[joint] -= 1e-5;
            more[joint] += 1e-5;
            let work = (at(&more) - at(&less)).dot(&force) / 2e-5;
            prop_assert!((torque[joint] - work).abs() < 1e-8, "joint {}: {} {}", joint + 1, torque[joint], work);
        }
    }

    #[test]
    fn torques_do_not_depend_on_the_first_joint(turn in any::<i16>(), q in any::<[i16; 6]>()) {
        let central = CentralComputation::new(&one_cell_skin());
        let mut q = q.map(Q1_14::from_bits);
        let one = central.cell_torque(0, &central.link_frames(&q), 2.0);
        q[0] = Q1_14::from_bits(turn);
        for (a, b) in one.iter().zip(central.cell_torque(0, &central.link_frames(&q), 2.0)) {
            prop_assert!((a - b).abs() < 1e-12);
        }
    }
}
