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
use protocol::packet::{Epoch, Length};
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
pub(crate) fn node(format: Format) -> Node {
    let identity = Identity { cell: CellId::new(12).ok(), serial: 100_012 };
    Node::unconfigured(identity, format, true, Micros(0))
}

/// Sets the cell's parameters.
#[inline(never)]
pub(crate) fn configure(node: &mut Node, parameters: &Parameters) {
    node.restore(&FlashState::Valid(*parameters));
}

/// Runs a cell until it owns its node id, and applies a force of 3 N. Writes the frames with the joints for it to
/// answer.
pub(crate) fn press(node: &mut Node, joints: Joints, format: Format, frames: &mut Frames) -> Option<()> {
    let mut now = Micros(0);
    for _ in 0..2 {
        now = node.poll_timeout();
        node.handle_timeout(now);
        while node.poll_transmit().is_some() {}
    }
    let skin = SkinSensors { contact: [Q5_10::from_bits(1_024); 3], ..SkinSensors::default() };
    let to = Address::Cell(node.identity().cell?);
    let press = Message::Stimulus { to, from: StimulusStart::Next, page: SensorPage::Skin(skin) };
    press.encode().frames(format).for_each(|frame| node.handle_frame(now, Span(0), &frame));
    let joints = Message::Joints { epoch: Epoch(1), joints }.encode();
    frames.count = joints.frame_count(format);
    for (place, frame) in frames.frames.iter_mut().zip(joints.frames(format)) {
        *place = frame;
    }
    Some(())
}

/// The frames of a packet.
#[derive(Clone, Copy)]
pub(crate) struct Frames {
    frames: [Frame; Length::MAX_SEGMENTS],
    count: usize,
}

impl Frames {
    pub(crate) const NONE: Self = Self { frames: [Frame::EMPTY; Length::MAX_SEGMENTS], count: 0 };
}

/// The time at which joints are answered: after the address claim and before the next heartbeat.
const ANSWER_TIME: Micros = Micros(400_000);

/// Passes the FD frame of joints to the node, and writes the frame of the node's reply to `answer`.
#[inline(never)]
#[unsafe(export_name = "measure_reply")]
pub(crate) extern "C" fn reply(node: &mut Node, joints: &Frames, answer: &mut Frames) {
    let ([joints, ..], [answer, ..]) = (&joints.frames, &mut answer.frames);
    node.handle_frame(ANSWER_TIME, Span(100), joints);
    while let Some(packet) = node.poll_transmit() {
        packet.write_frame(0, Format::Fd, answer);
    }
}

/// Passes the classic frames of joints to the node, and writes the frames of the node's reply to `answer`.
#[inline(never)]
#[unsafe(export_name = "measure_reply_classic")]
pub(crate) extern "C" fn reply_classic(node: &mut Node, joints: &Frames, answer: &mut Frames) {
    for frame in joints.frames.iter().take(joints.count) {
        node.handle_frame(ANSWER_TIME, Span(100), frame);
    }
    while let Some(packet) = node.poll_transmit() {
        for (number, frame) in answer.frames.iter_mut().take(packet.frame_count(Format::Classic)).enumerate()
        {
            packet.write_frame(number, Format::Classic, frame);
        }
    }
}
