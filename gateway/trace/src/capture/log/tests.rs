//! Tests that console output of candump is read as the same frames in a log are.

use std::fmt::Write as _;

use proptest::prelude::*;
use protocol::can::{ERROR, EXTENDED, EXTENDED_MASK, Format, Frame, STANDARD_MASK};

use super::*;
use crate::capture::{CaptureEntry, NoteKind};

/// Lines in the forms of candump 2020.11 and 2025, written by hand. Each is followed by the frame as a log has it, a
/// note's kind, or an error.
const CONSOLE: &str = include_str!("console.txt");

/// Returns the entries of a log as text (frames as lines of a log, notes by their kind) and the remarks.
fn entries(text: &[u8]) -> (Vec<String>, Vec<LogRemark>) {
    let mut log = LogReader::new(&[], Box::new(std::io::Cursor::new(text.to_vec())));
    let mut all = Vec::new();
    while let Some(entry) = log.next().unwrap() {
        all.push(match entry {
            CaptureEntry::Frame(record) => {
                let way = record.direction.map_or("", |way| match way {
                    protocol::candump::Direction::Sent => " T",
                    protocol::candump::Direction::Received => " R",
                });
                format!("{record}{way}")
            }
            CaptureEntry::Note(note) => match note.kind {
                NoteKind::Text => "text".to_owned(),
                NoteKind::CanXl => "CAN XL".to_owned(),
                NoteKind::Dropped(frames) => format!("dropped {frames}"),
                NoteKind::Unreadable(why) => why,
            },
        });
    }
    (all, log.remarks().to_vec())
}

fn frames(text: &str) -> (Vec<String>, Vec<LogRemark>) {
    entries(text.as_bytes())
}

#[test]
fn every_form_of_the_console_is_read() {
    let (mut cases, mut remarks) = (0, Vec::new());
    for case in CONSOLE.split("\n\n") {
        let lines = case.lines().filter(|line| !line.starts_with("##"));
        let (expected, lines): (Vec<_>, Vec<_>) = lines.partition(|line| line.starts_with("#= "));
        let lines = lines.join("\n").replace("^[", "\u{1b}");
        let expected: Vec<_> = expected.iter().map(|line| line.trim_start_matches("#= ")).collect();
        let (found, remark) = frames(&lines);
        assert_eq!(found, expected, "{lines}");
        cases += 1;
        remarks.extend(remark);
    }
    assert!(cases >= 30, "{cases}");
    for remark in [
        LogRemark::NoTimes,
        LogRemark::LocalTimes,
        LogRemark::SinceFirst,
        LogRemark::Differences,
        LogRemark::NoFlags,
    ] {
        assert!(remarks.contains(&remark), "{remark:?}");
    }
}

#[test]
fn differences_are_told_from_times_since_the_first_frame() {
    let line = |ms: u64| format!(" ({:03}.{:06})  can0  123   [0]\n", ms / 1_000, ms % 1_000 * 1_000);
    let last = |times: &[u64]| {
        let text: String = times.iter().copied().map(line).collect();
        let (frames, remarks) = frames(&text);
        (frames.last().unwrap().split_once(')').unwrap().0[1..].to_owned(), remarks)
    };
    let zero = || vec![LogRemark::SinceFirst];
    let differences = || vec![LogRemark::Differences];
    assert_eq!(last(&[0, 10, 20, 30]), ("0.030000".to_owned(), zero()));
    assert_eq!(last(&[0, 10, 9, 11]), ("0.030000".to_owned(), differences()));
    assert_eq!(last(&[0, 10, 10, 10, 10]), ("0.040000".to_owned(), differences()));
    // The clock was set once.
    let mut times: Vec<u64> = (0..40).map(|at| at * 10).collect();
    times[7] = 50;
    assert_eq!(last(&times), ("0.390000".to_owned(), zero()));
    // The lines alternate between two buses; only times of the same bus are compared.
    let text: String = (0..40)
        .map(|at| {
            format!(
                " (000.{:06})  can{}  123   [0]\n",
                if at % 2 == 0 { at * 100 + 150 } else { at * 100 },
                at % 2
            )
        })
        .collect();
    assert_eq!(frames(&text).1, zero());
}

#[test]
fn no_more_of_a_pipe_is_waited_for_than_is_needed() {
    struct Lines(u64);
    impl std::io::Read for Lines {
        fn read(&mut self, room: &mut [u8]) -> std::io::Result<usize> {
            assert!(self.0 < 22, "enough was there");
            let line = format!(" (000.{:06})  can0  123   [0]\n", self.0);
            self.0 += 1;
            room[..line.len()].copy_from_slice(line.as_bytes());
            Ok(line.len())
        }
    }
    let mut log = LogReader::new(&[], Box::new(Lines(0)));
    for _ in 0..21 {
        assert!(matches!(log.next().unwrap(), Some(CaptureEntry::Frame(_))));
    }
}

/// The options of candump that select the format of a printed line.
#[derive(Clone, Copy, Debug)]
struct PrintStyle {
    /// The option that prints times: `-t a`, `z`, `d` or `A`, or a blank for none.
    time: char,
    nine_digits: bool,
    marks: bool,
    ascii: bool,
    swapped: bool,
    binary: bool,
    dlc: bool,
    /// The number of times that `-c` is given, 0 to 3.
    colour: u8,
    indented: bool,
}

fn print() -> impl Strategy<Value = PrintStyle> {
    let time = prop::sample::select(vec!['a', 'z', 'd', 'A', '-']);
    let flags = any::<[bool; 7]>();
    (time, flags, 0..4_u8).prop_map(|(time, flags, colour)| {
        let [nine_digits, marks, ascii, swapped, binary, dlc, indented] = flags;
        PrintStyle { time, nine_digits, marks, ascii, swapped, binary, dlc, colour, indented }
    })
}

fn frame() -> impl Strategy<Value = Frame> {
    let data = proptest::collection::vec(any::<u8>(), 0..=64);
    (0..6, any::<u32>(), any::<u8>(), data).prop_map(|(kind, id, more, data)| {
        let short = &data[..data.len().min(8)];
        let full: [u8; 8] = std::array::from_fn(|at| data.get(at).copied().unwrap_or(7));
        let id = if more & 16 == 0 { id & STANDARD_MASK } else { id & EXTENDED_MASK | EXTENDED };
        match kind {
            0 => Frame::classic(id, short),
            1 => Frame::remote(id, more % 9),
            2 => Frame::classic(id & EXTENDED_MASK | ERROR, short),
            3 => Frame::classic(id, &full).map(|frame| frame.with_raw_dlc(9 + more % 7)),
            _ => Frame::fd(id, more & 3, &data),
        }
        .unwrap()
    })
}

/// Prints a frame as candump does. The function follows candump's source, so that the parser is not tested against
/// itself.
fn printed(print: PrintStyle, nanos: u64, step: u64, bus: &str, sent: bool, frame: &Frame) -> String {
    let mut line = " ".to_owned();
    let on = "\u{1b}[1m\u{1b}[34m";
    if print.colour > 2 {
        line += on;
    }
    let shown = if print.time == 'd' { step } else { nanos };
    let (seconds, below) = (shown / 1_000_000_000, shown % 1_000_000_000);
    let fraction = if print.nine_digits { format!("{below:09}") } else { format!("{:06}", below / 1_000) };
    match print.time {
        'a' => write!(line, "({seconds:010}.{fraction}) ").unwrap(),
        'z' | 'd' => write!(line, "({seconds:03}.{fraction}) ").unwrap(),
        'A' => write!(
            line,
            "(1970-01-{:02} {:02}:{:02}:{:02}.{fraction}) ",
            1 + seconds / 86_400,
            seconds / 3_600 % 24,
            seconds / 60 % 60,
            seconds % 60
        )
        .unwrap(),
        _ => {}
    }
    line += " ";
    if print.colour == 1 || print.colour == 2 {
        line += on;
    }
    write!(line, "{bus:>6}").unwrap();
    let is_fd = frame.format() == Format::Fd;
    if print.marks {
        let flag = |flag, letter| if is_fd && frame.flags() & flag != 0 { letter } else { '-' };
        write!(line, "  {} {} {}", if sent { "TX" } else { "RX" }, flag(1, 'B'), flag(2, 'E')).unwrap();
    }
    line += if print.colour == 1 { "\u{1b}[0m  " } else { "  " };
    if frame.is_error() {
        write!(line, "{:08X}  ", frame.raw_id()).unwrap();
    } else if frame.is_extended() {
        write!(line, "{:08X}  ", frame.id()).unwrap();
    } else {
        write!(line, "{}{:03X}  ", if print.indented { "     " } else { "" }, frame.id()).unwrap();
    }
    let len = frame.len();
    match () {
        () if is_fd => write!(line, "[{len:02}] ").unwrap(),
        () if print.dlc => {
            let dlc = if frame.raw_dlc() > 8 { frame.raw_dlc() } else { len };
            write!(line, " {{{dlc:X}}} ").unwrap();
        }
        () => write!(line, " [{len}] ").unwrap(),
    }
    if frame.is_remote() {
        line += " remote request";
    } else {
        let mut data = frame.data().to_vec();
        if print.swapped {
            data.reverse();
        }
        for (at, byte) in data.iter().enumerate() {
            line += if print.swapped && at > 0 { "`" } else { " " };
            if print.binary {
                write!(line, "{byte:08b}").unwrap();
            } else {
                write!(line, "{byte:02X}").unwrap();
            }
        }
        let gap = if print.binary { 9 } else { 3 } * usize::from(8_u8.saturating_sub(len));
        if frame.is_error() && len <= 8 {
            write!(line, "{:>1$}", "ERRORFRAME", gap + 13).unwrap();
        } else if print.ascii && len <= 8 {
            let quote = if print.swapped { '`' } else { '\'' };
            let text: String = data
                .iter()
                .map(|&byte| if (0x20..0x7F).contains(&byte) { char::from(byte) } else { '.' })
                .collect();
            write!(line, "{quote:>0$}{text}{quote}", gap + 4).unwrap();
        }
    }
    if print.colour > 1 {
        line += "\u{1b}[0m";
    }
    line
}

proptest! {
    #[test]
    fn whatever_candump_prints_comes_back(
        print in print(), buses in 1..3_usize,
        steps in proptest::collection::vec((1..5_000_000_000_u64, frame(), any::<bool>()), 1..40),
    ) {
        let (mut text, mut expected) = (String::new(), Vec::new());
        let mut nanos = 0;
        for (at, (step, frame, sent)) in steps.iter().enumerate() {
            let round = if print.nine_digits { 1 } else { 1_000 };
            let step = if at == 0 { 0 } else { step / round * round };
            nanos += step;
            let bus = ["can0", "vcan11"][at % buses];
            text += &printed(print, nanos, step, bus, *sent, frame);
            text.push('\n');
            let raw_dlc = if print.dlc { frame.raw_dlc() } else { 0 };
            let frame = match frame.format() {
                Format::Fd if !print.marks => Frame::fd(frame.raw_id(), 0, frame.data()).unwrap(),
                Format::Fd | Format::Classic => frame.with_raw_dlc(raw_dlc),
            };
            let nanos = if print.time == '-' { at as u64 * 1_000 } else { nanos };
            expected.push((nanos, bus, frame, print.marks.then_some(*sent)));
        }
        let mut log = LogReader::new(&[], Box::new(std::io::Cursor::new(text.clone().into_bytes())));
        let mut times = Vec::new();
        for (nanos, bus, frame, sent) in &expected {
            let Some(CaptureEntry::Frame(record)) = log.next().unwrap() else { panic!("{text}") };
            let way = record.direction.map(|way| way == protocol::candump::Direction::Sent);
            prop_assert_eq!((record.interface, record.frame, way), (*bus, *frame, *sent), "{}", text);
            times.push((record.time.nanos, *nanos));
        }
        prop_assert!(log.next().unwrap().is_none());
        // A few differences may be indistinguishable from times since the first frame.
        if print.time != 'd' || log.remarks().contains(&LogRemark::Differences) {
            prop_assert!(times.iter().all(|(found, expected)| found == expected), "{}\n{:?}", text, times);
        } else {
            prop_assert!(steps.len() < 16, "{}", text);
        }
    }

    #[test]
    fn no_bytes_panic(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
        let _ = entries(&bytes);
    }

    #[test]
    fn nothing_like_console_text_panics(
        lines in proptest::collection::vec("[ \\t\u{1b}]{0,2}(\\([0-9:. -]{0,26}\\))? ? can[01] ( [TR]X [-BS] [-ER] )? ?[0-9A-F]{0,9} {0,3}[\\[{][0-9A-F]{0,5}[\\]}] {0,2}([0-9A-F]{0,9}[` ]){0,9}.{0,9}", 0..20)
    ) {
        let _ = entries(lines.join("\n").as_bytes());
    }
}
