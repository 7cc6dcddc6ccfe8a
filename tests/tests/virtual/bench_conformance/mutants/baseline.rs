//! Cells that find, track, hold or report the zero wrongly.

use protocol::fixed::{Q, Q5_10};
use protocol::message::{Answer, Message, Request, SensorPage, SkinSensors};
use protocol::touch::contact_force;

use super::FaultCase;
use crate::bench_conformance::wrong::Memory;

/// Faults of the baseline.
pub(crate) const BASELINE: &[FaultCase] = &[
    ("a threshold of 0 is accepted", "BASE-1", |it| {
        it.say = |memory, message| {
            let written = match memory.heard {
                Some(Message::Configure { request: Request::Write { number: 11, words }, .. }) => Some(words),
                _ => None,
            };
            match (message, written) {
                (Message::Configured { from, tag, answer: Answer::Refused { .. } }, Some(words))
                    if words[1] == 0 =>
                {
                    let answer = Answer::Value { number: 11, written: true, words };
                    vec![(0, Message::Configured { from, tag, answer })]
                }
                _ => vec![(0, message)],
            }
        };
    }),
    ("a touch at the start is taken for the zero", "BASE-2", |it| {
        // Readings beyond the limit reach the cell as smaller ones, until another rule is written.
        it.say = |memory, message| {
            page_0(memory, message, |memory, skin| {
                if contact_force(&memory.latched) == 700 {
                    skin.contact = [Q::ZERO; 3];
                }
            })
        };
    }),
    ("the zero follows a touch", "BASE-3", |it| {
        it.say = |memory, message| {
            page_0(memory, message, |memory, skin| {
                let sum = contact_force(&memory.latched);
                memory.count = if sum == 1_024 { memory.count + 1 } else { 0 };
                if memory.count > 1 && sum == 1_024 {
                    skin.contact[0] = Q5_10::from_bits(skin.contact[0].to_bits() - 100);
                }
            })
        };
    }),
    ("the zero follows four times as quickly", "BASE-4", |it| {
        it.say = |_, mut message| {
            if let Message::Sensors { page: SensorPage::Baseline(page), .. } = &mut message {
                page.zero = Q5_10::from_bits(page.zero.to_bits().saturating_mul(4));
            }
            vec![(0, message)]
        };
    }),
    ("the zero does not follow", "BASE-4", |it| {
        it.say = |_, mut message| {
            if let Message::Sensors { page: SensorPage::Baseline(page), .. } = &mut message {
                page.zero = Q5_10::from_bits(if page.zero.to_bits() < 60 { 0 } else { page.zero.to_bits() });
            }
            vec![(0, message)]
        };
    }),
    ("the temperature does not move the zero in contact", "BASE-5", |it| {
        it.say = |memory, message| {
            page_0(memory, message, |memory, skin| {
                let [temperature, _] = memory.latched.temperature;
                if contact_force(&memory.latched) == 1_024 && temperature.to_bits() != 25 << 6 {
                    skin.contact = memory.latched.contact;
                }
            })
        };
    }),
    ("a tare while touched is accepted", "BASE-6", |it| {
        it.say = |_, message| match message {
            Message::Configured { from, tag, answer: Answer::Refused { number: 12, reason: 20 } } => {
                let answer = Answer::Value { number: 12, written: true, words: [1, 0, 0, 0, 0, 0] };
                vec![(0, Message::Configured { from, tag, answer })]
            }
            _ => vec![(0, message)],
        };
    }),
    ("the limit of a tare is not kept", "BASE-6", |it| {
        it.say = |_, message| match message {
            Message::Configured { from, tag, answer: Answer::Refused { number: 12, reason: 21 } } => {
                let answer = Answer::Value { number: 12, written: true, words: [1, 0, 0, 0, 0, 0] };
                vec![(0, Message::Configured { from, tag, answer })]
            }
            _ => vec![(0, message)],
        };
    }),
    ("refused tares are not counted", "BASE-6", |it| {
        it.say = |_, mut message| {
            if let Message::Sensors { page: SensorPage::Baseline(page), .. } = &mut message {
                page.refused = 0;
            }
            vec![(0, message)]
        };
    }),
    ("no page 3 goes with heartbeats", "BASE-7", |it| {
        it.say = |memory, message| {
            let is_zero = matches!(message, Message::Sensors { page: SensorPage::Baseline(_), .. });
            if memory.heard.is_none() && is_zero { Vec::new() } else { vec![(0, message)] }
        };
    }),
    ("a touch brings no page 3", "BASE-7", |it| {
        it.say = |memory, message| {
            let is_zero = matches!(message, Message::Sensors { page: SensorPage::Baseline(_), .. });
            let is_event = matches!(memory.heard, Some(Message::Joints { .. }));
            if is_event && is_zero { Vec::new() } else { vec![(0, message)] }
        };
    }),
    ("one word bears all of the zero", "BASE-8", |it| {
        it.say = |memory, message| {
            page_0(memory, message, |memory, skin| {
                let raw = memory.latched.contact;
                let rest = raw[2].to_bits() - skin.contact[2].to_bits() + raw[1].to_bits()
                    - skin.contact[1].to_bits();
                skin.contact = [Q5_10::from_bits(skin.contact[0].to_bits() - rest), raw[1], raw[2]];
            })
        };
    }),
];

/// Changes page 0 of a report.
fn page_0(
    memory: &mut Memory,
    mut message: Message,
    change: fn(&mut Memory, &mut SkinSensors),
) -> Vec<(u64, Message)> {
    if let (Some(Message::Report), Message::Sensors { page: SensorPage::Skin(skin), .. }) =
        (memory.heard, &mut message)
    {
        change(memory, skin);
    }
    vec![(0, message)]
}
