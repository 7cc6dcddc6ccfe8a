//! Tests of the reports of a cell's zero, sensors page 3.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::wildcard_enum_match_arm,
    reason = "a test may stop"
)]

use protocol::can::Format;
use protocol::fixed::{Q1_14, Q3_12, Q5_10};
use protocol::id::{CellId, Node as Address};
use protocol::message::{BaselinePage, Joints, Message, NetworkPage, Request, SensorPage};
use protocol::packet::Epoch;
use protocol::parameters::{Baseline, BaselineSettings, Contact, Parameter, Parameters, Pose};
use protocol::time::{Micros, Span};

use crate::baseline::STEADY_MESSAGES_BEFORE_TARE;
use crate::flash::FlashState;
use crate::identity::Identity;
use crate::node::Node;

fn cell() -> CellId {
    CellId::new(12).unwrap()
}

/// Returns a cell that owns its node id.
fn started() -> Node {
    let [zero, one] = [Q1_14::ZERO, Q1_14::nearest(1.0)];
    let pose = Pose { position: [one, zero, zero], normal: [zero, one, zero] };
    let contact =
        Contact { alpha_c: Q3_12::nearest(1.0), force_threshold: Q5_10::nearest(0.5), ..Contact::default() };
    let parameters =
        Parameters { joint: 1, joints: 1, pose, contact, period_us: 16_000, ..Parameters::default() };
    let identity = Identity { cell: Some(cell()), serial: 100_012 };
    let mut node = Node::new(identity, Format::Fd, &FlashState::Valid(parameters), true, Micros(0));
    for _ in 0..2 {
        node.handle_timeout(node.poll_timeout());
        drain(&mut node);
    }
    node
}

/// Switches the baseline on. Returns the messages that the cell sends.
fn switch_on(node: &mut Node) -> Vec<Message> {
    let settings = BaselineSettings {
        threshold: Q5_10::nearest(0.5),
        hysteresis: Q1_14::nearest(0.5),
        rate_un_per_s: 0,
        limit: Q5_10::nearest(4.0),
        n_per_c: Q1_14::ZERO,
    };
    let words = Baseline::On(settings).words();
    let request = Request::Write { number: Parameter::Baseline.number(), words };
    tell(node, &Message::Configure { to: Address::Cell(cell()), tag: 1, request })
}

fn drain(node: &mut Node) -> Vec<Message> {
    core::iter::from_fn(|| node.poll_transmit().copied())
        .map(|packet| Message::decode(&packet).unwrap())
        .collect()
}

fn tell(node: &mut Node, message: &Message) -> Vec<Message> {
    for frame in message.encode().frames(Format::Fd) {
        node.handle_frame(Micros(300_000), Span(0), &frame);
    }
    drain(node)
}

fn joints(epoch: u8) -> Message {
    Message::Joints { epoch: Epoch(epoch), joints: Joints { in_use: 1, ..Joints::default() } }
}

fn zero_pages(messages: &[Message]) -> Vec<BaselinePage> {
    let page = |message: &Message| match message {
        Message::Sensors { page: SensorPage::Baseline(page), .. } => Some(*page),
        _ => None,
    };
    messages.iter().filter_map(page).collect()
}

// BASE-7
#[test]
fn the_zero_is_reported_when_its_state_changes() {
    let mut node = started();
    assert!(!zero_pages(&switch_on(&mut node))[0].tared, "a new baseline");
    let pages: Vec<_> = (0..2 * STEADY_MESSAGES_BEFORE_TARE)
        .map(|epoch| zero_pages(&tell(&mut node, &joints(epoch))))
        .enumerate()
        .filter(|(_, pages)| !pages.is_empty())
        .collect();
    let [(at, then)] = pages.as_slice() else { panic!("{pages:?}") };
    assert_eq!((*at + 1, then.len()), (STEADY_MESSAGES_BEFORE_TARE.into(), 1));
    assert!(then[0].tared);
}

// BASE-7
#[test]
fn the_zero_is_reported_with_every_fourth_heartbeat() {
    for (is_on, expected) in [(true, 3), (false, 0)] {
        let mut node = started();
        if is_on {
            switch_on(&mut node);
        }
        let mut beats = vec![];
        while beats.len() < 12 {
            node.handle_timeout(node.poll_timeout());
            let messages = drain(&mut node);
            if messages
                .iter()
                .any(|it| matches!(it, Message::Network { page: NetworkPage::Heartbeat(_), .. }))
            {
                beats.push(zero_pages(&messages).len());
            }
        }
        let reported: Vec<_> = (0..12).filter(|beat| beats[*beat] > 0).collect();
        assert_eq!(beats.iter().sum::<usize>(), expected, "{beats:?}");
        assert!(reported.windows(2).all(|pair| pair[1] - pair[0] == 4), "{beats:?}");
    }
}
