//! Cells that answer joints wrongly.

use protocol::message::{Message, NetworkPage, State};
use protocol::packet::{Epoch, Words};

use super::{FaultCase, NODE, decoded};
use crate::bench_conformance::wrong::{fd, with};

/// Faults with joints and contacts.
pub(crate) const JOINTS: &[FaultCase] = &[
    ("a cell that measures answers everything with zeros", "JOINTS-6", |it| {
        it.add = |memory| match memory.heard {
            Some(Message::Joints { epoch, .. }) if !memory.test_mode && !memory.halted && memory.settled => {
                let from = protocol::id::CellId::new(NODE.into()).unwrap();
                let torque = Words::zeros(protocol::packet::Length::Six);
                vec![Message::Torque { from, epoch, torque }]
            }
            _ => Vec::new(),
        };
    }),
    ("answers one epoch late", "JOINTS-6", |it| {
        it.say = |memory, message| match message {
            Message::Torque { .. } => {
                let before = memory.frame.replace(fd(&message));
                before.and_then(|frame| decoded(&frame)).map(|message| (0, message)).into_iter().collect()
            }
            other => vec![(0, other)],
        };
    }),
    ("a torque has the epoch before", "JOINTS-6", |it| {
        it.say = |_, message| match message {
            Message::Torque { from, epoch, torque } => {
                vec![(0, Message::Torque { from, epoch: epoch.previous(), torque })]
            }
            other => vec![(0, other)],
        };
    }),
    ("answers a repeated epoch", "JOINTS-1", |it| {
        it.add = |memory| match (memory.heard, memory.last, memory.torque) {
            (Some(Message::Joints { epoch, .. }), Some((last, _)), Some(torque)) if epoch == last => {
                let is_again = memory.count == memory.joints as u64 && !torque.is_zero();
                memory.count = memory.joints as u64;
                let from = protocol::id::CellId::new(NODE.into()).unwrap();
                if is_again { vec![Message::Torque { from, epoch, torque }] } else { Vec::new() }
            }
            _ => Vec::new(),
        };
    }),
    ("takes increasing epochs only", "JOINTS-1", |it| {
        it.hear = |memory, message, frame| match (message, memory.last) {
            (Some(Message::Joints { epoch, .. }), Some((last, _))) if epoch.epochs_since(last) < 0 => {
                Vec::new()
            }
            _ => vec![frame],
        };
    }),
    ("takes no epoch that is more than 16 ahead", "JOINTS-1", |it| {
        it.hear = |memory, message, frame| match (message, memory.last) {
            (Some(Message::Joints { epoch, .. }), Some((last, _))) if epoch.epochs_since(last) > 16 => {
                Vec::new()
            }
            _ => vec![frame],
        };
    }),
    ("stops after 256 joints", "JOINTS-6", |it| {
        it.say = |memory, message| match message {
            Message::Torque { .. } if memory.joints > 256 => Vec::new(),
            other => vec![(0, other)],
        };
    }),
    ("does not skip joints that are too old", "JOINTS-4", |it| it.ages = false),
    ("answers joints that it skips", "JOINTS-4", |it| {
        it.ages = false;
        it.say = |memory, mut message| {
            if let Message::Network { page: NetworkPage::Received(page), .. } = &mut message
                && memory.in_use().period_us == 1
            {
                page.joints_late += 1;
            }
            vec![(0, message)]
        };
    }),
    ("a wrong count makes its epoch the last one", "JOINTS-2", |it| {
        it.hear = |memory, message, frame| {
            let Some(Message::Joints { epoch, joints }) = message else { return vec![frame] };
            let is_wrong = joints.in_use != memory.in_use().joints && !memory.commits.is_empty();
            let is_dropped = !is_wrong && memory.count == u64::from(epoch.0) + 1;
            memory.count = if is_wrong { u64::from(epoch.0) + 1 } else { 0 };
            if is_dropped { Vec::new() } else { vec![frame] }
        };
    }),
    ("a wrong count is not looked at", "JOINTS-2", |it| {
        it.hear = |memory, message, frame| {
            let Some(Message::Joints { epoch, joints }) = message else { return vec![frame] };
            let in_use = memory.in_use().joints.max(1);
            let joints = protocol::message::Joints { in_use, ..*joints };
            if joints.in_use <= 6 {
                vec![fd(&Message::Joints { epoch: *epoch, joints })]
            } else {
                vec![frame]
            }
        };
    }),
    ("no zeros after a contact", "JOINTS-6", |it| {
        it.say = |_, message| match message {
            Message::Torque { torque, .. } if torque.is_zero() => Vec::new(),
            other => vec![(0, other)],
        };
    }),
    ("zeros twice after a contact", "JOINTS-6", |it| {
        it.say = |memory, message| {
            if let Message::Torque { torque, .. } = message {
                memory.count = u64::from(torque.is_zero());
            }
            vec![(0, message)]
        };
        it.add = |memory| {
            let Some(Message::Joints { epoch, .. }) = memory.heard else { return Vec::new() };
            memory.count = if memory.count > 0 { memory.count + 1 } else { 0 };
            if memory.count != 3 {
                return Vec::new();
            }
            memory.count = 0;
            let from = protocol::id::CellId::new(NODE.into()).unwrap();
            let torque = Words::zeros(protocol::packet::Length::for_joints(memory.in_use().joints.into()));
            vec![Message::Torque { from, epoch, torque }]
        };
    }),
    ("two torques to the same joints", "JOINTS-6", |it| {
        it.say = |_, message| match message {
            Message::Torque { .. } => vec![(0, message), (300, message)],
            other => vec![(0, other)],
        };
    }),
    ("ACTIVE is never set", "STATE-1", |it| {
        it.say = |_, message| vec![(0, with(message, State::ACTIVE, false))];
    }),
    ("joints without a contact are not counted", "JOINTS-5", |it| {
        it.say = |_, mut message| {
            if let Message::Network { page: NetworkPage::Received(page), .. } = &mut message {
                page.joints = page.joints.wrapping_add(page.joints / 16);
            }
            vec![(0, message)]
        };
    }),
    ("heartbeats have no epoch", "JOINTS-3", |it| {
        it.say = |_, mut message| {
            if let Message::Network { epoch, .. } = &mut message {
                *epoch = Epoch(0);
            }
            vec![(0, message)]
        };
    }),
    ("torques are late", "TIME-2", |it| {
        it.say =
            |_, message| vec![(if matches!(message, Message::Torque { .. }) { 4_700 } else { 0 }, message)];
    }),
    ("a sync is answered before the torque", "CMD-3", |it| {
        it.say =
            |_, message| vec![(if matches!(message, Message::Torque { .. }) { 900 } else { 0 }, message)];
    }),
];
