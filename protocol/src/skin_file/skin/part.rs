//! Parsing of a skin with the cells of one bus only. A cell process serves one bus and need not parse the cells of the
//! others, which are most of a large file.

use std::path::Path;

use super::{DocumentError, Skin, check};
use crate::document;

impl Skin {
    /// Reads a file with the cells of one bus only, like [`Skin::parse_for_bus`].
    ///
    /// # Errors
    /// Returns an error if the file cannot be read, or the first error in it.
    pub fn read_for_bus(path: &Path, bus: &str) -> Result<Self, DocumentError> {
        Self::parse_for_bus(&path.display().to_string(), &document::read_text(path)?, bus)
    }

    /// Like [`Skin::parse`], but with the cells of one bus only, as [`Skin::with_cells_of_bus`] returns them. If the
    /// skin has no bus of this name, it keeps all cells. The cells of other buses are not checked, unless the rest of
    /// the text has an error: then the whole text is parsed, to report its first error.
    ///
    /// # Errors
    /// Returns the first error in the text.
    pub fn parse_for_bus(path: &str, text: &str, bus: &str) -> Result<Self, DocumentError> {
        if let Some(part) = without_other_cells(text, bus)
            && let Ok(skin) = document::parse(path, &part, |raw| check::check_skin_of_bus(raw, bus))
        {
            return Ok(skin);
        }
        let skin = Self::parse(path, text)?;
        let index = skin.bus_index(bus);
        Ok(index.map(|index| skin.with_cells_of_bus(index)).unwrap_or(skin))
    }
}

/// Returns the text without the `[[cell]]` tables that name another bus. Returns `None` if a line may be inside a
/// multi-line string, where tables cannot be recognised.
fn without_other_cells(text: &str, bus: &str) -> Option<String> {
    if text.contains("\"\"\"") || text.contains("'''") {
        return None;
    }
    let mut part = String::new();
    // The start of the current section, whether it is a cell, and whether that is on another bus.
    let (mut begun, mut is_cell, mut is_other, mut at) = (0, false, false, 0);
    for line in text.split_inclusive('\n') {
        let word = line.trim_start();
        // A line of a multi-line array may look like a header. The rest of such a section does not parse as a
        // skin.
        if word.starts_with('[') {
            part.push_str(text.get(begun..at).filter(|_| !is_other).unwrap_or_default());
            (begun, is_cell, is_other) = (at, word.starts_with("[[cell]]"), false);
        } else if is_cell && !is_other {
            is_other = bus_of_line(word).is_some_and(|named| named != bus);
        }
        at += line.len();
    }
    part.push_str(text.get(begun..).filter(|_| !is_other).unwrap_or_default());
    Some(part)
}

/// Returns the name of the bus in a line `bus = "NAME"`; `None` for any other line.
fn bus_of_line(line: &str) -> Option<&str> {
    let value = line.strip_prefix("bus")?.trim_start().strip_prefix('=')?.trim_start().strip_prefix('"')?;
    let (name, _) = value.split_once('"')?;
    (!name.contains('\\')).then_some(name)
}

#[cfg(test)]
mod tests {
    use super::super::tests::GOOD;
    use super::*;

    /// Returns the text [`GOOD`] with two buses and cells on each.
    fn two_buses(reply: &str) -> String {
        let bus = "[[bus]]\nname = \"vcan0\"\nreply = \"torque\"\nformat = \"fd\"\n\n";
        let other = bus.replace("vcan0", "vcan1").replace("\"torque\"", reply);
        let text = GOOD.replace(bus, &(bus.replace("\"torque\"", reply) + &other));
        let (head, cells) = text.split_at(text.find("[[cell]]").unwrap());
        let cells = cells.replace("node = 1\n", "node = 1\nroot = true\n");
        format!(
            "{head}{cells}\n# The cells of vcan1.\n{}",
            cells.replace("bus = \"vcan0\"", "bus = \"vcan1\"")
        )
    }

    #[test]
    fn a_part_is_that_of_the_whole_and_leaves_the_rest_unread() {
        for reply in ["\"torque\"", "\"sum\"\nslot_us = 100"] {
            let text = two_buses(reply);
            let whole = Skin::parse("skin.toml", &text).unwrap();
            for (index, bus) in ["vcan0", "vcan1"].into_iter().enumerate() {
                assert_eq!(
                    Skin::parse_for_bus("skin.toml", &text, bus).unwrap(),
                    whole.with_cells_of_bus(index),
                    "{bus}"
                );
                let part = without_other_cells(&text, bus).unwrap();
                assert_eq!((part.matches("[[cell]]").count(), part.matches("[[bus]]").count()), (2, 2));
            }
            assert_eq!(Skin::parse_for_bus("skin.toml", &text, "vcan2").unwrap(), whole, "of no bus, all");
        }
        assert_eq!(Skin::parse_for_bus("skin.toml", GOOD, "vcan0"), Skin::parse("skin.toml", GOOD));
    }

    #[test]
    fn cells_that_name_their_bus_in_another_way_are_read_too() {
        let text = two_buses("\"torque\"");
        let whole = Skin::parse("skin.toml", &text).unwrap();
        for (from, to) in [
            ("bus = \"vcan1\"", "bus='vcan1'"),
            ("bus = \"vcan1\"", "\"bus\" = \"vcan1\""),
            ("bus = \"vcan1\"", "bus = \"vcan\\u0031\""),
            ("[[cell]]", "[[ cell ]] # one"),
            ("[[cell]]", "  [[cell]]# one"),
            ("name = \"two\"", "name = \"\"\"two\"\"\""),
            ("position = [0.1, 0.0, 0.06]", "position = [\n  0.1,\n  0.0, 0.06\n]"),
        ] {
            let text = text.replace(from, to);
            for (index, bus) in ["vcan0", "vcan1"].into_iter().enumerate() {
                assert_eq!(
                    Skin::parse_for_bus("skin.toml", &text, bus).unwrap(),
                    whole.with_cells_of_bus(index),
                    "{to}"
                );
            }
        }
    }

    #[test]
    fn an_error_is_that_of_the_whole() {
        let text = two_buses("\"torque\"");
        for (from, to) in [
            ("joint = 2", "joint = 9"),
            ("neighbors = [2, 0, 0, 0]", "neighbors = [[2], 0, 0, 0]"),
            ("version = 1", "version = 2"),
            ("bus = \"vcan1\"", "bus = \"vcan7\""),
        ] {
            let text = text.replace(from, to);
            let whole = Skin::parse("skin.toml", &text);
            let part = Skin::parse_for_bus("skin.toml", &text, "vcan0");
            assert!(whole.is_err());
            assert!(part == whole || to.contains("vcan7"), "{to}: {part:?}");
        }
    }

    proptest::proptest! {
        #[test]
        fn no_text_panics(text in "(\\[\\[cell\\]\\]|\\[bus|bus = \"a|\"|\n|=|'| |é){0,40}") {
            let _ = (without_other_cells(&text, "a"), Skin::parse_for_bus("skin.toml", &text, "a"));
        }
    }
}
