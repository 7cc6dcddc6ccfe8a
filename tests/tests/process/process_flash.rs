//! Cells that keep their parameters in files: written once, found again, and rejected when damaged.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::fs;

use process::log::Log;
use process::{TestDir, names};
use protocol::can::Format;
use protocol::id::Node;
use protocol::message::{Message, NetworkPage, State};
use rustix::process::Signal;

/// Runs a bench whose cells have written their parameters.
fn written() -> TestDir {
    let place = TestDir::new();
    place.pressed();
    fs::create_dir(place.path("flash")).unwrap();
    place.bench(0.5, "--flash flash").end().succeeded();
    place.is_left_clean();
    let expected: Vec<_> = (1..=8).map(|node| format!("vcan0-{node}.flash")).collect();
    assert_eq!(names(&place.path("flash")), expected);
    place
}

fn damage(place: &TestDir, node: u8) {
    let path = place.path(&format!("flash/vcan0-{node}.flash"));
    let mut bytes = fs::read(&path).unwrap();
    bytes[20] ^= 1;
    fs::write(&path, bytes).unwrap();
}

fn images(place: &TestDir) -> Vec<Vec<u8>> {
    let files = names(&place.path("flash")).into_iter();
    files.map(|name| fs::read(place.path("flash").join(name)).unwrap()).collect()
}

#[test]
fn what_was_written_is_found_again_and_not_written_again() {
    let place = written();
    let before = images(&place);
    place.bench(0.5, "--flash flash").end().succeeded();
    let summary = place.summary();
    assert!(summary.adds_up().of_bus("/replies/due") > 0);
    assert_eq!(images(&place), before);
}

#[test]
fn a_damaged_file_is_not_used_and_the_gateway_names_the_cell() {
    let place = written();
    damage(&place, 3);
    let path = place.path("flash/vcan0-5.flash");
    let image = fs::read(&path).unwrap();
    fs::write(&path, &image[..40]).unwrap();
    let before = images(&place);
    let ended = place.bench(1.0, "--flash flash --quiet").end();
    place.is_left_clean();
    assert_eq!((ended.code(), ended.stdout.as_str()), (Some(1), ""), "{ended:#?}");
    let mut said: Vec<_> = ended.stderr.lines().collect();
    said.sort_unstable();
    let expected = [
        "cell-node: flash of cell 3 (flash/vcan0-3.flash) is not used: the CRC of the flash image is wrong; \
         commission the cell again, or delete the file"
            .to_owned(),
        format!(
            "cell-node: flash of cell 5 (flash/vcan0-5.flash) is not used: the flash image has 40 bytes, not \
             {} to 445; commission the cell again, or delete the file",
            image.len()
        ),
        "skinbus: these cells have no parameters: 3, 5 on vcan0; write the parameters with `skinbus commission`, or \
         delete the cells' flash files if these are damaged"
            .to_owned(),
    ];
    assert_eq!(said, expected);
    assert_eq!(images(&place), before, "no program deletes them");
    assert_eq!(place.files(), ["flash", "run.json", "run.log", "scenario.toml", "skin.toml"]);

    for node in [3, 5] {
        fs::remove_file(place.path(&format!("flash/vcan0-{node}.flash"))).unwrap();
    }
    place.bench(0.5, "--flash flash").end().succeeded();
    assert_eq!(fs::read(&path).unwrap(), image, "deleted, it is written again");
}

#[test]
fn what_is_no_regular_file_is_no_flash_and_delays_nothing() {
    let place = written();
    let path = place.path("flash/vcan0-3.flash");
    fs::remove_file(&path).unwrap();
    let (kind, mode) = (rustix::fs::FileType::Fifo, rustix::fs::Mode::from_raw_mode(0o600));
    rustix::fs::mknodat(rustix::fs::CWD, &path, kind, mode, 0).unwrap();
    let ended = place.bench(1.0, "--flash flash --quiet").end();
    let why = "flash of cell 3 (flash/vcan0-3.flash): it is a named pipe, but a file is needed";
    assert!(ended.code() == Some(1) && ended.stderr.contains(why), "{ended:#?}");
}

#[test]
fn a_cell_without_parameters_reports_it_and_sends_no_torque() {
    let place = written();
    damage(&place, 3);
    let server = place.start("vcan-setup", "serve vcan0");
    server.wait_for_stdout("serving vcan0 at ");
    let cells = place
        .start("cell-node", "--bus vcan0 --bus-kind embedded --nodes 1-8 --skin skin.toml --flash flash");
    cells.wait_for_stderr(
        "flash of cell 3 (flash/vcan0-3.flash) is not used: the CRC of the flash image is wrong",
    );
    place.test_client().waits_for("a heartbeat of cell 3 without parameters", |message| {
        matches!(message, Message::Network { from: Node::Cell(cell), page: NetworkPage::Heartbeat(heartbeat), .. }
            if cell.get() == 3
                && heartbeat.state.has(State::FLASH_DAMAGED)
                && !heartbeat.state.has(State::CONFIGURED)
                && heartbeat.configuration == 0)
    });
    let bench = place.running_bench(600.0, "--no-spawn");
    bench.wait_for_stderr("these cells have no parameters, so the run continues without them: 3 on vcan0");
    place.test_client().waits_for_epoch(20);
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    let summary = place.summary();
    assert_eq!(summary.adds_up().silent().len(), 0, "it is there, and sends no torques only");
    let log = Log::read(&place.read("run.log"), Format::Fd);
    assert_eq!(log.torques_after(0, 3), 0);
    assert!(log.torques_after(0, 4) > 0);
    drop((cells, server));
}

#[test]
fn cells_that_are_configured_for_another_skin_are_refused_by_name() {
    let place = written();
    let before = images(&place);
    let text = place.read("skin.toml");
    let other = text.replace("alpha_c = 1.0", "alpha_c = 1.5");
    place.write("skin.toml", &other);
    let said = "skinbus: these cells are not configured for skin.toml: 1, 2, 3, 4, 5, 6, 7, 8 on \
                vcan0; configure them with `skinbus commission`, or delete their flash files";
    assert_eq!(place.bench(1.0, "--flash flash --quiet").end().refusal(1), said);
    place.is_left_clean();

    // Another cell with the same node id.
    place.write("skin.toml", &text.replace("serial = 100006\n", "serial = 6\n"));
    let ended = place.bench(1.0, "--flash flash --quiet").end();
    assert_eq!(ended.code(), Some(1));
    assert!(
        ended.stderr.contains("is not used: the flash image belongs to cell 6 with serial number 100006"),
        "{ended:#?}"
    );
    assert!(ended.stderr.contains("skinbus: these cells have no parameters: 6 on vcan0"), "{ended:#?}");
    place.is_left_clean();
    assert_eq!(images(&place), before);
}

#[test]
fn a_directory_that_is_not_there_is_named() {
    let place = TestDir::new();
    place.pressed();
    let said = "skinbus: --flash flash: this directory does not exist; create it first";
    assert_eq!(place.bench(1.0, "--flash flash").end().refusal(2), said);
    let cell =
        place.start("cell-node", "--bus vcan0 --bus-kind embedded --node 1 --skin skin.toml --flash flash");
    let said = "cell-node: --flash flash: this directory does not exist; create it first";
    assert_eq!(cell.end().refusal(2), said);
    assert_eq!(place.files(), ["scenario.toml", "skin.toml"]);
    place.is_left_clean();
}

#[test]
fn two_programs_do_not_use_one_cells_file_at_a_time() {
    let place = written();
    let other = TestDir::new();
    other.pressed();
    let running = place.running_bench(600.0, "--flash flash");
    let flash = place.path("flash").display().to_string();
    // Another bench, whose bus has the same name, in a directory of its own.
    let before = images(&place);
    let ended = other.bench(0.5, &format!("--quiet --cells-per-process 8 --flash {flash}")).end();
    assert_eq!(ended.code(), Some(1), "{ended:#?}");
    let who = running.cell(1).as_raw_nonzero();
    assert!(ended.stderr.contains(&format!("flash of cell 1 ({flash}/vcan0-1.flash)")), "{ended:#?}");
    assert!(ended.stderr.contains(&format!("process {who} (cell-node) is using it")), "{ended:#?}");
    // A cell started alone reports it too; a cell without a file starts.
    let words = |node| {
        format!("--bus vcan0 --bus-kind embedded --node {node} --skin skin.toml --flash {flash} --fresh")
    };
    let refused = other.start("cell-node", &words(2)).end();
    assert!(refused.refusal(2).contains("(cell-node) is using it: stop that process first"), "{refused:#?}");
    assert_eq!(images(&place), before);
    running.signal(Signal::TERM);
    running.end();
    place.is_left_clean();
    other.bench(0.5, &format!("--flash {flash}")).end().succeeded();
}
