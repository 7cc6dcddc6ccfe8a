//! Recognises the kind of a text that has no frames, by its first lines.

const EXPORT_ADVICE: &str =
    "no converter for this format is known: export it as a candump log from the program that wrote it";
pub(super) const ASC_KIND: (&str, &str) =
    ("a Vector ASC log", "write a candump log with can-utils' `asc2log -I FILE -O NEW.log`");

/// The name of the kind for skin and scenario files.
pub const SKIN_OR_SCENARIO: &str = "a skin or a scenario";
/// Table headings that occur in skins and scenarios but rarely in other files.
const SKIN_TABLES: [&str; 7] =
    ["[robot]", "[[chain]]", "[[bus]]", "[[cell]]", "[motion]", "[[touch]]", "[[fault]]"];

/// Returns the kind of a text and advice to the user, or `None` if the kind is unknown.
pub(super) fn detect_text_kind(text: &[u8]) -> Option<(&'static str, &'static str)> {
    let text = String::from_utf8_lossy(text);
    let lines: Vec<_> = text.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
    let any = |is: &dyn Fn(&str) -> bool| lines.iter().any(|line| is(line));
    let all = |is: &dyn Fn(&str) -> bool| !lines.is_empty() && lines.iter().all(|line| is(line));
    let words = |line: &str| line.split_whitespace().map(str::to_owned).collect::<Vec<_>>();
    let begins_with = |begin: &'static str| any(&|line| line.starts_with(begin));
    let kinds: [(bool, (&'static str, &'static str)); 16] = [
        (begins_with("***BUSMASTER"), ("a BUSMASTER log", EXPORT_ADVICE)),
        (
            any(&|line| SKIN_TABLES.iter().any(|table| line.starts_with(table))),
            (SKIN_OR_SCENARIO, "it contains no CAN frames: name a candump log or an MCAP recording"),
        ),
        (
            any(&|line| line == "BS_:" || line == "NS_ :" || line == "NS_:" || line.starts_with("BO_ "))
                || begins_with("VERSION \""),
            (
                "a DBC file",
                "it describes signals and contains no CAN frames: name a candump log or an MCAP recording",
            ),
        ),
        (any(&|line| line.starts_with("base hex") || line.starts_with("base dec")), ASC_KIND),
        (any(&|line| line.starts_with("Begin Triggerblock") || line == "// version 7.0.0"), ASC_KIND),
        (
            any(&|line| is_trc_line(&words(line))),
            (
                "a PEAK trace",
                "write a candump log with `can_logconvert FILE NEW.log` (pip install python-can)",
            ),
        ),
        (
            any(&|line| words(line).get(..3).is_some_and(|head| head == ["Time", "ID", "DLC"])),
            ("a CANHacker trace", EXPORT_ADVICE),
        ),
        (begins_with("# Logger type:"), ("a CSS Electronics CLX000 log", EXPORT_ADVICE)),
        (any(&|line| line.starts_with("< frame ")), ("output of socketcand", EXPORT_ADVICE)),
        (
            any(&|line| line.starts_with("Timestamp:") && line.contains(" DL:")),
            ("output of python-can", "it is not a log: record one with `can_logger -f NEW.log`"),
        ),
        (any(&|line| is_kvaser_line(line)), ("a Kvaser log", EXPORT_ADVICE)),
        (any(&|line| is_crtd_line(&words(line))), ("a CRTD log", EXPORT_ADVICE)),
        (any(&is_canboat_line), ("a canboat log of NMEA 2000 messages", EXPORT_ADVICE)),
        (
            any(&|line| line.contains("]  ") && line.contains("  - '")),
            (
                "output of isotpsniffer",
                "it shows reassembled messages instead of frames: capture the frames with `candump -l`",
            ),
        ),
        (
            all(&|line| line.starts_with('#') || is_frame_of_cansend(line)) && any(&is_frame_of_cansend),
            (
                "a list of frames for cansend",
                "its frames have no times: write lines like `(1700000000.123456) can0 123#00`",
            ),
        ),
        (
            is_separated_table(&lines),
            (
                "a table in CSV",
                "convert a table of python-can to a candump log with `can_logconvert FILE NEW.log`; from other \
                 tables, write lines like \
                 `(1700000000.123456) can0 123#00`",
            ),
        ),
    ];
    kinds.into_iter().find(|(is, _)| *is).map(|(_, kind)| kind)
}

fn is_hex(word: &str) -> bool {
    !word.is_empty() && word.bytes().all(|byte| byte.is_ascii_hexdigit())
}

/// Matches `1)  1841  0001  8  00 ...`, with or without `Rx` before the identifier.
fn is_trc_line(words: &[String]) -> bool {
    let number = words.first().and_then(|word| word.strip_suffix(')'));
    let is_number = number.is_some_and(|word| word.parse::<u64>().is_ok());
    is_number && words.get(1).is_some_and(|word| word.parse::<f64>().is_ok()) && words.len() > 3
}

/// Matches `Chn Identifier Flg DLC ...` or a line with `Kvaser`.
fn is_kvaser_line(line: &str) -> bool {
    line.starts_with("Chn Identifier") || line.contains("Kvaser")
}

/// Matches `1320745424.002 1R11 402 FA 01`, and headers with `CXX`.
fn is_crtd_line(words: &[String]) -> bool {
    let [time, kind, ..] = words else { return false };
    let kind = kind.trim_start_matches(|digit: char| digit.is_ascii_digit());
    let is_of_crtd = matches!(kind, "R11" | "R29" | "T11" | "T29" | "CXX" | "CEV");
    is_of_crtd && time.parse::<f64>().is_ok()
}

/// Matches `2016-02-28T19:57:02.364Z,6,129285,204,255,8,...`.
fn is_canboat_line(line: &str) -> bool {
    let fields: Vec<_> = line.split(',').collect();
    let [time, rest @ ..] = fields.as_slice() else { return false };
    let (numbers, data) = rest.split_at(rest.len().min(5));
    let is_time = time.len() > 18 && matches!(time.as_bytes().get(10), Some(b'T' | b'-' | b' '));
    is_time
        && numbers.len() == 5
        && numbers.iter().all(|it| it.parse::<u32>().is_ok())
        && data.iter().all(|it| is_hex(it))
}

/// Matches `123#00`, `can0 123#00` and `cansend can0 123#00`.
fn is_frame_of_cansend(line: &str) -> bool {
    let words: Vec<_> = line.split_whitespace().collect();
    let ([frame] | [_, frame] | ["cansend", _, frame]) = words.as_slice() else { return false };
    protocol::candump::parse_frame(frame).is_ok()
}

/// Returns true if at least three quarters of the lines have the same number of separators, three or more.
fn is_separated_table(lines: &[&str]) -> bool {
    // The last line may be cut off.
    let lines = lines.get(..lines.len().saturating_sub(1)).filter(|lines| !lines.is_empty()).unwrap_or(lines);
    [',', ';', '\t'].iter().any(|separator| {
        let counts: Vec<_> = lines.iter().map(|line| line.matches(*separator).count()).collect();
        let same = counts.iter().filter(|count| Some(*count) == counts.first()).count();
        counts.first().is_some_and(|first| *first >= 3) && 4 * same >= 3 * counts.len()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_of_other_programs_are_recognised() {
        for (text, expected) in [
            ("VERSION \"1.0\"\n\nNS_:\n\nBS_:\n", "a DBC file"),
            ("BO_ 100 MSG: 8 ECU\n SG_ s : 0|8@1+ (1,0) [0|255] \"\" X\n", "a DBC file"),
            (
                "// version 7.1.0\ndate Mon\nbase hex  timestamps absolute\n 0.001 2 701 Rx d 1 05\n",
                "a Vector ASC log",
            ),
            ("base hex timestamps absolute\n", "a Vector ASC log"),
            ("***BUSMASTER Ver 2.6.2***\n***PROTOCOL CAN***\n", "a BUSMASTER log"),
            (
                "Time   ID     DLC Data                    Comment\r\n00,000 00D00422 8 00 \r\n",
                "a CANHacker trace",
            ),
            ("# a skin\nname = \"arm\"\n\n[robot]\nname = \"UR5\"\n", SKIN_OR_SCENARIO),
            ("duration_s = 4.0\n[[touch]] # one\ncells = [3]\n", SKIN_OR_SCENARIO),
            (";  Start time: 10.05.2016\n     1)      1841  0001  8  00 00 00\n", "a PEAK trace"),
            ("1) 2.5 Rx 0300 7 00 00\n", "a PEAK trace"),
            ("# Logger type: 29\n# HW rev: 00.01\nTimestamp ID Data\n", "a CSS Electronics CLX000 log"),
            ("< hi >\n< frame 0B0B00C9 1701324984.734672 0000 >\n", "output of socketcand"),
            (
                "Timestamp: 0.0    ID: 123    S Rx                DL:  4    11 22 33 44\n",
                "output of python-can",
            ),
            ("Chn Identifier Flg   DLC  D0...1...2\n", "a Kvaser log"),
            ("1320745424.002 1R11 402 FA 01 C3\n", "a CRTD log"),
            ("2016-02-28T19:57:02.364Z,6,129285,204,255,2,a3,99\n", "a canboat log of NMEA 2000 messages"),
            (" vcan0  714  [3]  11 22 33  - '.\"3'\n", "output of isotpsniffer"),
            ("309#40\n025#00\n", "a list of frames for cansend"),
            ("#!/bin/sh\ncansend vcan0 1D0#0A\ncansend vcan0 1D0#\n", "a list of frames for cansend"),
            ("time;id;data;dlc\n1;2;3;4\n5;6;7;8\n", "a table in CSV"),
        ] {
            assert_eq!(detect_text_kind(text.as_bytes()).map(|(what, _)| what), Some(expected), "{text}");
        }
    }

    #[test]
    fn words_are_no_kind() {
        for text in [
            "",
            "# a comment\n",
            "hello\nthis is noise\n",
            "a, b, c\nd\n",
            "\u{1b}[31m\0\n",
            "[[test]]\nname = \"a\"\n",
        ] {
            assert_eq!(detect_text_kind(text.as_bytes()), None, "{text}");
        }
    }
}
