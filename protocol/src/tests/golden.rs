//! Tests with the frames of `golden/*.log`, which the Python program `golden/make.py` wrote from the protocol document.
//!
//! A comment above each frame gives its meaning. The tests construct the message from this comment alone. They compare
//! both the encoded message with the frame and the decoded frame with the message, so that the same error in `encode`
//! and `decode` is found.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test may stop")]

mod meaning;

use std::collections::{BTreeMap, BTreeSet};

use meaning::{Error, Meaning};

use crate::can::{FD_FORMAT, Format, Frame};
use crate::candump::{self, CandumpLine};
use crate::fixed::{Accumulator, TorqueFormat};
use crate::id::{CellId, Id, Kind};
use crate::message::{Answer, Message, Request};
use crate::packet::{Epoch, Length, Lengths, Packet, Reassembler, Reassembly, crc16, data_frame_id};
use crate::parameters::{
    Baseline, Events, Parameter, ParameterError, Parameters, ReplyKind, Sensing, TareCommand,
};
use crate::port::LinkId;
use crate::time::Micros;

const FD: &str = include_str!("../../tests/golden/fd.log");
const LENIENT: &str = include_str!("../../tests/golden/lenient.log");
const BAD: &str = include_str!("../../tests/golden/bad.log");
const CLASSIC: &str = include_str!("../../tests/golden/classic.log");
const SESSION: &str = include_str!("../../tests/golden/session.log");
const REFUSALS: &str = include_str!("../../tests/golden/refusals.log");
const WIRE: &str = include_str!("../../tests/golden/wire.log");
const DOCUMENT: &str = include_str!("../../tests/golden/document.log");
const EXCHANGE: &str = include_str!("../../tests/golden/exchange.log");

/// A frame of a log, with the comment above it.
struct Golden<'a> {
    comment: &'a str,
    micros: u64,
    text: &'a str,
    frame: Frame,
}

fn lines(log: &str) -> Vec<Golden<'_>> {
    let mut golden = Vec::new();
    let mut comment = None;
    for line in log.lines() {
        match candump::parse(line).expect(line) {
            CandumpLine::Frame(record) => golden.push(Golden {
                comment: comment.take().expect("a comment above each frame"),
                micros: record.time.nanos / 1_000,
                text: line.rsplit_once(' ').unwrap().1,
                frame: record.frame,
            }),
            CandumpLine::Dropped { .. } | CandumpLine::CanXl | CandumpLine::Other => {
                comment = line.strip_prefix("# ")
            }
        }
    }
    assert!(golden.len() > 10, "the log is there");
    golden
}

fn read(frame: &Frame) -> Result<Message, Error> {
    let packet = Packet::from_fd(frame).map_err(Error::Packet)?;
    Message::decode(&packet).map_err(Error::Message)
}

fn only_frame(message: &Message) -> String {
    let mut frames = message.encode().frames(Format::Fd);
    let frame = frames.next().unwrap();
    assert!(frames.next().is_none());
    frame.to_string()
}

#[test]
fn bytes_and_meaning_agree_both_ways() {
    for log in [FD, SESSION, DOCUMENT, REFUSALS] {
        for golden in lines(log) {
            let message = Meaning::new(golden.comment).message();
            assert_eq!(read(&golden.frame), Ok(message), "{}", golden.text);
            assert_eq!(only_frame(&message), golden.text, "{}", golden.comment);
        }
    }
}

#[test]
fn the_exchanges_mean_what_they_say() {
    let mut both_ways = 0;
    for golden in lines(EXCHANGE) {
        let (_, meaning) = golden.comment.split_once(' ').unwrap();
        if golden.frame.format() == Format::Fd && !meaning.starts_with("of another") {
            let message = Meaning::new(meaning).message();
            assert_eq!(read(&golden.frame), Ok(message), "{}", golden.text);
            both_ways += u32::from(only_frame(&message) == golden.text);
        }
    }
    // The others write words into parameters that use none.
    assert!(both_ways > 150, "{both_ways}");
}

#[test]
fn every_kind_command_and_page_has_its_golden_frame() {
    let seen: Vec<_> = lines(FD).iter().map(|golden| Packet::from_fd(&golden.frame).unwrap()).collect();
    for kind in Kind::ALL {
        assert!(seen.iter().any(|packet| packet.id.kind == kind), "{kind:?}");
    }
    for command in 0..=4 {
        assert!(
            seen.iter().any(|packet| packet.id == Id { kind: Kind::Command, node: command }),
            "{command}"
        );
    }
    for (kind, counts) in [
        (Kind::Sensors, &[0, 1, 3][..]),
        (Kind::Network, &[0, 1, 2, 3, 4]),
        (Kind::Stimulus, &[0, 1, 0x80, 0x81]),
    ] {
        for &count in counts {
            assert!(
                seen.iter().any(|packet| packet.id.kind == kind && packet.count == count),
                "{kind:?} {count}"
            );
        }
    }
    for number in (0..=u8::MAX).filter(|&number| Parameter::from_number(number).is_some()) {
        let requested = |count| {
            seen.iter().any(|packet| packet.id.kind == Kind::Configure && packet.count & 0x7F == count)
        };
        assert!(requested(number), "parameter {number}");
    }
}

// OPT-2
#[test]
fn what_a_page_does_not_use_is_not_looked_at() {
    for golden in lines(LENIENT) {
        let message = Meaning::new(golden.comment).message();
        assert_eq!(read(&golden.frame), Ok(message), "{}", golden.text);
        assert_ne!(only_frame(&message), golden.text, "this belongs in fd.log");
    }
}

#[test]
fn bad_frames_are_refused_for_the_reason_given() {
    for golden in lines(BAD) {
        assert_eq!(read(&golden.frame), Err(Meaning::error(golden.comment)), "{}", golden.text);
    }
}

/// Returns the packet lengths on the bus of the log. They have six words, except for the packets of eight words, which
/// all belong to epoch 1.
fn lengths_of(golden: &Golden<'_>) -> Lengths {
    let log = lines(CLASSIC);
    let at = log.iter().position(|it| it.micros == golden.micros).unwrap();
    let whole =
        log.iter().skip(at).find(|it| it.frame.id() == golden.frame.id() && it.comment.starts_with("whole"));
    let is_long = whole.is_some_and(|it| it.frame.data().len() == 4);
    Lengths::only(if is_long { Length::Eight } else { Length::Six })
}

// COUNT-3
#[test]
fn classic_frames_pair_as_the_log_says() {
    let mut segments = BTreeMap::<u16, Reassembler>::new();
    for golden in lines(CLASSIC) {
        let outcome = data_frame_id(&golden.frame).and_then(|id| {
            let segment = segments.entry(id.to_bits()).or_default();
            segment.push(Micros(golden.micros), id, lengths_of(&golden), golden.frame.data())
        });
        match (golden.comment.split_once(' '), outcome) {
            (None, Ok(outcome)) => {
                let expected = match golden.comment {
                    "waiting" => Reassembly::Waiting,
                    _ => Reassembly::Incomplete,
                };
                assert_eq!(outcome, expected, "{}", golden.text);
            }
            (Some(("whole", rest)), Ok(Reassembly::Complete(packet))) if rest.starts_with("bad ") => {
                let decoded = Message::decode(&packet).map_err(Error::Message);
                assert_eq!(decoded, Err(Meaning::error(rest)), "{}", golden.text);
            }
            (Some(("whole", meaning)), Ok(Reassembly::Complete(packet))) => {
                let message = Meaning::new(meaning).message();
                assert_eq!(Message::decode(&packet), Ok(message), "{}", golden.text);
                let second = message.encode().frames(Format::Classic).last().unwrap();
                assert_eq!(second.to_string(), golden.text, "{meaning}");
            }
            (Some(("bad", _)), Err(error)) => {
                assert_eq!(Error::Packet(error), Meaning::error(golden.comment), "{}", golden.text);
            }
            (_, outcome) => panic!("{} {}: {outcome:?}", golden.comment, golden.text),
        }
    }
}

#[test]
fn the_first_classic_frames_are_written_as_the_log_has_them() {
    let golden = lines(CLASSIC);
    let mut pairs = 0;
    for pair in golden.windows(2) {
        let [first, second] = pair else { continue };
        if let Some(meaning) = second.comment.strip_prefix("whole ")
            && !meaning.starts_with("bad ")
            && second.frame.data().len() == 8
            && first.comment == "waiting"
            && first.frame.id() == second.frame.id()
        {
            let frames: Vec<_> = Meaning::new(meaning).message().encode().frames(Format::Classic).collect();
            let texts: Vec<_> = frames.iter().map(ToString::to_string).collect();
            assert_eq!(texts, [first.text, second.text], "{meaning}");
            pairs += 1;
        }
    }
    assert!(pairs >= 10, "{pairs}");
}

/// Applies the writes of a session. Returns the resulting parameters, and the hash and outcome of each commit.
fn staged(session: &str) -> (Parameters, Vec<(u16, bool)>) {
    let mut parameters = Parameters::default();
    let mut commits = Vec::new();
    let messages: Vec<_> = lines(session).iter().map(|golden| read(&golden.frame).unwrap()).collect();
    for pair in messages.windows(2) {
        let [Message::Configure { request: Request::Write { number, words }, .. }, answer] = pair else {
            continue;
        };
        match Parameter::from_number(*number) {
            Some(Parameter::Commit) => {
                let Message::Configured { answer, .. } = answer else { panic!("no answer to a commit") };
                commits.push((words[0].cast_unsigned(), matches!(answer, Answer::Value { .. })));
            }
            Some(Parameter::Mode) => {}
            Some(parameter) => parameters.set(parameter, *words).unwrap(),
            None => panic!("parameter {number}"),
        }
    }
    (parameters, commits)
}

#[test]
fn the_hash_of_the_session_is_that_of_its_commit() {
    let (parameters, commits) = staged(SESSION);
    assert_eq!(parameters.check(), Ok(()));
    assert_eq!(commits.len(), 2);
    for (hash, accepted) in commits {
        assert_eq!(hash == parameters.hash(), accepted, "{hash:04X}");
    }
}

// CONF-6, CONF-10, CONF-13, SENSE-3
#[test]
fn unsound_parameters_are_refused_with_the_code_of_the_log() {
    let (sound, _) = staged(SESSION);
    let messages: Vec<_> = lines(REFUSALS).iter().map(|golden| read(&golden.frame).unwrap()).collect();
    let mut codes = BTreeSet::new();
    for pair in messages.chunks(2) {
        let [
            Message::Configure { request: Request::Write { number, words }, .. },
            Message::Configured { answer: Answer::Refused { number: refused, reason }, .. },
        ] = pair
        else {
            panic!("{pair:?}");
        };
        let mut spoilt = sound;
        let expected = match Parameter::from_number(*number) {
            None => (*number, Answer::REFUSED_UNKNOWN_PARAMETER),
            Some(Parameter::Reply) => (*number, cannot_be(ReplyKind::from_words(*words))),
            Some(Parameter::Sensing) => (*number, cannot_be(Sensing::from_words(*words))),
            Some(Parameter::Events) => (*number, cannot_be(Events::from_words(*words))),
            Some(Parameter::Baseline) => (*number, cannot_be(Baseline::from_words(*words))),
            Some(Parameter::Tare) => (*number, cannot_be(TareCommand::from_words(*words))),
            // The cell of the session is not in test mode.
            Some(Parameter::LinksDown) => (*number, Answer::REFUSED_INVALID_WORDS),
            Some(parameter) => match spoilt.set(parameter, *words) {
                Err(error) => (*number, error.code()),
                Ok(()) => (127, spoilt.check().map_err(ParameterError::code).unwrap_err()),
            },
        };
        assert_eq!((*refused, *reason), expected, "{pair:?}");
        codes.insert(*reason);
    }
    assert!(codes.into_iter().eq([1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 19]));
}

fn cannot_be<T: core::fmt::Debug>(read: Option<T>) -> i16 {
    assert!(read.is_none(), "{read:?} can be");
    Answer::REFUSED_INVALID_WORDS
}

#[test]
fn wires_bytes_and_meaning_agree_both_ways() {
    let read = |frame: &Frame| {
        LinkId::from_raw_id(frame.raw_id()).map(|link_id| (link_id, link_id.decode_frame(frame)))
    };
    let mut kinds = BTreeSet::new();
    let mut odd = 0;
    for golden in lines(WIRE) {
        match golden.comment {
            "bad foreign" => assert_eq!(read(&golden.frame), None, "{}", golden.text),
            "bad wire" => {
                assert!(matches!(read(&golden.frame), Some((_, None))), "{}", golden.text);
            }
            comment => {
                let (link_id, message) = Meaning::new(comment).wire();
                assert_eq!(read(&golden.frame), Some((link_id, Some(message))), "{}", golden.text);
                kinds.insert(golden.frame.data()[0]);
                odd += u32::from(link_id.encode_frame(message).to_string() != golden.text);
            }
        }
    }
    assert!(kinds.into_iter().eq(1..=12), "every kind is there");
    assert_eq!(odd, 4, "frames that nobody should write so");
    let hello = lines(WIRE).into_iter().find(|golden| golden.comment.contains("node_id=7")).unwrap();
    assert!(DOCUMENTS.contains(hello.text), "the document's hello is {}", hello.text);
}

/// Computes the document's example of Algorithm 1: 3 N on a cell with J = (-1433, 4260, 0, 0, 0, 0) / 2^14.
#[test]
fn the_documents_torque_comes_out() {
    let (parameters, _) = staged(SESSION);
    let force: i64 = 3 * 1_024;
    assert!(force >= i64::from(parameters.contact.contact_threshold.to_bits()));
    let fused = Accumulator::<22>::from_steps(i64::from(parameters.contact.alpha_c.to_bits()) * force)
        .with_fraction_bits::<24>();
    assert!(fused >= parameters.contact.force_threshold.to_accumulator().with_fraction_bits());
    let rounded = (fused.steps() + (1 << 7)) >> 8;
    let torque = [-1_433, 4_260, 0, 0, 0, 0]
        .map(|j| TorqueFormat::Q3_12.round(Accumulator::<30>::from_steps(j * rounded)));
    let torque = torque.into();
    let from = CellId::new(12).unwrap();
    let expected = only_frame(&Message::Torque { from, epoch: Epoch(7), torque });
    assert!(lines(SESSION).iter().any(|golden| golden.text == expected), "{expected}");
}

/// The documents of the protocol, concatenated.
const DOCUMENTS: &str = concat!(
    include_str!("../../../docs/reference/protocol.md"),
    include_str!("../../../docs/reference/cell.md"),
    include_str!("../../../docs/reference/sensing.md"),
    include_str!("../../../docs/reference/tree.md"),
);

fn frames_of_the_documents() -> Vec<Frame> {
    let tokens = DOCUMENTS.split(|c: char| c.is_whitespace() || c == '`');
    tokens
        .filter(|token| token.len() > 30 && token.contains("##"))
        .map(|token| candump::parse_frame(token).unwrap())
        .collect()
}

#[test]
fn the_documents_spell_out_the_frames_of_their_log_and_no_others() {
    let same = |a: &Frame, b: &Frame| {
        (a.raw_id(), a.data(), a.flags() | FD_FORMAT) == (b.raw_id(), b.data(), b.flags() | FD_FORMAT)
    };
    let (written, golden) = (frames_of_the_documents(), lines(DOCUMENT));
    for golden in &golden {
        assert!(written.iter().any(|frame| same(frame, &golden.frame)), "{} is missing", golden.text);
    }
    for frame in &written {
        assert!(golden.iter().any(|golden| same(&golden.frame, frame)), "{frame} is not in document.log");
    }
}

#[test]
fn the_documents_crc_example_is_right() {
    // Section "CRC": the identifier 20C, six words, epoch 7, count 1.
    let bytes = [0x0C, 0x02, 0x00, 0x10, 0x00, 0xF8, 0x01, 0x00, 0, 0, 0, 0, 0, 0, 0x07, 0x01];
    assert_eq!(crc16(&bytes), 0xD675);
    assert!(DOCUMENTS.contains("0C 02 00 10 00 F8 01 00 00 00 00 00 00 00 07 01"));
    assert!(DOCUMENTS.contains("D675") && DOCUMENTS.contains("29B1"));
    let segments = lines(DOCUMENT)[0].frame;
    let (head, tail) = segments.data().split_at(8);
    for segment in [head, tail] {
        let segment = Frame::classic(0x20C, segment).unwrap().to_string();
        assert!(DOCUMENTS.contains(&segment), "{segment}");
    }
}

#[test]
fn neither_zeros_nor_ones_are_a_packet_under_any_identifier() {
    for bits in 0..0x800 {
        for bytes in [[0; 16], [0xFF; 16]] {
            assert!(Packet::decode(Id::from_bits(bits), &bytes).is_err(), "{bits:03X}");
        }
    }
}

#[test]
#[ignore = "needs python3"]
fn the_logs_are_what_make_py_writes() {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden/make.py");
    let output = std::process::Command::new("python3").args(["-B", script, "--check"]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
}
