//! The tables of a log that is written by hand.

use std::fmt::Write as _;
use std::fs;
use std::io::Cursor;
use std::path::Path;

use protocol::can::Format;
use protocol::fixed::Q1_14;
use protocol::message::{Joints, Message};
use protocol::packet::{Epoch, Length, Words, pad_with_defaults};
use protocol::skin::Skin;
use serde_json::Value;
use trace::capture::Reader;
use trace::columns::ColumnFolder;

use super::*;

/// Two arms of two and three joints, each with a bus and a cell.
const SKIN_TOML: &str = r#"version = 1
name = "arms"

[robot]
name = "arms"
joint = [{ name = "a1" }, { name = "a2" }, { name = "b1" }, { name = "b2" }, { name = "b3" }]

[[robot.chain]]
name = "a"
rows = [{ joint = "a1", a = 0.4 }, { joint = "a2", a = 0.3 }]

[[robot.chain]]
name = "b"
rows = [{ joint = "b1", a = 0.4 }, { joint = "b2", a = 0.3 }, { joint = "b3", a = 0.2 }]

[timing]
control_hz = 500.0
joint_broadcast_hz = 62.5

[contact]
alpha_c = 1.0
alpha_p = 0.0
contact_threshold_n = 0.1
proximity_threshold = 0.05
force_threshold_n = 0.1

[[bus]]
name = "can0"
chain = "a"
reply = "torque"
format = "fd"

[[bus]]
name = "can1"
chain = "b"
reply = "torque"
format = "fd"

[controller]
kind = "kinesthetic"
inertia = [1.0, 1.0, 1.0, 1.0, 1.0]
damping = [4.0, 4.0, 4.0, 4.0, 4.0]
max_speed = [2.0, 2.0, 2.0, 2.0, 2.0]

[[cell]]
bus = "can0"
node = 1
joint = 2
position = [0.0, 0.03, 0.0]
normal = [0.0, 1.0, 0.0]

[[cell]]
bus = "can1"
node = 7
joint = 3
position = [0.0, 0.03, 0.0]
normal = [0.0, 1.0, 0.0]
"#;

/// A log, of which each message comes at a time in µs.
#[derive(Default)]
struct Log(String);

impl Log {
    fn add(&mut self, micros: u64, bus: &str, message: &Message) {
        for frame in message.encode().frames(Format::Fd) {
            let (id, flags) = (frame.id(), frame.flags() & 3);
            let data: String = frame.data().iter().map(|byte| format!("{byte:02X}")).collect();
            writeln!(
                self.0,
                "({}.{:06}) {bus} {id:03X}##{flags}{data}",
                1_000 + micros / 1_000_000,
                micros % 1_000_000
            )
            .unwrap();
        }
    }

    fn joints(&mut self, micros: u64, bus: &str, epoch: u8, in_use: u8) {
        let positions = pad_with_defaults(&[Q1_14::from_bits(i16::from(epoch)); 3]);
        self.add(micros, bus, &Message::Joints { epoch: Epoch(epoch), joints: Joints { positions, in_use } });
    }

    fn torque(&mut self, micros: u64, bus: &str, node: i64, epoch: u8, words: [i16; 3]) {
        let torque = Words::new(Length::Six, pad_with_defaults(&words));
        let from = CellId::new(node).unwrap();
        self.add(micros, bus, &Message::Torque { from, epoch: Epoch(epoch), torque });
    }
}

/// Writes the columns of a log.
fn written(log: &Log, place: &Path) -> Value {
    let skin = Skin::parse("arms.toml", SKIN_TOML).unwrap();
    let mut reader = Reader::from_read("arms.log", Cursor::new(log.0.clone().into_bytes())).unwrap();
    let folder = ColumnFolder::create(place, false).unwrap();
    let columns = write_columns(&mut reader, &skin, folder).unwrap();
    let origin = ColumnOrigin { program: "1", sources: &[], skin_file: None };
    columns.finish(&origin, &skin, &reader).unwrap();
    serde_json::from_str(&fs::read_to_string(place.join("columns.json")).unwrap()).unwrap()
}

fn column<const N: usize>(place: &Path, name: &str) -> Vec<[u8; N]> {
    let bytes = fs::read(place.join(format!("{name}.npy"))).unwrap();
    bytes[128..].chunks_exact(N).map(|chunk| chunk.try_into().unwrap()).collect()
}

fn integers(place: &Path, name: &str) -> Vec<i64> {
    column(place, name).into_iter().map(i64::from_le_bytes).collect()
}

fn words(place: &Path, name: &str) -> Vec<i16> {
    column(place, name).into_iter().map(i16::from_le_bytes).collect()
}

#[test]
fn chains_of_different_lengths_share_the_width_of_the_longest() {
    let place = tempfile::tempdir().unwrap();
    let place = place.path().join("arms.columns");
    let mut log = Log::default();
    for epoch in 0..40_u8 {
        let at = u64::from(epoch) * 16_000;
        log.joints(at, "can0", epoch, 2);
        log.joints(at + 10, "can1", epoch, 3);
        if (3..6).contains(&epoch) {
            log.torque(at + 500, "can1", 7, epoch, [1, 2, 3]);
            log.torque(at + 510, "can0", 1, epoch, [4, 5, 0]);
        }
        if epoch == 4 {
            // A second answer, a stranger, and an answer to joints that are long past.
            log.torque(at + 600, "can1", 7, 4, [9, 9, 9]);
            log.torque(at + 610, "can1", 9, 4, [8, 8, 8]);
            log.torque(at + 620, "can1", 7, 200, [7, 7, 7]);
        }
    }
    let about = written(&log, &place);
    assert_eq!(about["tables"]["epochs"]["rows"], 40);
    assert_eq!(about["buses"][1]["joints"], serde_json::json!([2, 3, 4]));
    assert_eq!(about["tables"]["joints"]["groups"][1]["begin"], 40);
    let groups: Vec<_> = about["tables"]["torques"]["groups"]
        .as_array()
        .unwrap()
        .iter()
        .map(|group| ["bus", "node", "begin", "end"].map(|key| group[key].as_u64().unwrap()))
        .collect();
    assert_eq!(groups, [[0, 1, 0, 3], [1, 7, 3, 8], [1, 9, 8, 9]]);
    assert_eq!(words(&place, "torques.words")[..3], [4, 5, 0]);
    assert_eq!(integers(&place, "torques.joints_row"), [3, 4, 5, 3, 4, -1, -1, 5, -1]);
    let joints = words(&place, "joints.words");
    assert_eq!(
        (joints.len(), &joints[3..6], &joints[40 * 3 + 3..40 * 3 + 6]),
        (240, &[1, 1, 0][..], &[1; 3][..])
    );
    let accounts = &about["accounts"];
    assert_eq!((&accounts["buses"][1]["torques"], &accounts["buses"][1]["used"]), (&6.into(), &3.into()));
    assert_eq!(accounts["cells"][1]["used"], 3);
    // The state of the contacts is unknown, so an answer counts as one.
    assert_eq!(about["tables"]["contacts"]["rows"], 2);
    let times = |name| integers(&place, name).into_iter().map(|at| (at - 1_000_000_000_000) / 1_000);
    assert_eq!(times("contacts.begin_ns").collect::<Vec<_>>(), [48_000, 48_010]);
    assert_eq!(times("contacts.end_ns").collect::<Vec<_>>(), [96_000, 96_010]);
    assert_eq!(column::<1>(&place, "contacts.ended"), [[1], [1]]);
}

#[test]
fn frames_without_joints_have_no_epochs_and_notes_keep_their_texts() {
    let place = tempfile::tempdir().unwrap();
    let place = place.path().join("arms.columns");
    let mut log = Log("# begun\n".to_owned());
    log.torque(0, "can0", 1, 3, [1, 2, 0]);
    log.0 += "DROPCOUNT: dropped 12 CAN frames on 'can0' socket (total drops 40)\n(1000.1) can0 zzz\n";
    let about = written(&log, &place);
    assert_eq!(about["tables"]["epochs"]["rows"], 0);
    assert_eq!(about["began_ns"], 1_000_000_000_000_u64);
    assert_eq!(integers(&place, "torques.joints_row"), [-1]);
    let kinds: Vec<_> = column::<1>(&place, "notes.kind").into_iter().flatten().collect();
    assert_eq!(kinds, [0, 1, 3]);
    assert_eq!(integers(&place, "notes.frames"), [0, 12, 0]);
    assert_eq!(words(&place, "notes.bus"), [-1, 0, -1]);
    assert_eq!(fs::read(place.join("notes.text.npy")).unwrap()[128..135], *b"# begun");
    let accounts = &about["accounts"];
    assert_eq!((&accounts["lost"], &accounts["unreadable_lines"]), (&12.into(), &1.into()));
    assert_eq!(accounts["buses"][0]["lost"], 12);
}

/// The numbers of the five joints in each epoch.
fn numbers(place: &Path, name: &str) -> Vec<[f64; 5]> {
    let numbers: Vec<_> = column(place, name).into_iter().map(f64::from_le_bytes).collect();
    numbers.chunks_exact(5).map(|row| row.try_into().unwrap()).collect()
}

#[test]
fn torques_on_joints_whose_bus_sent_none_are_unknown() {
    let place = tempfile::tempdir().unwrap();
    let place = place.path().join("arms.columns");
    let mut log = Log::default();
    for epoch in 0..8_u8 {
        let at = u64::from(epoch) * 16_000;
        if epoch != 5 {
            log.joints(at, "can0", epoch, 2);
        }
        log.joints(at + 10, "can1", epoch, 3);
        log.torque(at + 500, "can1", 7, epoch, [4_096, 0, 0]);
    }
    assert_eq!(written(&log, &place)["tables"]["epochs"]["rows"], 8);
    for (name, of_can1) in
        [("positions", None), ("distributed", Some(1.0)), ("central", Some(0.0)), ("error", Some(1.0))]
    {
        for (epoch, row) in numbers(&place, &format!("epochs.{name}")).into_iter().enumerate() {
            let unknown = row.map(f64::is_nan);
            assert_eq!(unknown, [epoch == 5, epoch == 5, false, false, false], "{name} of epoch {epoch}");
            assert!(
                of_can1.is_none_or(|expected: f64| row[2].to_bits() == expected.to_bits()),
                "{name}: {row:?}"
            );
        }
    }
}

#[test]
fn cells_are_counted_once_whatever_joints_they_move() {
    let place = tempfile::tempdir().unwrap();
    let place = place.path().join("arms.columns");
    let mut log = Log::default();
    for epoch in 0..3_u8 {
        let at = u64::from(epoch) * 16_000;
        log.joints(at, "can0", epoch, 2);
        log.joints(at + 10, "can1", epoch, 3);
    }
    log.torque(16_500, "can0", 1, 1, [4, i16::MAX, 0]);
    log.torque(16_510, "can1", 7, 1, [i16::MIN, 5, i16::MAX]);
    log.torque(32_500, "can1", 7, 2, [i16::MIN, 5, 6]);
    written(&log, &place);
    let counts = |name| column(&place, name).into_iter().map(u32::from_le_bytes).collect::<Vec<_>>();
    // The contact states are unknown.
    assert_eq!(counts("epochs.open_cells"), [0, 2, 1]);
    assert_eq!(counts("epochs.saturated_cells"), [0, 2, 1]);
}

#[test]
fn an_answer_of_zeros_ends_a_contact_of_unknown_force() {
    let place = tempfile::tempdir().unwrap();
    let place = place.path().join("arms.columns");
    let mut log = Log::default();
    for epoch in 0..9_u8 {
        let at = u64::from(epoch) * 16_000;
        log.joints(at, "can1", epoch, 3);
        match epoch {
            2 | 3 => log.torque(at + 500, "can1", 7, epoch, [0, -1, 0]),
            4 | 6 => log.torque(at + 500, "can1", 7, epoch, [0; 3]),
            _ => {}
        }
    }
    assert_eq!(written(&log, &place)["tables"]["contacts"]["rows"], 1);
    let times = ["begin_ns", "end_ns"].map(|name| integers(&place, &format!("contacts.{name}")));
    assert_eq!(times.map(|times| (times[0] - 1_000_000_000_000) / 16_000_000), [2, 4]);
    assert_eq!(column::<1>(&place, "contacts.ended"), [[1]]);
}

#[test]
fn numbers_of_epochs_go_on_by_the_time_after_a_gap() {
    let place = tempfile::tempdir().unwrap();
    let place = place.path().join("arms.columns");
    let mut log = Log::default();
    // 62.5 Hz with a clock that is a little off: gaps of 312 epochs, which are 5 s, of 40 and of 700.
    let mut expected: Vec<i64> = (0..3).chain(314..360).chain(400..404).chain(1_104..1_150).collect();
    for number in &expected {
        let (epoch, at) = (number.to_le_bytes()[0], number.cast_unsigned() * 16_100);
        log.joints(at, "can0", epoch, 2);
        log.joints(at + 10, "can1", epoch, 3);
        if *number == 1 {
            // The configuration of the cell is unknown, so the bus waits for it until the other is behind the gap.
            log.torque(at + 500, "can1", 7, epoch, [1; 3]);
        }
    }
    // The clock is set back.
    for number in 1_150..1_153_i64 {
        let (epoch, at) = (number.to_le_bytes()[0], number.cast_unsigned() * 160);
        log.joints(at, "can0", epoch, 2);
        log.joints(at + 10, "can1", epoch, 3);
        expected.push(number);
    }
    written(&log, &place);
    assert_eq!(integers(&place, "epochs.number"), expected);
}
