//! A cell that is brought into the state of the middle of a recording must answer the rest as the recorded cell did:
//! real cells, in virtual time, hundreds of scripts, each cut somewhere.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::wildcard_enum_match_arm,
    reason = "a test may stop"
)]

use cell_node::flash::FlashState;
use cell_node::identity::Identity;
use cell_node::node::Node;
use model::generate::{SkinRequest, generate};
use model::latched::LatchedState;
use protocol::can::Format;
use protocol::fixed::{Q1_14, Q3_12, Q5_10};
use protocol::id::{CellId, Node as Address};
use protocol::message::{Joints, Message, Request, SensorPage, SkinSensors, StimulusStart};
use protocol::packet::pad_with_defaults;
use protocol::packet::{Epoch, WORDS};
use protocol::parameters::{Parameter, Parameters};
use protocol::skin::Skin;
use protocol::time::{Micros, Span};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

const CELL: i64 = 12;

fn parameters() -> Parameters {
    let skin = generate(&SkinRequest { cells: 1, ..SkinRequest::default() }).unwrap();
    let skin = Skin::parse("skin.toml", &skin).unwrap();
    skin.parameters(&skin.cells[0])
}

/// Returns a cell that has claimed its node id.
fn started() -> Node {
    let identity = Identity { cell: CellId::new(CELL).ok(), serial: 1 };
    let mut node = Node::new(identity, Format::Fd, &FlashState::Valid(parameters()), true, Micros(0));
    for _ in 0..2 {
        node.handle_timeout(node.poll_timeout());
        while node.poll_transmit().is_some() {}
    }
    node
}

/// Returns a cell's answers to a message, without its heartbeats and counters.
fn tell(node: &mut Node, message: &Message) -> Vec<Message> {
    let mut answers = Vec::new();
    for frame in message.encode().frames(Format::Fd) {
        // Before the next heartbeat: time does not pass.
        node.handle_frame(Micros(300_000), Span(0), &frame);
        if node.poll_store().is_some() {
            node.handle_stored(true);
        }
        let said = core::iter::from_fn(|| node.poll_transmit().copied())
            .map(|packet| Message::decode(&packet).unwrap());
        answers.extend(said.filter(|said| !matches!(said, Message::Network { .. })));
    }
    answers
}

/// Returns random messages of a gateway, with many joints between them; `tame` scripts keep the cell's parameters and
/// leave it operating.
fn script(random: &mut Pcg64, tame: bool) -> Vec<Message> {
    let mut epoch = Epoch(random.random());
    let mut script = Vec::new();
    for _ in 0..120 {
        let to = if random.random_ratio(1, 4) {
            Address::Everyone
        } else {
            Address::Cell(CellId::new(CELL).unwrap())
        };
        script.push(match random.random_range(0..20) {
            0..=8 => {
                epoch = if random.random_ratio(1, 30) { Epoch(random.random()) } else { epoch.next() };
                let angle = |random: &mut Pcg64| Q1_14::from_bits(random.random());
                Message::Joints {
                    epoch,
                    joints: Joints {
                        positions: pad_with_defaults(&[(); WORDS].map(|()| angle(random))),
                        in_use: 6,
                    },
                }
            }
            9..=14 => {
                // Two of three are released.
                let newtons = f64::from(random.random_range(-2..2_i8).max(0)) + 0.2;
                let contact = [Q5_10::nearest(if newtons < 1.0 { 0.0 } else { newtons }); 3];
                let from = match random.random_range(0..3) {
                    0 => StimulusStart::Next,
                    _ => StimulusStart::Epoch(
                        epoch.advanced_by(random.random_range(0..6)).advanced_by(u8::MAX),
                    ),
                };
                Message::Stimulus {
                    to,
                    from,
                    page: SensorPage::Skin(SkinSensors { contact, ..SkinSensors::default() }),
                }
            }
            15 => {
                let page = SensorPage::Acceleration([Q3_12::from_bits(random.random()); 3]);
                Message::Stimulus { to, from: StimulusStart::Next, page }
            }
            16 if random.random_ratio(1, 2) => Message::Halt,
            16 | 17 => Message::Resume,
            18 => Message::Report,
            _ if tame => Message::Report,
            _ => configure(random, to),
        });
    }
    script
}

fn configure(random: &mut Pcg64, to: Address) -> Message {
    let mut changed = parameters();
    changed.contact.force_threshold = Q5_10::nearest([0.1, 2.0, 5.0][random.random_range(0..3)]);
    let contact = changed.words(Parameter::Contact);
    let (parameter, words) = match random.random_range(0..4) {
        0 => (Parameter::Mode, [random.random_range(0..2), 0, 0, 0, 0, 0]),
        1 | 2 => (Parameter::Contact, contact),
        _ => (Parameter::Commit, [changed.hash().cast_signed(), 0, 0, 0, 0, 0]),
    };
    Message::Configure {
        to,
        tag: random.random(),
        request: Request::Write { number: parameter.number(), words },
    }
}

fn mode(obeys: i16) -> Message {
    let mut words = [0; WORDS];
    words[0] = obeys;
    let request = Request::Write { number: Parameter::Mode.number(), words };
    Message::Configure { to: Address::Everyone, tag: 0, request }
}

#[test]
fn a_cell_with_another_past_answers_the_rest_as_the_recorded_one_did() {
    let (mut torques, mut ends, mut all) = (0, 0, 0);
    for seed in 0..600 {
        let mut random = Pcg64::seed_from_u64(seed);
        let script_of_recording = script(&mut random, false);
        let link_down = random.random_range(0..script_of_recording.len());
        let (before, after) = script_of_recording.split_at(link_down);
        let (mut recorded, mut state) = (started(), LatchedState::default());
        for message in before {
            state.apply_message(message);
            for answer in tell(&mut recorded, message) {
                state.apply_message(&answer);
            }
        }
        let next = after.iter().find_map(|message| match message {
            Message::Joints { epoch, joints } => Some((*epoch, *joints)),
            _ => None,
        });

        let mut other = started();
        for message in script(&mut random, true).iter().take(random.random_range(0..100)) {
            tell(&mut other, message);
        }
        tell(&mut other, &mode(1));
        for message in state.restoring_messages(|_| true, next) {
            tell(&mut other, &message);
        }
        let mut has_epoch = before.iter().any(|message| matches!(message, Message::Joints { .. }));
        for (at, message) in after.iter().enumerate() {
            let (then, now) = (tell(&mut recorded, message), tell(&mut other, message));
            has_epoch |= matches!(message, Message::Joints { .. });
            // A report before the first joints has the epoch of an earlier sender.
            if matches!(message, Message::Report) && !has_epoch {
                continue;
            }
            assert_eq!(
                then,
                now,
                "seed {seed}, {at} messages after {link_down}: {message:?}\nrestored: {:#?}",
                state.restoring_messages(|_| true, next)
            );
            let zero =
                |answer: &&Message| matches!(answer, Message::Torque { torque, .. } if torque.is_zero());
            ends += then.iter().filter(zero).count();
            torques += then.iter().filter(|it| matches!(it, Message::Torque { .. })).count();
            all += 1;
        }
    }
    assert!(torques > all / 20 && ends > 300, "{torques} torques, {ends} ends of contacts in {all} messages");
}
