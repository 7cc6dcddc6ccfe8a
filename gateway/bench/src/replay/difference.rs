//! One reply that is not as it was recorded, for people.

use core::fmt::{self, Display, Formatter};

use protocol::fixed::{Q3_12, Q7_8};
use protocol::id::{CellId, Id, Kind, Node};
use protocol::message::{Answer, Message};
use protocol::packet::{Epoch, Packet, WORDS};
use serde::Serialize;

use super::judge::Own;
use model::decode::Decoded;

/// A reply to joints.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd)]
pub enum What {
    /// A torque.
    Torque,
    /// What a cell feels, page 0.
    Skin,
    /// What it feels, page 1.
    Acceleration,
}

/// How it is not as it was recorded.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum How {
    /// Other words.
    Different,
    /// It did not come.
    Missing,
    /// It was not recorded.
    Extra,
}

/// What was said, as far as anything was.
#[derive(Clone, Debug, PartialEq)]
pub enum Said {
    /// The words of a reply to joints.
    Words {
        /// Which reply.
        what: What,
        /// In the recording.
        recorded: Option<[i16; WORDS]>,
        /// Now.
        now: Option<[i16; WORDS]>,
    },
    /// Sums, and what is left of them without those of the children.
    Sums {
        /// In the recording.
        recorded: Option<Own>,
        /// Now.
        now: Option<Own>,
    },
    /// Answers to `configure`, with their tags.
    Answers {
        /// In the recording.
        recorded: Option<(u8, Answer)>,
        /// Now.
        now: Option<(u8, Answer)>,
    },
}

/// Some joints of a recording.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct When {
    /// Which of the replayed ones on their bus, from 0.
    pub joints: u64,
    /// Their epoch.
    pub epoch: u8,
    /// When they came, in s after the recording's first frame.
    pub at_s: f64,
}

/// A reply that is not as it was recorded. Displayed in several lines.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// How.
    pub how: How,
    /// The bus, as it is called now.
    pub bus: String,
    /// The cell.
    pub cell: CellId,
    /// The joints that it answers, if it answers joints.
    pub when: Option<When>,
    /// What was said.
    pub said: Said,
}

impl Difference {
    /// The reply as a message would say it.
    fn told(&self, words: [i16; WORDS], what: What) -> String {
        let epoch = Epoch(self.when.map_or(0, |when| when.epoch));
        let (kind, count) = match what {
            What::Torque => (Kind::Torque, 1),
            What::Skin => (Kind::Sensors, 0),
            What::Acceleration => (Kind::Sensors, 1),
        };
        let packet = Packet { id: Id::new(kind, Node::Cell(self.cell)), words, epoch, count };
        Message::decode(&packet).map_or_else(|error| error.to_string(), meaning)
    }

    /// A sum, its children, and what the cell itself put into it.
    fn summed(&self, own: &Own) -> String {
        let epoch = Epoch(self.when.map_or(0, |when| when.epoch));
        let sum = Message::Sum { from: self.cell, epoch, torque: own.sum, count: own.count };
        let children: Vec<_> = own.children.iter().map(ToString::to_string).collect();
        let less = match children.as_slice() {
            [] => "no children".to_owned(),
            [one] => format!("less its child {one}"),
            several => format!("less its children {}", several.join(", ")),
        };
        let word = |step: &Option<i32>| match step {
            Some(step) => format!(" {:.3}", f64::from(*step) * Q7_8::from_bits(1).to_f64()),
            None => " saturated".to_owned(),
        };
        let words: String = own.steps.iter().map(word).collect();
        format!("{}; {less}:{words} Nm", meaning(sum))
    }

    fn answered(&self, (tag, answer): (u8, Answer)) -> String {
        meaning(Message::Configured { from: self.cell, tag, answer })
    }
}

/// A message in words, without the verdict.
fn meaning(message: Message) -> String {
    let text = Decoded::Message(message).to_string();
    text.split_once(' ').map_or(String::new(), |(_, text)| text.trim_start().to_owned())
}

impl Display for Difference {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let (cell, bus) = (self.cell, &self.bus);
        match self.how {
            How::Different => write!(f, "the first difference: cell {cell} on {bus}")?,
            How::Missing => write!(f, "the first missing reply: cell {cell} on {bus}")?,
            How::Extra => write!(f, "the first extra reply: cell {cell} on {bus}")?,
        }
        if let Some(When { joints, epoch, at_s }) = self.when {
            write!(f, ", joints {joints} (epoch {epoch}, {at_s:.3} s into the recording)")?;
        }
        let (recorded, now) = match &self.said {
            &Said::Words { what, recorded, now } => {
                (recorded.map(|words| self.told(words, what)), now.map(|words| self.told(words, what)))
            }
            Said::Sums { recorded, now } => {
                let told = |own: &Option<Own>| own.as_ref().map(|own| self.summed(own));
                (told(recorded), told(now))
            }
            &Said::Answers { recorded, now } => {
                (recorded.map(|answer| self.answered(answer)), now.map(|answer| self.answered(answer)))
            }
        };
        let nothing = || "nothing".to_owned();
        write!(f, "\n  recorded  {}", recorded.unwrap_or_else(nothing))?;
        write!(f, "\n  now       {}", now.unwrap_or_else(nothing))?;
        if let Said::Words { what: What::Torque, recorded: Some(recorded), now: Some(now) } = self.said {
            let steps = |words: [i16; WORDS]| words.map(|word| Some(i32::from(word)));
            write!(f, "\n  {}", Steps(steps(recorded), steps(now), Q3_12::from_bits(1).to_f64()))?;
        }
        if let Said::Sums { recorded: Some(recorded), now: Some(now) } = &self.said {
            write!(f, "\n  {}", Steps(recorded.steps, now.steps, Q7_8::from_bits(1).to_f64()))?;
        }
        Ok(())
    }
}

/// By how much torques differ: `joint 1: 2 steps more (0.0005 Nm), joint 3: ...`.
struct Steps([Option<i32>; WORDS], [Option<i32>; WORDS], f64);

impl Display for Steps {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let mut comma = "";
        for (joint, (&recorded, &now)) in (1..).zip(self.0.iter().zip(&self.1)) {
            let steps = now.unwrap_or(0) - recorded.unwrap_or(0);
            if now.is_none() != recorded.is_none() {
                let when = if now.is_none() { "now" } else { "then" };
                write!(f, "{comma}joint {joint}: saturated {when}")?;
                comma = ", ";
                continue;
            }
            if steps == 0 {
                continue;
            }
            let (count, way) = (steps.unsigned_abs(), if steps > 0 { "more" } else { "less" });
            let unit = if count == 1 { "step" } else { "steps" };
            let nm = f64::from(count) * self.2;
            write!(f, "{comma}joint {joint}: {count} {unit} {way} ({nm:.4} Nm)")?;
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
        let difference = Difference {
            how: How::Different,
            bus: "vcan0".to_owned(),
            cell: CellId::new(12).unwrap(),
            when: Some(When { joints: 37, epoch: 7, at_s: 2.3842 }),
            said: Said::Words {
                what: What::Torque,
                recorded: Some([-1075, 3195, 0, 0, 0, 0]),
                now: Some([-1074, 3193, 0, 0, 0, 0]),
            },
        };
        let expected =
            "the first difference: cell 12 on vcan0, joints 37 (epoch 7, 2.384 s into the recording)
  recorded  torque 12 epoch 7: -0.2625 0.7800 0.0000 0.0000 0.0000 0.0000 Nm
  now       torque 12 epoch 7: -0.2622 0.7795 0.0000 0.0000 0.0000 0.0000 Nm
  joint 1: 1 step more (0.0002 Nm), joint 2: 2 steps less (0.0005 Nm)";
        assert_eq!(difference.to_string(), expected);
    }

    #[test]
    fn what_was_not_said_is_nothing() {
        let difference = Difference {
            how: How::Missing,
            bus: "can1".to_owned(),
            cell: CellId::new(3).unwrap(),
            when: None,
            said: Said::Answers {
                recorded: Some((9, Answer::Refused { number: 127, reason: Answer::WRONG_HASH })),
                now: None,
            },
        };
        let text = difference.to_string();
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(lines.len(), 3, "{text}");
        assert_eq!(lines[0], "the first missing reply: cell 3 on can1");
        assert!(lines[1].starts_with("  recorded  configured 3 tag 9: refuses "), "{text}");
        assert_eq!(lines[2], "  now       nothing");
    }
}
