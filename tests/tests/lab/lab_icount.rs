//! The lab machine whose time is counted in instructions: each repetition is equal, however busy the host is.

#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use model::generate::{SkinRequest, generate};
use process::log::Log;
use process::{TestDir, whole};
use protocol::can::Format;
use protocol::id::Kind;

#[test]
#[ignore = "needs the lab machine"]
fn all_253_processes_answer_every_broadcast_in_time_at_the_full_rate() {
    let broadcasts = 1875; // 62.5 Hz for 30 s
    let summary = whole::runs_for_half_a_minute(broadcasts, 500.0);
    whole::all_is_answered(&summary);
    assert_eq!(summary.of_bus("/epochs_complete"), u64::from(broadcasts));
    assert_eq!((summary.of_bus("/replies/late"), summary.number("/loop/ticks_skipped")), (0, 0));
    assert_eq!(summary.number("/loop/broadcasts_skipped"), 0);
}

/// Everything changes all the time, by the number of the broadcast. A robot moved by the torques would also depend on
/// the tick in which they arrive.
const LIVELY: &str = r#"version = 1
duration_s = 4.0

[motion]
kind = "sine"
start_rad = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]
amplitude_rad = [0.5, 0.3, 0.4, 0.3, 0.2, 0.2]
period_s = 3.0

[[mode]]
at_s = 0.0
kind = "compare"

[[touch]]
at_s = 0.5
for_s = 2.5
all = true
force_n = 1.5
profile = "half-sine"
"#;

#[test]
#[ignore = "needs the lab machine"]
fn the_same_run_on_vcan_and_on_the_embedded_bus_differs_in_times_and_interleaving_only() {
    let [vcan, embedded] = [TestDir::on_vcan(), TestDir::new()].map(|place| {
        let expected = SkinRequest { cells: 24, ..SkinRequest::default() };
        place.write("skin.toml", &generate(&expected).unwrap());
        place.scenario(LIVELY);
        place.bench(4.0, "").end().succeeded();
        place.summary().adds_up();
        assert_eq!(place.summary().number("/loop/ticks_skipped"), 0);
        let log = Log::read(&place.read("run.log"), Format::Fd);
        log.heartbeats_count_what_came();
        log
    });
    let [vcan, embedded] = [vcan, embedded].map(|log| log.by_sender());
    assert_eq!(vcan.keys().collect::<Vec<_>>(), embedded.keys().collect::<Vec<_>>());
    for (sender, said) in &vcan {
        for (vcan, embedded) in said.iter().zip(&embedded[sender]) {
            assert_eq!(vcan, embedded, "{sender:?}");
        }
        assert_eq!(said.len(), embedded[sender].len(), "{sender:?}");
    }
    let torques: usize =
        vcan.iter().filter(|((kind, ..), _)| *kind == Kind::Torque).map(|(_, all)| all.len()).sum();
    assert!(torques > 24 * 100, "{torques} torques");
}
