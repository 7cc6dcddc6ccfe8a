//! A recording of a bench on a real kernel's vcan, beside `candump`: it misses nothing.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

mod process;
#[path = "process/recorded.rs"]
mod recorded;

use gateway::generate::{Wanted, generate};
use process::vcan::{Candump, by_identifier};
use process::{PRESSED, Place};
use protocol::candump::{Line, parse};
use protocol::id::{Id, Kind};
use recorded::Recorded;

/// Records a bench of pressed cells, and sees that the recording has exactly the frames that candump has seen.
fn has_what_candump_sees(cells: usize, broadcast_hz: f64, more: &str) {
    let place = Place::on_vcan();
    let wanted = Wanted { cells, broadcast_hz, ..Wanted::default() };
    place.write("skin.toml", &generate(&wanted).unwrap());
    place.scenario(PRESSED);
    let candump = Candump::start("vcan0", &place.path("candump.log"));
    place.bench(4.0, &format!("--record run.mcap {more}")).end().well();
    let (theirs, summary) = (candump.frames(), place.summary());
    assert_eq!(
        (summary.of_bus("/dropped_by_bus"), summary.number("/recording/lost")),
        (0, 0),
        "{:#}",
        summary.0
    );
    let recorded = Recorded::read(&place.path("run.mcap"));
    assert!(recorded.on("/can/notes").next().is_none());
    let frame = |line: &String| match parse(line) {
        Ok(Line::Frame(record)) => record.frame,
        other => panic!("{line}: {other:?}"),
    };
    let ours: Vec<_> = recorded.lines("/can/vcan0").iter().map(frame).collect();
    let counted = summary.total("/buses/0/received") + summary.total("/buses/0/sent");
    assert_eq!(ours.len() as u64, counted, "the recording has what is counted");
    assert!(counted > 4 * cells as u64, "{:#}", summary.0);

    let (ours, theirs) = (by_identifier(&ours), by_identifier(&theirs));
    assert_eq!(ours.keys().collect::<Vec<_>>(), theirs.keys().collect::<Vec<_>>());
    for (id, theirs) in &theirs {
        let ours = &ours[id];
        // Cells that are being ended may still say a heartbeat when the gateway no longer listens.
        let kind = Id::from_bits(u16::try_from(*id).unwrap()).kind;
        assert!(theirs.len() == ours.len() || kind == Kind::Network, "frames of {id:03X}");
        assert!(theirs.starts_with(ours), "{id:03X} comes in another order");
    }
}

#[test]
#[ignore = "needs vcan"]
fn twelve_cells_are_recorded_as_candump_sees_them() {
    has_what_candump_sees(12, 20.0, "");
}

#[test]
#[ignore = "needs vcan"]
fn the_whole_skin_is_recorded_as_candump_sees_it() {
    has_what_candump_sees(253, 62.5, "--cells-per-process 16");
}
