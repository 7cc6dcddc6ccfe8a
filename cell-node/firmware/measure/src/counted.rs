//! The functions whose instructions are counted. Each has an exported name, by which the emulator finds it.

use cell_node::contact::{Force, Torque, TorqueRounding};
use cell_node::flash::FlashState;
use cell_node::identity::Identity;
use cell_node::kernel::oracle::Projection;
use cell_node::kernel::{Kernel, Wrench};
use cell_node::node::Node;
use protocol::can::{Format, Frame};
use protocol::fixed::{Q1_14, Q5_10};
use protocol::id::{CellId, Node as Address};
use protocol::message::{Joints, Message, SensorPage, SkinSensors, StimulusStart};
use protocol::packet::Epoch;
use protocol::parameters::{MAX_JOINTS, Parameters};
use protocol::time::{Micros, Span};

/// Computes the Jacobian J with the wrench kernel.
#[inline(never)]
#[unsafe(export_name = "measure_wrench")]
pub(crate) extern "C" fn wrench(
    kernel: &Wrench,
    joints: &[Q1_14; MAX_JOINTS],
    out: &mut [Q1_14; MAX_JOINTS],
) {
    kernel.write_jacobian(joints, out);
}

/// Computes the Jacobian J with the projection kernel.
#[inline(never)]
#[unsafe(export_name = "measure_projection")]
pub(crate) extern "C" fn projection(
    kernel: &Projection,
    joints: &[Q1_14; MAX_JOINTS],
    out: &mut [Q1_14; MAX_JOINTS],
) {
    kernel.write_jacobian(joints, out);
}

/// Computes the torque words from the Jacobian J for a force in steps of 2^-16 N. The cell is moved by `joints` joints;
/// `rounding` is prepared from its configuration.
#[inline(never)]
#[unsafe(export_name = "measure_torque_words")]
pub(crate) extern "C" fn torque_words(
    jacobian: &[Q1_14; MAX_JOINTS],
    joints: u8,
    force: i32,
    out: &mut [i16; MAX_JOINTS],
    rounding: &TorqueRounding,
) {
    let moved = jacobian.get(..joints.into()).unwrap_or_default();
    Torque::new(moved, Force::from_steps(force.into())).write_words(rounding, out);
}

/// Creates a cell with a node id but without parameters. [`configure`] sets them in place, because a microcontroller
/// has no memory for two nodes.
pub(crate) fn node() -> Node {
    let identity = Identity { cell: CellId::new(12).ok(), serial: 100_012 };
    Node::unconfigured(identity, Format::Fd, true, Micros(0))
}

/// Sets the cell's parameters.
#[inline(never)]
pub(crate) fn configure(node: &mut Node, parameters: &Parameters) {
    node.restore(&FlashState::Valid(*parameters));
}

/// Runs a cell until it owns its node id, and applies a force of 3 N. Returns the frame with the joints for it to
/// answer.
pub(crate) fn pressed(node: &mut Node, joints: Joints) -> Option<Frame> {
    let mut now = Micros(0);
    for _ in 0..2 {
        now = node.poll_timeout();
        node.handle_timeout(now);
        while node.poll_transmit().is_some() {}
    }
    let skin = SkinSensors { contact: [Q5_10::from_bits(1_024); 3], ..SkinSensors::default() };
    let to = Address::Cell(node.identity().cell?);
    let press = Message::Stimulus { to, from: StimulusStart::Next, page: SensorPage::Skin(skin) };
    let frame = |message: &Message| message.encode().frames(Format::Fd).next();
    node.handle_frame(now, Span(0), &frame(&press)?);
    frame(&Message::Joints { epoch: Epoch(1), joints })
}

/// The time at which joints are answered: after the address claim and before the next heartbeat.
const ANSWER_TIME: Micros = Micros(600_000);

/// Passes a joints frame to the node, and writes the frame of the node's reply to `answer`.
#[inline(never)]
#[unsafe(export_name = "measure_reply")]
pub(crate) extern "C" fn reply(node: &mut Node, joints: &Frame, answer: &mut Frame) {
    node.handle_frame(ANSWER_TIME, Span(100), joints);
    while let Some(packet) = node.poll_transmit() {
        for frame in packet.frames(Format::Fd) {
            *answer = frame;
        }
    }
}
