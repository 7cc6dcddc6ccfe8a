//! What is said over the wire between two ports, [`crate::wire`].

use super::field::{Absent, Field, Format};
use super::{ALWAYS, Layout, Text};

const ROUND: &str = "the exploration from which the depth is";
const DEPTH: &str = "wires to the gateway's side";
const WALK: &[Field] = &[
    Field::bits("walk", 8, 8, "which walk"),
    Field::bits("first", 16, 8, "the first number that is free"),
    Field::bits("last", 24, 8, "the last of them; none is free when the first is greater"),
];

const fn message(number: u8, name: &'static str, fields: &'static [Field], text: Text) -> Layout {
    Layout { number, name, prefix: "", fields, text }
}

/// The messages by their first byte. What a hello and a return say depends on several fields: they have no text here.
pub const PORT_MESSAGES: &[Layout] = &[
    message(
        1,
        "hello",
        &[
            Field::new("", 30, Format::Flag(1), "it has a label"),
            Field::bits("version", 8, 8, "the protocol's version"),
            Field::bits("number", 16, 8, "the cell's number; 0 of a cell without one, and of the gateway"),
            Field::bits("port", 24, 3, "the port that it says this on"),
            Field::new("hears", 27, Format::Flag(1), "it hears the other end"),
            Field::new("up", 28, Format::Flag(1), "its sums go out here"),
            Field::new("unnumbered", 29, Format::Flag(1), "it, or a cell below it, has no number yet"),
            Field::bits("round", 32, 8, ROUND).when(1, 1, Absent::Omitted),
            Field::bits("depth", 40, 8, DEPTH).when(1, 1, Absent::Omitted),
        ],
        &[],
    ),
    message(2, "join", &[], &[]),
    message(
        3,
        "grant",
        &[Field::bits("round", 8, 8, ROUND), Field::bits("depth", 16, 8, DEPTH)],
        &[(ALWAYS, ", round {round} depth {depth}")],
    ),
    message(4, "refuse", &[], &[]),
    message(5, "leave", &[], &[]),
    message(6, "left", &[], &[]),
    message(
        7,
        "state",
        &[Field::bits("epoch", 8, 8, "the first one whose sums are for the parent")],
        &[(ALWAYS, ", sums from epoch {epoch} on")],
    ),
    message(
        8,
        "missed",
        &[Field::bits("epoch", 8, 8, "the one whose sum was not taken")],
        &[(ALWAYS, ", the sum of epoch {epoch}")],
    ),
    message(
        9,
        "seek",
        &[Field::bits("round", 8, 8, "a later one than this is wanted")],
        &[(ALWAYS, ", a round later than {round}")],
    ),
    message(10, "number", WALK, &[(ALWAYS, ", walk {walk}, {first} to {last}")]),
    message(11, "return", WALK, &[]),
    message(12, "ask", &[], &[]),
];

/// The message whose first byte this is.
#[must_use]
pub fn port_message(number: u8) -> Option<&'static Layout> {
    PORT_MESSAGES.iter().find(|layout| layout.number == number)
}
