//! Cells that handle halt, resume, sync and report wrongly.

use protocol::message::{Message, NetworkPage, SensorPage, State};
use protocol::packet::Epoch;

use super::{FaultCase, NODE};
use crate::bench_conformance::wrong::with;

/// Faults of halt, resume, sync and report.
pub(crate) const COMMANDS: &[FaultCase] = &[
    ("halt is ignored", "CMD-1", |it| {
        it.hear = |_, message, frame| if message == Some(&Message::Halt) { Vec::new() } else { vec![frame] };
    }),
    ("answers while it is halted", "CMD-1", |it| {
        it.add = |memory| match (memory.heard, memory.torque) {
            (Some(Message::Joints { epoch, .. }), Some(torque)) if memory.halted && !torque.is_zero() => {
                let from = protocol::id::CellId::new(NODE.into()).unwrap();
                vec![Message::Torque { from, epoch, torque }]
            }
            _ => Vec::new(),
        };
    }),
    ("a halted cell takes no joints", "CMD-1", |it| {
        it.hear = |memory, message, frame| match message {
            Some(Message::Joints { .. }) if memory.halted => Vec::new(),
            _ => vec![frame],
        };
    }),
    ("halt does not clear ACTIVE", "STATE-1", |it| {
        it.say = |memory, message| {
            let is_touched = memory.torque.is_some_and(|torque| !torque.is_zero()) && memory.halted;
            vec![(0, if is_touched { with(message, State::ACTIVE, true) } else { message })]
        };
    }),
    ("HALTED is not shown", "STATE-3", |it| {
        it.say = |_, message| vec![(0, with(message, State::HALTED, false))];
    }),
    ("resume is ignored every other time", "CMD-2", |it| {
        it.hear = |memory, message, frame| {
            if message == Some(&Message::Resume) && memory.halted {
                memory.count += 1;
                if memory.count.is_multiple_of(2) {
                    return Vec::new();
                }
            }
            vec![frame]
        };
    }),
    ("the first torque after a resume is an old one", "CMD-2", |it| {
        it.say = |memory, message| match (message, memory.torque) {
            (Message::Torque { from, epoch, torque }, Some(old))
                if memory.count == 1 && !torque.is_zero() =>
            {
                memory.count = 0;
                vec![(0, Message::Torque { from, epoch, torque: old })]
            }
            _ => vec![(0, message)],
        };
        it.hear = |memory, message, frame| {
            if message == Some(&Message::Resume) && memory.halted {
                memory.count = 1;
            }
            vec![frame]
        };
    }),
    ("a resume sends a torque", "CMD-2", |it| {
        it.add = |memory| match (memory.heard, memory.torque, memory.last) {
            (Some(Message::Resume), Some(torque), Some((epoch, _))) => {
                let from = protocol::id::CellId::new(NODE.into()).unwrap();
                vec![Message::Torque { from, epoch, torque }]
            }
            _ => Vec::new(),
        };
    }),
    ("a sync is answered twice", "CMD-3", |it| {
        it.say = |memory, message| {
            let twice = memory.heard == Some(Message::Sync);
            if twice { vec![(0, message), (900, message)] } else { vec![(0, message)] }
        };
    }),
    ("a page of a report is left out", "CMD-4", |it| {
        it.say = |_, message| match message {
            Message::Network { page: NetworkPage::Rejected(_), .. } => Vec::new(),
            other => vec![(0, other)],
        };
    }),
    ("pages of a report come in another order", "CMD-4", |it| {
        it.say = |_, message| match message {
            Message::Network { page: NetworkPage::Received(_), .. } => vec![(200, message)],
            other => vec![(0, other)],
        };
    }),
    ("a report's sensors are those that are pending", "SENSE-2", |it| {
        it.say = |memory, message| match (message, memory.pending.last()) {
            (
                Message::Sensors { from, epoch, page: SensorPage::Skin(_) },
                Some((_, page @ SensorPage::Skin(_))),
            ) => {
                vec![(0, Message::Sensors { from, epoch, page: *page })]
            }
            _ => vec![(0, message)],
        };
    }),
    ("the bytes of one page are swapped", "SENSE-2", |it| {
        it.say = |_, message| match message {
            Message::Sensors { from, epoch, page: SensorPage::Acceleration(words) } => {
                let swapped =
                    words.map(|word| protocol::fixed::Q3_12::from_bits(word.to_bits().swap_bytes()));
                vec![(0, Message::Sensors { from, epoch, page: SensorPage::Acceleration(swapped) })]
            }
            other => vec![(0, other)],
        };
    }),
    ("a halt with words is ignored", "OPT-2", |it| {
        it.hear = |_, message, frame| {
            let is_plain = frame.data().iter().take(14).all(|byte| *byte == 0);
            if message == Some(&Message::Halt) && !is_plain { Vec::new() } else { vec![frame] }
        };
    }),
    ("a halt is answered by a sensors page", "SEND-1", |it| {
        it.add = |memory| match memory.heard {
            Some(Message::Halt) => vec![sensors()],
            _ => Vec::new(),
        };
    }),
];

fn sensors() -> Message {
    let from = protocol::id::CellId::new(NODE.into()).unwrap();
    Message::Sensors {
        from,
        epoch: Epoch(0),
        page: SensorPage::Acceleration([protocol::fixed::Q3_12::ZERO; 3]),
    }
}
