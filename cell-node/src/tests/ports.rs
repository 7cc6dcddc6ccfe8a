//! Tests of cells with and without ports: their messages over wires, and parameter 6.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may stop")]

use crate::flash::FlashState;
use crate::identity::Identity;
use crate::node::Node;
use protocol::can::Format;
use protocol::fixed::{Q1_14, Q3_12, Q5_10};
use protocol::id::{CellId, Node as Address};
use protocol::message::{
    Answer, Joints, Message, NetworkPage, Request, SensorPage, SkinSensors, StimulusStart,
};
use protocol::packet::{Epoch, WORDS, padded_words};
use protocol::parameters::{Contact, Parameter, Parameters, Pose};
use protocol::port::{Hello, NodeIdWalk, PortMessage, TreeRank, UPLINK};
use protocol::time::{Micros, Span};

const REPLY: u8 = 6;

fn start(wired: u8) -> Node {
    start_with(wired, CellId::new(12).ok())
}

fn start_with(wired: u8, cell: Option<CellId>) -> Node {
    let [zero, one] = [Q1_14::ZERO, Q1_14::nearest(1.0)];
    let parameters = Parameters {
        joint: 1,
        joints: 1,
        pose: Pose { position: [one, zero, zero], normal: [zero, one, zero] },
        contact: Contact { alpha_c: Q3_12::nearest(1.0), ..Contact::default() },
        period_us: 16_000,
        ..Parameters::default()
    };
    let identity = Identity { cell, serial: 1 };
    Node::new(identity, Format::Fd, &FlashState::Valid(parameters), true, Micros(0)).with_ports(wired)
}

/// Advances the time of a cell. Returns the messages that the cell sends over wires, each with its port.
fn until(node: &mut Node, at: Micros) -> Vec<(usize, PortMessage)> {
    while node.poll_timeout() <= at {
        node.handle_timeout(node.poll_timeout());
        while node.poll_transmit().is_some() {}
    }
    core::iter::from_fn(|| node.poll_port_transmit()).collect()
}

fn tell(node: &mut Node, now: Micros, message: &Message) -> Vec<Message> {
    for frame in message.encode().frames(Format::Fd) {
        node.handle_frame(now, Span(0), &frame);
    }
    core::iter::from_fn(|| node.poll_transmit().copied())
        .map(|packet| Message::decode(&packet).unwrap())
        .collect()
}

fn sum_with(words: [i16; WORDS]) -> Message {
    let number = Parameter::Reply.number();
    Message::Configure { to: Address::Everyone, tag: 0, request: Request::Write { number, words } }
}

// CLAIM-8, HELLO-1
#[test]
fn hellos_of_a_claiming_cell_have_the_node_id_that_it_claims() {
    let mut node = start(0b1);
    // It is settled at the earliest 250 ms after its first heartbeat.
    let hellos = until(&mut node, Micros(200_000));
    assert!(
        matches!(hellos[..], [(0, PortMessage::Hello(Hello { number: 12, rank: None, .. }))]),
        "{hellos:?}"
    );
}

// OPT-1, CONF-3, CONF-4, CONF-10, CONF-11
#[test]
fn a_cell_without_ports_does_not_sum_and_one_with_ports_reads_back_what_it_was_told() {
    let now = Micros(400_000);
    let answers = [0, 0b1].map(|wired| {
        let mut node = start(wired);
        until(&mut node, now);
        match tell(&mut node, now, &sum_with([1, 1_500, 6, 1, -7, -7])).as_slice() {
            [Message::Configured { answer, .. }] => *answer,
            other => panic!("{other:?}"),
        }
    });
    let refused = Answer::Refused { number: REPLY, reason: Answer::REFUSED_INVALID_WORDS };
    let taken = Answer::Value { number: REPLY, written: true, words: padded_words([1, 1_500, 6, 1]) };
    assert_eq!(answers, [refused, taken]);
}

// LEASE-1, JOIN-5
#[test]
fn a_root_sends_its_sums_to_the_gateways_side_without_a_state() {
    let mut node = start(1 << UPLINK);
    let now = Micros(400_000);
    until(&mut node, now);
    join_gateway(&mut node, now);
    tell(&mut node, now, &sum_with([1, 1_500, 0, 1, 0, 0]));
    let contact = [Q5_10::nearest(4.0), Q5_10::ZERO, Q5_10::ZERO];
    let page = SensorPage::Skin(SkinSensors { contact, ..SkinSensors::default() });
    tell(&mut node, now, &Message::Stimulus { to: Address::Everyone, from: StimulusStart::Next, page });
    let joints = Joints { in_use: 1, ..Joints::default() };
    let sent = tell(&mut node, now, &Message::Joints { epoch: Epoch(7), joints });
    assert!(sent.iter().any(|message| matches!(message, Message::Sum { count: 1, .. })), "{sent:?}");
    let said: Vec<_> = core::iter::from_fn(|| node.poll_port_transmit()).collect();
    let is_up = |message: &PortMessage| matches!(message, PortMessage::Hello(Hello { is_parent: true, .. }));
    assert!(said.iter().any(|(port, message)| *port == UPLINK && is_up(message)), "{said:?}");
    assert!(!said.iter().any(|(_, message)| matches!(message, PortMessage::State(_))), "{said:?}");
}

/// Makes the cell a root, by a grant from the gateway's side.
fn join_gateway(node: &mut Node, now: Micros) {
    let rank = TreeRank { round: 1, depth: 0 };
    let hello = Hello {
        version: 1,
        number: 0,
        port: 0,
        receives: true,
        is_parent: false,
        unnumbered: false,
        rank: Some(rank),
    };
    node.handle_port(now, Span(0), UPLINK, PortMessage::Hello(hello));
    node.handle_port(now, Span(0), UPLINK, PortMessage::Grant(rank));
}

// JOIN-6
#[test]
fn the_place_in_the_tree_is_reported_at_most_every_50_ms() {
    let mut node = start(1 << UPLINK | 0b1);
    let pages = |node: &mut Node| {
        core::iter::from_fn(|| node.poll_transmit().copied())
            .filter_map(|packet| {
                let message = Message::decode(&packet).unwrap();
                let Message::Network { page: NetworkPage::Tree(tree), .. } = message else { return None };
                Some((tree.parent, tree.children))
            })
            .collect::<Vec<_>>()
    };
    until(&mut node, Micros(400_000));
    join_gateway(&mut node, Micros(400_000));
    assert_eq!(pages(&mut node), [(Some(0), 0)]);
    node.handle_port(Micros(410_000), Span(0), 0, PortMessage::Join);
    node.handle_timeout(Micros(449_999));
    assert_eq!(pages(&mut node), []);
    node.handle_timeout(Micros(450_000));
    assert_eq!(pages(&mut node), [(Some(0), 0b1)]);
}

// NODE-2
#[test]
fn a_new_node_id_changes_once_what_a_cell_receives() {
    let mut node = start_with(1 << UPLINK, None);
    assert!(!node.poll_received_ids());
    join_gateway(&mut node, Micros(1_000));
    assert!(!node.poll_received_ids(), "the gateway sends no sums");
    let walk = NodeIdWalk { walk: 1, first: 3, last: 9 };
    node.handle_port(Micros(2_000), Span(0), UPLINK, PortMessage::NodeId(walk));
    assert_eq!([node.poll_received_ids(), node.poll_received_ids()], [true, false]);
}
