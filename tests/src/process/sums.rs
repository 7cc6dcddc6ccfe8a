//! Benches of cells in a grid that answer with sums along a tree, on a bus of either format, with links that go down
//! and come up again.

use std::collections::{BTreeMap, BTreeSet};

use model::generate::{ReplyMode, SkinRequest, generate};
use protocol::can::Format;
use protocol::id::Node;
use protocol::message::{Message, NetworkPage};
use rustix::process::Signal;

use super::buses::mixed_skin;
use super::test_client::TestClient;
use super::{Ended, PRESSED, Running, TIMEOUT, TestDir, is_stopped, until};

/// The number of cells, in rows of four; the cells at two opposite corners are roots.
pub const CELLS: u8 = 12;
pub const ROOTS: [u8; 2] = [1, 12];

/// Returns the neighbours at the ports of a cell of the grid: left, right, up, down.
pub fn neighbors(cell: u8) -> [u8; 4] {
    let (row, column) = ((cell - 1) / 4, (cell - 1) % 4);
    [
        if column > 0 { cell - 1 } else { 0 },
        if column < 3 { cell + 1 } else { 0 },
        if row > 0 { cell - 4 } else { 0 },
        if row < 2 { cell + 4 } else { 0 },
    ]
}

/// Writes `skin.toml`: a grid, with a joint rate so low that a busy machine keeps up.
pub fn grid(place: &TestDir, format: Format) {
    wired(place, format, neighbors);
}

pub fn wired(place: &TestDir, format: Format, neighbors: impl Fn(u8) -> [u8; 4]) {
    let expected = SkinRequest { cells: CELLS.into(), reply: ReplyMode::Sum, ..SkinRequest::default() };
    let classic: &[_] = if format == Format::Classic { &["vcan0"] } else { &[] };
    let text = mixed_skin(&generate(&expected).unwrap(), classic);
    let mut node = 0;
    let mut lines = Vec::new();
    for line in text.lines() {
        let value = line.split_once(" = ").map(|(_, value)| value);
        match line.split(' ').next() {
            Some("node") => node = value.unwrap().parse().unwrap(),
            Some("root") => continue,
            Some("joint_broadcast_hz") => {
                lines.push("joint_broadcast_hz = 20.0".to_owned());
                continue;
            }
            Some("slot_us") => {
                lines.push("slot_us = 6000".to_owned());
                continue;
            }
            Some("neighbors") => {
                lines.push(format!("neighbors = {:?}", neighbors(node)));
                lines.push(format!("root = {}", ROOTS.contains(&node)));
                continue;
            }
            _ => {}
        }
        lines.push(line.to_owned());
    }
    place.write("skin.toml", &(lines.join("\n") + "\n"));
}

/// Starts a bench that records nothing.
pub fn unrecorded(place: &TestDir, seconds: f64, more: &str) -> Running {
    let words = format!(
        "run skin.toml --bus-kind {} --scenario scenario.toml --duration {seconds} --summary run.json \
         --overwrite {more}",
        place.kind()
    );
    place.start("skinbus", &words)
}

/// Waits until the sums of the roots contain this number of cells in three consecutive epochs.
pub fn holds(test_client: &TestClient, expected: u32) {
    let (mut epoch, mut counts, mut row) = (None, BTreeMap::<u8, u8>::new(), 0);
    // A root that found another route is in another root's sum.
    let mut below = BTreeSet::new();
    test_client.send(&Message::Report);
    let mut seen = Vec::new();
    let whole = test_client.receive_until(|message| match message {
        Message::Joints { epoch: of, .. } => {
            let roots = counts.iter().filter(|(root, _)| !below.contains(*root));
            let count: u32 = roots.map(|(_, &count)| u32::from(count)).sum();
            seen.push(count);
            row = if epoch.is_some() && count == expected { row + 1 } else { 0 };
            (epoch, counts) = (Some(*of), BTreeMap::new());
            row == 3
        }
        Message::Sum { from, epoch: of, count, .. } if ROOTS.contains(&from.get()) && epoch == Some(*of) => {
            let most = counts.entry(from.get()).or_default();
            *most = (*count).max(*most);
            false
        }
        Message::Network { from: Node::Cell(cell), page: NetworkPage::Tree(tree), .. } => {
            if tree.parent == Some(0) {
                below.remove(&cell.get())
            } else {
                below.insert(cell.get())
            };
            false
        }
        _ => false,
    });
    assert!(whole, "waited {TIMEOUT:?} for sums of {expected} cells; they were of {seen:?}");
}

/// Waits until each of these cells has a route to a root over these cells only, by the reports of the cells.
fn wait_for_routes(test_client: &TestClient, cells: &BTreeSet<u8>) {
    let mut parents = BTreeMap::new();
    let leads = |parents: &BTreeMap<u8, Option<u8>>, cell: u8| {
        let up = |cell: &u8| parents.get(cell).copied().flatten();
        let mut route = std::iter::successors(Some(cell), up).take(usize::from(CELLS) + 1);
        route.find(|cell| !cells.contains(cell)) == Some(0)
    };
    test_client.send(&Message::Report);
    let all = test_client.receive_until(|message| {
        if let Message::Network { from: Node::Cell(cell), page: NetworkPage::Tree(tree), .. } = message {
            parents.insert(cell.get(), tree.parent);
        }
        cells.iter().all(|&cell| leads(&parents, cell))
    });
    assert!(all, "waited {TIMEOUT:?} for routes of {cells:?}: {parents:?}");
}

/// Ends a bench, and checks that its counts add up.
pub fn end(place: &TestDir, bench: Running) -> Ended {
    bench.signal(Signal::TERM);
    let ended = bench.end().succeeded();
    place.is_left_clean();
    place.summary().adds_up();
    ended
}

/// Checks that sums bypass a cell that is killed, and one that hangs, until they come back.
pub fn goes_round_a_cell(place: &TestDir, format: Format) {
    grid(place, format);
    place.scenario(PRESSED);
    let bench = unrecorded(place, 600.0, "");
    bench.wait_for_loop();
    let test_client = TestClient::on(place, "vcan0", format);
    holds(&test_client, 12);

    super::signal(bench.cell(6), Signal::KILL);
    holds(&test_client, 11);
    bench.wait_for_event(6, "fallen silent");

    let stopped = bench.cell(7);
    super::signal(stopped, Signal::STOP);
    until("a stopped cell", || is_stopped(stopped).then_some(()));
    holds(&test_client, 10);
    super::signal(stopped, Signal::CONT);
    holds(&test_client, 11);

    // The restarted cell gets its slot and its stimulus again.
    let words = format!("--bus vcan0 --bus-kind {} --node 6 --skin skin.toml", place.kind());
    let again = place.start("cell-node", &words);
    bench.wait_for_stderr("cell 6 on vcan0 restarted");
    holds(&test_client, 12);
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    drop(again);
    let summary = place.summary();
    summary.adds_up();
    assert!(summary.of_bus("/network/parent_changes") >= 12, "{:#}", summary.0);
    assert!(summary.of_bus("/sums/contributions/missing") > 0, "{:#}", summary.0);
}

/// Checks that without a touch hellos show a lost cell, and that the other cells find another route.
pub fn keeps_ways_without_a_touch(place: &TestDir, format: Format) {
    grid(place, format);
    place.scenario(PRESSED.split("[[touch]]").next().unwrap());
    let bench = unrecorded(place, 600.0, "");
    bench.wait_for_loop();
    let test_client = TestClient::on(place, "vcan0", format);
    let mut cells: BTreeSet<u8> = (1..=CELLS).collect();
    wait_for_routes(&test_client, &cells);
    super::signal(bench.cell(6), Signal::KILL);
    cells.remove(&6);
    wait_for_routes(&test_client, &cells);
    let stopped = bench.cell(7);
    super::signal(stopped, Signal::STOP);
    cells.remove(&7);
    wait_for_routes(&test_client, &cells);
    super::signal(stopped, Signal::CONT);
    cells.insert(7);
    wait_for_routes(&test_client, &cells);
    end(place, bench);
}

/// Faults that take links down while the loop runs: one of many in one direction, and all of the cell in a corner.
const LINKS_DOWN: &str = r#"
[[fault]]
at_s = 2.0
kind = "cut"
cells = [6, 5]
one_way = true

[[fault]]
at_s = 8.0
kind = "cut"
cells = [3, 4]
for_s = 12.0

[[fault]]
at_s = 8.0
kind = "cut"
cells = [8, 4]
for_s = 12.0
"#;

/// Checks that a bench with links down names an unreachable cell, and that the other cells find another route.
pub fn goes_on_without_a_wire(place: &TestDir, format: Format) {
    grid(place, format);
    place.scenario(&format!("{PRESSED}{LINKS_DOWN}"));
    let bench = unrecorded(place, 600.0, "");
    bench.wait_for_loop();
    let test_client = TestClient::on(place, "vcan0", format);
    bench.wait_for_stderr("scenario: link down from cell 6 to cell 5 on vcan0");
    holds(&test_client, 12);
    bench.wait_for_stderr("cell 4 on vcan0 has had no route to the gateway for");
    holds(&test_client, 11);
    bench.wait_for_stderr("scenario: link up between cell 8 and cell 4 on vcan0");
    bench.wait_for_stderr("cell 4 on vcan0 has a route to the gateway again, after");
    holds(&test_client, 12);
    end(place, bench);
    let summary = place.summary();
    assert!(summary.figure("/buses/0/network/longest_unreachable_s") > 1.0, "{:#}", summary.0);
    assert_eq!(summary.0["buses"][0]["network"]["unreachable"].as_array().unwrap().len(), 0);
}
