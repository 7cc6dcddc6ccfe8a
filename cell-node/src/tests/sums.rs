//! Tests of children's sums that arrive late.
#![allow(clippy::unwrap_used, reason = "a test may stop")]

use crate::sum::{EpochStart, SubtreeSum, SumWords};
use protocol::fixed::Q7_8;
use protocol::packet::Epoch;
use protocol::parameters::MAX_JOINTS;
use protocol::parameters::SumSchedule;
use protocol::time::{Micros, Span};

/// Starts an epoch of a cell without contact. The cell is the root of a tree of two, with its child at port 0.
fn begin(sum: &mut SubtreeSum, epoch: u8, at: u64) {
    let begin = EpochStart {
        epoch: Epoch(epoch),
        at: Micros(at),
        period: Span(16_000),
        depth: Some(0),
        may_send: true,
        children: 1,
    };
    sum.begin_epoch(&begin, None);
}

fn words(bits: i16) -> SumWords {
    SumWords { torque: [Q7_8::from_bits(bits); MAX_JOINTS], count: 1 }
}

/// Returns the sum that the cell sends within half a period after `after`; `None` if it sends none.
fn said(sum: &mut SubtreeSum, after: u64) -> Option<SumWords> {
    sum.poll_sum(Micros(after + 8_000)).map(|(_, words, _)| words)
}

// LEASE-1, LEASE-2
#[test]
fn a_sum_that_arrives_after_its_epoch_is_not_taken_for_another_epoch() {
    let mut sum = SubtreeSum::default();
    sum.set_schedule(Some(SumSchedule { slot_us: 1_000, deepest: 1, carry: true }));
    begin(&mut sum, 129, 0);
    // A slow machine delivers it late; then the child's state message arrives.
    sum.receive_sum(Micros(100), 0, Epoch(126), words(-154));
    sum.handle_state_message(Micros(200), 0, Epoch(129));
    assert_eq!(said(&mut sum, 0), None, "nothing of this epoch has come");
    sum.receive_sum(Micros(9_000), 0, Epoch(129), words(-151));
    assert_eq!(said(&mut sum, 9_000), Some(words(-151)));
}

// LEASE-2
#[test]
fn a_sum_that_arrives_before_its_state_is_taken_when_the_state_arrives() {
    let mut sum = SubtreeSum::default();
    sum.set_schedule(Some(SumSchedule { slot_us: 1_000, deepest: 1, carry: true }));
    begin(&mut sum, 7, 0);
    sum.receive_sum(Micros(100), 0, Epoch(7), words(3));
    assert_eq!((said(&mut sum, 0), sum.dropped), (None, 1));
    sum.handle_state_message(Micros(200), 0, Epoch(7));
    assert_eq!((said(&mut sum, 200), sum.taken, sum.dropped), (Some(words(3)), 1, 0));
}
