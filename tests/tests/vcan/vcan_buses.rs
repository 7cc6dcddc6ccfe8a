//! Several buses on a real kernel, with CAN FD and with classic frames, beside one that is not an interface: a bus that
//! goes down, or is removed and made again, is lost alone.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]
#![allow(clippy::wildcard_enum_match_arm, reason = "a test looks for what it looks for")]

use skinbus_tests::process;

use model::generate::{SkinRequest, generate};
use process::buses::{carries, mixed_skin};
use process::page::{Page, watched_skin};
use process::test_client::TestClient;
use process::vcan::{Vcan, tool};
use process::{PRESSED, Running, TestDir, until};
use protocol::bus::{BusKind, KindChoice};
use protocol::can::Format;
use rustix::process::Signal;
use serde_json::Value;

/// vcan0 exists already; vcan1 is a classic interface; vcan3 is an embedded bus.
const BUSES: [(&str, Format, BusKind); 4] = [
    ("vcan0", Format::Fd, BusKind::SocketCan),
    ("vcan1", Format::Classic, BusKind::SocketCan),
    ("vcan2", Format::Fd, BusKind::SocketCan),
    ("vcan3", Format::Fd, BusKind::Embedded),
];
const CELLS: usize = 8;

/// Creates eight cells on four buses, all pressed, and an arm that moves under the touch.
fn prepare() -> (TestDir, Vcan, Vcan) {
    let place = TestDir::on_vcan();
    let expected =
        SkinRequest { cells: CELLS, buses: BUSES.len(), broadcast_hz: 20.0, ..SkinRequest::default() };
    place.write("skin.toml", &mixed_skin(&generate(&expected).unwrap(), &["vcan1"]));
    place.scenario(&PRESSED.replace("hold", "kinesthetic"));
    (place, Vcan::with_mtu("vcan1", 16), Vcan::make("vcan2"))
}

fn run(place: &TestDir) -> Running {
    let bench = place.running_bench(600.0, "--bus-kind vcan3=embedded --cells-per-process 2");
    for (bus, _, kind) in BUSES {
        bench.wait_for_stderr(&format!("{bus} is {kind}, with a receive buffer"));
    }
    all_answer(place);
    bench
}

fn answers(place: &TestDir, bus: usize) {
    let (bus, format, kind) = BUSES[bus];
    TestClient::on_kind(place, bus, format, KindChoice::Only(kind)).waits_for_torques(1..=2);
}

fn all_answer(place: &TestDir) {
    (0..BUSES.len()).for_each(|bus| answers(place, bus));
}

/// Waits until a bench has printed a text a number of times.
fn says(bench: &Running, words: &str, times: usize) {
    until(words, || (bench.stderr().matches(words).count() == times).then_some(()));
}

/// Ends a bench, and checks that all counts add up, and how many times each bus was lost.
fn ended_well(place: &TestDir, bench: Running, times: [u64; 4]) {
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    place.is_left_clean();
    let summary = place.summary();
    summary.adds_up();
    let lost = [0, 1, 2, 3].map(|bus| summary.number(&format!("/buses/{bus}/outages/times")));
    assert_eq!(lost, times, "{:#}", summary.0);
    assert_eq!(summary.total("/loop/bad_cycles"), 0, "{:#}", summary.0);
    assert!(summary.0["halted"].is_null(), "{:#}", summary.0);
    for (bus, (_, _, kind)) in BUSES.iter().enumerate() {
        assert_eq!(summary.0["buses"][bus]["silent_cells"].as_array().unwrap().len(), 0, "{:#}", summary.0);
        assert_eq!(summary.number(&format!("/buses/{bus}/uplink/restarts")), 0, "{:#}", summary.0);
        assert_eq!(summary.0["buses"][bus]["kind"], kind.name());
    }
    let log = place.read("run.log");
    for (bus, format, _) in BUSES {
        assert!(carries(&log, bus, format), "{bus}");
    }
}

#[test]
#[ignore = "needs vcan"]
fn an_interface_that_goes_down_is_lost_alone_and_works_again_when_it_is_up() {
    let (place, _vcan1, _vcan2) = prepare();
    let bench = run(&place);
    let cells = bench.cells();
    for (times, bus) in [(1, 1), (1, 2), (2, 1)] {
        let name = BUSES[bus].0;
        tool(&format!("ip link set {name} down"));
        says(&bench, &format!("{name} is down: bring it up with `"), times);
        (1..=2).for_each(|cell| bench.wait_for_event_on(name, cell, "fallen silent"));
        (0..BUSES.len()).filter(|&other| other != bus).for_each(|other| answers(&place, other));
        tool(&format!("ip link set {name} up"));
        says(&bench, &format!("{name} works again"), times);
        all_answer(&place);
    }
    assert_eq!(bench.cells(), cells, "no cell was restarted");
    ended_well(&place, bench, [0, 2, 1, 0]);
}

#[test]
#[ignore = "needs vcan"]
fn an_interface_that_is_removed_and_made_again_is_opened_again() {
    let (place, vcan1, vcan2) = prepare();
    let bench = run(&place);
    let cells = bench.cells();
    let removed =
        |name: &str| format!("{name} was removed while it was in use: create it again, then open it again");
    vcan2.remove();
    bench.wait_for_stderr(&format!("{}; the other buses continue", removed("vcan2")));
    vcan1.remove();
    bench.wait_for_stderr(&format!("{}; the other buses continue", removed("vcan1")));
    for cell in 1..=2 {
        bench.wait_for_event_on("vcan1", cell, "fallen silent");
        bench.wait_for_event_on("vcan2", cell, "fallen silent");
    }
    answers(&place, 0);
    answers(&place, 3);
    let _vcan1 = Vcan::with_mtu("vcan1", 16);
    bench.wait_for_stderr("vcan1 works again");
    answers(&place, 1);
    // First with the wrong setting, which is reported, and then with the right one.
    let narrow = Vcan::with_mtu("vcan2", 16);
    bench.wait_for_stderr("vcan2 cannot be reopened yet: vcan2 has MTU 16, but CAN FD needs 72");
    narrow.remove();
    let _vcan2 = Vcan::make("vcan2");
    bench.wait_for_stderr("vcan2 works again");
    all_answer(&place);
    assert_eq!(bench.cells(), cells, "no cell was restarted");
    ended_well(&place, bench, [0, 1, 1, 0]);
}

#[test]
#[ignore = "needs vcan"]
fn a_bus_that_is_missing_when_a_run_begins_is_refused_with_its_hint() {
    let (place, _vcan1, vcan2) = prepare();
    vcan2.remove();
    let refused = place.bench(1.0, "--quiet --bus-kind vcan3=embedded").end();
    assert!(
        refused.refusal(2).starts_with("skinbus: there is no interface vcan2: make it with `"),
        "{refused:#?}"
    );
    let refused = place.bench(1.0, "--quiet --bus-kind vcan1=embedded --bus-kind vcan2=embedded").end();
    assert!(
        refused.refusal(2).starts_with("skinbus: there is no interface vcan3: make it with `"),
        "{refused:#?}"
    );
    place.is_left_clean();
}

#[test]
#[ignore = "needs vcan"]
fn a_page_takes_an_interface_down_and_up() {
    let place = TestDir::on_vcan();
    let slow = SkinRequest { cells: 4, broadcast_hz: 20.0, ..SkinRequest::default() };
    place.write("skin.toml", &generate(&slow).unwrap());
    let (run, address) = watched_skin(&place, "");
    let mut page = Page::new(&address);
    page.wait_for_snapshot("all cells", |it| it.cells.iter().all(|cell| cell.0 == 1));
    page.send(r#"{"do":"bus","bus":"vcan0","down":true}"#);
    assert!(page.answer("bus vcan0 down"));
    let is_up = || {
        let shown: Value = serde_json::from_slice(&tool("ip -json link show vcan0").stdout).unwrap();
        shown[0]["flags"].as_array().unwrap().iter().any(|flag| flag == "UP")
    };
    assert!(!is_up());
    page.wait_for_status("the bus down", |said| {
        said["buses"][0]["up"] == false && said["bench"]["buses"][0]["down"] == true
    });
    page.wait_for_snapshot("silent cells", |it| it.cells.iter().all(|cell| cell.0 == 4));
    let said = page.wait_for_status("words", |_| true);
    assert_eq!(said["buses"][0]["up"], false, "frames from before are no sign that it works again");
    page.send(r#"{"do":"bus","bus":"vcan0","down":false}"#);
    assert!(page.answer("bus vcan0 up"));
    assert!(is_up());
    run.wait_for_stderr("vcan0 works again");
    page.wait_for_status("the bus up", |said| {
        said["buses"][0]["up"] == true && said["bench"]["buses"][0]["down"] == false
    });
    page.wait_for_snapshot("all cells again", |it| it.cells.iter().all(|cell| cell.0 != 4));
    run.signal(Signal::INT);
    run.end();
    place.is_left_clean();
}
