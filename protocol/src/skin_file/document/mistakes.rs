//! Error messages for mistakes that the TOML parser finds. They name the key, its value and the allowed values.

use core::ops::Range;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::skin::CellName;

/// Maximum number of characters quoted from a value.
const MAX_QUOTED_CHARS: usize = 40;

/// Rewrites the parser's error message about the value at the bytes `at` in terms of the key and its value.
pub(super) fn explain_parse_error(text: &str, at: Range<usize>, message: &str) -> String {
    let found = DeTable::parse(text).ok().and_then(|root| find_in_table(root.get_ref(), at.start));
    if let Some(field) = message.strip_prefix("missing field ") {
        // A key that is missing at the top level has no table.
        let table = found.filter(|found| found.value == at).map(|found| format!("{}: ", found.path));
        return format!("{}key {field} is missing", table.unwrap_or_default());
    }
    let Some(FoundValue { path, value }) = found else { return explain_syntax_error(message) };
    let value = text.get(value).unwrap_or_default().lines().next().unwrap_or_default();
    let quoted = value.chars().take(MAX_QUOTED_CHARS).collect::<String>();
    let Some(allowed) = describe_allowed_values(&path, message) else { return message.to_owned() };
    match quoted.starts_with('[') && allowed.contains("[[") {
        true => format!("{path}: {allowed}"),
        false => format!("{path} = {quoted}: {allowed}"),
    }
}

/// Describes the values that the parser expected at a path; `None` if its message does not contain them.
fn describe_allowed_values(path: &str, message: &str) -> Option<String> {
    if let Some((got, target)) = message
        .strip_prefix("invalid length ")
        .and_then(|rest| rest.split_once(", expected an array of length "))
    {
        return Some(format!("must have {target} values, not {got}"));
    }
    let (got, expected) = message.strip_prefix("invalid type: ")?.split_once(", expected ")?;
    Some(match expected {
        "a sequence" if got == "map" => format!("must be a list of tables: write [[{path}]]"),
        "f64" => "must be a number".to_owned(),
        "i64" | "u64" | "u32" | "u8" if got.starts_with("integer ") => "the number is too large".to_owned(),
        "i64" | "u64" | "u32" | "u8" => match parse_cell_name(got) {
            Some(CellName { bus: Some(bus), node }) => {
                format!("must be a whole number: write {node}, and bus = \"{bus}\" as a separate key")
            }
            Some(_) | None => "must be a whole number".to_owned(),
        },
        table if table.starts_with("struct ") => {
            format!("must be a table: write [{path}], and its keys below")
        }
        "a string" => "must be text in quotes".to_owned(),
        "a boolean" => "must be true or false".to_owned(),
        list if list == "a sequence" || list.starts_with("an array") || list.starts_with("a tuple") => {
            "must be a list of values in brackets".to_owned()
        }
        // A value of several types lists them itself.
        either if either.starts_with("either ") => format!("must be {either}"),
        _ => return None,
    })
}

/// Parses the name of a cell that the user has copied from the command line: `string "BUS:NODE"`.
fn parse_cell_name(got: &str) -> Option<CellName> {
    got.strip_prefix("string \"")?.strip_suffix('"')?.parse().ok()
}

/// Rewrites the parser's message about text that is not TOML, without the parser's advice, which only fits strings.
fn explain_syntax_error(message: &str) -> String {
    let more = if message.starts_with("string values must be quoted") {
        "; write numbers without units or formulas, such as 5000000 or 1.5708"
    } else if message.starts_with("duplicate key") {
        "; begin each bus, cell, touch or fault with [[bus]], [[cell]], [[touch]] or [[fault]]"
    } else {
        ""
    };
    format!("{message}{more}")
}

/// A value and its path.
struct FoundValue {
    path: String,
    value: Range<usize>,
}

/// Returns the innermost value at this byte of a table.
fn find_in_table(table: &DeTable<'_>, at: usize) -> Option<FoundValue> {
    table.iter().find_map(|(key, value)| find_in_value(key.get_ref(), value, at))
}

fn find_in_value(path: &str, value: &Spanned<DeValue<'_>>, at: usize) -> Option<FoundValue> {
    let inner = match value.get_ref() {
        DeValue::Table(table) => find_in_table(table, at)
            .map(|found| FoundValue { path: format!("{path}.{}", found.path), ..found }),
        DeValue::Array(values) => values
            .iter()
            .enumerate()
            .find_map(|(index, value)| find_in_value(&format!("{path}[{index}]"), value, at)),
        DeValue::String(_)
        | DeValue::Integer(_)
        | DeValue::Float(_)
        | DeValue::Boolean(_)
        | DeValue::Datetime(_) => None,
    };
    inner.or_else(|| {
        value.span().contains(&at).then(|| FoundValue { path: path.to_owned(), value: value.span() })
    })
}
