//! Tests of the state that results from generated frames.

use super::*;
use crate::command::CellReference;
use crate::page_command::SelectedCell;
use model::generate::{ReplyMode, SkinRequest, generate};
use protocol::fixed::{Q1_14, Q5_10};
use protocol::id::Node;
use protocol::message::{
    Heartbeat, Joints, Message, NetworkPage, SensorPage, State, StimulusStart, TreePage,
};
use protocol::packet::{Epoch, Packet, Words};

fn skin() -> Skin {
    Skin::parse("ur5", include_str!("../../../examples/ur5-253.toml")).unwrap()
}

fn selected(cell: &str) -> SelectedCell {
    SelectedCell { cell: CellReference(cell.to_owned()), frame: None }
}

/// The state of the example skin, whose frames are generated at 62.5 Hz.
struct Bench {
    live: LiveState,
    now: Micros,
    /// The index of the bus on which messages are sent.
    bus: usize,
}

impl Bench {
    fn new() -> Self {
        Self { live: LiveState::new(skin()), now: Micros(1_000_000), bus: 0 }
    }

    fn say(&mut self, message: &Message) {
        self.now.0 += 100;
        let packet: Packet = message.encode();
        for frame in packet.frames(protocol::can::Format::Fd) {
            self.live.apply_frame(self.bus, self.now, &frame);
        }
    }

    fn heartbeat(&mut self, node: u8, configuration: u16) {
        let from = CellId::new(node.into()).unwrap();
        let state = State(0x1000 | State::CONFIGURED.0 | State::TEST_MODE.0 | 2 << 8);
        let is_it = |cell: &&protocol::skin::Cell| (cell.bus, cell.node) == (self.bus, from);
        let serial = self.live.skin.cells.iter().find(is_it).unwrap().serial;
        let heartbeat = Heartbeat { serial, configuration, state, ..Heartbeat::default() };
        let page = NetworkPage::Heartbeat(heartbeat);
        self.say(&Message::Network { from: Node::Cell(from), epoch: Epoch(0), page });
    }

    fn joints(&mut self, epoch: u8, q: [f64; 6]) {
        self.now.0 += 16_000;
        let mut positions = [Q1_14::ZERO; protocol::parameters::MAX_JOINTS];
        for (position, q) in positions.iter_mut().zip(q) {
            *position = Q1_14::from_radians(q).unwrap();
        }
        self.say(&Message::Joints { epoch: Epoch(epoch), joints: Joints { positions, in_use: 6 } });
    }

    fn snapshot(&mut self) -> Vec<u8> {
        self.live.handle_time(self.now);
        self.live.snapshot(self.now, &TouchRegistry::default())
    }
}

fn float(bytes: &[u8], at: usize) -> f32 {
    f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
}

const Q: [f64; 6] = [0.3, -1.2, 1.0, -1.4, -1.5, 0.2];

#[test]
fn a_snapshot_holds_the_last_epoch_that_is_over() {
    let mut bench = Bench::new();
    let hash = bench.live.skin.parameters(&bench.live.skin.cells[4]).hash();
    bench.heartbeat(5, hash);
    bench.heartbeat(6, 1);
    bench.joints(1, Q);
    let node = CellId::new(5).unwrap();
    let page = SensorPage::Skin(SkinSensors { contact: [Q5_10::nearest(1.0); 3], ..SkinSensors::default() });
    bench.say(&Message::Stimulus { to: Node::Cell(node), from: StimulusStart::Next, page });
    bench.joints(2, Q);
    let words = [100_i16, -200, 0, 0, 0, 0];
    bench.say(&Message::Torque { from: node, epoch: Epoch(2), torque: words.into() });
    let before = bench.snapshot();
    assert_eq!(before.len(), 24 + 12 * 6 + 8 * 253);
    assert_eq!(float(&before, 24 + 4), 0.0, "epoch 2 is not over");
    bench.joints(3, Q);
    let bytes = bench.snapshot();
    assert_eq!(u32::from_le_bytes(bytes[..4].try_into().unwrap()), 2);
    for (joint, q) in Q.iter().enumerate() {
        assert!((f64::from(float(&bytes, 24 + 12 * joint)) - q).abs() < 1e-4, "{joint}");
    }
    assert_eq!(float(&bytes, 24 + 4), 100.0 / 4096.0);
    assert_eq!(float(&bytes, 24 + 16), -200.0 / 4096.0);
    let central = float(&bytes, 24 + 8);
    assert!(central != 0.0 && central.abs() < 3.0, "{central}");
    let cell = |node: usize| &bytes[24 + 72 + 8 * (node - 1)..24 + 72 + 8 * node];
    assert_eq!((cell(5)[0], cell(5)[1]), (2, 0), "active");
    let force = u16::from_le_bytes([cell(5)[2], cell(5)[3]]);
    assert!((2990..=3010).contains(&force), "{force} mN");
    assert_eq!(
        (cell(6)[0], cell(6)[1]),
        (1, flag::OTHER_CONFIGURATION_BIT),
        "quiet, with another configuration"
    );
    assert_eq!(cell(7)[0], 0, "never heard");

    let said = bench.live.status_message(bench.now);
    // The start of the cell was not observed, so no reply of it was due.
    assert_eq!((said.contacts, said.dead, said.halted, said.buses[0].due), (1, 0, false, 0));
    let detail = bench.live.cell_detail(&selected("5"), bench.now).unwrap();
    let answer = detail.torque.unwrap();
    assert_eq!((answer.epoch, answer.words[..2].to_vec(), detail.serial), (2, vec![100, -200], 100_005));
    let exact = answer.central.unwrap();
    let jacobian = answer.jacobian.unwrap();
    let force_n = detail.force_n.unwrap();
    for (torque, row) in exact.iter().zip(&jacobian) {
        assert!((torque - row * force_n).abs() < 1e-9, "tau = J F: {exact:?} {jacobian:?}");
    }
    assert_eq!(detail.readings.len(), 3, "no page of acceleration was sent: {:?}", detail.readings);
    let unknown = bench.live.cell_detail(&selected("7"), bench.now).unwrap();
    assert_eq!((unknown.force_n, unknown.readings), (None, vec![]), "never heard");
    let contact = bench.live.skin.cells[4].contact;
    assert_eq!(detail.gains.alpha[0], contact.alpha_c.to_f64());
    assert_eq!(detail.gains.thresholds[2], contact.force_threshold.to_f64());
    assert!((exact[0] - f64::from(central)).abs() < 1e-6, "the only cell in contact: {exact:?} {central}");
    for other in ["254", "0", "vcan7:1", "five"] {
        assert_eq!(bench.live.cell_detail(&selected(other), bench.now), None, "{other}");
    }
}

#[test]
fn a_touch_from_before_the_view_makes_the_central_torque_unknown_until_it_ends() {
    let mut bench = Bench::new();
    let node = CellId::new(5).unwrap();
    let (quiet, touched) = (Words::from([0; 6]), Words::from([100, -200, 0, 0, 0, 0]));
    let mut both_torques = |epoch: u8, torque: Words| {
        bench.heartbeat(5, 0);
        bench.joints(epoch, Q);
        bench.say(&Message::Torque { from: node, epoch: Epoch(epoch), torque });
        bench.joints(epoch + 1, Q);
        let bytes = bench.snapshot();
        (float(&bytes, 24 + 4), float(&bytes, 24 + 8))
    };
    let (distributed, central) = both_torques(1, touched);
    assert_eq!(distributed, 100.0 / 4096.0);
    assert!(central.is_nan(), "no stimulus was seen: {central}");
    assert_eq!(both_torques(3, quiet), (0.0, 0.0), "the torque of 0 Nm ended the contact");
}

#[test]
fn torques_are_those_of_the_buses_that_have_completed_an_epoch() {
    let target = SkinRequest { cells: 8, buses: 2, ..SkinRequest::default() };
    let skin = Skin::parse("two", &generate(&target).unwrap()).unwrap();
    let mut bench = Bench { live: LiveState::new(skin), now: Micros(1_000_000), bus: 0 };
    let from = CellId::new(1).unwrap();
    let mut after = |bus: usize, epoch: u8, messages: usize| {
        bench.bus = bus;
        bench.joints(epoch, Q);
        if messages > 1 {
            bench.say(&Message::Torque { from, epoch: Epoch(epoch), torque: [4096, 0, 0, 0, 0, 0].into() });
            bench.joints(epoch + 1, Q);
        }
        float(&bench.snapshot(), 24 + 4)
    };
    assert!(after(0, 1, 1).is_nan(), "the first epoch is not over");
    assert_eq!(after(0, 2, 2), 1.0);
    assert_eq!(after(1, 1, 1), 1.0, "of one bus");
    assert_eq!(after(1, 2, 2), 2.0, "of both");
}

#[test]
fn the_position_of_a_joint_is_unknown_until_a_bus_has_sent_it() {
    let mut skin = skin();
    // No bus has the last joint.
    let other = skin.robot.joints[0].clone();
    skin.robot.joints.push(other);
    let mut bench = Bench { live: LiveState::new(skin), now: Micros(1_000_000), bus: 0 };
    let mut unknown = |epoch: Option<u8>| {
        epoch.iter().for_each(|epoch| bench.joints(*epoch, Q));
        let bytes = bench.snapshot();
        (0..7).filter(|joint| float(&bytes, 24 + 12 * joint).is_nan()).collect::<Vec<_>>()
    };
    assert_eq!(unknown(None), [0, 1, 2, 3, 4, 5, 6]);
    assert_eq!(unknown(Some(1)), [6]);
}

#[test]
fn a_silent_cell_is_dead_since_it_was_noticed_and_a_halt_stands_until_the_resume() {
    let mut bench = Bench::new();
    bench.heartbeat(5, 0);
    bench.joints(1, Q);
    bench.say(&Message::Halt);
    bench.now.0 += 2_000_000;
    let bytes = bench.snapshot();
    assert_eq!(bytes[24 + 72 + 8 * 4], 4);
    bench.now.0 += 3_000_000;
    let said = bench.live.status_message(bench.now);
    assert!(said.halted && said.dead == 1 && (said.dead_cells[0].for_s - 3.0).abs() < 0.1, "{said:?}");
    bench.say(&Message::Resume);
    assert!(!bench.live.status_message(bench.now).halted);
    bench.heartbeat(5, 0);
    bench.snapshot();
    assert_eq!(bench.live.status_message(bench.now).dead_cells, []);
}

#[test]
fn only_cells_of_the_skin_in_test_mode_may_be_pressed() {
    let mut bench = Bench::new();
    let cell = |node| CellId::new(node).unwrap();
    assert!(!bench.live.is_pressable((0, cell(12))), "it has not reported test mode");
    bench.heartbeat(12, 0);
    assert!(bench.live.is_pressable((0, cell(12))));
    for other in [(0, cell(254)), (1, cell(12))] {
        assert!(!bench.live.is_pressable(other), "{other:?}");
    }
}

#[test]
fn ten_thousand_cells_on_forty_buses_are_shown() {
    let (buses, each) = (40, 250);
    let target = SkinRequest { cells: buses * each, buses, broadcast_hz: 20.0, ..SkinRequest::default() };
    let skin = Skin::parse("large", &generate(&target).unwrap()).unwrap();
    let mut bench = Bench { live: LiveState::new(skin), now: Micros(1_000_000), bus: 0 };
    for bus in 0..buses {
        bench.bus = bus;
        bench.joints(1, Q);
        for node in 1..=each {
            let node = CellId::new(i64::try_from(node).unwrap()).unwrap();
            let word = i16::try_from(bus).unwrap();
            bench.say(&Message::Torque {
                from: node,
                epoch: Epoch(1),
                torque: [word + 1, 0, 0, 0, 0, 0].into(),
            });
        }
        bench.joints(2, Q);
    }
    let bytes = bench.snapshot();
    assert_eq!(bytes.len(), 24 + 12 * 6 + 8 * buses * each);
    let sum: f64 = (1..=buses).map(|bus| f64::from(u32::try_from(bus * each).unwrap()) / 4096.0).sum();
    assert!((f64::from(float(&bytes, 24 + 4)) - sum).abs() < 1e-3, "the torques of all buses");
    let (bus, node) = (buses - 1, CellId::new(250).unwrap());
    let page = SensorPage::Skin(SkinSensors { contact: [Q5_10::nearest(1.0); 3], ..SkinSensors::default() });
    bench.heartbeat(250, 0);
    bench.say(&Message::Stimulus { to: Node::Cell(node), from: StimulusStart::Next, page });
    bench.joints(3, Q);
    let bytes = bench.snapshot();
    let pressed: Vec<_> =
        bytes[24 + 72..].chunks(8).enumerate().filter(|(_, cell)| cell[2..4] != [0, 0]).collect();
    let expected = bench.live.skin.cells.iter().position(|cell| (cell.bus, cell.node) == (bus, node));
    assert_eq!(pressed.iter().map(|(at, _)| *at).collect::<Vec<_>>(), [expected.unwrap()]);
    assert_eq!(bench.live.status_message(bench.now).buses.len(), buses);
}

#[test]
fn a_bus_with_sums_says_where_cells_are_in_the_tree() {
    let target = SkinRequest { cells: 4, reply: ReplyMode::Sum, ..SkinRequest::default() };
    let skin = Skin::parse("sums", &generate(&target).unwrap()).unwrap();
    let mut bench = Bench { live: LiveState::new(skin), now: Micros(1_000_000), bus: 0 };
    let places = |bench: &Bench| bench.live.status_message(bench.now).buses[0].tree.clone().unwrap();
    bench.joints(1, Q);
    for (node, parent) in [(1, Some(0)), (2, Some(1)), (3, None)] {
        bench.heartbeat(node, 0);
        let page = NetworkPage::Tree(TreePage {
            parent,
            parent_port: 0,
            working_ports: 0b0101,
            ..TreePage::default()
        });
        bench.say(&Message::Network {
            from: Node::Cell(CellId::new(node.into()).unwrap()),
            epoch: Epoch(1),
            page,
        });
    }
    assert_eq!(
        places(&bench),
        [
            Some(CellParentAndWires(Some(0), 0b0101)),
            Some(CellParentAndWires(Some(1), 0b0101)),
            Some(CellParentAndWires(None, 0b0101)),
            None
        ]
    );
    let json = serde_json::to_string(&bench.live.status_message(bench.now)).unwrap();
    assert!(json.contains(r#""tree":[[0,5],[1,5],[null,5],null]"#), "{json}");
    bench.now.0 += 5_000_000;
    bench.live.handle_time(bench.now);
    assert_eq!(places(&bench), [None; 4], "they are silent");
    let said = Bench::new().live.status_message(Micros(0));
    assert_eq!(said.buses[0].tree, None, "torques have no tree");
    assert_eq!(said.unheard, Bench::new().live.skin.cells.len());
}
