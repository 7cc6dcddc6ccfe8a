//! Cells that send sensors pages without a request wrongly.

use protocol::message::{Answer, Message, Request, SensorPage};

use super::{FaultCase, page_0};

/// Faults with sensor values without a request.
pub(crate) const SENSING: &[FaultCase] = &[
    ("a switch sends no pages", "SENSE-4", |it| {
        it.say = |memory, message| {
            let is_switch = matches!(memory.heard, Some(Message::Configure { .. }));
            if is_switch && matches!(message, Message::Sensors { .. }) {
                Vec::new()
            } else {
                vec![(0, message)]
            }
        };
    }),
    ("the same mode again sends pages", "SENSE-4", |it| {
        it.say = |memory, message| match (memory.heard, message) {
            (
                Some(Message::Configure { request: Request::Write { number: 7, words: [2, ..] }, .. }),
                Message::Configured { answer: Answer::Value { .. }, .. },
            ) => {
                let was_on = core::mem::replace(&mut memory.count, 1) == 1;
                if was_on { vec![(0, message), (100, page_0())] } else { vec![(0, message)] }
            }
            (
                Some(Message::Configure { request: Request::Write { number: 7, .. }, .. }),
                Message::Configured { .. },
            ) => {
                memory.count = 0;
                vec![(0, message)]
            }
            _ => vec![(0, message)],
        };
    }),
    ("continuous pages are 40 ms late", "SENSE-5", |it| {
        it.say = |memory, message| {
            let is_late = memory.heard.is_none() && matches!(message, Message::Sensors { .. });
            vec![(if is_late { 40_000 } else { 0 }, message)]
        };
    }),
    ("pages follow joints", "SENSE-6", |it| {
        it.say = |memory, message| {
            if let (
                Some(Message::Configure { request: Request::Write { number: 7, words }, .. }),
                Message::Configured { .. },
            ) = (memory.heard, message)
            {
                memory.count = u64::from(words[0] == 1 && words[1] == 16);
            }
            vec![(0, message)]
        };
        it.add = |memory| match memory.heard {
            Some(Message::Joints { .. }) if memory.count == 1 => vec![page_0()],
            _ => Vec::new(),
        };
    }),
    ("some events are not sent", "SENSE-7", |it| {
        it.say = |memory, message| {
            let is_event = matches!(memory.heard, Some(Message::Joints { .. }));
            if is_event && matches!(message, Message::Sensors { .. }) {
                memory.count += 1;
                if memory.count.is_multiple_of(9) {
                    return Vec::new();
                }
            }
            vec![(0, message)]
        };
    }),
    ("the end of a soft touch is not sent", "SENSE-9", |it| {
        it.say = |memory, message| match (memory.heard, message) {
            (Some(Message::Joints { .. }), Message::Sensors { page: SensorPage::Skin(skin), .. })
                if skin.contact.iter().all(|word| word.to_bits() == 0) =>
            {
                Vec::new()
            }
            _ => vec![(0, message)],
        };
    }),
    ("a page comes before its torque", "TIME-3", |it| {
        it.say = |memory, message| {
            let is_first = matches!(memory.heard, Some(Message::Joints { .. }))
                && matches!(message, Message::Torque { .. });
            vec![(if is_first { 400 } else { 0 }, message)]
        };
    }),
    ("no page follows a heartbeat", "SENSE-10", |it| {
        it.say = |memory, message| {
            let is_it = memory.heard.is_none() && matches!(message, Message::Sensors { .. });
            if is_it { Vec::new() } else { vec![(0, message)] }
        };
    }),
    ("page 1 follows no heartbeat", "SENSE-10", |it| {
        it.say = |memory, message| {
            let is_1 = matches!(message, Message::Sensors { page: SensorPage::Acceleration(_), .. });
            if memory.heard.is_none() && is_1 { Vec::new() } else { vec![(0, message)] }
        };
    }),
    ("a halted cell sends no events", "SENSE-11", |it| {
        it.say = |memory, message| {
            let is_event = memory.halted && matches!(memory.heard, Some(Message::Joints { .. }));
            if is_event && matches!(message, Message::Sensors { .. }) {
                Vec::new()
            } else {
                vec![(0, message)]
            }
        };
    }),
    ("what answers a report is not what was sent last", "SENSE-8", |it| {
        it.hear = |memory, message, frame| {
            // A hidden page restores the values before the report.
            if message == Some(&Message::Report) {
                memory.count = 3;
            }
            vec![frame]
        };
        it.say = |memory, message| match (memory.heard, message) {
            (Some(Message::Joints { .. }), Message::Sensors { .. }) if memory.count > 0 => {
                memory.count -= 1;
                Vec::new()
            }
            _ => vec![(0, message)],
        };
    }),
    ("pages of a report are left out in event mode", "SENSE-1", |it| {
        it.say = |memory, message| {
            let is_1 = matches!(message, Message::Sensors { page: SensorPage::Acceleration(_), .. });
            if memory.heard == Some(Message::Report) && is_1 { Vec::new() } else { vec![(0, message)] }
        };
    }),
];
