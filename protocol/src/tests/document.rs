//! Checks that the field tables of `docs/reference/protocol.md` match the schema, and that every requirement
//! on a cell has its own id and a test that names it.
//!
//! Each table stands between `<!-- fields: NAME -->` and `<!-- end -->`. With `SKINBUS_TAKE_OVER=yes` this
//! test writes the tables instead of comparing them.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test may stop")]

use core::fmt::Write;
use std::collections::BTreeSet;
use std::path::Path;

use crate::id::{Command, Kind};
use crate::message::State;
use crate::parameters::Parameter;
use crate::schema::{
    Field, FieldFormat, FieldRange, Layout, PacketSchema, packet_schemas, refusal_reasons, wire_layouts,
};

/// The documents with the requirements.
const REQUIREMENTS: [&str; 3] = [
    include_str!("../../../docs/reference/cell.md"),
    include_str!("../../../docs/reference/sensing.md"),
    include_str!("../../../docs/reference/tree.md"),
];
/// The folders with tests that name requirements.
const TESTS: [&str; 4] = ["cell-node", "protocol", "gateway/reference/src/tests", "tests/tests"];

const PATH: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/reference/protocol.md");

/// Returns the name and the text of every table in the document.
fn tables() -> [(&'static str, String); 4] {
    let of = |kind| packet_schemas().iter().find(|schema| schema.kind == kind).unwrap();
    [
        ("packets", kinds()),
        ("sensors", fields("page", &of(Kind::Sensors).layouts)),
        ("network", fields("page", &of(Kind::Network).layouts)),
        ("parameters", fields("parameter", &of(Kind::Configured).layouts)),
    ]
}

/// Returns the table of message kinds and commands, one per line.
fn kinds() -> String {
    let head = "| identifier | name | from | node field | words | epoch byte | count byte |\n|---|---|---|---|---|---|---|\n";
    let mut out = head.to_owned();
    for schema in packet_schemas() {
        let PacketSchema { kind, command, end, layouts, .. } = schema;
        let digit = *kind as u8;
        let id = match (command, kind) {
            (Some(command), _) => format!("`{digit}{:02}`", *command as u8),
            (None, Kind::Configure | Kind::Stimulus) => format!("`{digit}nn`, `{digit}FF`"),
            (None, _) => format!("`{digit}nn`"),
        };
        let is_parameter = matches!(kind, Kind::Configure | Kind::Configured);
        let first = layouts.first().and_then(|layout| layout.fields.first());
        let words = match first {
            None => "0".to_owned(),
            Some(words) if layouts.len() == 1 => {
                format!("{}, {}, {}", words.meaning, unit(words), format_of(words))
            }
            Some(_) if is_parameter => "see [parameters](#parameters)".to_owned(),
            Some(_) => "a page".to_owned(),
        };
        let only = layouts.first().filter(|_| layouts.len() == 1).map_or(&[][..], |layout| &layout.fields);
        let at = |from: usize, to: usize| {
            let there = end.iter().chain(only).filter(move |field| (from..to).contains(&field.first_bit()));
            let mut there: Vec<_> = there.collect();
            there.sort_by_key(|field| field.first_bit());
            let flag = |field: &Field| if field.first_bit() == 111 { "+ 0x80: " } else { "" };
            let all: Vec<_> = there
                .iter()
                .map(|field| format!("{}{}{}", flag(field), field.meaning, range(field)))
                .collect();
            if all.is_empty() { "0".to_owned() } else { all.join("; ") }
        };
        let (from, node) = match kind {
            Kind::Command => ("gateway", "command"),
            Kind::Network => ("cell, gateway", "sender"),
            Kind::Sum | Kind::Torque | Kind::Sensors | Kind::Configured => ("cell", "sender"),
            Kind::Configure | Kind::Stimulus => ("gateway", "addressee"),
        };
        let (name, epoch, count) = (command.map_or(kind.name(), Command::name), at(96, 104), at(104, 112));
        writeln!(out, "| {id} | {name} | {from} | {node} | {words} | {epoch} | {count} |").unwrap();
    }
    out
}

/// Returns the table of the fields in these layouts, one per line.
fn fields(of: &str, layouts: &[Layout]) -> String {
    let mut out =
        format!("| {of} | word | field | format | unit | range | meaning |\n|---|---|---|---|---|---|---|\n");
    for layout in layouts {
        let parameter = Parameter::from_number(layout.number).filter(|_| of == "parameter");
        let note = match parameter {
            Some(Parameter::Row(0)) => " to 47: row 1 to 32",
            Some(Parameter::Row(_)) => continue,
            Some(Parameter::Identity) => ", read only",
            Some(Parameter::Commit) => ", write only",
            Some(parameter) if parameter.is_volatile() => ", volatile",
            _ => "",
        };
        let name = if note.starts_with(" to") { "" } else { &layout.name };
        let mut title = format!("{} {name}", layout.number).trim_end().to_owned() + note;
        let mut row = |field: &Field, within: bool| {
            let choices = field.names.iter().filter(|_| field.format == FieldFormat::Choice);
            let names = choices.map(|(value, name)| format!("{value} {name}"));
            let names = names.collect::<Vec<_>>().join(", ");
            let meaning =
                if names.is_empty() { field.meaning.clone() } else { format!("{}: {names}", field.meaning) };
            let place = words(field, within);
            let name = if field.name.is_empty() { "" } else { field.name_without_unit() };
            let (format, unit, range) = (format_of(field), unit(field), range(field));
            let range = range.trim_start_matches(", ");
            writeln!(out, "| {title} | {place} | {name} | {format} | {unit} | {range} | {meaning} |")
                .unwrap();
            title.clear();
        };
        for field in layout.fields.iter().filter(|field| !matches!(field.format, FieldFormat::Total(_))) {
            row(field, false);
            if let FieldFormat::Group(group) = &field.format {
                group.iter().for_each(|part| row(part, true));
            }
        }
    }
    out
}

fn range(field: &Field) -> String {
    match field.range {
        FieldRange::All => String::new(),
        FieldRange::NotNegative | FieldRange::NotNegativeAtCommit => ", 0 or more".to_owned(),
        FieldRange::Within(min, max) if min == max => String::new(),
        FieldRange::Within(min, max) => format!(", {min} to {max}"),
    }
}

/// Returns the unit of a field on the wire, where angles are in quarter turns.
fn unit(field: &Field) -> &str {
    if matches!(field.format, FieldFormat::Angle | FieldFormat::Position) {
        "quarter turns"
    } else {
        &field.unit
    }
}

/// Formats the position of a field in words or bytes: `0`, `0 to 2`, `2, bits 8 to 15`.
fn words(field: &Field, within: bool) -> String {
    let (word, bit, width) = (field.first_bit() / 16, field.first_bit() % 16, usize::from(field.bit_width()));
    let bits = if width == 1 { format!("bit {bit}") } else { format!("bits {bit} to {}", bit + width - 1) };
    match (width, field.element_count()) {
        (32, _) => format!("{word}, {}", word + 1),
        (16, 1) => word.to_string(),
        (16, several) => format!("{word} to {}", word + several - 1),
        _ if within => bits,
        _ => format!("{word}, {bits}"),
    }
}

fn format_of(field: &Field) -> String {
    match &field.format {
        FieldFormat::Word => "unsigned".to_owned(),
        FieldFormat::Unsigned(bits) | FieldFormat::Parameter(bits) | FieldFormat::Page(bits) => {
            format!("unsigned, {bits} bits")
        }
        FieldFormat::Signed | FieldFormat::Choice | FieldFormat::Reason => "signed".to_owned(),
        FieldFormat::Flag(_) => "0 or 1".to_owned(),
        FieldFormat::Hex => "16 bits".to_owned(),
        FieldFormat::Fixed(bits)
        | FieldFormat::Threshold(bits)
        | FieldFormat::Saturating(bits)
        | FieldFormat::Total(bits) => {
            format!("Q{}.{bits}", 15 - bits)
        }
        FieldFormat::Angle | FieldFormat::Position => "Q1.14".to_owned(),
        FieldFormat::Torque => "Q3.12, or the bus' torque format".to_owned(),
        FieldFormat::Port => "unsigned, 8 bits".to_owned(),
        FieldFormat::Ports(..) => "bits".to_owned(),
        FieldFormat::State => "state".to_owned(),
        FieldFormat::Group(_) => "see below".to_owned(),
    }
}

#[test]
fn the_documents_tables_list_the_fields_of_the_schema() {
    let mut document = std::fs::read_to_string(PATH).unwrap();
    for (name, table) in tables() {
        let begin = format!("<!-- fields: {name} -->\n");
        let from = document.find(&begin).unwrap_or_else(|| panic!("no table {name}")) + begin.len();
        let to = from + document[from..].find("<!-- end -->").expect("an end");
        if std::env::var_os("SKINBUS_TAKE_OVER").is_some() {
            document.replace_range(from..to, &table);
        } else {
            assert_eq!(document[from..to], table, "SKINBUS_TAKE_OVER=yes writes the tables again");
        }
    }
    if std::env::var_os("SKINBUS_TAKE_OVER").is_some() {
        std::fs::write(PATH, document).unwrap();
    }
}

#[test]
fn the_document_names_every_reason_and_every_message_over_a_wire() {
    let document = std::fs::read_to_string(PATH).unwrap();
    for (number, why) in refusal_reasons() {
        assert!(document.contains(&format!("\n| {number} | ")), "{number}: {why}");
    }
    for Layout { number, name, .. } in wire_layouts() {
        assert!(document.contains(&format!("\n| {number} | {name} | ")), "{name}");
    }
}

#[test]
fn the_document_names_every_bit_of_the_state() {
    let document = std::fs::read_to_string(PATH).unwrap();
    for (bit, name) in State::NAMES {
        let row = format!("| {} | {} |", bit.0.trailing_zeros(), name.to_uppercase().replace('-', "_"));
        assert!(document.contains(&row), "{row}");
    }
}

/// Finds requirement ids in a text: letters, a dash, a number.
fn ids(text: &str) -> impl Iterator<Item = (&str, u32)> {
    let words = text.split(|c: char| !(c.is_ascii_alphanumeric() || c == '-'));
    words.filter_map(|word| {
        let (topic, number) = word.split_once('-')?;
        let is_topic = !topic.is_empty() && topic.bytes().all(|byte| byte.is_ascii_uppercase());
        Some((topic, number.parse().ok().filter(|_| is_topic)?))
    })
}

/// Returns the requirements in their order.
fn requirements() -> Vec<(&'static str, u32)> {
    let lines = REQUIREMENTS.into_iter().flat_map(str::lines);
    let bold = lines.filter_map(|line| line.strip_prefix("- **")?.split_once("**"));
    bold.flat_map(|(id, _)| ids(id)).collect()
}

/// Appends the source text of tests in a folder, and of the program that writes the golden logs.
fn test_sources(path: &Path, found: &mut String) {
    for entry in std::fs::read_dir(path).unwrap() {
        let path = entry.unwrap().path();
        let is_source = path.extension().is_some_and(|extension| extension == "rs" || extension == "py");
        if path.is_dir() && !path.ends_with("target") {
            test_sources(&path, found);
        } else if is_source {
            found.push_str(&std::fs::read_to_string(path).unwrap());
        }
    }
}

#[test]
fn requirements_are_numbered_and_named_by_a_test_or_said_to_have_none() {
    let requirements = requirements();
    assert!(requirements.len() > 80, "{} requirements", requirements.len());
    for (index, &(topic, number)) in requirements.iter().enumerate() {
        let before = requirements.iter().take(index).filter(|(other, _)| *other == topic).count();
        assert_eq!(u32::try_from(before + 1), Ok(number), "{topic}-{number} is out of turn");
    }
    let mut sources = String::new();
    let top = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    TESTS.into_iter().for_each(|tests| test_sources(&top.join(tests), &mut sources));
    let all: BTreeSet<_> = requirements.into_iter().collect();
    let is_known = |(topic, _): &(&str, u32)| all.iter().any(|(known, _)| known == topic);
    let named: BTreeSet<_> = ids(&sources).filter(is_known).collect();
    let unknown: Vec<_> = named.difference(&all).collect();
    assert!(unknown.is_empty(), "tests name what no document has: {unknown:?}");
    let [cell, ..] = REQUIREMENTS;
    let (_, without) = cell.split_once("## What no test checks").unwrap();
    assert_eq!(all.difference(&named).copied().collect::<BTreeSet<_>>(), ids(without).collect());
}
