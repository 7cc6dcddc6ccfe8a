//! Cells that handle reads, writes and commits wrongly.

use protocol::message::{Answer, Message, NetworkPage, Request, State};
use protocol::parameters::Parameter;

use super::{FaultCase, NODE};
use crate::bench_conformance::wrong::{Memory, beat, fd, with};

/// Faults with parameters.
pub(crate) const PARAMETERS: &[FaultCase] = &[
    ("the identity has the hash with the high byte first", "CONF-1", |it| {
        it.say = |_, mut message| {
            if let Message::Configured { answer: Answer::Value { number: 0, words, .. }, .. } = &mut message {
                words[3] = words[3].swap_bytes();
            }
            vec![(0, message)]
        };
    }),
    ("the hash of a commit is not looked at", "CONF-7", |it| {
        it.hear = |memory, message, frame| hashed(memory, message, frame, 0)
    }),
    ("half of a commit's hash is looked at", "CONF-7", |it| {
        it.hear = |memory, message, frame| hashed(memory, message, frame, 0x00FF);
    }),
    ("the other byte of a commit's hash is looked at", "CONF-7", |it| {
        it.hear = |memory, message, frame| hashed(memory, message, frame, 0xFF00);
    }),
    ("a refused write is staged as far as it goes", "CONF-5", |it| {
        it.hear = |memory, message, frame| match message {
            Some(Message::Configure {
                to,
                request: Request::Write { number: 1, words: [k, n, row, rows, format, _] },
                tag,
            }) if !(0..=2).contains(format) && (0..=14).contains(n) && (0..=14).contains(k) => {
                let _ = (row, rows);
                memory.count = 1;
                let request = Request::Write { number: 1, words: [*k, *n, 0, 0, 0, 0] };
                vec![fd(&Message::Configure { to: *to, tag: *tag, request }), frame]
            }
            _ => vec![frame],
        };
        it.say = |memory, message| match message {
            Message::Configured { .. } if memory.count == 1 => {
                memory.count = 0;
                Vec::new()
            }
            other => vec![(0, other)],
        };
    }),
    ("what is staged is read", "CONF-2", |it| {
        it.say = |memory, message| match message {
            Message::Configured { from, tag, answer: Answer::Value { number, written: false, .. } }
                if number != 0 =>
            {
                let parameter = Parameter::from_number(number).filter(|it| it.is_stored());
                let Some(parameter) = parameter else { return vec![(0, message)] };
                let words = memory.staged.words(parameter);
                let answer = Answer::Value { number, written: false, words };
                vec![(0, Message::Configured { from, tag, answer })]
            }
            other => vec![(0, other)],
        };
    }),
    ("the tag does not come back", "CONF-12", |it| {
        it.say = |_, mut message| {
            if let Message::Configured { tag, .. } = &mut message {
                *tag &= 0x7F;
            }
            vec![(0, message)]
        };
    }),
    ("a tag that came before is not answered", "CONF-1", |it| {
        it.hear = |memory, message, frame| {
            if let Some(Message::Configure { tag, request: Request::Read { number: 2 }, .. }) = message {
                let is_again = memory.count == u64::from(*tag) + 1;
                memory.count = u64::from(*tag) + 1;
                if is_again {
                    return Vec::new();
                }
            }
            vec![frame]
        };
    }),
    ("of several reasons another one is given", "CONF-6", |it| {
        it.say = |memory, mut message| {
            if let Message::Configured {
                answer: Answer::Refused { number: 127, reason: reason @ 2..=8 }, ..
            } = &mut message
                && memory.staged.period_us == 0
            {
                *reason = 6;
            }
            vec![(0, message)]
        };
    }),
    ("the hash is looked at before the parameters", "CONF-6", |it| {
        it.say = |_, mut message| {
            if let Message::Configured { answer: Answer::Refused { number: 127, reason }, .. } = &mut message
            {
                *reason = 16;
            }
            vec![(0, message)]
        };
    }),
    ("the normal may have any length", "CONF-6", |it| {
        it.say = |_, mut message| {
            if let Message::Configured {
                answer: Answer::Refused { number: 127, reason: reason @ 4 }, ..
            } = &mut message
            {
                *reason = 16;
            }
            vec![(0, message)]
        };
    }),
    ("an unknown parameter is read as zeros", "CONF-13", |it| {
        it.say = |_, message| match message {
            Message::Configured { from, tag, answer: Answer::Refused { number, reason: 18 } } => {
                let answer = Answer::Value { number, written: false, words: [0; 6] };
                vec![(0, Message::Configured { from, tag, answer })]
            }
            other => vec![(0, other)],
        };
    }),
    ("an unknown parameter is not answered", "CONF-13", |it| {
        it.say = |_, message| match message {
            Message::Configured { answer: Answer::Refused { reason: 18, .. }, .. } => Vec::new(),
            other => vec![(0, other)],
        };
    }),
    ("unused words come back", "CONF-3", |it| {
        it.say = |memory, mut message| {
            if let (
                Some(Message::Configure { request: Request::Write { words: raw, .. }, .. }),
                Message::Configured { answer: Answer::Value { number, words, .. }, .. },
            ) = (memory.heard, &mut message)
                && (1..=4).contains(number)
            {
                words[5] = raw[5];
            }
            vec![(0, message)]
        };
    }),
    ("a write is answered as a read", "CONF-4", |it| {
        it.say = |_, mut message| {
            if let Message::Configured { answer: Answer::Value { written, .. }, .. } = &mut message {
                *written = false;
            }
            vec![(0, message)]
        };
    }),
    ("requests to everyone are not answered", "CONF-11", |it| {
        it.hear = |_, message, frame| match message {
            Some(Message::Configure { to: protocol::id::Node::Everyone, .. }) => Vec::new(),
            _ => vec![frame],
        };
    }),
    ("requests to another cell are answered", "ID-2", |it| {
        it.hear = |_, message, frame| match message {
            Some(Message::Configure { to: protocol::id::Node::Cell(to), tag, request })
                if to.get() == NODE ^ 1 =>
            {
                let own = protocol::id::CellId::new(NODE.into()).unwrap();
                vec![fd(&Message::Configure {
                    to: protocol::id::Node::Cell(own),
                    tag: *tag,
                    request: *request,
                })]
            }
            _ => vec![frame],
        };
    }),
    ("answers are late", "TIME-2", |it| {
        it.say = |_, message| {
            vec![(if matches!(message, Message::Configured { .. }) { 60_000 } else { 0 }, message)]
        };
    }),
    ("one byte of the hash in heartbeats is wrong", "STATE-3", |it| {
        it.say = |_, mut message| {
            if let Some(beat) = beat(&mut message) {
                beat.configuration &= 0x00FF;
            }
            vec![(0, message)]
        };
    }),
    ("refusals are counted", "COUNT-2", |it| {
        it.say = |memory, mut message| {
            if let Message::Configured { answer: Answer::Refused { .. }, .. } = message {
                memory.count += 1;
            }
            let refusals = u16::try_from(memory.count % 65_536).unwrap();
            if let Message::Network { page: NetworkPage::Rejected(page), .. } = &mut message {
                page.meaning = page.meaning.wrapping_add(refusals);
            }
            if let Some(beat) = beat(&mut message) {
                beat.rejected = beat.rejected.wrapping_add(refusals);
            }
            vec![(0, message)]
        };
    }),
    ("a reply of sums is taken without ports", "OPT-1", |it| {
        it.say = |memory, message| accepted(memory, message, 6, 0)
    }),
    ("a slot of 0 is taken", "CONF-10", |it| it.say = |memory, message| accepted(memory, message, 6, 1)),
    ("links go down outside test mode", "LINK-1", |it| {
        it.say = |memory, message| accepted(memory, message, 9, 2)
    }),
    ("a hysteresis below 0 is taken", "SENSE-3", |it| {
        it.say = |memory, message| accepted(memory, message, 8, 3)
    }),
    ("test mode begins with any mode but 0", "CONF-3", |it| {
        it.hear = |_, message, frame| match message {
            Some(Message::Configure { to, tag, request: Request::Write { number: 5, words } })
                if words[0] != 0 =>
            {
                let request = Request::Write { number: 5, words: [1, 0, 0, 0, 0, 0] };
                vec![fd(&Message::Configure { to: *to, tag: *tag, request })]
            }
            _ => vec![frame],
        };
    }),
    ("TEST_MODE is shown late", "CONF-9", |it| {
        it.say = |memory, message| {
            let set = memory.count == 1;
            if beat(&mut message.clone()).is_some() {
                memory.count = u64::from(memory.test_mode);
                return vec![(0, with(message, State::TEST_MODE, set))];
            }
            vec![(0, message)]
        };
    }),
];

/// Corrects the hash of a commit, if it is right in these bits.
fn hashed(
    memory: &Memory,
    message: Option<&Message>,
    frame: protocol::can::Frame,
    bits: u16,
) -> Vec<protocol::can::Frame> {
    match message {
        Some(Message::Configure { to, tag, request: Request::Write { number: 127, words } })
            if (words[0].cast_unsigned() ^ memory.staged.hash()) & bits == 0 =>
        {
            let words = [memory.staged.hash().cast_signed(), 0, 0, 0, 0, 0];
            vec![fd(&Message::Configure {
                to: *to,
                tag: *tag,
                request: Request::Write { number: 127, words },
            })]
        }
        _ => vec![frame],
    }
}

/// Answers a write that has to be refused as if it was accepted.
fn accepted(memory: &Memory, message: Message, of: u8, which: u8) -> Vec<(u64, Message)> {
    let Some(Message::Configure { request: Request::Write { number, words }, .. }) = memory.heard else {
        return vec![(0, message)];
    };
    let is_it = number == of
        && match which {
            0 => words == [1, 500, 3, 1, 0, 0],
            1 => words[0] == 1 && words[1] == 0,
            2 => !memory.test_mode,
            _ => words[4] < 0,
        };
    match message {
        Message::Configured { from, tag, answer: Answer::Refused { reason: 19, .. } } if is_it => {
            let answer = Answer::Value { number, written: true, words };
            vec![(0, Message::Configured { from, tag, answer })]
        }
        other => vec![(0, other)],
    }
}
