//! Checks that `docs/reference/summary.md` names exactly the keys of a summary, and that its sums are right.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use std::collections::{BTreeMap, BTreeSet};

use crate::summary::{
    BusSummary, CellError, CellSummary, ErrorCells, HaltSummary, HostSummary, LoopSummary, NetworkSummary,
    Outcome, PrivateMemory, ProcessorUse, RecordingAccount, RepliesSummary, Summary, SumsSummary,
    TickSummary, TimedReport, Verdict, WrittenFile,
};
use model::table::{BusTable, CellStatus, FrameEvent, TorqueAccuracy};
use protocol::can::Format;
use protocol::fixed::{Q3_12, Q5_10};
use protocol::id::{CellId, Kind, Node};
use protocol::message::{
    Answer, Heartbeat, Joints, Message, NetworkPage, Request, SensorPage, SkinSensors, State, StimulusStart,
};
use protocol::packet::{Epoch, WORDS};
use protocol::parameters::Parameter;
use protocol::quantiles::{Quantiles, histogram};
use protocol::skin::Skin;
use protocol::time::Micros;
use serde_json::Value;

const SUMMARY_MD: &str = include_str!("../../../../docs/reference/summary.md");
const SKIN_MD: &str = include_str!("../../../../docs/reference/skin.md");

/// The two cells of `docs/reference/skin.md`.
fn skin() -> Skin {
    let text = SKIN_MD.split("```toml\n").find(|block| block.starts_with("# skin.toml:")).unwrap();
    let text = text.split("```").next().unwrap();
    Skin::parse("docs/reference/skin.md", text).unwrap()
}

/// A run whose optional figures are all present.
fn summary(bus: BusSummary, cells: Vec<CellSummary>) -> Summary {
    let quantiles = Quantiles::from_histogram(&histogram(), 1.0);
    Summary {
        skin: "two-cells".to_owned(),
        verdict: Verdict {
            well: false,
            look_at: vec!["the run failed: these buses did not work when the run ended: vcan0".to_owned()],
        },
        cells,
        outcome: Outcome::Failed,
        failure: Some("these buses did not work when the run ended: vcan0".to_owned()),
        duration_s: 1.0,
        interrupted: false,
        halted: Some("a halt frame was received".to_owned()),
        halts: vec![HaltSummary {
            at_s: 0.5,
            tick: 250,
            epoch: 31,
            reason: "a halt frame was received".to_owned(),
            until_s: None,
        }],
        further_halts: 0,
        before_halt: vec![TickSummary {
            tick: 250,
            time_s: 0.5,
            late_us: 1.0,
            took_us: 1.0,
            skipped: 0,
            epoch: 31,
            q_rad: vec![0.0; 6],
            qdot_rad_s: vec![0.0; 6],
            torque_nm: vec![0.0; 6],
            valid: true,
            contributing: 0,
            age: 0,
            stale: 0,
            dead: 0,
            lost_buses: vec!["vcan1".to_owned()],
            bad_cycle: Some("the torque is not valid".to_owned()),
            command_rad_s: vec![0.0; 6],
            halted: true,
        }],
        no_controller: Some("no external controller sent a hello".to_owned()),
        cell_errors: vec![CellError {
            reason: "cannot send to vcan0".to_owned(),
            cells: vec![ErrorCells { bus: "vcan0".to_owned(), nodes: vec![1] }],
        }],
        first_broadcast_s: 1.0,
        control: LoopSummary {
            ticks: 500,
            ticks_skipped: 0,
            broadcasts: 63,
            broadcasts_skipped: 0,
            bad_cycles: BTreeMap::new(),
            controller: BTreeMap::new(),
            late_us: quantiles,
            idle_late_us: quantiles,
            took_us: quantiles,
            central_us: quantiles,
            took_distributed_us: quantiles,
            fifo: true,
            memory_locked: true,
            records_lost: 0,
            unsent: 0,
        },
        accuracy: TorqueAccuracy::default(),
        backlog_dropped: Some(0),
        buses: vec![bus],
        processor: ProcessorUse::default(),
        memory: PrivateMemory {
            cell_private_kib: Some(768),
            gateway_private_kib: Some(9_000),
            buses_private_kib: Some(500),
        },
        recording: Some(RecordingAccount {
            files: vec![WrittenFile {
                path: "run.log".to_owned(),
                format: "candump",
                frames: 0,
                messages: 0,
                bytes: 0,
            }],
            ..RecordingAccount::default()
        }),
    }
}

/// Collects each key of a value with its type. Quantiles, errors and maps count as one key.
fn keys(path: &str, value: &Value, maps: &BTreeSet<String>, into: &mut BTreeMap<String, &'static str>) {
    let kind = match value {
        _ if maps.contains(path) => "map",
        Value::Null | Value::Number(_) => "number",
        Value::String(_) => "text",
        Value::Bool(_) => "flag",
        Value::Array(all) if all.iter().any(Value::is_object) => {
            return all.iter().for_each(|value| keys(&format!("{path}[]"), value, maps, into));
        }
        Value::Array(all) if all.iter().any(Value::is_string) || path == "recording.errors" => "texts",
        Value::Array(_) => "numbers",
        Value::Object(object) if object.contains_key("p50") => "quantiles",
        Value::Object(object) if object.contains_key("mean_nm") => "errors",
        Value::Object(object) => {
            for (key, value) in object {
                let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
                keys(&path, value, maps, into);
            }
            return;
        }
    };
    into.insert(path.to_owned(), kind);
}

/// Keys of the lists whose items begin with one, with the type and the heading above: "- `a`, `b` flag: ..." names two
/// flags. A key without a type is a number.
fn rows() -> impl Iterator<Item = (&'static str, &'static str, &'static str)> {
    let mut heading = "";
    let items = SUMMARY_MD.lines().filter_map(move |line| {
        if let Some(text) = line.strip_prefix("## ") {
            heading = text;
        }
        let (item, _) = line.strip_prefix("- ").filter(|item| item.starts_with('`'))?.split_once(": ")?;
        let kind = item.rsplit('`').next()?.trim().trim_end_matches("or null").trim_end();
        Some((heading, item, if kind.is_empty() { "number" } else { kind }))
    });
    items.flat_map(|(heading, item, kind)| {
        item.split('`').skip(1).step_by(2).map(move |key| (heading, key, kind))
    })
}

fn documented(target: impl Fn(&str) -> bool) -> BTreeMap<String, &'static str> {
    let events: BTreeSet<_> = FrameEvent::ALL.into_iter().map(FrameEvent::name).collect();
    let rows = rows().filter(|(heading, key, _)| target(heading) && !events.contains(key));
    rows.map(|(_, key, kind)| (key.to_owned(), kind)).collect()
}

fn maps() -> BTreeSet<String> {
    rows().filter(|(_, _, kind)| *kind == "map").map(|(_, key, _)| key.to_owned()).collect()
}

/// Returns the summaries of all cells of a skin.
fn of_each(skin: &Skin, table: &BusTable) -> Vec<CellSummary> {
    let both = skin.cells.iter().zip(table.cells());
    both.map(|(described, cell)| CellSummary::new(skin, described, Some(cell))).collect()
}

fn serialised(summary: &Summary) -> Value {
    serde_json::from_str(&serde_json::to_string(summary).unwrap()).unwrap()
}

#[test]
fn every_key_is_documented_with_its_type_and_no_other() {
    let (skin, table) = (skin(), BusTable::new(&skin(), 0));
    let mut cells = of_each(&skin, &table);
    cells.iter_mut().for_each(|cell| cell.mode = Some("test"));
    let bus = BusSummary::new("vcan0", "embedded", 0, &table, 0, Micros(0));
    let bus = BusSummary {
        hosts: vec![HostSummary { name: "cells".to_owned(), ..HostSummary::default() }],
        last_reply_bound_us: Some(14_360.0),
        sums: Some(SumsSummary::default()),
        timed: Some(TimedReport {
            load: Some(0.5),
            record_failure: Some("cannot write record.txt".to_owned()),
            ..TimedReport::default()
        }),
        network: Some(NetworkSummary {
            differences: vec!["cell 2 does not speak".to_owned()],
            unreachable: vec![2],
            ..NetworkSummary::default()
        }),
        ..bus
    };
    let mut found = BTreeMap::new();
    keys("", &serialised(&summary(bus, cells)), &maps(), &mut found);
    assert_eq!(documented(|heading| !["Quantiles", "Errors"].contains(&heading)), found);
}

#[test]
fn the_keys_of_quantiles_and_errors_are_documented() {
    let of = |value: Value| {
        let mut found = BTreeMap::new();
        let keys = value.as_object().unwrap().keys();
        found.extend(keys.map(|key| (key.clone(), "number")));
        found
    };
    let quantiles = serde_json::to_value(Quantiles::default()).unwrap();
    assert_eq!(documented(|heading| heading == "Quantiles"), of(quantiles));
    let errors = serde_json::to_value(TorqueAccuracy::default().single).unwrap();
    assert_eq!(documented(|heading| heading == "Errors"), of(errors));
}

#[test]
fn the_names_in_maps_are_documented() {
    let statuses =
        [CellStatus::Unknown, CellStatus::Quiet, CellStatus::Active, CellStatus::Stale, CellStatus::Dead];
    let names = FrameEvent::ALL.into_iter().map(FrameEvent::name);
    let names = names.chain(Kind::ALL.into_iter().map(Kind::name)).chain(statuses.map(CellStatus::name));
    for name in names {
        assert!(SUMMARY_MD.contains(&format!("`{name}`")), "{name}");
    }
}

#[test]
fn every_outcome_is_documented_with_its_exit_code() {
    let rows: BTreeMap<_, _> = SUMMARY_MD
        .lines()
        .filter_map(|line| {
            let mut columns = line.strip_prefix("| ")?.split(" | ");
            let (code, name) = (columns.next()?.parse::<u8>().ok()?, columns.next()?);
            Some((name.strip_prefix('`')?.strip_suffix('`')?.to_owned(), code))
        })
        .collect();
    let outcomes = Outcome::ALL.map(|outcome| {
        let name = serde_json::to_value(outcome).unwrap().as_str().unwrap().to_owned();
        (name, outcome.exit_code())
    });
    assert_eq!(rows, BTreeMap::from(outcomes));
}

/// A bus with two pressed cells: one answers in time; the other's replies are lost, refused, late and repeated.
fn troubled_bus() -> (BusSummary, Vec<CellSummary>, u64) {
    let skin = skin();
    let mut table = BusTable::new(&skin, 0);
    let mut broadcasts = 0;
    let mut at = 0;
    let mut say = |table: &mut BusTable, own: bool, message: &Message, spoil: bool| {
        at += 100;
        for frame in message.encode().frames(Format::Fd) {
            let mut bytes = frame.data().to_vec();
            bytes[0] ^= u8::from(spoil);
            let frame =
                protocol::can::Frame::with_data(frame.id(), Format::Fd, frame.flags(), &bytes).unwrap();
            table.handle_frame(Micros(at), own, &frame, &mut |_| None);
        }
    };
    let cells = [1, 2].map(|node| CellId::new(node).unwrap());
    let heartbeat = |table: &BusTable, place: usize, sent| {
        let state = State::CONFIGURED.with_flags(State::TEST_MODE, true);
        let configuration = table.cells()[place].configuration;
        let page = Heartbeat { serial: 1, configuration, sent, rejected: 0, state };
        let from = Node::Cell(cells[place]);
        Message::Network { from, epoch: Epoch(0), page: NetworkPage::Heartbeat(page) }
    };
    let joints = Joints { in_use: 6, ..Joints::default() };
    let torque = |place: usize, epoch| Message::Torque {
        from: cells[place],
        epoch: Epoch(epoch),
        torque: [Q3_12::nearest(0.5); WORDS].map(Q3_12::to_bits).into(),
    };
    let skin_page = SkinSensors { contact: [Q5_10::nearest(1.0); 3], ..SkinSensors::default() };
    table.set_torque_comparison(true);
    for place in 0..2 {
        let word = heartbeat(&table, place, 0);
        say(&mut table, false, &word, false);
    }
    // Nothing touches the cells, whatever touched them before.
    let (number, words) = (Parameter::Mode.number(), [1, 0, 0, 0, 0, 0]);
    let request = Request::Write { number, words };
    say(&mut table, true, &Message::Configure { to: Node::Everyone, tag: 0, request }, false);
    for from in cells {
        let answer = Answer::Value { number, written: true, words };
        say(&mut table, false, &Message::Configured { from, tag: 0, answer }, false);
    }
    let press = Message::Stimulus {
        to: Node::Everyone,
        from: StimulusStart::Next,
        page: SensorPage::Skin(skin_page),
    };
    say(&mut table, true, &press, false);
    for epoch in 0..8 {
        say(&mut table, true, &Message::Joints { epoch: Epoch(epoch), joints }, false);
        broadcasts += 1;
        say(&mut table, false, &torque(0, epoch), false);
        match epoch {
            0 | 4 => say(&mut table, false, &torque(1, epoch), false),
            1 => say(&mut table, false, &torque(1, epoch), true),
            3 => say(&mut table, false, &torque(1, 2), false),
            5 => (0..2).for_each(|_| say(&mut table, false, &torque(1, 5), false)),
            _ => {}
        }
    }
    for (place, sent) in [(0, 10), (1, 10)] {
        let word = heartbeat(&table, place, sent);
        say(&mut table, false, &word, false);
    }
    table.finish();
    let bus = BusSummary::new("vcan0", "embedded", 0, &table, 1, Micros(1_000));
    (bus, of_each(&skin, &table), broadcasts)
}

/// Number of joints that move a cell of the skin.
fn joints_of(place: usize) -> u64 {
    skin().cells[place].joint.into()
}

#[test]
fn what_the_document_says_adds_up_does() {
    let (bus, cells, broadcasts) = troubled_bus();
    let up = bus.uplink;
    assert_eq!(
        up.sent + up.surplus,
        up.delivered + up.rejected + up.unheard + up.dropped + up.queues + up.unknown,
        "{up:?}"
    );
    let replies = bus.replies;
    let RepliesSummary { due, in_time, late, too_late, skipped, not_heard, lost, in_doubt, unknown, .. } =
        replies;
    let RepliesSummary { unasked, contact_unknown, unexpected, .. } = replies;
    assert!(contact_unknown + unexpected <= unasked, "{replies:?}");
    assert_eq!(cells.iter().map(|cell| cell.contact_unknown).sum::<u64>(), contact_unknown, "{cells:?}");
    let missing = too_late + skipped + not_heard + lost + in_doubt + unknown;
    assert_eq!(due, in_time + late + missing, "{replies:?}");
    assert!(bus.epochs_complete <= bus.epochs_due && bus.epochs_due <= broadcasts);
    let event = |name| bus.events.get(name).copied().unwrap_or(0);
    let used = in_time + late + unasked;
    let refused = event("wrong CRC");
    let counted = used + event("stale torque") + event("repeated torque") + refused;
    assert_eq!(bus.received["torque"], counted, "{bus:?}");
    let seen = (due, in_time, late, up.rejected, event("repeated torque"));
    assert_eq!(seen, (16, 11, 1, 1, 1), "the bus was troubled: {bus:?}");

    let of = |figure: fn(&CellSummary) -> u64| cells.iter().map(figure).sum::<u64>();
    assert_eq!((of(|cell| cell.due), of(|cell| cell.in_time), of(|cell| cell.late)), (due, in_time, late));
    assert_eq!(of(|cell| cell.missing.values().sum()), missing, "{cells:?}");
    for (why, count) in replies.missing_replies_by_reason() {
        assert_eq!(
            cells.iter().filter_map(|cell| cell.missing.get(why)).sum::<u64>(),
            count,
            "{why}: {cells:?}"
        );
        assert!(documented(|_| true).contains_key(&format!("buses[].replies.{why}")), "{why}");
    }
    let [first, second] = cells.as_slice() else { panic!("{cells:?}") };
    assert_eq!((first.node, first.due, first.in_time, first.missing.len()), (1, 8, 8, 0));
    assert_eq!((second.node, second.in_time, second.late), (2, 3, 1));
    // The same torque is wrong for both cells, whose joints are compared.
    assert_eq!((first.error.count(), second.error.count()), (8 * joints_of(0), 4 * joints_of(1)));
    assert!(cells.iter().all(|cell| cell.error.max() > 0.1 && cell.mode == Some("test")), "{cells:?}");
}

#[test]
fn a_cell_that_measures_is_said_to_and_one_that_was_never_heard_is_in_no_mode() {
    let skin = skin();
    let mut table = BusTable::new(&skin, 0);
    let page = NetworkPage::Heartbeat(Heartbeat { state: State::CONFIGURED, ..Heartbeat::default() });
    let beat = Message::Network { from: Node::Cell(skin.cells[0].node), epoch: Epoch(0), page };
    for frame in beat.encode().frames(Format::Fd) {
        table.handle_frame(Micros(0), false, &frame, &mut |_| None);
    }
    let modes: Vec<_> = of_each(&skin, &table).iter().map(|cell| (cell.mode, cell.is_measuring())).collect();
    assert_eq!(modes, [(Some("measure"), true), (None, false)]);
}
