//! Cells with wrong heartbeats and a wrong defence of the node id.

use protocol::message::{Message, NetworkPage, State};

use super::{FaultCase, NODE, is_claim};
use crate::bench_conformance::wrong::{Memory, beat, with};

/// Faults of heartbeats.
pub(crate) const BEATS: &[FaultCase] = &[
    ("a heartbeat every 300 ms", "BEAT-1", |it| {
        it.say = |memory, mut message| {
            if beat(&mut message).is_none() || is_asked(memory) || !memory.settled {
                return vec![(0, message)];
            }
            let delay = memory.count * 50_000 % 300_000;
            memory.count += 1;
            if delay == 250_000 { Vec::new() } else { vec![(delay, message)] }
        };
    }),
    ("every third heartbeat is 50 ms late", "BEAT-1", |it| {
        it.say = |memory, mut message| {
            if beat(&mut message).is_none() || is_asked(memory) || !memory.settled {
                return vec![(0, message)];
            }
            memory.count += 1;
            vec![(if memory.count.is_multiple_of(3) { 50_000 } else { 0 }, message)]
        };
    }),
    ("a sync shifts heartbeats", "BEAT-3", |it| {
        it.say = |memory, mut message| {
            if beat(&mut message).is_none() || !memory.settled {
                return vec![(0, message)];
            }
            if is_asked(memory) {
                memory.count = memory.now.elapsed_since(memory.at).0 % 250_000;
                return vec![(0, message)];
            }
            memory.at = memory.now;
            vec![(memory.count, message)]
        };
    }),
    ("heartbeats are 100 ms late while joints come", "BEAT-2", |it| {
        it.say = |memory, mut message| {
            if beat(&mut message).is_some() && matches!(memory.heard, Some(Message::Joints { .. })) {
                return vec![(100_000, message)];
            }
            vec![(0, message)]
        };
    }),
    ("the clock is 3 % slow", "TIME-1", |it| {
        it.say = |memory, mut message| {
            if beat(&mut message).is_none() || is_asked(memory) || !memory.settled {
                return vec![(0, message)];
            }
            vec![(memory.now.0 * 3 / 100 % 250_000, message)]
        };
    }),
    ("sent counts the heartbeat itself", "BEAT-4", |it| {
        it.say = |memory, mut message| {
            memory.count += 1;
            if let Some(beat) = beat(&mut message)
                && memory.count > 9
            {
                beat.sent = beat.sent.wrapping_add(u16::try_from(memory.count % 7).unwrap());
            }
            vec![(0, message)]
        };
    }),
    ("refused leaves out wrong CRCs", "BEAT-4", |it| {
        it.say = |memory, mut message| {
            if let Message::Network { page: NetworkPage::Rejected(page), .. } = message {
                memory.count = page.crc.into();
            }
            if let Some(beat) = beat(&mut message) {
                beat.rejected = beat.rejected.wrapping_sub(u16::try_from(memory.count).unwrap());
            }
            vec![(0, message)]
        };
    }),
    ("the version is 0", "STATE-3", |it| {
        it.say = |_, mut message| {
            if let Some(beat) = beat(&mut message) {
                beat.state = State(beat.state.0 & 0x0FFF);
            }
            vec![(0, message)]
        };
    }),
    ("the joint in the state is that of the first configuration", "STATE-3", |it| {
        it.say = |memory, mut message| {
            let joint = memory.commits.first().map_or(0, |first| u16::from(first.joint));
            if let Some(beat) = beat(&mut message) {
                beat.state = State(beat.state.0 & 0xF0FF | joint << 8);
            }
            vec![(0, message)]
        };
    }),
    ("heartbeats have another serial number than the identity", "ID-1", |it| {
        it.say = |_, mut message| {
            if let Some(beat) = beat(&mut message) {
                beat.serial += 1;
            }
            vec![(0, message)]
        };
    }),
];

/// Returns true if a heartbeat answers a request, false for a regular one.
fn is_asked(memory: &Memory) -> bool {
    matches!(memory.heard, Some(Message::Sync | Message::Network { .. }))
}

/// Faults of a settled cell that receives its own node id.
pub(crate) const CLAIMS: &[FaultCase] = &[
    ("claims are not answered", "CLAIM-6", |it| {
        it.say = |memory, mut message| {
            let is_answer = matches!(memory.heard, Some(Message::Network { .. }));
            if beat(&mut message).is_some() && is_answer { Vec::new() } else { vec![(0, message)] }
        };
    }),
    ("claims with a higher serial number are not answered", "CLAIM-6", |it| {
        it.hear = |_, message, frame| match message {
            Some(Message::Network { page: NetworkPage::Heartbeat(beat), .. })
                if beat.serial > 100_000 + u32::from(NODE) && beat.state.has(State::CLAIMING_NODE_ID) =>
            {
                Vec::new()
            }
            _ => vec![frame],
        };
    }),
    ("DUPLICATE is never set", "CLAIM-7", |it| {
        it.say = |_, message| vec![(0, with(message, State::DUPLICATE, false))];
    }),
    ("DUPLICATE stays for ever", "STATE-2", |it| {
        it.say = |memory, mut message| {
            if beat(&mut message).is_some_and(|beat| beat.state.has(State::DUPLICATE)) {
                memory.count = 1;
            }
            vec![(0, if memory.count == 1 { with(message, State::DUPLICATE, true) } else { message })]
        };
    }),
    ("whatever comes under its node id is answered", "CLAIM-6", |it| {
        it.add = |memory| match memory.heard {
            Some(message @ Message::Network { page, .. }) if memory.settled && !is_claim(Some(&message)) => {
                let mut beat =
                    protocol::message::Heartbeat { serial: 100_000 + u32::from(NODE), ..Default::default() };
                beat.state = State::DUPLICATE.with_flags(State::CONFIGURED, true).with_joint(2);
                let _ = page;
                let from = protocol::id::Node::from_byte(NODE);
                let epoch = memory.last.map(|(epoch, _)| epoch).unwrap_or_default();
                vec![Message::Network { from, epoch, page: NetworkPage::Heartbeat(beat) }]
            }
            _ => Vec::new(),
        };
    }),
    ("each of many claims is answered", "CLAIM-6", |it| {
        it.say = |memory, mut message| {
            if beat(&mut message).is_some() && matches!(memory.heard, Some(Message::Network { .. })) {
                return vec![(0, message), (1_000, message)];
            }
            vec![(0, message)]
        };
    }),
    ("answers to claims are late", "TIME-2", |it| {
        it.say = |memory, mut message| {
            let is_answer = matches!(memory.heard, Some(Message::Network { .. }));
            vec![(if beat(&mut message).is_some() && is_answer { 30_000 } else { 0 }, message)]
        };
    }),
];
