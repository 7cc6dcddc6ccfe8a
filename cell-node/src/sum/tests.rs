use super::*;

const PERIOD: Span = Span(16_000);

fn sum(carry: bool) -> SubtreeSum {
    let mut sum = SubtreeSum::default();
    sum.set_schedule(Some(SumSchedule { slot_us: 1_000, deepest: 3, carry }));
    sum
}

fn begin(epoch: u8, depth: u8) -> EpochStart {
    let at = Micros(u64::from(epoch) * PERIOD.0);
    EpochStart {
        epoch: Epoch(epoch),
        at,
        period: PERIOD,
        depth: Some(depth),
        may_send: true,
        children: 0b1111,
    }
}

/// Returns a torque of this many thousandths of a Q7.8 step, the same for every joint.
fn own(thousandths: i64) -> [Accumulator<30>; MAX_JOINTS] {
    [Accumulator::from_steps(thousandths * (1 << 22) / 1_000); MAX_JOINTS]
}

fn words(word: i16, count: u8) -> SumWords {
    SumWords { torque: [Q7_8::from_bits(word); MAX_JOINTS], count }
}

fn at(epoch: u8, micros: u64) -> Micros {
    Micros(u64::from(epoch) * PERIOD.0 + micros)
}

/// Returns the sums sent from now until the end of the epoch, each with its time.
fn says(sum: &mut SubtreeSum, epoch: u8) -> Vec<(u64, i16, u8, bool)> {
    let mut said = Vec::new();
    for micros in (0..PERIOD.0).step_by(100) {
        if let Some((of, words, restarted)) = sum.poll_sum(at(epoch, micros)) {
            assert_eq!(of, Epoch(epoch));
            said.push((micros, words.torque[0].to_bits(), words.count, restarted));
        }
    }
    said
}

// SUM-4, SUM-6
#[test]
fn a_cell_sends_in_the_slot_of_its_depth_and_sends_one_end() {
    let mut sum = sum(false);
    sum.begin_epoch(&begin(1, 1), Some(&own(2_400)));
    assert_eq!(says(&mut sum, 1), [(2_000, 2, 1, true)]);
    sum.begin_epoch(&begin(2, 1), Some(&own(2_600)));
    assert_eq!(says(&mut sum, 2), [(2_000, 3, 1, false)]);
    sum.begin_epoch(&begin(3, 1), None);
    assert_eq!(says(&mut sum, 3), [(2_000, 0, 0, false)]);
    sum.begin_epoch(&begin(4, 1), None);
    assert_eq!(says(&mut sum, 4), []);
    sum.begin_epoch(&begin(5, 1), Some(&own(1_000)));
    assert_eq!(says(&mut sum, 5), [(2_000, 1, 1, true)], "stated again");
}

// SUM-2
#[test]
fn the_rounding_remainder_is_carried_until_the_contact_ends() {
    for (carry, target) in [(true, [0, 1, 0, 1, 0]), (false, [0; 5])] {
        let mut sum = sum(carry);
        let mut got = Vec::new();
        for epoch in 0..5 {
            sum.begin_epoch(&begin(epoch, 0), Some(&own(400)));
            got.extend(says(&mut sum, epoch).first().map(|said| said.1));
        }
        assert_eq!(got, target);
    }
    let mut sum = sum(true);
    sum.begin_epoch(&begin(0, 0), Some(&own(400)));
    sum.begin_epoch(&begin(1, 0), None);
    sum.begin_epoch(&begin(2, 0), Some(&own(400)));
    assert_eq!(says(&mut sum, 2).first().map(|said| said.1), Some(0), "no remainder");
}

// SUM-4, SUM-5
#[test]
fn a_late_child_makes_one_more_sum_of_all_in_the_next_slot() {
    let mut sum = sum(false);
    sum.begin_epoch(&begin(1, 2), Some(&own(1_000)));
    sum.handle_state_message(at(1, 10), 0, Epoch(1));
    sum.receive_sum(at(1, 500), 0, Epoch(1), words(10, 3));
    assert_eq!(sum.poll_sum(at(1, 1_000)), Some((Epoch(1), words(11, 4), true)));
    sum.receive_sum(at(1, 1_700), 0, Epoch(1), words(12, 4));
    sum.receive_sum(at(1, 1_800), 0, Epoch(1), words(9, 2));
    assert_eq!(sum.poll_sum(at(1, 1_900)), None);
    assert_eq!(sum.poll_sum(at(1, 2_000)), Some((Epoch(1), words(13, 5), false)));
    assert_eq!((sum.sent, sum.taken, sum.dropped), (2, 2, 0));
}

// LEASE-2, NACK-3
#[test]
fn a_sum_is_taken_while_its_lease_runs_and_not_after_a_gap() {
    let mut sum = sum(false);
    sum.begin_epoch(&begin(1, 2), None);
    sum.receive_sum(at(1, 500), 1, Epoch(1), words(10, 1));
    assert_eq!((sum.taken, sum.dropped), (0, 1), "no state yet");
    sum.handle_state_message(at(1, 600), 1, Epoch(1));
    assert_eq!((sum.taken, sum.dropped), (1, 0), "the state came late");
    sum.begin_epoch(&begin(2, 2), None);
    sum.receive_sum(at(2, 500), 1, Epoch(2), words(10, 1));
    assert_eq!(sum.taken, 2);
    sum.begin_epoch(&begin(3, 2), None);
    assert_eq!(sum.take_missing_children(), Some((Epoch(3), 0b10)), "it did not come");
    sum.begin_epoch(&begin(4, 2), None);
    assert_eq!(sum.poll_timeout(), Some(at(4, 14_000)), "checked in time");
    assert_eq!(
        (sum.poll_check_lateness(at(4, 13_999)), sum.poll_check_lateness(at(4, 14_000))),
        (None, Some(Span(0)))
    );
    sum.receive_sum(at(4, 500), 1, Epoch(4), words(10, 1));
    assert_eq!(sum.taken, 2, "after a gap");
    sum.remove_child(1);
    sum.begin_epoch(&begin(5, 2), None);
    sum.handle_state_message(at(5, 0), 1, Epoch(4));
    sum.receive_sum(at(5, 500), 1, Epoch(5), words(10, 1));
    assert_eq!(sum.taken, 2, "stated for another epoch");
}

// LEASE-2, NACK-3
#[test]
fn a_sum_that_came_before_its_joints_and_without_a_lease_waits_for_its_state() {
    let mut sum = sum(false);
    sum.begin_epoch(&begin(1, 2), None);
    sum.receive_sum(at(1, 15_900), 1, Epoch(2), words(10, 1));
    sum.begin_epoch(&begin(2, 2), None);
    assert_eq!((sum.taken, sum.dropped), (0, 1), "no state yet");
    sum.handle_state_message(at(2, 100), 1, Epoch(2));
    assert_eq!((sum.taken, sum.dropped), (1, 0));
    sum.remove_child(1);
    sum.receive_sum(at(2, 15_900), 1, Epoch(3), words(10, 1));
    sum.begin_epoch(&begin(3, 2), None);
    assert_eq!(sum.take_missing_children(), Some((Epoch(3), 0b10)), "it does not come");
}

// LEASE-2
#[test]
fn a_sum_that_comes_late_is_not_in_its_epoch_and_keeps_its_lease() {
    let mut sum = sum(false);
    sum.begin_epoch(&begin(1, 2), None);
    sum.handle_state_message(at(1, 0), 1, Epoch(1));
    sum.receive_sum(at(1, 100), 1, Epoch(1), words(10, 1));
    sum.begin_epoch(&begin(2, 2), None);
    sum.begin_epoch(&begin(3, 2), None);
    sum.receive_sum(at(3, 100), 1, Epoch(2), words(10, 1));
    assert_eq!((sum.taken, sum.dropped), (1, 1));
    sum.receive_sum(at(3, 200), 1, Epoch(3), words(10, 1));
    assert_eq!((sum.taken, sum.dropped), (2, 1));
    assert_eq!(sum.take_missing_children(), Some((Epoch(3), 0)));
}

// LEASE-3
#[test]
fn an_end_closes_the_lease_without_a_nack() {
    let mut sum = sum(false);
    sum.begin_epoch(&begin(1, 2), None);
    sum.handle_state_message(at(1, 0), 1, Epoch(1));
    sum.receive_sum(at(1, 100), 1, Epoch(1), SumWords::LEASE_END);
    sum.begin_epoch(&begin(2, 2), None);
    assert_eq!(
        (sum.poll_timeout(), sum.take_missing_children()),
        (None, Some((Epoch(2), 0))),
        "nothing is missing"
    );
}

// SUM-3
#[test]
fn saturation_passes_upwards_word_by_word() {
    let mut sum = sum(false);
    sum.begin_epoch(&begin(1, 2), Some(&own(-1_000_000)));
    sum.handle_state_message(at(1, 0), 0, Epoch(1));
    let mut saturated = words(5, 2);
    saturated.torque[1] = Q7_8::MAX;
    saturated.torque[2] = Q7_8::MIN;
    sum.receive_sum(at(1, 0), 0, Epoch(1), saturated);
    let (_, said, _) = sum.poll_sum(at(1, 1_000)).unwrap();
    let mut target = [-995; MAX_JOINTS];
    target[1..3].copy_from_slice(&[i16::MAX, i16::MIN]);
    assert_eq!(said.torque.map(Q7_8::to_bits), target);
    sum.begin_epoch(&begin(2, 2), Some(&own(i64::from(i16::MAX) * 1_000)));
    sum.receive_sum(at(2, 0), 0, Epoch(2), words(1, 1));
    let (_, said, _) = sum.poll_sum(at(2, 1_000)).unwrap();
    assert_eq!(said.torque, [Q7_8::MAX; MAX_JOINTS]);
}

// SUM-3
#[test]
fn a_torque_beyond_the_32_bits_that_are_kept_of_it_saturates_at_its_end() {
    for (steps, end) in [(i64::MIN / 2, Q7_8::MIN), (i64::MAX / 2, Q7_8::MAX)] {
        let mut sum = sum(false);
        sum.begin_epoch(&begin(1, 2), Some(&[Accumulator::from_steps(steps); MAX_JOINTS]));
        let (_, said, _) = sum.poll_sum(at(1, 1_000)).unwrap();
        assert_eq!(said.torque, [end; MAX_JOINTS]);
    }
}

// NACK-2
#[test]
fn a_machine_that_receives_late_checks_no_missing_sums() {
    for (age, missing) in [(PERIOD.0 / 4, Some((Epoch(2), 0b1))), (PERIOD.0 / 4 + 1, None)] {
        let mut sum = sum(false);
        sum.begin_epoch(&begin(1, 1), Some(&own(1_000)));
        sum.handle_state_message(at(1, 10), 0, Epoch(1));
        sum.receive_sum(at(1, 500), 0, Epoch(1), words(1, 1));
        sum.begin_epoch(&begin(2, 1), Some(&own(1_000)));
        sum.schedule_missing_check();
        sum.note_frame_delay(Span(age));
        assert_eq!(sum.take_missing_children(), missing, "{age} µs");
    }
}
