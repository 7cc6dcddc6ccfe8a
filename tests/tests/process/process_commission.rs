//! `skinbus commission` and `skinbus cells` beside cells that are processes, on an embedded bus.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::collections::BTreeMap;
use std::fs;

use cell_node::flash;
use cell_node::identity::Identity;
use model::generate::{Format, ReplyMode, SkinRequest, generate};
use process::{Ended, Running, TestDir, skin, skin_of, until};
use protocol::id::CellId;
use protocol::parameters::Parameters;
use protocol::skin::Skin;
use rustix::process::Signal;
use serde_json::Value;

/// Returns the skin as the cells have it from an earlier commissioning: with another gain, another wrist, and other
/// poses.
fn older(text: &str) -> String {
    let older = text
        .replace("alpha_c = 1.0", "alpha_c = 0.5")
        .replace("d = 0.0823", "d = 0.09")
        .replace("position = [0.", "position = [0.01");
    assert_ne!(older, text);
    older
}

/// A bus with running cells, which have the older skin in their flash.
struct Workshop {
    place: TestDir,
    _cells: Running,
    _bus: Running,
}

impl Workshop {
    fn new(text: &str) -> Self {
        Self::with(text, &older(text), "")
    }

    /// Starts the cells from 1 on in one process, with the skin `had`.
    fn with(text: &str, had: &str, more: &str) -> Self {
        let place = TestDir::new();
        place.write("skin.toml", text);
        place.write("had.toml", had);
        fs::create_dir(place.path("flash")).unwrap();
        let bus = place.start("vcan-setup", "serve vcan0");
        bus.wait_for_stdout("serving ");
        let cells = Skin::parse("skin.toml", had).unwrap().cells.len();
        let cells =
            format!("--bus vcan0 --nodes 1-{cells} --skin had.toml --flash flash --bus-kind embedded {more}");
        let cells = place.start("cell-node", &cells);
        let workshop = Self { place, _cells: cells, _bus: bus };
        until("cells on the bus", || workshop.list("").ok());
        workshop
    }

    fn skin(&self) -> Skin {
        Skin::read(&self.place.path("skin.toml")).unwrap()
    }

    fn commission(&self, more: &str) -> Running {
        self.place.start("skinbus", &format!("commission skin.toml --bus-kind embedded {more}"))
    }

    /// Returns the list of cells as JSON.
    fn list(&self, more: &str) -> Result<Value, Ended> {
        let ended =
            self.place.start("skinbus", &format!("cells vcan0 --bus-kind embedded --json {more}")).end();
        match ended.code() {
            Some(0) => Ok(serde_json::from_str(&ended.stdout).unwrap()),
            _ => Err(ended),
        }
    }

    /// Returns the parameters in the flash of each cell, by node id.
    fn flashes(&self) -> BTreeMap<u8, Option<Parameters>> {
        let of = |cell: &protocol::skin::Cell| {
            let file = self.place.path(&format!("flash/vcan0-{}.flash", cell.node));
            let identity = Identity { cell: Some(cell.node), serial: cell.serial };
            let kept = flash::decode(identity, &fs::read(file).ok()?).unwrap();
            Some((cell.node.get(), kept.parameters))
        };
        self.skin().cells.iter().filter_map(of).collect()
    }

    /// Checks that each cell has either the older skin's parameters or the new one's; returns the number with the new
    /// ones.
    fn none_is_mixed(&self) -> usize {
        let of = |name: &str| {
            let skin = Skin::read(&self.place.path(name)).unwrap();
            skin.cells.iter().map(|cell| (cell.node.get(), skin.parameters(cell))).collect::<BTreeMap<_, _>>()
        };
        let (old, new) = (of("had.toml"), of("skin.toml"));
        let flashes = self.flashes();
        assert_eq!(flashes.len(), new.len());
        for (node, parameters) in &flashes {
            let has = |all: &BTreeMap<u8, Parameters>| *parameters == all.get(node).copied();
            assert!(has(&old) || has(&new), "cell {node} has neither: {parameters:?}");
        }
        flashes.iter().filter(|(node, parameters)| **parameters == new.get(node).copied()).count()
    }

    /// Checks that all cells report the skin's configuration.
    fn all_have_it(&self) {
        let listed = self.list("--skin skin.toml").unwrap();
        let cells = listed["cells"].as_array().unwrap();
        assert_eq!(cells.len(), self.skin().cells.len(), "{listed:#}");
        assert!(cells.iter().all(|cell| cell["skin"] == "yes"), "{listed:#}");
        assert_eq!(listed["missing"], Value::Array(Vec::new()));
        assert_eq!(self.none_is_mixed(), cells.len());
    }
}

fn json(ended: &Ended) -> Value {
    serde_json::from_str(&ended.stdout).unwrap_or_else(|error| panic!("{error}: {ended:#?}"))
}

#[test]
fn cells_get_the_skins_parameters_and_a_repeat_is_a_no_op() {
    for format in [Format::Fd, Format::Classic] {
        let workshop = Workshop::new(&skin_of(20, 1, format));
        let dry = workshop.commission("--dry-run --json").end().succeeded();
        assert_eq!(json(&dry).pointer("/buses/0/would_write"), Some(&20.into()), "{dry:#?}");
        assert_eq!(workshop.none_is_mixed(), 0, "a dry run writes nothing");

        let first = workshop.commission("").end().succeeded();
        assert!(first.stdout.contains("written          20"), "{}", first.stdout);
        workshop.all_have_it();

        let second = workshop.commission("--json").end().succeeded();
        let bus = &json(&second)["buses"][0];
        assert_eq!((&bus["already_so"], &bus["requests"]), (&20.into(), &0.into()), "{bus:#}");
        let third = workshop.commission("--verify --json --quiet").end().succeeded();
        assert_eq!((json(&third)["buses"][0]["verified"].as_u64(), third.stderr.as_str()), (Some(20), ""));
    }
}

#[test]
fn killed_in_the_middle_and_run_again_it_is_complete_and_nothing_is_mixed() {
    let workshop = Workshop::new(&skin(120));
    let mut halfway = false;
    // A machine may be too quick or too slow; in between, some cells have it and others do not.
    for _ in 0..40 {
        let running = workshop.commission("--quiet");
        let file = workshop.place.path("flash/vcan0-1.flash");
        let before = fs::read(&file).unwrap();
        until("the first cell's flash, or the end", || {
            let over = workshop.none_is_mixed() == 120;
            (over || fs::read(&file).unwrap() != before).then_some(())
        });
        running.signal(Signal::KILL);
        running.end();
        let new = workshop.none_is_mixed();
        if 0 < new && new < 120 {
            halfway = true;
            break;
        }
        // Once more from the start.
        fs::rename(workshop.place.path("skin.toml"), workshop.place.path("new.toml")).unwrap();
        fs::copy(workshop.place.path("had.toml"), workshop.place.path("skin.toml")).unwrap();
        workshop.commission("--quiet").end().succeeded();
        fs::rename(workshop.place.path("new.toml"), workshop.place.path("skin.toml")).unwrap();
    }
    assert!(halfway, "it was never killed in the middle");
    let ended = workshop.commission("--json").end().succeeded();
    let bus = &json(&ended)["buses"][0];
    let (written, already) = (bus["written"].as_u64().unwrap(), bus["already_so"].as_u64().unwrap());
    assert!(written > 0 && already > 0 && written + already == 120, "{bus:#}");
    workshop.all_have_it();
}

#[test]
fn cells_that_hang_delay_no_others_and_are_named() {
    let text = skin(9);
    let workshop = Workshop::new(&text);
    // The cells of the second process have the next node ids.
    let more = skin(12);
    workshop.place.write("skin.toml", &more);
    workshop.place.write("had.toml", &older(&more));
    let hung = workshop
        .place
        .start("cell-node", "--bus vcan0 --nodes 10-12 --skin had.toml --flash flash --bus-kind embedded");
    until("twelve cells", || {
        let listed = workshop.list("").unwrap();
        let ready =
            |cell: &&Value| cell["state"].as_array().is_some_and(|state| !state.contains(&"claiming".into()));
        (listed["cells"].as_array().unwrap().iter().filter(ready).count() == 12).then_some(())
    });
    let running = workshop.commission("--json");
    // Its first message is received, but not answered.
    hung.signal(Signal::STOP);
    let ended = running.end();
    assert_eq!(ended.code(), Some(1), "{ended:#?}");
    let bus = &json(&ended)["buses"][0];
    assert_eq!((bus["written"].as_u64(), bus["failed"].as_u64()), (Some(9), Some(3)), "{bus:#}");
    for cell in &bus["cells"].as_array().unwrap()[9..] {
        let why = cell["why"].as_str().unwrap();
        assert!(why.starts_with("does not answer ") || why.starts_with("is not on the bus"), "{why}");
    }
    assert!(
        ended.stderr.contains("skinbus: 3 of 12 cells are not commissioned: see the table,"),
        "{ended:#?}"
    );
    hung.signal(Signal::CONT);
    until("the others too", || (workshop.commission("--quiet").end().code() == Some(0)).then_some(()));
    workshop.all_have_it();
}

#[test]
fn node_ids_on_the_bus_are_written_into_a_copy_of_the_description() {
    // Node 6 is 1 in the description, and so on.
    let had = skin(6);
    let text = had.replace("version = 1\n", "version = 1   # as drawn\n");
    let serial = |node: u32| format!("node = {node}\nserial = {}", 100_000 + node);
    let turned = |node: u32| format!("node = {}\nserial = {}", 7 - node, 100_000 + node);
    let mut described = text.clone();
    for node in 1..=6 {
        described = described.replace(&serial(node), &format!("@{node}@"));
    }
    for node in 1..=6 {
        described = described.replace(&format!("@{node}@"), &turned(node));
    }
    let renamed = |line: &str| {
        let Some(list) = line.strip_prefix("neighbors = [").and_then(|rest| rest.strip_suffix(']')) else {
            return line.to_owned();
        };
        let turn = |number: &str| match number.parse::<u32>().unwrap() {
            0 => "0".to_owned(),
            number => (7 - number).to_string(),
        };
        format!("neighbors = [{}]", list.split(", ").map(turn).collect::<Vec<_>>().join(", "))
    };
    let described: String = described.lines().map(|line| renamed(line) + "\n").collect();
    let workshop = Workshop::with(&described, &older(&had), "");
    let ended = workshop.commission("--node-ids as-is.toml").end().succeeded();
    assert!(
        ended
            .stderr
            .contains("the cell with serial number 100001 has node id 1 on vcan0, but 6 in skin.toml"),
        "{ended:#?}"
    );
    assert_eq!(workshop.place.read("as-is.toml"), text, "node ids and neighbors, and nothing else");
    assert_eq!(workshop.commission("--json").end().succeeded().stdout.matches("\"already so\"").count(), 6);
    let listed = workshop.list("--skin as-is.toml").unwrap();
    assert!(listed["cells"].as_array().unwrap().iter().all(|cell| cell["skin"] == "yes"), "{listed:#}");
    // A bench of the copy runs with the existing cells.
    let run = "run as-is.toml --no-spawn --bus-kind embedded --duration 0.5 --quiet";
    workshop.place.start("skinbus", run).end().succeeded();
}

#[test]
fn new_cells_get_node_ids_from_the_network_and_then_their_parameters() {
    let place = TestDir::new();
    let text = generate(&SkinRequest { cells: 8, reply: ReplyMode::Sum, ..SkinRequest::default() }).unwrap();
    place.write("skin.toml", &text);
    fs::create_dir(place.path("flash")).unwrap();
    let bus = place.start("vcan-setup", "serve vcan0");
    bus.wait_for_stdout("serving ");
    let cell = |node: u8| {
        let fresh = format!("--node {node} --skin skin.toml --fresh --flash flash");
        place.start("cell-node", &format!("--bus vcan0 --bus-kind embedded {fresh}"))
    };
    let _cells: Vec<_> = (1..=8).rev().map(cell).collect();
    let commission = |more: &str| {
        place.start("skinbus", &format!("commission skin.toml --bus-kind embedded {more}")).end()
    };
    // A slow machine may not have started all of them before the first one ends.
    until("all of them", || (commission("--quiet --node-ids as-is.toml").code() == Some(0)).then_some(()));
    let skin = Skin::read(&place.path("skin.toml")).unwrap();
    let copy = Skin::read(&place.path("as-is.toml")).unwrap();
    let mut node_ids: Vec<_> = copy.cells.iter().map(|cell| cell.node.get()).collect();
    node_ids.sort_unstable();
    assert_eq!(node_ids, (1..=8).collect::<Vec<_>>(), "dense and unique");
    for (described, there) in skin.cells.iter().zip(&copy.cells) {
        let file = fs::read(place.path(&format!("flash/vcan0-s{}.flash", described.serial))).unwrap();
        let kept = flash::decode(Identity { cell: None, serial: described.serial }, &file).unwrap();
        assert_eq!((kept.number, kept.parameters), (Some(there.node), Some(skin.parameters(described))));
        // The wiring is the same, with other node ids.
        let renamed =
            |node: CellId| skin.cells.iter().position(|cell| cell.node == node).map(|at| copy.cells[at].node);
        assert_eq!(described.neighbors.map(|it| it.and_then(renamed)), there.neighbors);
    }
    let again = commission("--json").succeeded();
    assert_eq!(json(&again).pointer("/buses/0/already_so"), Some(&8.into()), "{again:#?}");
}

#[test]
fn several_buses_are_commissioned_at_the_same_time_or_one_alone() {
    let place = TestDir::new();
    let text = skin_of(10, 2, Format::Fd);
    place.write("skin.toml", &text);
    place.write("had.toml", &older(&text));
    let buses = ["vcan0", "vcan1"].map(|bus| {
        let served = place.start("vcan-setup", &format!("serve {bus}"));
        served.wait_for_stdout("serving ");
        let cells = format!("--bus {bus} --nodes 1-5 --skin had.toml --bus-kind embedded");
        (served, place.start("cell-node", &cells))
    });
    let commission = |more: &str| {
        place
            .start("skinbus", &format!("commission skin.toml --bus-kind embedded --json --quiet {more}"))
            .end()
    };
    until("the second bus", || (commission("--bus vcan1").code() == Some(0)).then_some(()));
    let both = until("both", || Some(commission("")).filter(|ended| ended.code() == Some(0)));
    let both = json(&both);
    let parts = |bus: &Value| (bus["name"].clone(), bus["written"].clone(), bus["already_so"].clone());
    let expected = [("vcan0".into(), 5.into(), 0.into()), ("vcan1".into(), 0.into(), 5.into())];
    assert_eq!(both["buses"].as_array().unwrap().iter().map(parts).collect::<Vec<_>>(), expected);
    drop(buses);
}

#[test]
fn a_list_is_redrawn_while_it_is_watched() {
    let workshop = Workshop::new(&skin(3));
    let watched = workshop
        .place
        .start("skinbus", "cells vcan0 --bus-kind embedded --watch --json --duration 2.2")
        .end()
        .succeeded();
    let lines: Vec<Value> = watched.stdout.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let last = lines.last().unwrap()["cells"].as_array().unwrap();
    assert!(lines.len() >= 2 && last.len() == 3, "{watched:#?}");
    assert!(last.iter().all(|cell| cell["heard"].is_object() && cell["tree"].is_null()), "{last:#?}");
}

#[test]
fn unknown_nodes_are_named_and_left_alone_and_missing_cells_are_named() {
    let text = skin(6);
    let workshop = Workshop::new(&text);
    let without: String = {
        // The fourth cell has a serial number that the skin does not list.
        text.replace("serial = 100004", "serial = 7")
    };
    workshop.place.write("skin.toml", &without);
    let ended = workshop.commission("").end();
    assert_eq!(ended.code(), Some(1), "{ended:#?}");
    let unknown_node =
        "cells on vcan0 that are not in skin.toml were left unchanged: 4 (serial number 100004)";
    assert!(ended.stderr.contains(unknown_node), "{ended:#?}");
    assert!(ended.stdout.contains("is not on the bus: switch it on"), "{ended:#?}");
    let listed = workshop.list("--skin skin.toml").unwrap();
    let says: Vec<_> =
        listed["cells"].as_array().unwrap().iter().map(|cell| cell["skin"].as_str().unwrap()).collect();
    assert_eq!(says, ["yes", "yes", "yes", "unknown", "yes", "yes"]);
    assert_eq!(listed["missing"], serde_json::json!([4]));
    // The unknown cell keeps its parameters.
    workshop.place.write("skin.toml", &text);
    assert_eq!(workshop.none_is_mixed(), 5);
    workshop.commission("--node-ids out.toml").end().succeeded();
    assert_eq!((workshop.none_is_mixed(), workshop.place.read("out.toml")), (6, text));
}

#[test]
fn beside_a_gateway_nothing_is_sent() {
    let place = TestDir::new();
    place.pressed();
    let bench = place.running_bench(600.0, "");
    let text = place.read("skin.toml");
    place.write("other.toml", &older(&text));
    let said = place.start("skinbus", "commission other.toml --bus-kind embedded --quiet").end();
    assert_eq!(said.refusal(1), "skinbus: another gateway is on vcan0: stop it first");
    // Listing does not disturb other clients.
    let listed = until("all in the list", || {
        let listed =
            place.start("skinbus", "cells vcan0 --bus-kind embedded --skin skin.toml").end().succeeded();
        let all = "8 cells on vcan0 (embedded), 8 in contact, and a gateway\n";
        listed.stdout.ends_with(all).then_some(listed)
    });
    assert_eq!(listed.stdout.lines().count(), 1 + 8 + 1, "{}", listed.stdout);
    bench.signal(Signal::INT);
    bench.end().succeeded();
    place.summary().adds_up();
}

#[test]
fn an_interrupted_commissioning_says_how_far_it_came() {
    let workshop = Workshop::new(&skin(8));
    let running = workshop.commission("");
    running.wait_for_stderr("listening: ");
    running.signal(Signal::INT);
    let ended = running.end();
    assert_eq!(ended.code(), Some(1), "{ended:#?}");
    assert!(ended.stderr.ends_with("skinbus: interrupted before anything was written\n"), "{ended:#?}");
    workshop.none_is_mixed();
}

#[test]
fn what_cannot_be_done_is_one_line() {
    let place = TestDir::new();
    place.write("skin.toml", &skin(4));
    let said = |words: &str, code: i32| {
        place.start("skinbus", &format!("{words} --bus-kind embedded")).end().refusal(code).to_owned()
    };
    for command in ["commission skin.toml", "cells vcan0"] {
        let line = said(command, 2);
        assert!(line.starts_with("skinbus: no embedded bus vcan0 is served in "), "{line}");
    }
    let line = said("commission skin.toml --bus vcan7", 2);
    assert_eq!(line, "skinbus: the skin file skin.toml has no bus vcan7; its buses are vcan0");
    let line = said("cells vcan7 --skin skin.toml", 2);
    assert_eq!(line, "skinbus: the skin file skin.toml has no bus vcan7; its buses are vcan0");
    assert_eq!(
        said("commission nowhere.toml", 2),
        "skinbus: nowhere.toml: No such file or directory (os error 2)"
    );

    let bus = place.start("vcan-setup", "serve vcan0");
    bus.wait_for_stdout("serving ");
    let line = said("commission skin.toml --quiet", 1);
    assert_eq!(
        line,
        "skinbus: no cells were found on vcan0: start them or switch them on, then run the command again"
    );
    let line = said("cells vcan0 --duration 0.4", 1);
    assert!(line.starts_with("skinbus: no cell sent anything on vcan0 for 0.4 s: "), "{line}");

    place.write("other.toml", &skin(4).replace("serial = 1000", "serial = 2000"));
    let _cells = place.start("cell-node", "--bus vcan0 --nodes 1-4 --skin other.toml --bus-kind embedded");
    let expected = "skinbus: none of the cells on vcan0 is in skin.toml: their serial numbers are 200001, \
                    200002, 200003, 200004; name the skin file with these numbers";
    until("cells of another skin", || {
        let ended = place.start("skinbus", "commission skin.toml --bus-kind embedded --quiet").end();
        (ended.refusal(1) == expected).then_some(())
    });
}
