//! Recorded runs, and replays of them to other cells.

use std::path::Path;
use std::time::Duration;

use protocol::can::Format;
use protocol::candump::{self, CandumpLine};
use protocol::fixed::{Q3_12, Q5_10};
use protocol::id::{CellId, Node};
use protocol::message::{Message, Request, SensorPage, SkinSensors, StimulusStart};
use protocol::packet::{Packet, WORDS};
use protocol::parameters::Parameter;
use protocol::skin::Skin;
use serde_json::Value;

use super::test_client::TestClient;
use super::{Ended, Running, TestDir};

/// The options of a replay to new cells that are configured by the recording's skin.
pub const FRESH: &str = "--expect --spawn --skin skin.toml";

/// A scenario in which the arm swings, and touches come and go on several cells at once.
pub const TOUCHED: &str = r#"version = 1
duration_s = 4.0

[motion]
kind = "sine"
start_rad = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]
amplitude_rad = [0.5, 0.3, 0.4, 0.3, 0.2, 0.2]
period_s = 3.0

[[mode]]
at_s = 0.0
kind = "distributed"

[[touch]]
at_s = 0.0
for_s = 4.0
bus = "vcan0"
cells = [1]
force_n = 2.0
profile = "step"

[[touch]]
at_s = 0.2
for_s = 1.2
bus = "vcan0"
cells = [2, 3]
force_n = 4.0
profile = "half-sine"

[[touch]]
at_s = 0.9
for_s = 2.0
bus = "vcan0"
cells = [4, 5, 8]
force_n = 6.0
profile = "ramp"
"#;

pub fn cell(node: i64) -> CellId {
    CellId::new(node).unwrap()
}

/// Sends messages while a run is recorded: every command, stimuli of both pages in both ways, and parameters that are
/// read, written, refused and committed. It needs 48 broadcasts, a fifth of those in four seconds at 62.5 Hz.
pub fn send_every_message(test_client: &TestClient, skin: &Path) {
    let configure = |to, tag, request| Message::Configure { to, tag, request };
    let write = |parameter: Parameter, words| Request::Write { number: parameter.number(), words };
    test_client.waits_for_epoch(10);
    test_client.send(&Message::Report);
    test_client.send(&Message::Sync);
    let page = SensorPage::Acceleration([Q3_12::nearest(0.5), Q3_12::ZERO, Q3_12::nearest(-1.0)]);
    test_client.send(&Message::Stimulus { to: Node::Everyone, from: StimulusStart::Next, page });
    let skin_page = SkinSensors { contact: [Q5_10::nearest(0.7); 3], ..SkinSensors::default() };
    test_client.send(&Message::Stimulus {
        to: Node::Cell(cell(6)),
        from: StimulusStart::Next,
        page: SensorPage::Skin(skin_page),
    });
    test_client.waits_for_epoch(20);
    // Cell 4 is moved by a hand's breadth: its torques change in the middle of a contact.
    let skin = Skin::read(skin).unwrap();
    let described = skin.cells.iter().find(|it| it.node.get() == 4).unwrap();
    let mut parameters = skin.parameters(described);
    let to = Node::Cell(cell(4));
    test_client.send(&configure(to, 1, Request::Read { number: Parameter::Pose.number() }));
    test_client.send(&configure(to, 2, write(Parameter::Commit, [1, 0, 0, 0, 0, 0])));
    let [_, y, z] = parameters.pose.position;
    parameters.pose.position = [protocol::fixed::Q1_14::nearest(0.05), y, z];
    test_client.send(&configure(to, 3, write(Parameter::Pose, parameters.words(Parameter::Pose))));
    let hash = [parameters.hash().cast_signed(), 0, 0, 0, 0, 0];
    test_client.send(&configure(to, 4, write(Parameter::Commit, hash)));
    test_client.send(&configure(Node::Everyone, 5, Request::Read { number: 99 }));
    test_client.waits_for_epoch(30);
    test_client.send(&Message::Halt);
    test_client.waits_for_epoch(40);
    test_client.send(&Message::Resume);
    test_client.waits_for_epoch(48);
    // Writing the mode of a cell resets its contact state.
    test_client.send(&configure(Node::Cell(cell(5)), 6, write(Parameter::Mode, [1, 0, 0, 0, 0, 0])));
}

impl TestDir {
    /// Records `run.log` with `skin.toml`: a run of some cells with touches and every message.
    pub fn records(&self, cells: usize) {
        let skin = self.skin(cells);
        self.records_with(&skin);
    }

    /// Records `run.log` with a given skin.
    pub fn records_with(&self, skin: &Path) {
        self.scenario(TOUCHED);
        let bench = self.running_bench(4.0, "");
        send_every_message(&self.test_client(), skin);
        bench.end().succeeded();
        self.is_left_clean();
    }

    /// Starts a replay of a capture, with `replay.json`.
    pub fn replay(&self, file: &str, more: &str) -> Running {
        let kind = self.kind();
        self.start(
            "skinbus",
            &format!("replay {file} --bus-kind {kind} --summary replay.json --overwrite {more}"),
        )
    }

    /// Runs a replay like [`Self::replay`] to its end, and returns its summary.
    pub fn replayed(&self, file: &str, more: &str) -> (Ended, Replayed) {
        let ended = self.replay(file, more).end_after(Duration::from_secs(60));
        let text = std::fs::read_to_string(self.path("replay.json"));
        let text = text.unwrap_or_else(|error| panic!("{error}: {ended:#?}"));
        (ended, Replayed(serde_json::from_str(&text).unwrap()))
    }
}

/// The summary of a replay.
#[derive(Debug)]
pub struct Replayed(pub Value);

impl Replayed {
    pub fn number(&self, pointer: &str) -> u64 {
        self.0.pointer(pointer).and_then(Value::as_u64).unwrap_or_else(|| panic!("{pointer} in {:#}", self.0))
    }

    pub fn text(&self, pointer: &str) -> &str {
        self.0.pointer(pointer).and_then(Value::as_str).unwrap_or_else(|| panic!("{pointer} in {:#}", self.0))
    }

    /// Returns the numbers of equal, different, missing and extra replies.
    pub fn replies(&self) -> [u64; 4] {
        ["equal", "different", "missing", "extra"].map(|what| self.number(&format!("/expect/{what}")))
    }

    /// Checks that all recorded replies came again, and no others. Returns their number.
    pub fn all_came_back(&self, ended: &Ended) -> u64 {
        let [equal, rest @ ..] = self.replies();
        assert_eq!((rest, ended.code()), ([0, 0, 0], Some(0)), "{:#} {ended:#?}", self.0);
        equal
    }

    /// Checks the replies of a replay at the recording's own times. A busy machine misses some: missing replies must
    /// then be those to joints that came too late.
    pub fn all_came_back_in_time(&self, ended: &Ended) -> u64 {
        let late = self.number("/expect/joints_skipped");
        if late == 0 {
            return self.all_came_back(ended);
        }
        let [equal, different, missing, extra] = self.replies();
        // A contact whose end falls on skipped joints ends with the next ones.
        assert!(different == 0 && missing <= late && extra <= late, "{:#} {ended:#?}", self.0);
        equal + missing
    }
}

/// Changes the `nth` packet of a log that satisfies `expected`, and corrects its CRC.
pub fn changed(
    log: &str,
    nth: usize,
    expected: impl Fn(&Message) -> bool,
    change: impl Fn(&mut [i16; WORDS]),
) -> String {
    let mut left = nth;
    let line = |line: &str| {
        let Ok(CandumpLine::Frame(record)) = candump::parse(line) else { return line.to_owned() };
        let Ok(mut packet) = Packet::from_fd(&record.frame) else { return line.to_owned() };
        if !Message::decode(&packet).is_ok_and(|message| expected(&message)) {
            return line.to_owned();
        }
        left = left.wrapping_sub(1);
        if left != usize::MAX {
            return line.to_owned();
        }
        let mut words = packet.words.first_six();
        change(&mut words);
        packet.words = words.into();
        let frame = packet.frames(Format::Fd).next().unwrap();
        candump::Record { frame, ..record }.to_string()
    };
    let lines: Vec<_> = log.lines().map(line).collect();
    assert!(left > usize::MAX / 2, "there are {nth} of them");
    lines.join("\n") + "\n"
}

/// Returns a log without some of its packets.
pub fn without(log: &str, mut unwanted: impl FnMut(&Message) -> bool) -> String {
    let keeps = |line: &&str| {
        let Ok(CandumpLine::Frame(record)) = candump::parse(line) else { return true };
        let packet = Packet::from_fd(&record.frame).ok();
        !packet.and_then(|packet| Message::decode(&packet).ok()).is_some_and(|message| unwanted(&message))
    };
    log.lines().filter(keeps).map(|line| format!("{line}\n")).collect()
}

/// Returns true for a torque of a pressed cell.
pub fn is_torque(message: &Message, cell: u8) -> bool {
    matches!(message, Message::Torque { from, torque, .. } if from.get() == cell && !torque.is_zero())
}

/// Starts the embedded bus and the cells of `skin.toml` by hand.
pub fn by_hand(place: &TestDir, nodes: &str) -> [Running; 2] {
    let server = place.start("vcan-setup", "serve vcan0");
    server.wait_for_stdout("serving vcan0 at ");
    let words = format!("--bus vcan0 --bus-kind embedded --nodes {nodes} --skin skin.toml");
    [place.start("cell-node", &words), server]
}
