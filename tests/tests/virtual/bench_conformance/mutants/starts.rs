//! Cells with wrong starts and address claims.

use cell_node::flash::FlashState;
use protocol::message::{Answer, Message, NetworkPage, Request, State};
use protocol::time::Micros;

use super::{FaultCase, NODE, is_claim, page_0};
use crate::bench_conformance::wrong::{beat, fd, with};

/// Faults that show at a start.
pub(crate) const STARTS: &[FaultCase] = &[
    ("the first heartbeat has no CLAIMING", "CLAIM-1", |it| {
        it.say = |memory, message| {
            let first = core::mem::replace(&mut memory.at, Micros(1)) == Micros(0);
            vec![(0, if first { with(message, State::CLAIMING_NODE_ID, false) } else { message })]
        };
    }),
    ("sensors pages come before the claim", "CLAIM-1", |it| {
        it.say = |memory, message| {
            let is_new = memory.at == Micros(0) && memory.starts > 1;
            memory.at = Micros(1);
            if is_new { vec![(0, page_0()), (100, message)] } else { vec![(0, message)] }
        };
    }),
    ("a claiming cell answers a sync", "CLAIM-2", |it| {
        it.add = |memory| match memory.heard {
            Some(Message::Sync) if !memory.settled && memory.starts > 1 => vec![page_0()],
            _ => Vec::new(),
        };
    }),
    ("a claiming cell takes no joints", "CLAIM-2", |it| {
        it.hear = |memory, message, frame| match message {
            Some(Message::Joints { .. }) if !memory.settled => Vec::new(),
            _ => vec![frame],
        };
    }),
    ("a claiming cell latches nothing", "STIM-8", |it| {
        it.hear = |memory, message, frame| match message {
            Some(Message::Stimulus { .. }) if !memory.settled => Vec::new(),
            _ => vec![frame],
        };
    }),
    ("a claiming cell gives way to nobody", "CLAIM-3", |it| {
        it.hear = |memory, message, frame| match message {
            Some(Message::Network { .. }) if !memory.settled => Vec::new(),
            _ => vec![frame],
        };
    }),
    ("a claiming cell stays with an equal serial number", "CLAIM-3", |it| {
        it.hear = |memory, message, frame| match message {
            Some(Message::Network { page: NetworkPage::Heartbeat(beat), .. })
                if !memory.settled && beat.serial == 100_000 + u32::from(NODE) =>
            {
                Vec::new()
            }
            _ => vec![frame],
        };
    }),
    ("a claiming cell gives way to claims only", "CLAIM-3", |it| {
        it.hear = |memory, message, frame| match message {
            Some(Message::Network { .. }) if !memory.settled && !is_claim(message) => Vec::new(),
            _ => vec![frame],
        };
    }),
    ("a claiming cell gives way to higher serial numbers too", "CLAIM-3", |it| {
        it.hear = |memory, message, frame| {
            let Some(Message::Network { from, epoch, page: NetworkPage::Heartbeat(beat) }) = message else {
                return vec![frame];
            };
            if memory.settled {
                return vec![frame];
            }
            let page = NetworkPage::Heartbeat(protocol::message::Heartbeat { serial: 0, ..*beat });
            vec![fd(&Message::Network { from: *from, epoch: *epoch, page })]
        };
    }),
    ("a claiming cell does not answer claims", "CLAIM-3", |it| {
        it.say = |memory, mut message| {
            let is_answer = matches!(memory.heard, Some(Message::Network { .. })) && !memory.settled;
            if beat(&mut message).is_some() && is_answer { Vec::new() } else { vec![(0, message)] }
        };
    }),
    ("a cell that gave way goes on", "CLAIM-4", |it| it.yields = false),
    ("claiming ends 80 ms late", "CLAIM-5", |it| {
        it.say = |memory, mut message| {
            let settles = beat(&mut message).is_some_and(|beat| !beat.state.has(State::CLAIMING_NODE_ID));
            let is_first = settles
                && core::mem::replace(&mut memory.count, memory.starts as u64) != memory.starts as u64;
            vec![(if is_first { 80_000 } else { 0 }, message)]
        };
    }),
    ("what was committed is lost in a reset", "CONF-8", |it| it.store = |_, _| FlashState::Empty),
    ("the first configuration comes back after a reset", "CONF-8", |it| {
        it.store = |memory, flash| memory.commits.first().copied().map_or(flash, FlashState::Valid);
    }),
    ("what was only staged survives a reset", "CONF-2", |it| {
        it.hear = |memory, message, frame| {
            if let Some(Message::Configure { request: Request::Write { number: 127, words }, .. }) = message
                && memory.starts > 1
                && memory.staged.hash() != words[0].cast_unsigned()
            {
                memory.count = 1;
            }
            vec![frame]
        };
        it.say = |memory, message| match message {
            Message::Configured { from, tag, answer: Answer::Refused { number: 127, .. } }
                if memory.count == 1 =>
            {
                memory.count = 0;
                let answer = Answer::Value { number: 127, written: true, words: [1, 0, 0, 0, 0, 0] };
                vec![(0, Message::Configured { from, tag, answer })]
            }
            other => vec![(0, other)],
        };
    }),
    ("a volatile parameter survives a reset", "CONF-9", |it| {
        it.say = |memory, message| {
            if let Some(Message::Configure { request: Request::Write { number: 8, words }, .. }) =
                memory.heard
            {
                memory.kept = vec![words];
            }
            match (message, memory.kept.first()) {
                (
                    Message::Configured {
                        from,
                        tag,
                        answer: Answer::Value { number: 8, written: false, .. },
                    },
                    Some(words),
                ) if memory.starts > 1 => {
                    let answer = Answer::Value { number: 8, written: false, words: *words };
                    vec![(0, Message::Configured { from, tag, answer })]
                }
                _ => vec![(0, message)],
            }
        };
    }),
    ("it is silent after a reset", "CLAIM-1", |it| {
        it.say = |memory, message| if memory.starts > 1 { Vec::new() } else { vec![(0, message)] };
    }),
];
