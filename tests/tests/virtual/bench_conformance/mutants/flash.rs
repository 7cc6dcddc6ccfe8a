//! Cells whose flash loses values, or whose commits change values that they should leave.

use cell_node::flash::FlashState;
use protocol::fixed::{Q, TorqueFormat};
use protocol::message::{Answer, Message, Request, State};
use protocol::parameters::{Parameters, Row, RowKind};

use super::{FaultCase, NODE};
use crate::bench_conformance::wrong::{Memory, beat, fd, with};

/// Returns flash without some of the committed values.
fn loses(flash: FlashState, lose: fn(&mut Parameters)) -> FlashState {
    match flash {
        FlashState::Valid(mut parameters) => {
            lose(&mut parameters);
            FlashState::Valid(parameters)
        }
        other => other,
    }
}

/// Faults at a restart after a commit.
pub(crate) const FLASH: &[FaultCase] = &[
    ("flash takes ten commits and no more", "CONF-8", |it| {
        it.store = |memory, flash| memory.commits.get(9).copied().map_or(flash, FlashState::Valid);
    }),
    ("flash loses the threshold of the force", "CONF-8", |it| {
        it.store = |_, flash| loses(flash, |it| it.contact.force_threshold = Q::ZERO);
    }),
    ("flash loses the gain of the proximity", "CONF-8", |it| {
        it.store = |_, flash| loses(flash, |it| it.contact.alpha_p = Q::ZERO);
    }),
    ("flash loses the torque format", "CONF-8", |it| {
        it.store = |_, flash| loses(flash, |it| it.torque_format = TorqueFormat::Q3_12);
    }),
    ("flash loses row and rows", "CONF-8", |it| {
        it.store = |_, flash| loses(flash, |it| (it.row, it.table_rows) = (0, 0));
    }),
    ("flash loses the kinds of rows", "CONF-8", |it| {
        it.store =
            |_, flash| loses(flash, |it| it.rows.iter_mut().for_each(|row| row.kind = RowKind::Revolute));
    }),
    ("flash loses the rows after the sixth", "CONF-8", |it| {
        it.store = |_, flash| {
            loses(flash, |it| {
                it.rows.iter_mut().skip(6).for_each(|row| *row = Row { kind: row.kind, ..Row::default() })
            })
        };
    }),
    ("flash loses a word of the normal", "CONF-8", |it| {
        it.store = |_, flash| loses(flash, |it| it.pose.normal[1] = Q::ZERO);
    }),
    ("test mode survives a reset", "CONF-9", |it| {
        it.say = |memory, mut message| {
            if let Some(Message::Configure { request: Request::Write { number: 5, words }, .. }) =
                memory.heard
            {
                memory.kept = vec![words];
            }
            let is_on = memory.kept.first().is_some_and(|words| words[0] == 1);
            let claims = beat(&mut message).is_some_and(|beat| beat.state.has(State::CLAIMING_NODE_ID));
            vec![(0, if claims { with(message, State::TEST_MODE, is_on) } else { message })]
        };
    }),
];

/// Adds a request after a commit, whose answer is hidden.
fn commits(
    memory: &mut Memory,
    message: Option<&Message>,
    frame: protocol::can::Frame,
    number: u8,
    words: [i16; 6],
) -> Vec<protocol::can::Frame> {
    match message {
        Some(Message::Configure { to, request: Request::Write { number: 127, words: hash }, .. })
            if memory.staged.hash() == hash[0].cast_unsigned() && memory.settled =>
        {
            memory.count = u64::from(number);
            let request = Request::Write { number, words };
            vec![frame, fd(&Message::Configure { to: *to, tag: 0, request })]
        }
        _ => vec![frame],
    }
}

/// Hides the answer to the request that [`commits`] has added.
fn hides(memory: &mut Memory, message: Message) -> Vec<(u64, Message)> {
    match message {
        Message::Configured { tag: 0, answer: Answer::Value { number, written: true, .. }, .. }
            if memory.count == u64::from(number) =>
        {
            memory.count = 0;
            Vec::new()
        }
        other => vec![(0, other)],
    }
}

/// Faults of a commit, a resume and a write of the mode that change other values.
pub(crate) const LEAVES: &[FaultCase] = &[
    ("a commit clears ACTIVE", "STATE-1", |it| {
        it.say = |memory, message| {
            if matches!(
                message,
                Message::Configured { answer: Answer::Value { number: 127, written: true, .. }, .. }
            ) {
                memory.count = memory.joints as u64 + 1;
            }
            let is_cleared = memory.count == memory.joints as u64 + 1;
            vec![(0, if is_cleared { with(message, State::ACTIVE, false) } else { message })]
        };
    }),
    ("a commit forgets stimuli", "CONF-7", |it| {
        it.hear = |memory, message, frame| commits(memory, message, frame, 5, [1, 0, 0, 0, 0, 0]);
        it.say = hides;
    }),
    ("a commit switches sensor values off", "CONF-7", |it| {
        it.hear = |memory, message, frame| commits(memory, message, frame, 7, [0; 6]);
        it.say = hides;
    }),
    ("a commit resets the thresholds of events", "CONF-7", |it| {
        it.hear = |memory, message, frame| {
            let words = protocol::parameters::Events::default().words();
            commits(memory, message, frame, 8, words)
        };
        it.say = hides;
    }),
    ("a commit clears counters", "CONF-7", |it| {
        it.say = |memory, mut message| {
            if matches!(
                message,
                Message::Configured { answer: Answer::Value { number: 127, written: true, .. }, .. }
            ) {
                memory.count = memory.joints as u64;
            }
            if let Message::Network { page: protocol::message::NetworkPage::Received(page), .. } =
                &mut message
            {
                page.joints = page.joints.saturating_sub(u16::try_from(memory.count % 65_536).unwrap());
            }
            vec![(0, message)]
        };
    }),
    ("a resume forgets stimuli", "CMD-2", |it| {
        it.hear = |memory, message, frame| {
            if message != Some(&Message::Resume) || !memory.settled || !memory.test_mode {
                return vec![frame];
            }
            memory.count = 5;
            let to = protocol::id::Node::Cell(protocol::id::CellId::new(NODE.into()).unwrap());
            let request = Request::Write { number: 5, words: [1, 0, 0, 0, 0, 0] };
            vec![frame, fd(&Message::Configure { to, tag: 0, request })]
        };
        it.say = hides;
    }),
    ("a write of the mode ends a halt", "STATE-3", |it| {
        it.hear = |_, message, frame| match message {
            Some(Message::Configure { request: Request::Write { number: 5, .. }, .. }) => {
                vec![frame, fd(&Message::Resume)]
            }
            _ => vec![frame],
        };
    }),
    ("a commit of everyone is not obeyed", "CONF-11", |it| {
        it.hear = |_, message, frame| match message {
            Some(Message::Configure {
                to: protocol::id::Node::Everyone,
                request: Request::Write { number: 127, .. },
                ..
            }) => Vec::new(),
            _ => vec![frame],
        };
    }),
    ("a mode of everyone is answered and not obeyed", "CONF-11", |it| {
        it.add = |memory| {
            let Some(Message::Configure {
                to: protocol::id::Node::Everyone,
                tag,
                request: Request::Write { number: 5, words },
            }) = memory.heard
            else {
                return Vec::new();
            };
            let from = protocol::id::CellId::new(NODE.into()).unwrap();
            let answer =
                Answer::Value { number: 5, written: true, words: [i16::from(words[0] == 1), 0, 0, 0, 0, 0] };
            vec![Message::Configured { from, tag, answer }]
        };
        it.hear = |_, message, frame| match message {
            Some(Message::Configure {
                to: protocol::id::Node::Everyone,
                request: Request::Write { number: 5, .. },
                ..
            }) => {
                // A frame without an effect.
                vec![protocol::can::Frame::fd(0x003, 1, &[0; 1]).unwrap_or(frame)]
            }
            _ => vec![frame],
        };
    }),
    ("a cell without a configuration reads zeros", "CONF-1", |it| {
        it.say = |memory, message| match message {
            Message::Configured { from, tag, answer: Answer::Value { number: 2, written: false, .. } }
                if memory.commits.is_empty() =>
            {
                let answer = Answer::Value { number: 2, written: false, words: [0; 6] };
                vec![(0, Message::Configured { from, tag, answer })]
            }
            other => vec![(0, other)],
        };
    }),
    ("joints without a configuration are not the last ones", "JOINTS-3", |it| {
        it.say = |memory, mut message| {
            if let Message::Network { epoch, .. } = &mut message
                && memory.commits.is_empty()
            {
                *epoch = protocol::packet::Epoch(0);
            }
            vec![(0, message)]
        };
    }),
];
