//! Files that people write, in TOML, and the errors when something in them is wrong: one line that
//! names the file, the line and column, the key, the value and what is allowed.
//!
//! The file is read into a plain struct (`serde`, unknown keys refused); a `check` function
//! makes of it what it means, or a [`Fault`]. The file is read without positions, which is quick; only
//! when something is wrong is it read again with them.

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

/// One step from the file's root to a value.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Step {
    /// Into a table.
    Key(&'static str),
    /// Into an array, counted from 0.
    Index(usize),
}

/// What is wrong with a value, and where it stands.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Fault {
    path: Vec<Step>,
    value: String,
    why: String,
}

/// What was checked, or what is wrong with it.
pub type Checked<T> = Result<T, Fault>;

/// Where a value stands in a file, or a table of them; what is wrong there, and what is not.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Place(Vec<Step>);

impl Place {
    /// The file itself.
    #[must_use]
    pub const fn root() -> Self {
        Self(Vec::new())
    }

    /// A key of the file itself.
    #[must_use]
    pub fn named(key: &'static str) -> Self {
        Self(vec![Step::Key(key)])
    }

    /// A key of the table that stands here.
    #[must_use]
    pub fn key(&self, key: &'static str) -> Self {
        Self([&self.0[..], &[Step::Key(key)]].concat())
    }

    /// One of the values that stand here, counted from 0.
    #[must_use]
    pub fn nth(&self, index: usize) -> Self {
        Self([&self.0[..], &[Step::Index(index)]].concat())
    }

    /// What stands here cannot be, and why; an empty value is not printed.
    #[must_use]
    pub fn fault(&self, value: impl fmt::Display, why: impl fmt::Display) -> Fault {
        Fault { path: self.0.clone(), value: value.to_string(), why: why.to_string() }
    }

    /// What a word means, one of a few.
    ///
    /// # Errors
    /// Returns an error if it is none of them.
    pub fn word<T: Copy>(&self, got: &str, words: &[(&str, T)]) -> Result<T, Fault> {
        let found = words.iter().find(|(word, _)| *word == got);
        found.map(|&(_, meaning)| meaning).ok_or_else(|| {
            let mut words = words.iter().map(|(word, _)| format!("{word:?}")).collect::<Vec<_>>();
            let last = words.pop().unwrap_or_default();
            self.fault(format_args!("{got:?}"), format_args!("{} or {last}", words.join(", ")))
        })
    }

    /// A whole number within a range; `unit` is printed behind the range.
    ///
    /// # Errors
    /// Returns an error if it is outside.
    pub fn within(&self, got: i64, range: RangeInclusive<u32>, unit: &str) -> Result<u32, Fault> {
        u32::try_from(got).ok().filter(|value| range.contains(value)).ok_or_else(|| {
            let (min, max) = range.into_inner();
            self.fault(got, format_args!("{min} to {max}{unit} are possible"))
        })
    }

    /// A number that is neither infinite nor none at all.
    ///
    /// # Errors
    /// Returns an error if it is.
    pub fn finite(&self, value: f64) -> Result<f64, Fault> {
        if value.is_finite() { Ok(value) } else { Err(self.fault(value, "a finite number is needed")) }
    }

    /// A finite number above 0.
    ///
    /// # Errors
    /// Returns an error if it is not.
    pub fn positive(&self, value: f64) -> Result<f64, Fault> {
        let positive = value.is_finite() && value > 0.0;
        if positive { Ok(value) } else { Err(self.fault(value, "must be above 0")) }
    }

    /// The word that holds a number, as `fit` rounds it.
    ///
    /// # Errors
    /// Returns an error if it is outside the word's range.
    pub fn fit<const F: u32>(&self, value: f64, fit: Fit<F>) -> Result<Q<F>, Fault> {
        fit(value).map_err(|OutOfRange { min, bound, .. }| {
            self.fault(value, format_args!("its word holds [{min}, {bound})"))
        })
    }

    /// Sets a word that must not be negative, when a number is given for it.
    ///
    /// # Errors
    /// Returns an error if it is negative, or outside the word's range.
    pub fn set<const F: u32>(&self, given: Option<f64>, word: &mut Q<F>, fit: Fit<F>) -> Result<(), Fault> {
        match given {
            None => {}
            Some(value) if value < 0.0 => return Err(self.fault(value, "must not be negative")),
            Some(value) => *word = self.fit(value, fit)?,
        }
        Ok(())
    }
}

/// How a number is rounded to a word.
pub type Fit<const F: u32> = fn(f64) -> Result<Q<F>, OutOfRange>;

impl fmt::Display for Fault {
    /// `cell[3].joint = 9: the robot has joints 1 to 6`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, step) in self.path.iter().enumerate() {
            match step {
                Step::Key(key) if index == 0 => write!(f, "{key}")?,
                Step::Key(key) => write!(f, ".{key}")?,
                Step::Index(at) => write!(f, "[{at}]")?,
            }
        }
        if !self.value.is_empty() {
            write!(f, " = {}", self.value)?;
        }
        write!(f, ": {}", self.why)
    }
}

/// What is wrong with a file.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum DocumentError {
    /// It cannot be read.
    #[error("{path}: {reason}")]
    Unreadable {
        /// The file.
        path: String,
        /// Why.
        reason: String,
    },
    /// Something in it is wrong.
    #[error("{path}:{line}:{column}: {what}")]
    Wrong {
        /// The file.
        path: String,
        /// The line, from 1.
        line: usize,
        /// The column, from 1.
        column: usize,
        /// The key, the value, and what is allowed.
        what: String,
    },
    /// It is a file of another kind.
    #[error("{path}: {what}")]
    Mistaken {
        /// The file.
        path: String,
        /// What it is, and where it belongs.
        what: &'static str,
    },
}

impl DocumentError {
    /// What is said instead of a text that has one of the keys `has` and none of `lacks`: it is of another kind.
    #[must_use]
    pub fn or_mistaken(self, text: &str, has: &[&str], lacks: &[&str], what: &'static str) -> Self {
        let Self::Wrong { path, .. } = &self else { return self };
        let Ok(root) = DeTable::parse(text) else { return self };
        let any = |keys: &[&str]| keys.iter().any(|key| root.get_ref().contains_key(*key));
        if any(has) && !any(lacks) { Self::Mistaken { path: path.clone(), what } } else { self }
    }
}

/// The most bytes of a file that people write; a skin of 253 cells has 60 KB.
pub const LONGEST: u64 = 16 << 20;

/// The most keys, values and tables of a TOML file, by the signs that each of them needs. A skin of 10 000 cells has 280 000;
/// this many cost at most 0.5 GB of memory.
const MOST_SIGNS: usize = 500_000;

/// A length of time of so many seconds, which are not negative and no more than a file allows.
#[must_use]
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "bounded by whoever calls")]
pub fn span(seconds: f64) -> Span {
    Span((seconds * 1e6).round() as u64)
}

/// The text of a file of at most [`LONGEST`] bytes.
///
/// # Errors
/// Returns an error if it is longer, or cannot be read as UTF-8.
pub fn text(path: &Path) -> Result<String, DocumentError> {
    text_within(path, LONGEST)
}

/// The text of a file of at most so many bytes.
///
/// # Errors
/// Returns an error if it is longer, or cannot be read as UTF-8.
pub fn text_within(path: &Path, longest: u64) -> Result<String, DocumentError> {
    let read =
        || String::from_utf8(input::bytes(path, longest)?).map_err(|_| io::Error::other("it is not UTF-8"));
    read().map_err(|error: io::Error| DocumentError::Unreadable {
        path: path.display().to_string(),
        reason: error.to_string(),
    })
}

/// Reads a text and checks it; `path` is what errors call it.
///
/// # Errors
/// The first thing that is wrong with it.
pub fn parse<Raw: DeserializeOwned, T>(
    path: &str,
    text: &str,
    check: impl FnOnce(Raw) -> Result<T, Fault>,
) -> Result<T, DocumentError> {
    let wrong = |at, what| {
        let (line, column) = line_and_column(text, at);
        DocumentError::Wrong { path: path.to_owned(), line, column, what }
    };
    let signs = text.bytes().filter(|byte| b"=.,[{".contains(byte)).count();
    if signs > MOST_SIGNS {
        let reason = format!("it has {signs} of the signs = . , [ {{ and at most {MOST_SIGNS} are read");
        return Err(DocumentError::Unreadable { path: path.to_owned(), reason });
    }
    let raw = deserialize(text).map_err(|(at, what)| wrong(at, what))?;
    check(raw).map_err(|fault| wrong(offset_of(text, &fault.path), fault.to_string()))
}

/// Parses a document; the error is where it stands, in bytes, and one line of text.
fn deserialize<T: DeserializeOwned>(text: &str) -> Result<T, (usize, String)> {
    toml::from_str(text).map_err(|error| {
        let at = error.span().unwrap_or_default();
        (at.start, mistakes::explained(text, at, &error.message().lines().collect::<Vec<_>>().join("; ")))
    })
}

/// Where the value at the end of the path stands, or the nearest thing above it that exists.
fn offset_of(text: &str, path: &[Step]) -> usize {
    let Ok(root) = DeTable::parse(text) else { return 0 };
    let mut at = root.span().start;
    let mut table = Some(root.get_ref());
    let mut value: Option<&Spanned<DeValue<'_>>> = None;
    for step in path {
        let next = match step {
            Step::Key(key) => table.and_then(|table| table.get(*key)),
            Step::Index(index) => value.and_then(|value| value.get_ref().as_array()?.get(*index)),
        };
        let Some(next) = next else { break };
        at = next.span().start;
        table = next.get_ref().as_table();
        value = Some(next);
    }
    at
}

/// A place in a text as people and editors count, both from 1.
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
        assert_eq!((span(1.5), span(0.000_000_6)), (Span(1_500_000), Span(1)));
        let of = |signs| {
            let text = format!("#{}", ".".repeat(signs));
            parse("x.toml", &text, |_: toml::Table| Ok(())).map_err(|error| error.to_string())
        };
        assert_eq!(of(MOST_SIGNS), Ok(()));
        assert!(of(MOST_SIGNS + 1).unwrap_err().contains("it has 500001 of the signs"));
        assert!(of(MOST_SIGNS * 2).is_err());
    }
}
