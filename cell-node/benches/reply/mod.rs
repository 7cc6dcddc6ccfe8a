//! A pressed cell and the frames of the joints that it answers.

use std::hint::black_box;

use cell_node::flash::FlashState;
use cell_node::identity::Identity;
use cell_node::node::Node;
use protocol::can::{Format, Frame};
use protocol::fixed::{Q1_14, Q3_12, Q5_10};
use protocol::id::{CellId, Node as Address};
use protocol::message::{Joints, Message, SensorPage, SkinSensors, StimulusStart};
use protocol::packet::{Epoch, pad_with_defaults};
use protocol::parameters::{Contact, Parameters, Pose, Row};
use protocol::time::{Micros, Span};

/// The time at which joints are answered: after the address claim and before the next heartbeat.
const ANSWER_TIME: Micros = Micros(400_000);

/// A cell on the last of six joints, pressed with 6 N, and its next joints.
pub(crate) struct PressedCell {
    node: Node,
    format: Format,
    joints: Vec<Frame>,
    reply: Frame,
}

impl PressedCell {
    /// Creates a cell that has answered joints once.
    pub(crate) fn new(format: Format) -> Self {
        let [zero, one] = [0.0, 1.0].map(Q1_14::nearest);
        let contact = Contact { alpha_c: Q3_12::nearest(1.0), ..Contact::default() };
        let pose = Pose { position: [Q1_14::nearest(0.05), zero, zero], normal: [zero, one, zero] };
        let mut parameters =
            Parameters { joint: 6, joints: 6, pose, contact, period_us: 16_000, ..Parameters::default() };
        let link = Row { a: Q1_14::nearest(0.2), ..Row::default() };
        parameters.rows.iter_mut().take(6).for_each(|row| *row = link);
        let identity = Identity { cell: CellId::all().nth(11), serial: 100_012 };
        let mut node = Node::new(identity, format, &FlashState::Valid(parameters), true, Micros(0));
        for _ in 0..2 {
            node.handle_timeout(node.poll_timeout());
            while node.poll_transmit().is_some() {}
        }
        let skin = SkinSensors { contact: [Q5_10::nearest(2.0); 3], ..SkinSensors::default() };
        let page = SensorPage::Skin(skin);
        let press = Message::Stimulus { to: Address::Everyone, from: StimulusStart::Next, page };
        let positions = pad_with_defaults(&[0.3, -1.2, 1.0, -1.4, -0.6, 0.2_f64].map(Q1_14::nearest));
        let frames = |message: Message| message.encode().frames(format).collect();
        let joints =
            |epoch| frames(Message::Joints { epoch: Epoch(epoch), joints: Joints { positions, in_use: 6 } });
        let mut cell = Self { node, format, joints: frames(press), reply: Frame::EMPTY };
        for joints in [joints(1), joints(2)] {
            cell.reply();
            cell.joints = joints;
        }
        cell
    }

    /// Receives the joints. Returns the last frame of the reply; an empty one if there is none.
    pub(crate) fn reply(&mut self) -> &Frame {
        for frame in black_box(&self.joints) {
            self.node.handle_frame(ANSWER_TIME, Span(0), frame);
        }
        while let Some(packet) = self.node.poll_transmit() {
            for number in 0..packet.frame_count(self.format) {
                packet.write_frame(number, self.format, &mut self.reply);
            }
        }
        &self.reply
    }
}
