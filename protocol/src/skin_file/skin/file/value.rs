//! Values to write into a skin file.

use core::fmt::{self, Write};

use crate::usage::is_unprintable;

/// A value to write into a skin file. Numbers must be finite.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value<'a> {
    /// An integer.
    Integer(i64),
    /// A number, written with the fewest digits that identify it.
    Number(f64),
    /// An array of numbers, each written with the fewest digits that identify it.
    Numbers(&'a [f64]),
    /// An array of node ids, where 0 is a free port.
    Nodes(&'a [u8]),
    /// A string, written in quotes.
    Text(&'a str),
    /// A boolean.
    Flag(bool),
}

impl fmt::Display for Value<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Integer(value) => write!(f, "{value}"),
            Self::Number(value) => write!(f, "{value:?}"),
            Self::Numbers(values) => write!(f, "{values:?}"),
            Self::Nodes(values) => write!(f, "{values:?}"),
            Self::Text(text) => write_quoted(f, text),
            Self::Flag(value) => write!(f, "{value}"),
        }
    }
}

/// Writes a basic string of TOML, whose escapes differ from Rust's.
fn write_quoted(f: &mut fmt::Formatter<'_>, text: &str) -> fmt::Result {
    f.write_char('"')?;
    for letter in text.chars() {
        match letter {
            '"' | '\\' => write!(f, "\\{letter}")?,
            '\n' => f.write_str("\\n")?,
            '\r' => f.write_str("\\r")?,
            '\t' => f.write_str("\\t")?,
            letter if is_unprintable(letter) && letter > '\u{ffff}' => write!(f, "\\U{:08x}", letter as u32)?,
            letter if is_unprintable(letter) => write!(f, "\\u{:04x}", letter as u32)?,
            letter => f.write_char(letter)?,
        }
    }
    f.write_char('"')
}
