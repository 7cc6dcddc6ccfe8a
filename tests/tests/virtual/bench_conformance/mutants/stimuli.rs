//! Cells that latch stimuli wrongly.

use protocol::message::{Message, NetworkPage, Request, SensorPage};
use protocol::packet::Epoch;

use super::{FaultCase, NODE};
use crate::bench_conformance::wrong::fd;

/// Faults with stimuli.
pub(crate) const STIMULI: &[FaultCase] = &[
    ("stimuli of later epochs are latched at once", "STIM-3", |it| {
        it.hear = |_, message, frame| match message {
            Some(Message::Stimulus { to, page, .. }) => {
                vec![fd(&Message::Stimulus {
                    to: *to,
                    from: protocol::message::StimulusStart::Next,
                    page: *page,
                })]
            }
            _ => vec![frame],
        };
    }),
    ("epochs of stimuli are compared without a corner", "STIM-3", |it| {
        it.hear = |memory, message, frame| match (message, memory.last) {
            (
                Some(Message::Stimulus { to, from: protocol::message::StimulusStart::Epoch(first), page }),
                Some((last, _)),
            ) if first.0 < last.0 => {
                vec![fd(&Message::Stimulus {
                    to: *to,
                    from: protocol::message::StimulusStart::Next,
                    page: *page,
                })]
            }
            _ => vec![frame],
        };
    }),
    ("stimuli from the next joints on have an epoch", "STIM-4", |it| {
        it.hear = |_, message, frame| match message {
            Some(Message::Stimulus { to, from: protocol::message::StimulusStart::Next, page })
                if frame.data()[12] != 0 =>
            {
                let from = protocol::message::StimulusStart::Epoch(Epoch(frame.data()[12]));
                vec![fd(&Message::Stimulus { to: *to, from, page: *page })]
            }
            _ => vec![frame],
        };
    }),
    ("late stimuli are dropped", "STIM-5", |it| {
        it.hear = |memory, message, frame| match (message, memory.last) {
            (
                Some(Message::Stimulus { from: protocol::message::StimulusStart::Epoch(first), .. }),
                Some((last, _)),
            ) if last.epochs_since(*first) >= 0 => Vec::new(),
            _ => vec![frame],
        };
    }),
    ("late stimuli are not counted as late", "STIM-5", |it| {
        it.say = |_, mut message| {
            if let Message::Network { page: NetworkPage::Received(page), .. } = &mut message {
                page.stimuli_late = 0;
            }
            vec![(0, message)]
        };
    }),
    ("7 stimuli can be pending", "STIM-6", |it| {
        it.hear = |memory, message, frame| match message {
            Some(Message::Stimulus { .. }) if memory.pending.len() >= 7 => Vec::new(),
            _ => vec![frame],
        };
    }),
    ("a stimulus holds for one epoch", "STIM-7", |it| {
        it.hear = |memory, message, frame| match message {
            Some(Message::Joints { .. }) if memory.pending.is_empty() && memory.test_mode => {
                let own = protocol::id::Node::Cell(protocol::id::CellId::new(NODE.into()).unwrap());
                let page = SensorPage::Skin(protocol::message::SkinSensors::default());
                vec![
                    fd(&Message::Stimulus { to: own, from: protocol::message::StimulusStart::Next, page }),
                    frame,
                ]
            }
            _ => vec![frame],
        };
    }),
    ("of two stimuli the first remains", "STIM-7", |it| {
        it.hear = |memory, message, frame| match message {
            Some(Message::Stimulus { page: SensorPage::Skin(_), .. })
                if memory.pending.iter().any(|(_, page)| matches!(page, SensorPage::Skin(_)))
                    && memory.pending.len() < 3 =>
            {
                Vec::new()
            }
            _ => vec![frame],
        };
    }),
    ("the mode forgets no pending stimuli", "STIM-2", |it| {
        it.hear = |memory, message, frame| match message {
            Some(Message::Configure {
                request: Request::Write { number: 5, words: [1, ..] }, to, ..
            }) => {
                let again = memory
                    .pending
                    .iter()
                    .map(|(from, page)| fd(&Message::Stimulus { to: *to, from: *from, page: *page }));
                core::iter::once(frame).chain(again).collect()
            }
            _ => vec![frame],
        };
    }),
    ("a measuring cell does not count stimuli", "STIM-1", |it| {
        it.hear = |memory, message, frame| match message {
            Some(Message::Stimulus { .. }) if !memory.test_mode => Vec::new(),
            _ => vec![frame],
        };
    }),
    ("a halted cell latches nothing", "STIM-8", |it| {
        it.hear = |memory, message, frame| match message {
            Some(Message::Stimulus { .. }) if memory.halted => Vec::new(),
            _ => vec![frame],
        };
    }),
];
