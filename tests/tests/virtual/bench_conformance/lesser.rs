//! Correct cells that differ from this project's: they lack options, or are slow.

use protocol::can::Format;
use protocol::message::{Answer, Message, Request, SensorPage};

use crate::bench_conformance::wrong::{FaultyCell, Memory};

/// Its name, and the function that makes it from this project's cell.
type ReducedCase = (&'static str, fn(&mut FaultyCell));

pub(crate) const ALL: &[ReducedCase] = &[
    ("no sensor values without a request", |it| {
        it.say = |memory, message| vec![(0, without(memory, message, &[7, 8]))]
    }),
    ("no baseline", |it| {
        it.say = |memory, message| {
            if matches!(message, Message::Sensors { page: SensorPage::Baseline(_), .. }) {
                return Vec::new();
            }
            vec![(0, without(memory, message, &[11, 12]))]
        }
    }),
    ("the protocol before there was a baseline", |it| {
        it.say = |memory, message| {
            if matches!(message, Message::Sensors { page: SensorPage::Baseline(_), .. }) {
                return Vec::new();
            }
            let asked = match memory.heard {
                Some(Message::Configure {
                    request: Request::Read { number } | Request::Write { number, .. },
                    ..
                }) => number,
                _ => 0,
            };
            let Message::Configured { from, tag, .. } = message else { return vec![(0, message)] };
            let unknown = Answer::Refused { number: asked, reason: Answer::REFUSED_UNKNOWN_PARAMETER };
            let unknown = Message::Configured { from, tag, answer: unknown };
            vec![(0, if [11, 12].contains(&asked) { unknown } else { message })]
        }
    }),
    ("no test mode", |it| {
        it.hear = |_, message, frame| match message {
            Some(Message::Configure { to, tag, request: Request::Write { number: 5, .. } }) => {
                let request = Request::Write { number: 5, words: [0; 6] };
                let format = frame.format();
                let message = Message::Configure { to: *to, tag: *tag, request };
                // On a classic bus this is called with the last segment, while the first one already waits.
                message.encode().frames(format).skip(usize::from(format == Format::Classic)).collect()
            }
            _ => vec![frame],
        };
        it.say = |memory, message| vec![(0, without(memory, message, &[5]))];
        it.memory.measures = true;
    }),
    ("six joints in six rows", |it| {
        it.say = |memory, mut message| {
            if let Message::Configured { answer: Answer::Value { number: 0, words, .. }, .. } = &mut message {
                words[5] = 0;
            }
            vec![(0, without(memory, message, &[22]))]
        };
    }),
    ("answers take 3 ms", |it| it.say = |_, message| vec![(3_000, message)]),
];

/// Returns the answer of a cell to which these parameters can only be zeros.
fn without(memory: &Memory, message: Message, parameters: &[u8]) -> Message {
    let Some(Message::Configure { request, .. }) = memory.heard else { return message };
    let Message::Configured { from, tag, .. } = message else { return message };
    let (number, written, words) = match request {
        Request::Read { number } => (number, false, [0; 6]),
        Request::Write { number, words } => (number, true, words),
    };
    if !parameters.contains(&number) {
        return message;
    }
    let is_zero = words.iter().all(|word| *word == 0);
    let answer = if is_zero {
        Answer::Value { number, written, words }
    } else {
        Answer::Refused { number, reason: 19 }
    };
    Message::Configured { from, tag, answer }
}
