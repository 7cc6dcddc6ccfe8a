//! A bench of processes on a real kernel's vcan, beside `candump`.

#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use model::generate::{SkinRequest, generate};
use process::TestDir;
use process::log::{Log, same_torques};
use process::vcan::{Candump, frames_of, same_by_sender};
use protocol::can::Format;

/// The joints stand still, so that torques depend only on the epoch, also when a slow machine skips ticks.
const SCENARIO: &str = r#"version = 1
duration_s = 6.0

[motion]
kind = "hold"
start_rad = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]

[[touch]]
at_s = 0.0
for_s = 6.0
all = true
force_n = 1.5
profile = "half-sine"
"#;

/// Writes a skin of twelve cells with a rate that an emulated machine can follow.
fn prepare(place: &TestDir) {
    let expected = SkinRequest { cells: 12, broadcast_hz: 20.0, ..SkinRequest::default() };
    place.write("skin.toml", &generate(&expected).unwrap());
    place.scenario(SCENARIO);
}

#[test]
#[ignore = "needs vcan"]
fn candump_sees_exactly_what_the_gateway_counts_in_the_same_order_by_sender() {
    let place = TestDir::on_vcan();
    prepare(&place);
    let candump = Candump::start("vcan0", &place.path("candump.log"));
    place.bench(6.0, "").end().succeeded();
    let (ours, theirs) = (frames_of(&place.path("run.log")), candump.frames());
    let summary = place.summary();
    assert_eq!(summary.0["buses"][0]["kind"], "socketcan");
    summary.adds_up();
    assert_eq!(summary.of_bus("/dropped_by_bus"), 0);
    assert_eq!(summary.odd(0), 0, "{:#}", summary.0);
    let counted = summary.total("/buses/0/received") + summary.total("/buses/0/sent");
    assert_eq!(ours.len() as u64, counted, "the log has what is counted");
    // A tenth of the number on a machine that is always in time.
    assert!(summary.of_bus("/replies/due") > 144, "{:#}", summary.0);

    same_by_sender(&ours, &theirs);
}

#[test]
#[ignore = "needs vcan"]
fn what_candump_logged_is_the_same_run_when_we_decode_it() {
    let place = TestDir::on_vcan();
    prepare(&place);
    let candump = Candump::start("vcan0", &place.path("candump.log"));
    place.bench(3.0, "").end().succeeded();
    let frames = candump.frames();
    let dumped = |file: &str| {
        let dump =
            place.start("skinbus", &format!("dump {file} --kind torque,stimulus,command")).end().succeeded();
        let mut lines: Vec<_> = dump.stdout.lines().map(without_time).map(str::to_owned).collect();
        lines.sort();
        lines
    };
    let (ours, theirs) = (dumped("run.log"), dumped("candump.log"));
    assert!(ours.len() > 12 * 6 && ours == theirs, "{} and {} lines", ours.len(), theirs.len());
    let [ours, theirs] =
        [Log::read(&place.read("run.log"), Format::Fd), Log::from_frames(frames, Format::Fd)];
    let (shared, all) = same_torques(&ours, &theirs);
    assert!(shared == all && ours.torques().len() == theirs.torques().len(), "{shared} of {all}");
}

/// Returns a line of `skinbus dump` from the interface's name on.
fn without_time(line: &str) -> &str {
    line.find("vcan0").map_or(line, |at| &line[at..])
}

#[test]
#[ignore = "needs vcan"]
fn torques_are_the_same_bit_for_bit_on_vcan_and_on_the_embedded_bus() {
    let [on_vcan, on_embedded] = [TestDir::on_vcan(), TestDir::new()].map(|place| {
        prepare(&place);
        place.bench(6.0, "").end().succeeded();
        place.summary().adds_up();
        Log::read(&place.read("run.log"), Format::Fd)
    });
    // A machine that pauses skips broadcasts, and its cells skip epochs: the shared causes must be equal, and at least
    // a tenth of the 732 causes of a machine that is always in time.
    let (shared, all) = same_torques(&on_vcan, &on_embedded);
    assert!(shared > 70, "{shared} of {all} causes are in both runs");
}
