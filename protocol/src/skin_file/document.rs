//! TOML files that users write, and the errors in them. An error is one line with the file, line and column, key, value
//! and allowed values.
//!
//! The file is deserialised into a plain struct with `serde`, which refuses unknown keys. A `check` function then
//! converts the struct to checked types or returns a [`DocumentFault`]. Deserialisation records no positions, which
//! makes it fast; after an error, the file is parsed again with positions.

mod mistakes;

use core::fmt;
use core::ops::RangeInclusive;
use std::io;
use std::path::Path;

use serde::de::DeserializeOwned;
use thiserror::Error;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::fixed::{OutOfRange, Q};
use crate::input;
use crate::time::Span;

/// A step of the path from the root of a file to a value.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum PathStep {
    /// A key of a table.
    Key(&'static str),
    /// An index into an array, counted from 0.
    Index(usize),
}

/// The error for an invalid value: its path in the file, the value and the reason.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct DocumentFault {
    path: Vec<PathStep>,
    value: String,
    why: String,
}

/// The result of a check: the checked value, or the first fault.
pub type Checked<T> = Result<T, DocumentFault>;

/// The path of a value or table in a file. Its methods check the value at that path and create faults about it.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct KeyPath(Vec<PathStep>);

impl KeyPath {
    /// Returns the path of the file itself.
    #[must_use]
    pub const fn root() -> Self {
        Self(Vec::new())
    }

    /// Returns the path of a key at the top level.
    #[must_use]
    pub fn top_level_key(key: &'static str) -> Self {
        Self(vec![PathStep::Key(key)])
    }

    /// Returns the path of a key in the table at this path.
    #[must_use]
    pub fn with_key(&self, key: &'static str) -> Self {
        Self([&self.0[..], &[PathStep::Key(key)]].concat())
    }

    /// Returns the path of an element of the array at this path, counted from 0.
    #[must_use]
    pub fn with_index(&self, index: usize) -> Self {
        Self([&self.0[..], &[PathStep::Index(index)]].concat())
    }

    /// Creates a fault about the value at this path. If `value` is empty, the message contains only the path and the
    /// reason.
    #[must_use]
    pub fn fault(&self, value: impl fmt::Display, why: impl fmt::Display) -> DocumentFault {
        DocumentFault { path: self.0.clone(), value: value.to_string(), why: why.to_string() }
    }

    /// Converts one of the allowed words to the value that it stands for.
    ///
    /// # Errors
    /// Returns an error if the word is not one of them.
    pub fn parse_choice<T: Copy>(&self, got: &str, words: &[(&str, T)]) -> Result<T, DocumentFault> {
        let found = words.iter().find(|(word, _)| *word == got);
        found.map(|&(_, meaning)| meaning).ok_or_else(|| {
            let mut words = words.iter().map(|(word, _)| format!("{word:?}")).collect::<Vec<_>>();
            let last = words.pop().unwrap_or_default();
            self.fault(format_args!("{got:?}"), format_args!("must be {} or {last}", words.join(", ")))
        })
    }

    /// Checks that an integer is within a range. The error prints `unit` after the range.
    ///
    /// # Errors
    /// Returns an error if it is outside the range.
    pub fn check_range(
        &self,
        got: i64,
        range: RangeInclusive<u32>,
        unit: &str,
    ) -> Result<u32, DocumentFault> {
        u32::try_from(got).ok().filter(|value| range.contains(value)).ok_or_else(|| {
            let (min, max) = range.into_inner();
            self.fault(got, format_args!("must be {min} to {max}{unit}"))
        })
    }

    /// Checks that a number is finite.
    ///
    /// # Errors
    /// Returns an error if the number is infinite or NaN.
    pub fn check_finite(&self, value: f64) -> Result<f64, DocumentFault> {
        if value.is_finite() { Ok(value) } else { Err(self.fault(value, "must be a finite number")) }
    }

    /// Checks that a number is finite and above 0.
    ///
    /// # Errors
    /// Returns an error if the number is not finite or not above 0.
    pub fn check_positive(&self, value: f64) -> Result<f64, DocumentFault> {
        let positive = value.is_finite() && value > 0.0;
        if positive { Ok(value) } else { Err(self.fault(value, "must be above 0")) }
    }

    /// Converts a number to a fixed-point word with the rounding function `fit`.
    ///
    /// # Errors
    /// Returns an error if the number is outside the range of the word.
    pub fn to_fixed<const F: u32>(&self, value: f64, fit: RoundingFn<F>) -> Result<Q<F>, DocumentFault> {
        fit(value).map_err(|OutOfRange { min, bound, .. }| {
            self.fault(value, format_args!("must be in [{min}, {bound})"))
        })
    }

    /// Sets a fixed-point word to a number, if one is given. The number must not be negative.
    ///
    /// # Errors
    /// Returns an error if the number is negative, or outside the range of the word.
    pub fn set_fixed_if_given<const F: u32>(
        &self,
        given: Option<f64>,
        word: &mut Q<F>,
        fit: RoundingFn<F>,
    ) -> Result<(), DocumentFault> {
        match given {
            None => {}
            Some(value) if value < 0.0 => return Err(self.fault(value, "must not be negative")),
            Some(value) => *word = self.to_fixed(value, fit)?,
        }
        Ok(())
    }
}

/// A function that rounds a number to a fixed-point word.
pub type RoundingFn<const F: u32> = fn(f64) -> Result<Q<F>, OutOfRange>;

impl fmt::Display for DocumentFault {
    /// Formats the fault like `cell[3].joint = 9: use a joint from 1 to 6`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, step) in self.path.iter().enumerate() {
            match step {
                PathStep::Key(key) if index == 0 => write!(f, "{key}")?,
                PathStep::Key(key) => write!(f, ".{key}")?,
                PathStep::Index(at) => write!(f, "[{at}]")?,
            }
        }
        if !self.value.is_empty() {
            write!(f, " = {}", self.value)?;
        }
        write!(f, ": {}", self.why)
    }
}

/// The error for a file that cannot be used.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum DocumentError {
    /// The file cannot be read.
    #[error("{path}: {reason}")]
    Unreadable {
        /// The file.
        path: String,
        /// The reason.
        reason: String,
    },
    /// A value in the file is invalid.
    #[error("{path}:{line}:{column}: {what}")]
    InvalidValue {
        /// The file.
        path: String,
        /// The line, from 1.
        line: usize,
        /// The column, from 1.
        column: usize,
        /// The key, the value, and what is allowed.
        what: String,
    },
    /// The file is valid, but of another kind, such as a scenario in place of a skin.
    #[error("{path}: {what}")]
    WrongKind {
        /// The file.
        path: String,
        /// The kind of the file, and the option or command that it is for.
        what: &'static str,
    },
}

impl DocumentError {
    /// Returns [`DocumentError::WrongKind`] with `what` if the text is a file of another kind: it has one of the keys
    /// `has` and none of the keys `lacks`. Otherwise returns the error unchanged.
    #[must_use]
    pub fn detect_wrong_kind(self, text: &str, has: &[&str], lacks: &[&str], what: &'static str) -> Self {
        let Self::InvalidValue { path, .. } = &self else { return self };
        let Ok(root) = DeTable::parse(text) else { return self };
        let any = |keys: &[&str]| keys.iter().any(|key| root.get_ref().contains_key(*key));
        if any(has) && !any(lacks) { Self::WrongKind { path: path.clone(), what } } else { self }
    }
}

/// Maximum size of a user-written file in bytes. For comparison: a skin of 253 cells has 60 KB.
pub const MAX_FILE_BYTES: u64 = 16 << 20;

/// Maximum number of keys, values and tables in a TOML file, estimated by the number of its punctuation characters. A
/// skin of 10 000 cells has 280 000 of them; a file with the maximum takes up to 0.5 GB of memory to parse.
const MAX_PUNCTUATION_CHARS: usize = 500_000;

/// Converts seconds to a duration. The caller has checked that the seconds are not negative and within the limits of
/// the file format.
#[must_use]
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "bounded by whoever calls")]
pub fn span_from_seconds(seconds: f64) -> Span {
    Span((seconds * 1e6).round() as u64)
}

/// Reads a file of at most [`MAX_FILE_BYTES`] bytes.
///
/// # Errors
/// Returns an error if the file is longer, or cannot be read as UTF-8.
pub fn read_text(path: &Path) -> Result<String, DocumentError> {
    read_text_up_to(path, MAX_FILE_BYTES)
}

/// Reads a file of at most `longest` bytes.
///
/// # Errors
/// Returns an error if the file is longer, or cannot be read as UTF-8.
pub fn read_text_up_to(path: &Path, longest: u64) -> Result<String, DocumentError> {
    let read = || {
        String::from_utf8(input::read_bytes(path, longest)?).map_err(|_| io::Error::other("it is not UTF-8"))
    };
    read().map_err(|error: io::Error| DocumentError::Unreadable {
        path: path.display().to_string(),
        reason: error.to_string(),
    })
}

/// Parses a text and checks it. `path` names the text in errors.
///
/// # Errors
/// Returns the first error in the text.
pub fn parse<Raw: DeserializeOwned, T>(
    path: &str,
    text: &str,
    check: impl FnOnce(Raw) -> Result<T, DocumentFault>,
) -> Result<T, DocumentError> {
    let wrong = |at, what| {
        let (line, column) = line_and_column(text, at);
        DocumentError::InvalidValue { path: path.to_owned(), line, column, what }
    };
    let signs = text.bytes().filter(|byte| b"=.,[{".contains(byte)).count();
    if signs > MAX_PUNCTUATION_CHARS {
        let reason = format!(
            "it has {signs} of the characters = . , [ {{, but at most {MAX_PUNCTUATION_CHARS} are allowed"
        );
        return Err(DocumentError::Unreadable { path: path.to_owned(), reason });
    }
    let raw = deserialize(text).map_err(|(at, what)| wrong(at, what))?;
    check(raw).map_err(|fault| wrong(offset_of(text, &fault.path), fault.to_string()))
}

/// Deserialises a document. An error consists of an offset in bytes and one line of text.
fn deserialize<T: DeserializeOwned>(text: &str) -> Result<T, (usize, String)> {
    toml::from_str(text).map_err(|error| {
        let at = error.span().unwrap_or_default();
        (
            at.start,
            mistakes::explain_parse_error(text, at, &error.message().lines().collect::<Vec<_>>().join("; ")),
        )
    })
}

/// Returns the byte offset of the value at a path. If the value does not exist, returns the offset of the innermost
/// table or array on the path that does.
fn offset_of(text: &str, path: &[PathStep]) -> usize {
    let Ok(root) = DeTable::parse(text) else { return 0 };
    let mut at = root.span().start;
    let mut table = Some(root.get_ref());
    let mut value: Option<&Spanned<DeValue<'_>>> = None;
    for step in path {
        let next = match step {
            PathStep::Key(key) => table.and_then(|table| table.get(*key)),
            PathStep::Index(index) => value.and_then(|value| value.get_ref().as_array()?.get(*index)),
        };
        let Some(next) = next else { break };
        at = next.span().start;
        table = next.get_ref().as_table();
        value = Some(next);
    }
    at
}

/// Converts an offset to a line and column, both counted from 1.
fn line_and_column(text: &str, at: usize) -> (usize, usize) {
    let before = text.get(..at).unwrap_or(text);
    let line = before.rsplit('\n').next().unwrap_or(before);
    (before.matches('\n').count() + 1, line.chars().count() + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seconds_are_spans_and_too_much_is_not_read() {
        assert_eq!((span_from_seconds(1.5), span_from_seconds(0.000_000_6)), (Span(1_500_000), Span(1)));
        let of = |signs| {
            let text = format!("#{}", ".".repeat(signs));
            parse("x.toml", &text, |_: toml::Table| Ok(())).map_err(|error| error.to_string())
        };
        assert_eq!(of(MAX_PUNCTUATION_CHARS), Ok(()));
        assert!(of(MAX_PUNCTUATION_CHARS + 1).unwrap_err().contains("it has 500001 of the characters"));
        assert!(of(MAX_PUNCTUATION_CHARS * 2).is_err());
    }
}
