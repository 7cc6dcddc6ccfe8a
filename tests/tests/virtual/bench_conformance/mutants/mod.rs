//! One faulty cell for each fault that a cell can have, with the requirement that it breaks.

pub(crate) mod arithmetic;
pub(crate) mod baseline;
pub(crate) mod beats;
pub(crate) mod commands;
pub(crate) mod counters;
pub(crate) mod flash;
pub(crate) mod joints;
pub(crate) mod parameters;
pub(crate) mod segments;
pub(crate) mod sensing;
pub(crate) mod starts;
pub(crate) mod stimuli;

use protocol::can::{Format, Frame};
use protocol::message::{Message, NetworkPage, SensorPage, State};

use crate::bench_conformance::wrong::FaultyCell;

/// Its name, the requirement, and the function that makes it from a correct cell.
pub(crate) type FaultCase = (&'static str, &'static str, fn(&mut FaultyCell));

/// The node id of all of them.
pub(crate) const NODE: u8 = 12;

/// All of them, with the format of their bus.
pub(crate) const ALL: &[(&[FaultCase], Format)] = &[
    (arithmetic::ARITHMETIC, Format::Fd),
    (joints::JOINTS, Format::Fd),
    (commands::COMMANDS, Format::Fd),
    (parameters::PARAMETERS, Format::Fd),
    (stimuli::STIMULI, Format::Fd),
    (beats::BEATS, Format::Fd),
    (beats::CLAIMS, Format::Fd),
    (counters::COUNTERS, Format::Fd),
    (segments::SEGMENTS, Format::Classic),
    (sensing::SENSING, Format::Fd),
    (baseline::BASELINE, Format::Fd),
    (starts::STARTS, Format::Fd),
    (flash::FLASH, Format::Fd),
    (flash::LEAVES, Format::Fd),
];

pub(crate) fn decoded(frame: &Frame) -> Option<Message> {
    Message::decode(&protocol::packet::Packet::from_fd(frame).ok()?).ok()
}

/// Returns true for a heartbeat with CLAIMING.
fn is_claim(message: Option<&Message>) -> bool {
    matches!(
        message,
        Some(Message::Network { page: NetworkPage::Heartbeat(beat), .. }) if beat.state.has(State::CLAIMING_NODE_ID)
    )
}

/// Returns an unrequested sensors page.
fn page_0() -> Message {
    let from = protocol::id::CellId::new(NODE.into()).unwrap();
    let page = SensorPage::Skin(protocol::message::SkinSensors::default());
    Message::Sensors { from, epoch: protocol::packet::Epoch(0), page }
}
