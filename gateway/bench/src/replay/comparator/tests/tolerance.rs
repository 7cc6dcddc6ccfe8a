//! Torques that differ by a few steps.

use super::*;

/// Number of torque words that differ by 0, 1, 2 and 3 steps, and the largest difference.
fn steps(steps: &StepHistogram) -> ([u64; 4], u32) {
    (*steps.by_steps.first_chunk().unwrap(), steps.max)
}

/// Replies of [`run`] with torques off by these steps.
fn off(by: [i16; 2]) -> Vec<Message> {
    let mut now = run();
    (now[3], now[5]) = (torque(1, 1, 5 + by[0]), torque(1, 2, 6 + by[1]));
    now
}

#[test]
fn torques_within_the_tolerance_are_equal_and_counted() {
    let comparator = rated_within(2, &run(), &off([1, -2]));
    assert_eq!((counts(&comparator), comparator.tally.tolerated), ([3, 0, 0, 0], 2));
    assert_eq!(steps(&comparator.tally.torque_words), ([16, 1, 1, 0], 2));
    assert!(comparator.tally.has_only_equal_replies() && comparator.first_difference().is_none());
    // Without a tolerance, with one that is too small, and without a difference.
    for (tolerance, by, equal, tolerated, words) in [
        (0, [1, -2], 1, 0, ([16, 1, 1, 0], 2)),
        (1, [1, -2], 2, 1, ([16, 1, 1, 0], 2)),
        (2, [0, 3], 2, 0, ([17, 0, 0, 1], 3)),
        (2, [0, 0], 3, 0, ([18, 0, 0, 0], 0)),
    ] {
        let comparator = rated_within(tolerance, &run(), &off(by));
        let ReplyTally { tolerated: found, torque_words, .. } = comparator.tally;
        assert_eq!((counts(&comparator), found), ([equal, 3 - equal, 0, 0], tolerated), "{tolerance} {by:?}");
        assert_eq!(steps(&torque_words), words, "{tolerance} {by:?}");
    }
}

#[test]
fn words_far_off_are_counted_together_and_the_largest_is_told() {
    let mut recorded = run();
    recorded[3] = torque(1, 1, i16::MIN);
    let comparator = rated_within(u16::MAX, &recorded, &off([i16::MAX - 5, 8]));
    assert_eq!(counts(&comparator), [3, 0, 0, 0]);
    assert_eq!((comparator.tally.torque_words.by_steps[8], comparator.tally.torque_words.max), (2, 65_535));
}

#[test]
fn a_tolerance_does_not_hide_replies_that_are_missing_extra_or_no_torques() {
    let mut now = run();
    now.remove(5);
    now.insert(8, torque(1, 4, 1));
    let recorded = [&run()[..], &[joints(5)]].concat();
    let comparator = rated_within(9, &recorded, &now);
    assert_eq!((counts(&comparator), comparator.tally.tolerated), ([2, 0, 1, 1], 0));
    let skin = |bits| {
        let contact = [protocol::fixed::Q5_10::from_bits(bits); 3];
        let page = SensorPage::Skin(protocol::message::SkinSensors { contact, ..Default::default() });
        let mut said = run();
        said.insert(4, Message::Sensors { from: cell(1), epoch: Epoch(1), page });
        said
    };
    assert_eq!(counts(&rated_within(9, &skin(1_000), &skin(1_000))), [4, 0, 0, 0]);
    assert_eq!(counts(&rated_within(9, &skin(1_000), &skin(1_001))), [3, 1, 0, 0]);
}

#[test]
fn in_sums_each_cell_that_adds_its_own_may_be_off_and_one_that_passes_on_may_not() {
    // Cell 2 is pressed; cell 1, its parent, is pressed or not.
    let said = |own: i16, child: i16, count: u8| {
        let trees = [tree(1, 0, Some(0)), tree(2, 0, Some(1))];
        let sums = [joints(1), sum(2, 1, child, 1), sum(1, 1, child + own, count), joints(2)];
        [&[joints(0)][..], &trees, &sums].concat()
    };
    let of = |tolerance, now: &[Message], count| {
        let comparator = rated_within(tolerance, &said(if count > 1 { 40 } else { 0 }, 20, count), now);
        let ReplyTally { equal, different, tolerated, sum_words, .. } = comparator.tally;
        (equal, different, tolerated, sum_words.max)
    };
    // 16 steps of a torque are one of a sum's, and one step is rounding.
    assert_eq!(of(0, &said(41, 21, 2), 2), (2, 0, 0, 1));
    assert_eq!(of(0, &said(42, 22, 2), 2), (0, 2, 0, 2));
    assert_eq!(of(16, &said(42, 22, 2), 2), (2, 0, 2, 2), "each of the two");
    assert_eq!(of(16, &said(43, 20, 2), 2), (1, 1, 0, 3));
    assert_eq!(of(17, &said(43, 20, 2), 2), (2, 0, 1, 3));
    let (.., different, tolerated, _) = of(64, &said(2, 20, 1), 1);
    assert_eq!((different, tolerated), (1, 0), "nothing touches it");
}
