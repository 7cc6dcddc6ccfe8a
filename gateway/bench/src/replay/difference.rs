//! A reply that differs from the recorded one, described as text.

use core::fmt::{self, Display, Formatter};

use protocol::fixed::TorqueFormat;
use protocol::id::{CellId, Id, Kind, Node};
use protocol::message::{Answer, Message};
use protocol::packet::{Epoch, Packet, Words};
use protocol::parameters::MAX_JOINTS;
use protocol::schema::BusUnits;
use protocol::skin::JointKind;
use serde::Serialize;

use super::comparator::OwnContribution;
use model::decode::Decoded;

/// Kind of a reply to joints.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd)]
pub enum ReplyKind {
    /// A torque packet.
    Torque,
    /// A sensor packet with this page.
    Sensors(u8),
}

/// Kind of a difference.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum DifferenceKind {
    /// The words of the reply differ from the recorded ones.
    Different,
    /// The reply did not come.
    Missing,
    /// The reply was not recorded.
    Extra,
}

/// A value that a cell sent: the words of a reply, a sum, or an answer.
#[derive(Clone, Debug, PartialEq)]
pub enum SentValue {
    /// Words of a reply to joints.
    Words(ReplyKind, Words),
    /// A sum, with the cell's own contribution to it.
    Sum(OwnContribution),
    /// An answer to `configure`, with its tag.
    Answer(u8, Answer),
}

/// Position of joints in a recording.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct RecordingPosition {
    /// Number of the joints among the replayed joints of the bus, from 0.
    pub joints: u64,
    /// Epoch of the joints.
    pub epoch: u8,
    /// Time of the joints in s after the recording's first frame.
    pub at_s: f64,
}

/// A reply that differs from the recorded one.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// Kind of the difference.
    pub how: DifferenceKind,
    /// Present name of the bus.
    pub bus: String,
    /// Node id of the cell.
    pub cell: u8,
    /// Position of the joints that the reply answers, if it answers any.
    #[serde(flatten)]
    pub when: Option<RecordingPosition>,
    /// Text for people, in several lines.
    pub text: String,
}

impl Difference {
    /// Describes the difference between the values that a cell sent in the recording and in this replay.
    #[must_use]
    pub fn new(
        how: DifferenceKind,
        (bus, units): (&str, BusUnits),
        cell: CellId,
        when: Option<RecordingPosition>,
        recorded: Option<&SentValue>,
        now: Option<&SentValue>,
    ) -> Self {
        let what = match how {
            DifferenceKind::Different => "difference",
            DifferenceKind::Missing => "missing reply",
            DifferenceKind::Extra => "extra reply",
        };
        let joints = when.map_or_else(String::new, |RecordingPosition { joints, epoch, at_s }| {
            format!(", joints message {joints} (epoch {epoch}, {at_s:.3} s into the recording)")
        });
        let epoch = Epoch(when.map_or(0, |when| when.epoch));
        let shown = |said: Option<&SentValue>| {
            said.map_or_else(|| "nothing".to_owned(), |said| said.value_text(cell, epoch, units))
        };
        let mut text = format!(
            "the first {what}: cell {cell} on {bus}{joints}\n  recorded  {}\n  now       {}",
            shown(recorded),
            shown(now)
        );
        if let Some(((recorded, format), (now, _))) = recorded
            .and_then(|said| said.torque_steps(units))
            .zip(now.and_then(|said| said.torque_steps(units)))
        {
            text += &format!("\n  {}", StepDifferences { recorded, now, format, units });
        }
        Self { how, bus: bus.to_owned(), cell: cell.get(), when, text }
    }
}

impl SentValue {
    /// Formats the value as the text of a message.
    fn value_text(&self, cell: CellId, epoch: Epoch, units: BusUnits) -> String {
        match self {
            &Self::Words(what, words) => {
                let (kind, count) = match what {
                    ReplyKind::Torque => (Kind::Torque, 1),
                    ReplyKind::Sensors(page) => (Kind::Sensors, page),
                };
                let packet = Packet { id: Id::new(kind, Node::Cell(cell)), words, epoch, count };
                Message::decode(&packet)
                    .map_or_else(|error| error.to_string(), |message| message_text(message, units))
            }
            Self::Sum(own) => sum_text(cell, epoch, own, units),
            &Self::Answer(tag, answer) => {
                message_text(Message::Configured { from: cell, tag, answer }, units)
            }
        }
    }

    /// Returns the torques in steps, with `None` for saturated words, and their format.
    fn torque_steps(&self, units: BusUnits) -> Option<([Option<i32>; MAX_JOINTS], TorqueFormat)> {
        match self {
            Self::Words(ReplyKind::Torque, words) => {
                Some((words.padded().map(|word| Some(word.into())), units.torque_format()))
            }
            Self::Sum(own) => Some((own.steps, TorqueFormat::Q7_8)),
            Self::Words(ReplyKind::Sensors(_), ..) | Self::Answer(..) => None,
        }
    }
}

/// Formats a sum, the children whose sums it contains, and the cell's own contribution.
fn sum_text(cell: CellId, epoch: Epoch, own: &OwnContribution, units: BusUnits) -> String {
    let sum = Message::Sum { from: cell, epoch, torque: own.sum, count: own.count };
    let children: Vec<_> = own.children.iter().map(ToString::to_string).collect();
    let less = match children.as_slice() {
        [] => "without children".to_owned(),
        [one] => format!("without its child {one}"),
        several => format!("without its children {}", several.join(", ")),
    };
    let word = |(joint, step): (usize, &Option<i32>)| match (step, units.torque_unit(joint)) {
        (None, _) => " saturated".to_owned(),
        (Some(step), unit) => {
            let value = f64::from(*step) * TorqueFormat::Q7_8.step_size();
            if unit == JointKind::Revolute.torque_unit() {
                format!(" {value:.3}")
            } else {
                format!(" {value:.3} {unit}")
            }
        }
    };
    let words: String = own.steps.iter().take(own.sum.length().words()).enumerate().map(word).collect();
    format!("{}; {less}:{words} Nm", message_text(sum, units))
}

/// Formats a message as text, without the verdict on its frame.
fn message_text(message: Message, units: BusUnits) -> String {
    let text = Decoded::Message(message).in_units(units).to_string();
    text.split_once(' ').map_or(String::new(), |(_, text)| text.trim_start().to_owned())
}

/// Formats the differences between torques: `joint 1: 2 steps higher (0.0005 Nm), joint 3: ...`.
struct StepDifferences {
    recorded: [Option<i32>; MAX_JOINTS],
    now: [Option<i32>; MAX_JOINTS],
    format: TorqueFormat,
    units: BusUnits,
}

impl Display for StepDifferences {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let mut comma = "";
        for (index, (&recorded, &now)) in self.recorded.iter().zip(&self.now).enumerate() {
            let joint = index + 1;
            let steps = now.unwrap_or(0) - recorded.unwrap_or(0);
            if now.is_none() != recorded.is_none() {
                let when = if now.is_none() { "now" } else { "in the recording" };
                write!(f, "{comma}joint {joint}: saturated {when}")?;
            } else if steps != 0 {
                let (count, way) = (steps.unsigned_abs(), if steps > 0 { "higher" } else { "lower" });
                let steps = if count == 1 { "step" } else { "steps" };
                let (value, unit) =
                    (f64::from(count) * self.format.step_size(), self.units.torque_unit(index));
                write!(f, "{comma}joint {joint}: {count} {steps} {way} ({value:.4} {unit})")?;
            } else {
                continue;
            }
            comma = ", ";
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_different_torque_is_shown_word_by_word() {
        let torque = |words: [i16; 6]| SentValue::Words(ReplyKind::Torque, words.into());
        let (recorded, now) = (torque([-1075, 3195, 0, 0, 0, 0]), torque([-1074, 3193, 0, 0, 0, 0]));
        let when = Some(RecordingPosition { joints: 37, epoch: 7, at_s: 2.3842 });
        let cell = CellId::new(12).unwrap();
        let difference = Difference::new(
            DifferenceKind::Different,
            ("vcan0", BusUnits::default()),
            cell,
            when,
            Some(&recorded),
            Some(&now),
        );
        let expected =
            "the first difference: cell 12 on vcan0, joints message 37 (epoch 7, 2.384 s into the recording)
  recorded  torque 12 epoch 7: -0.2625 0.7800 0.0000 0.0000 0.0000 0.0000 Nm
  now       torque 12 epoch 7: -0.2622 0.7795 0.0000 0.0000 0.0000 0.0000 Nm
  joint 1: 1 step higher (0.0002 Nm), joint 2: 2 steps lower (0.0005 Nm)";
        assert_eq!(difference.text, expected);
    }

    #[test]
    fn a_reply_that_was_not_sent_is_nothing() {
        let refused =
            SentValue::Answer(9, Answer::Refused { number: 127, reason: Answer::REFUSED_WRONG_HASH });
        let cell = CellId::new(3).unwrap();
        let text = Difference::new(
            DifferenceKind::Missing,
            ("can1", BusUnits::default()),
            cell,
            None,
            Some(&refused),
            None,
        )
        .text;
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(lines.len(), 3, "{text}");
        assert_eq!(lines[0], "the first missing reply: cell 3 on can1");
        assert!(lines[1].starts_with("  recorded  configured 3 tag 9: refuses "), "{text}");
        assert_eq!(lines[2], "  now       nothing");
    }
}
