//! Commands to a run: one JSON object a line.

use std::io::{self, BufRead};

use serde_json::Value;

use super::event::RequestId;
use crate::command::ControlCommand;
use crate::pressed::MAX_FORCE_N;

/// The maximum length of a line in bytes, without its end.
pub const MAX_LINE_BYTES: usize = 4_096;
/// The maximum length of a textual id in bytes.
const MAX_ID_BYTES: usize = 64;

/// A line of the input.
#[derive(Clone, Debug, PartialEq)]
pub enum InputLine {
    /// A command.
    Request(Request),
    /// A line that is not a command.
    Refused {
        /// The id of the command, if it could be read.
        id: Option<RequestId>,
        /// The reason, in one line.
        reason: String,
    },
}

/// A command with its id.
#[derive(Clone, Debug, PartialEq)]
pub struct Request {
    /// The id that comes back in all events about the command.
    pub id: Option<RequestId>,
    /// The command.
    pub command: ControlCommand,
}

impl InputLine {
    /// Parses a line.
    #[must_use]
    pub fn parse(line: &[u8]) -> Self {
        let refused = |id, reason: String| Self::Refused { id, reason };
        if line.len() > MAX_LINE_BYTES {
            return refused(None, too_long());
        }
        let mut object = match serde_json::from_slice(line) {
            Ok(Value::Object(object)) => object,
            Ok(_) => return refused(None, not_an_object("it is another JSON value")),
            Err(error) => {
                let reason = match error.to_string() {
                    text if text.starts_with("number out of range") => text,
                    _ => format!("it is not JSON at column {}", error.column()),
                };
                return refused(None, not_an_object(&reason));
            }
        };
        let id = match object.remove("id").map(RequestId::try_from) {
            None => None,
            Some(Ok(id)) => Some(id),
            Some(Err(reason)) => return refused(None, reason),
        };
        match serde_json::from_value(Value::Object(object)) {
            Ok(ControlCommand::Press { force_n, .. }) if !(0.0..=MAX_FORCE_N).contains(&force_n) => {
                refused(id, format!("force_n {force_n}: use 0 to {MAX_FORCE_N} N"))
            }
            Ok(command) => Self::Request(Request { id, command }),
            Err(error) => refused(id, error.to_string()),
        }
    }
}

impl TryFrom<Value> for RequestId {
    type Error = String;

    fn try_from(value: Value) -> Result<Self, String> {
        match value {
            Value::Number(number) => Ok(Self::Number(number)),
            Value::String(text) if text.len() <= MAX_ID_BYTES => Ok(Self::Text(text)),
            other
            @ (Value::Null | Value::Bool(_) | Value::String(_) | Value::Array(_) | Value::Object(_)) => Err(
                format!("id {}: use a number, or a text of at most {MAX_ID_BYTES} bytes", kind_of(&other)),
            ),
        }
    }
}

const fn kind_of(value: &Value) -> &'static str {
    match value {
        Value::Null => "null",
        Value::Bool(_) => "true or false",
        Value::Number(_) => "number",
        Value::String(_) => "text",
        Value::Array(_) => "list",
        Value::Object(_) => "object",
    }
}

fn too_long() -> String {
    format!("the line has more than {MAX_LINE_BYTES} bytes: send one command a line")
}

fn not_an_object(reason: &str) -> String {
    format!("the line is not a command: {reason}; send one JSON object a line, such as {{\"do\":\"report\"}}")
}

/// Reads the next line, without its end. Returns `None` at the end of the input. Empty lines are skipped, and the rest
/// of a line that is too long is discarded.
///
/// # Errors
/// Returns [`io::Error`] if the input cannot be read.
pub(super) fn read_line(input: &mut impl BufRead) -> io::Result<Option<InputLine>> {
    loop {
        let mut line = Vec::new();
        let mut is_cut = false;
        let ended = loop {
            let available = match input.fill_buf() {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                available => available?,
            };
            if available.is_empty() {
                break true;
            }
            let end = available.iter().position(|&byte| byte == b'\n');
            let used = end.unwrap_or(available.len());
            let room = (MAX_LINE_BYTES + 1).saturating_sub(line.len());
            line.extend(available.iter().take(used.min(room)));
            is_cut |= used > room;
            input.consume(end.map_or(used, |end| end + 1));
            if end.is_some() {
                break false;
            }
        };
        if is_cut {
            return Ok(Some(InputLine::Refused { id: None, reason: too_long() }));
        }
        if !line.trim_ascii().is_empty() {
            return Ok(Some(InputLine::parse(&line)));
        }
        if ended {
            return Ok(None);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::command::CellReference;
    use proptest::prelude::*;

    fn command(text: &str) -> Option<ControlCommand> {
        match InputLine::parse(text.as_bytes()) {
            InputLine::Request(request) => Some(request.command),
            InputLine::Refused { .. } => None,
        }
    }

    fn reason(text: &str) -> String {
        match InputLine::parse(text.as_bytes()) {
            InputLine::Refused { reason, .. } => reason,
            InputLine::Request(request) => panic!("{request:?}"),
        }
    }

    #[test]
    fn each_command_is_read_with_its_id() {
        let cell = |text: &str| CellReference(text.to_owned());
        let press = ControlCommand::Press { cell: cell("12"), force_n: 3.0 };
        let with_id = InputLine::parse(br#"{"do":"press","id":7,"cell":12,"force_n":3}"#);
        let id = Some(RequestId::Number(7.into()));
        assert_eq!(with_id, InputLine::Request(Request { id, command: press }));
        assert_eq!(
            command(r#" {"force_n":0.5,"cell":"vcan0:3","do":"press","id":"a"} "#),
            Some(ControlCommand::Press { cell: cell("vcan0:3"), force_n: 0.5 })
        );
        assert_eq!(command(r#"{"do":"release"}"#), Some(ControlCommand::Release { cell: None }));
        assert_eq!(
            command(r#"{"do":"link","cells":[3,"4"],"down":true}"#),
            Some(ControlCommand::Link { cells: [cell("3"), cell("4")], down: true })
        );
        for name in ["halt", "resume", "report", "end"] {
            let read = command(&format!(r#"{{"do":"{name}"}}"#)).unwrap();
            assert_eq!(read.name(), name);
        }
        for name in ["kill", "stop", "continue", "restart"] {
            let read = command(&format!(r#"{{"do":"{name}","cell":5}}"#)).unwrap();
            assert_eq!(read.name(), name);
        }
    }

    #[test]
    fn another_line_is_refused_with_the_reason_and_its_id() {
        for (line, expected) in [
            (
                "x",
                "the line is not a command: it is not JSON at column 1; send one JSON object a line, such as \
                   {\"do\":\"report\"}",
            ),
            (
                "[]",
                "the line is not a command: it is another JSON value; send one JSON object a line, such as \
                    {\"do\":\"report\"}",
            ),
            ("{}", "missing field `do`"),
            (
                r#"{"do":"shoot"}"#,
                "unknown variant `shoot`, expected one of `press`, `release`, `halt`, `resume`, \
                                   `kill`, `stop`, `continue`, `restart`, `bus`, `link`, `epochs`, `report`, `end`",
            ),
            (r#"{"do":"halt","cell":1}"#, "unknown field `cell`, there are no fields"),
            (r#"{"do":"press","cell":1}"#, "missing field `force_n`"),
            (r#"{"do":"press","cell":[1],"force_n":1}"#, "cell [1]: use a node id or \"BUS:NODE\""),
            (r#"{"do":"press","cell":1,"force_n":90.5}"#, "force_n 90.5: use 0 to 90 N"),
            (r#"{"do":"press","cell":1,"force_n":-1}"#, "force_n -1: use 0 to 90 N"),
            (r#"{"do":"halt","id":[]}"#, "id list: use a number, or a text of at most 64 bytes"),
        ] {
            assert_eq!(reason(line), expected, "{line}");
        }
        let refused = InputLine::parse(br#"{"do":"shoot","id":"x"}"#);
        let InputLine::Refused { id, .. } = refused else { panic!("{refused:?}") };
        assert_eq!(id, Some(RequestId::Text("x".to_owned())));
    }

    #[test]
    fn lines_are_read_one_by_one_and_long_ones_are_discarded() {
        let long = "x".repeat(3 * MAX_LINE_BYTES);
        let text = format!("\n{{\"do\":\"halt\"}}\n{long}\n  \n{{\"do\":\"end\"}}");
        for capacity in [1, 7, 8_192] {
            let mut input = io::BufReader::with_capacity(capacity, text.as_bytes());
            let read: Vec<_> = std::iter::from_fn(|| read_line(&mut input).unwrap()).collect();
            let [first, second, third] = read.as_slice() else { panic!("{read:?}") };
            assert!(matches!(first, InputLine::Request(Request { command: ControlCommand::Halt {}, .. })));
            assert_eq!(*second, InputLine::Refused { id: None, reason: too_long() });
            assert!(matches!(third, InputLine::Request(Request { command: ControlCommand::End {}, .. })));
        }
    }

    proptest! {
        #[test]
        fn any_bytes_are_read_without_a_panic(bytes: Vec<u8>) {
            let _ = InputLine::parse(&bytes);
            let mut input = bytes.as_slice();
            while read_line(&mut input).unwrap().is_some() {}
        }
    }
}
