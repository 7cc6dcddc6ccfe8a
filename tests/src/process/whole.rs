//! A run of the largest skin on the kernel's vcan: 253 processes that all answer every broadcast, with `candump` on the
//! same bus.

use std::time::Duration;

use model::generate::{SkinRequest, generate};
use protocol::can::Frame;
use protocol::id::{Id, Kind};

use super::vcan::{Candump, tool};
use super::{Running, Summary, TestDir, program};

const CELLS: u64 = 253;
const SECONDS: u32 = 30;

/// A scenario in which all cells are always in contact. The central torque is not computed, because under emulation it
/// would take a fifth of the only processor.
const SCENARIO: &str = r#"version = 1
duration_s = 30.0

[motion]
kind = "sine"
start_rad = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]
amplitude_rad = [0.5, 0.3, 0.4, 0.3, 0.2, 0.2]
period_s = 10.0

[[mode]]
at_s = 0.0
kind = "distributed"

[[touch]]
at_s = 0.0
for_s = 31.0
all = true
force_n = 1.5
profile = "step"
"#;

/// Runs the bench for half a minute. Checks that every broadcast was sent, or counted as skipped because the machine
/// was late, that no frame was lost, and that candump saw exactly the counted frames.
pub fn runs_for_half_a_minute(broadcasts: u32, control_hz: f64) -> Summary {
    let broadcast_hz = f64::from(broadcasts) / f64::from(SECONDS);
    let place = TestDir::on_vcan();
    let expected = SkinRequest { cells: 253, broadcast_hz, ..SkinRequest::default() };
    let (skin, usual) = (generate(&expected).unwrap(), "control_hz = 500.0");
    assert!(skin.contains(usual), "{usual}");
    place.write("skin.toml", &skin.replace(usual, &format!("control_hz = {control_hz:?}")));
    place.scenario(SCENARIO);
    // Everything is read from the host's files before the run: where time is counted in instructions, waiting for them
    // would let it pass.
    for name in ["skinbus", "cell-node"] {
        tool(&format!("cp {} {}", program(name).display(), place.path(name).display()));
        Running::start(place.command_of(&place.path(name), "--version")).end().succeeded();
    }
    let candump = Candump::start("vcan0", &place.path("candump.log"));
    let run =
        "run skin.toml --scenario scenario.toml --bus-kind socketcan --quiet --summary run.json --overwrite";
    let bench = Running::start(place.command_of(&place.path("skinbus"), run));
    let ended = bench.end_after(Duration::from_secs(SECONDS.into()) + Duration::from_secs(60)).succeeded();
    eprintln!("{}", ended.stdout);
    let summary = place.summary();
    summary.adds_up();

    let (sent, skipped) = (summary.number("/loop/broadcasts"), summary.number("/loop/broadcasts_skipped"));
    assert_eq!(sent + skipped, u64::from(broadcasts), "joints");
    for lost in
        ["/dropped_by_bus", "/uplink/dropped", "/uplink/backlog", "/uplink/unknown", "/uplink/rejected"]
    {
        assert_eq!(summary.of_bus(lost), 0, "{lost}");
    }
    assert_eq!((summary.odd(0), summary.number("/loop/unsent")), (0, 0), "{:#}", summary.0);

    let seen = candump.frames();
    let counted = summary.total("/buses/0/received") + summary.total("/buses/0/sent");
    // Cells that are being ended may still send a heartbeat.
    let (ours, later) = seen.split_at(usize::try_from(counted).unwrap());
    assert!(later.iter().all(|frame| kind_of(frame) == Kind::Network), "{} and {counted}", seen.len());
    let torques = ours.iter().filter(|frame| kind_of(frame) == Kind::Torque).count() as u64;
    assert_eq!(torques, summary.count("/buses/0/received", "torque"), "torques that candump saw");
    summary
}

/// Checks that every broadcast that was due was sent, and that all cells have answered each.
pub fn all_is_answered(summary: &Summary) {
    assert_eq!(summary.number("/loop/broadcasts_skipped"), 0);
    let due = CELLS * summary.number("/loop/broadcasts");
    let answered = summary.of_bus("/replies/in_time") + summary.of_bus("/replies/late");
    assert_eq!((summary.of_bus("/replies/due"), answered), (due, due), "{:#}", summary.0);
    assert_eq!(summary.count("/buses/0/received", "torque"), due);
}

fn kind_of(frame: &Frame) -> Kind {
    Id::from_bits(u16::try_from(frame.raw_id()).unwrap()).kind
}
