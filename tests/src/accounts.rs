//! Checks of invariants that hold for every run, whatever faults it has: counters add up.

use model::table::{FrameEvent, Replies, UplinkCounts};
use protocol::can::Format;
use protocol::id::Kind;

use crate::bench::Bench;

/// Checks that the counters of a finished run add up: of each cell, of torques, and of frames.
///
/// # Panics
/// Panics if counters do not add up; the message names them and the cell.
pub fn check(bench: &Bench) {
    cells(bench);
    torques(bench);
    frames(bench);
    let table = &bench.gateway.table;
    let counters = table.counters();
    let dead = bench.gateway.table.snapshot().sums.dead;
    let silent = table.statuses(bench.now()).filter(|(_, status)| status.name() == "dead").count();
    assert_eq!(dead as usize, silent, "the dead are counted");
    assert!(counters.epochs_complete <= counters.epochs_due, "{counters:?}");
    assert!(counters.epochs_due <= counters.epochs, "{counters:?}");
    assert_eq!(counters.epochs, bench.oracle.tally.broadcasts, "every broadcast is an epoch that ends");
}

/// Checks the counters of each cell: those of its replies, and those of its packets.
fn cells(bench: &Bench) {
    for (place, cell) in bench.gateway.table.cells().iter().enumerate() {
        let (uplink, replies, node) = (cell.uplink(), cell.replies, cell.node);
        let UplinkCounts { sent, delivered, rejected, lost, surplus, .. } = uplink;
        assert_eq!(sent + surplus, delivered + rejected + lost, "packets of cell {node}: {uplink:?}");
        let Replies {
            due,
            in_time,
            late,
            missing,
            in_doubt,
            unasked,
            contact_unknown,
            unexpected,
            too_late: _,
        } = replies;
        assert!(contact_unknown + unexpected <= unasked, "replies of cell {node}: {replies:?}");
        assert_eq!(due, in_time + late + missing, "replies of cell {node}: {replies:?}");
        assert!(in_doubt <= missing, "replies of cell {node}: {replies:?}");
        let arrived = bench.oracle.arrived(place);
        let tally = bench.oracle.tally;
        if is_fd(bench) && (tally.flipped, tally.truncated, tally.babbled) == (0, 0, 0) {
            let elsewhere = uplink.in_doubt + uplink.unsettled;
            assert_eq!(delivered + elsewhere, arrived, "arrivals of cell {node}: {uplink:?}");
        }
        assert!(delivered <= arrived, "cell {node} delivered {arrived}: {uplink:?}");
    }
}

fn is_fd(bench: &Bench) -> bool {
    bench.skin.buses.first().is_some_and(|bus| bus.format == Format::Fd)
}

/// Checks that every torque that arrived is used, or counted with a reason.
fn torques(bench: &Bench) {
    let (table, tally) = (&bench.gateway.table, bench.oracle.tally);
    let replies = Replies::total(table.cells().iter().map(|cell| cell.replies));
    let used = replies.in_time + replies.late + replies.unasked;
    let dropped = |event| table.counters().event_count(event);
    let (stale, repeated) = (dropped(FrameEvent::StaleTorque), dropped(FrameEvent::RepeatedTorque));
    if bench.oracle.compares {
        assert_eq!((used, stale, repeated), (tally.used, tally.stale, tally.repeated), "torques");
    } else {
        assert_eq!(used + stale + repeated, tally.used + tally.stale + tally.repeated, "torques");
    }
}

/// Checks that every frame that arrived is counted somewhere.
fn frames(bench: &Bench) {
    let (table, tally) = (&bench.gateway.table, bench.oracle.tally);
    let counters = table.counters();
    let count = |event| counters.event_count(event);
    let by_kind: u64 =
        Kind::ALL.into_iter().map(|kind| counters.received_count(kind) + counters.sent_count(kind)).sum();
    let elsewhere = count(FrameEvent::Foreign) + count(FrameEvent::ErrorFrame);
    // Flipped bits may produce an unused identifier, also in a frame that is truncated.
    let foreign = count(FrameEvent::Foreign);
    if tally.babbled == 0 {
        assert!(
            (tally.truncated.saturating_sub(foreign)..=tally.truncated).contains(&count(FrameEvent::Length)),
            "truncated frames"
        );
    }
    if is_fd(bench) {
        assert_eq!(by_kind + elsewhere, tally.frames, "frames by kind");
        if tally.babbled == 0 {
            let harmed = count(FrameEvent::Length) + count(FrameEvent::Crc) + foreign;
            assert_eq!(
                harmed,
                tally.truncated + tally.flipped,
                "frames with flipped bits, and truncated ones"
            );
        }
        assert_eq!(count(FrameEvent::Incomplete), 0);
        return;
    }
    // A packet has two segments; an incomplete one has one, and one may be waiting for each identifier.
    let odd = count(FrameEvent::Incomplete) + count(FrameEvent::Length);
    let segments = 2 * (by_kind - odd) + odd;
    let waiting = tally.frames - elsewhere - segments;
    assert!(waiting <= 1 << 11, "{waiting} segments wait");
    assert_eq!(count(FrameEvent::Crc), 0);
}
