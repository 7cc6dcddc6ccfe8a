use super::*;
use bench::remote::CommandReply;
use model::central::CentralComputation;
use model::testing::ONE_CELL_SKIN_TOML;
use protocol::can::Format;
use protocol::fixed::TorqueFormat;
use protocol::id::Node;
use protocol::message::{Heartbeat, Joints, NetworkPage, State, StimulusStart};
use protocol::packet::{Epoch, Length, Words};
use protocol::parameters::MAX_JOINTS;
use serde_json::{Value, json};

/// A controlled run of one cell, whose bus the test plays.
struct Played {
    state: ControlState,
    epoch: u8,
}

impl Played {
    fn new() -> Self {
        let skin = Skin::parse("skin.toml", ONE_CELL_SKIN_TOML).unwrap();
        Self { state: ControlState::new(skin, "1.0", vec![("embedded", None)]), epoch: 0 }
    }

    /// A run that is ready, in its first epoch.
    fn ready() -> Self {
        let mut played = Self::new();
        played.begin_epoch();
        played.beat();
        played.answer(&[]);
        played.state.handle_time(played.now());
        assert_eq!(played.events()[0]["event"], "ready");
        played
    }

    fn now(&self) -> Micros {
        Micros(u64::from(self.epoch) * 16_000)
    }

    fn receive(&mut self, message: &Message) {
        for frame in message.encode().frames(Format::Fd) {
            self.state.handle_frame(0, self.now().0 * 1_000, &frame);
        }
        self.state.handle_time(self.now());
    }

    fn begin_epoch(&mut self) {
        self.epoch += 1;
        let in_use = u8::try_from(self.state.skin.robot.joints.len()).unwrap();
        let joints = Joints { positions: Default::default(), in_use };
        self.receive(&Message::Joints { epoch: Epoch(self.epoch), joints });
    }

    fn beat(&mut self) {
        self.beat_with(0);
    }

    /// Sends a heartbeat of a cell that has sent this many packets since its start.
    fn beat_with(&mut self, sent: u16) {
        let state = State(State::CONFIGURED.0 | State::TEST_MODE.0);
        let page = NetworkPage::Heartbeat(Heartbeat { state, sent, ..Heartbeat::default() });
        let from = Node::Cell(CellId::new(1).unwrap());
        self.receive(&Message::Network { from, epoch: Epoch(self.epoch), page });
    }

    /// Sends the torque that the cell computes with a force in an epoch.
    fn answer_joints(&mut self, epoch: u8, force_n: f64) {
        let central = CentralComputation::new(&self.state.skin);
        let frames = central.link_frames(&[Default::default(); MAX_JOINTS]);
        let mut torque = Words::zeros(Length::Six);
        for (word, expected) in torque.as_mut_slice().iter_mut().zip(central.cell_torque(0, &frames, force_n))
        {
            *word = TorqueFormat::Q3_12.nearest_word(expected);
        }
        self.receive(&Message::Torque { from: CellId::new(1).unwrap(), epoch: Epoch(epoch), torque });
    }

    /// Returns the outcomes of presses so far, each with its id and its epoch or reason.
    fn outcomes(&mut self) -> Vec<(u64, Value)> {
        let events = self.events().into_iter();
        events
            .filter_map(|event| {
                let outcome = match event["event"].as_str()? {
                    "confirmed" => event["epoch"].clone(),
                    "unconfirmed" => event["reason"].clone(),
                    _ => return None,
                };
                Some((event["id"].as_u64()?, outcome))
            })
            .collect()
    }

    fn line(&mut self, line: &Value) -> Vec<Value> {
        self.state.handle_line(self.now(), InputLine::parse(line.to_string().as_bytes()));
        self.events()
    }

    fn events(&mut self) -> Vec<Value> {
        let events = self.state.output.events.drain(..);
        events.map(|event| serde_json::to_value(event).unwrap()).collect()
    }

    fn answer(&mut self, answers: &[(u64, bool, &str)]) {
        let reply =
            |&(number, done, text): &(u64, bool, &str)| CommandReply { number, done, text: text.to_owned() };
        let answers = answers.iter().map(reply).collect();
        self.state.handle_bench_state(self.now(), BenchState { answers, ..BenchState::default() });
    }
}

#[test]
fn the_first_event_waits_for_the_loop_and_each_cell() {
    let mut played = Played::new();
    assert_eq!(played.line(&json!({"do": "report", "id": 1})).len(), 0);
    played.begin_epoch();
    played.answer(&[]);
    played.state.handle_time(played.now());
    assert_eq!(played.events().len(), 0);
    played.beat();
    let names: Vec<_> = played.events().iter().map(|event| event["event"].clone()).collect();
    assert_eq!(names, ["ready", "report", "accepted"]);
}

#[test]
fn commands_are_carried_out_in_their_order() {
    let mut played = Played::ready();
    for id in 1..=5 {
        assert_eq!(played.line(&json!({"do": "kill", "cell": 1, "id": id})).len(), 0);
    }
    assert_eq!(played.state.output.commands.len(), MAX_COMMANDS_IN_FLIGHT);
    assert_eq!(played.line(&json!({"do": "press", "cell": 1, "force_n": 3, "id": 6})).len(), 0);
    played.answer(&[(1, true, "kill cell 1"), (2, false, "it has ended"), (3, false, "b"), (4, false, "c")]);
    let answered = [
        json!({"event": "accepted", "id": 1, "do": "kill", "text": "kill cell 1"}),
        json!({"event": "error", "id": 2, "text": "it has ended"}),
    ];
    assert_eq!(played.events()[..2], answered);
    assert_eq!(played.state.output.messages, [], "the fifth command is under way");
    played.answer(&[(4, false, "c"), (5, false, "d")]);
    let epoch = played.epoch + 2;
    let expected = [
        json!({"event": "error", "id": 5, "text": "d"}),
        json!({"event": "accepted", "id": 6, "do": "press", "cell": "vcan0:1", "force_n": 3.0, "epoch": epoch}),
    ];
    assert_eq!(played.events(), expected);
    let from = |message: &Message| {
        if let Message::Stimulus { from, .. } = message { Some(*from) } else { None }
    };
    let sent: Vec<_> =
        played.state.output.messages.iter().map(|(bus, message)| (*bus, from(message))).collect();
    assert_eq!(sent, [(0, Some(StimulusStart::Epoch(Epoch(epoch))))]);
}

#[test]
fn commands_that_are_under_way_at_the_end_are_answered() {
    let mut played = Played::ready();
    played.line(&json!({"do": "press", "cell": 1, "force_n": 3, "id": 1}));
    played.line(&json!({"do": "kill", "cell": 1, "id": 2}));
    played.line(&json!({"do": "halt", "id": 3}));
    played.state.handle_end([InputLine::parse(br#"{"do":"resume","id":4}"#)]);
    let events: Vec<_> = played.events().iter().map(|it| (it["event"].clone(), it["id"].clone())).collect();
    let expected = [("error", 2), ("error", 3), ("error", 4), ("unconfirmed", 1)];
    assert_eq!(events, expected.map(|(event, id)| (json!(event), json!(id))));
}

#[test]
fn the_end_of_the_input_ends_the_run_after_its_commands() {
    let mut played = Played::ready();
    played.line(&json!({"do": "kill", "cell": 1, "id": 1}));
    played.state.handle_end_of_input(played.now());
    assert!(matches!(
        played.state.output.commands.as_slice(),
        [BenchCommand::Process { .. }, BenchCommand::End]
    ));
    let refused = played.line(&json!({"do": "halt", "id": 2}));
    assert_eq!(refused.len(), 0, "it waits for the answers");
    played.answer(&[(1, true, "kill"), (2, true, "end the run")]);
    let last = played.events().pop();
    assert_eq!(last, Some(json!({"event": "error", "id": 2, "text": "the run is ending"})));
}

#[test]
fn a_press_is_confirmed_by_its_epoch_also_if_joints_were_lost() {
    let mut played = Played::ready();
    played.line(&json!({"do": "press", "cell": 1, "force_n": 3, "id": 1}));
    // The joints of the next epoch do not arrive here.
    played.epoch += 1;
    played.begin_epoch();
    let epoch = played.epoch;
    played.answer_joints(epoch, 3.0);
    assert_eq!(played.outcomes(), [(1, json!(epoch))]);
    // Repeated joints are no epoch.
    played.line(&json!({"do": "press", "cell": 1, "force_n": 5, "id": 2}));
    played.epoch -= 1;
    played.begin_epoch();
    played.begin_epoch();
    played.answer_joints(epoch + 1, 3.0);
    assert_eq!(played.outcomes(), [], "the force is asked for later");
    played.begin_epoch();
    played.answer_joints(epoch + 2, 5.0);
    assert_eq!(played.outcomes(), [(2, json!(epoch + 2))]);
}

#[test]
fn a_release_is_shown_by_zeros_and_a_touched_cell_has_to_send_them() {
    let mut played = Played::ready();
    played.line(&json!({"do": "release", "cell": 1, "id": 1}));
    (0..6).for_each(|_| played.begin_epoch());
    played.beat();
    assert_eq!(played.outcomes(), [(1, json!("not-touched"))]);
    played.line(&json!({"do": "press", "cell": 1, "force_n": 3, "id": 2}));
    played.begin_epoch();
    played.line(&json!({"do": "release", "cell": 1, "id": 3}));
    played.begin_epoch();
    played.answer_joints(played.epoch, 3.0);
    assert_eq!(played.outcomes(), [(2, json!(played.epoch))]);
    // The torque of zeros is lost.
    for _ in 0..30 {
        played.begin_epoch();
        played.beat();
    }
    assert_eq!(played.outcomes(), [], "it may come late");
    for _ in 0..15 {
        played.begin_epoch();
        played.beat();
    }
    assert_eq!(played.outcomes(), [(3, json!("no-answer"))]);
    // Of two releases, the first one ends the contact.
    played.line(&json!({"do": "press", "cell": 1, "force_n": 3, "id": 4}));
    (0..2).for_each(|_| played.begin_epoch());
    played.answer_joints(played.epoch, 3.0);
    assert_eq!(played.outcomes(), [(4, json!(played.epoch))]);
    played.line(&json!({"do": "release", "cell": 1, "id": 5}));
    played.begin_epoch();
    played.line(&json!({"do": "release", "cell": 1, "id": 6}));
    played.begin_epoch();
    played.answer_joints(played.epoch, 0.0);
    (0..5).for_each(|_| played.begin_epoch());
    played.beat();
    assert_eq!(played.outcomes(), [(5, json!(played.epoch - 5)), (6, json!("not-touched"))]);
}

#[test]
fn a_force_that_rounds_to_nothing_is_below_the_threshold() {
    let mut played = Played::ready();
    played.line(&json!({"do": "press", "cell": 1, "force_n": 0.0004, "id": 1}));
    (0..5).for_each(|_| played.begin_epoch());
    assert_eq!(played.outcomes(), [(1, json!("below-threshold"))]);
}

#[test]
fn no_stimulus_names_an_epoch_from_before_a_loss_of_the_bus() {
    let mut played = Played::ready();
    played.state.handle_bus_state(played.now(), 0, true, 0);
    played.state.handle_bus_state(played.now(), 0, false, 0);
    played.state.output.messages.clear();
    let events = played.line(&json!({"do": "press", "cell": 1, "force_n": 1, "id": 1}));
    assert_eq!(events.last().unwrap()["event"], "error", "{events:?}");
    assert_eq!(played.state.output.messages, []);
    let report = played.line(&json!({"do": "report"})).remove(0);
    assert_eq!((&report["positions"], &report["central"]), (&json!([]), &json!([])), "they are unknown");
    played.state.handle_bus_state(played.now(), 0, true, 0);
    played.epoch += 100;
    played.begin_epoch();
    let events = played.line(&json!({"do": "press", "cell": 1, "force_n": 1, "id": 2}));
    assert_eq!(events.last().unwrap()["epoch"], played.epoch + 2, "{events:?}");
}

#[test]
fn cells_on_a_lost_bus_stay_pressed_until_they_can_be_released() {
    let mut played = Played::ready();
    played.state.handle_bus_state(played.now(), 0, true, 0);
    played.line(&json!({"do": "press", "cell": 1, "force_n": 1, "id": 1}));
    played.state.handle_bus_state(played.now(), 0, false, 0);
    let events = played.line(&json!({"do": "release", "id": 2}));
    let reason = "cell vcan0:1: no joints come on vcan0: wait for the bus, or bring it up";
    assert_eq!(events, [json!({"event": "error", "id": 2, "text": reason})]);
    played.state.handle_bus_state(played.now(), 0, true, 0);
    played.begin_epoch();
    let events = played.line(&json!({"do": "release", "id": 3}));
    let accepted = json!({"event": "accepted", "id": 3, "do": "release", "text": "release 1 cells"});
    assert_eq!(events.last(), Some(&accepted));
}

#[test]
fn a_touch_that_no_stimulus_explains_leaves_the_central_torques_unknown() {
    let mut played = Played::new();
    played.beat_with(100);
    played.begin_epoch();
    played.answer_joints(played.epoch, 2.0);
    played.begin_epoch();
    played.begin_epoch();
    played.answer(&[]);
    played.state.handle_time(played.now());
    played.events();
    let report = played.line(&json!({"do": "report"})).remove(0);
    let distributed = report["distributed"].as_array().unwrap();
    assert!(distributed.iter().any(|torque| *torque != json!(0.0)), "{report}");
    assert_eq!(report["central"], json!([]));
}
