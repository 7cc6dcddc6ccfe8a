//! XML that other programs read and a strict parser refuses, made readable; and files that are something else.
//!
//! [`text`] decodes a file by its byte order mark or its declaration. [`prepare`] repairs what changes no value: it binds
//! prefixes that the file does not, blanks comments with `--` inside and a document type without definitions, and takes
//! NUL bytes off the end. Lines stay where they are. [`foreign`] names files that are no XML or the wrong one.

mod encoding;
mod foreign;
mod tags;

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::fmt;
use std::ops::Range;

pub use encoding::text;
pub use foreign::{Foreign, foreign, kind_of_root};
use tags::{Part, parts};

/// The most attributes of an element: a parser compares each with all others.
pub const MAX_ATTRIBUTES: usize = 256;

/// The most prefixes of a file, and how often it may bind them: a parser compares those that are bound around an element that
/// binds one more.
const MAX_PREFIXES: usize = 64;
const MAX_BINDINGS: usize = 10_000;

/// A fault of a file, and what to do.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Fault {
    /// The line, from 1, where it has one.
    pub line: Option<usize>,
    /// One line: what is there, and what to do.
    pub what: String,
}

impl Fault {
    fn at(text: &str, offset: usize, what: impl Into<String>) -> Self {
        Self { line: Some(line_of(text, offset)), what: what.into() }
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.line {
            Some(line) => write!(f, "line {line}: {}", self.what),
            None => f.write_str(&self.what),
        }
    }
}

/// The line, from 1, of a place in a text.
#[must_use]
pub fn line_of(text: &str, offset: usize) -> usize {
    let before = text.as_bytes().get(..offset).unwrap_or(text.as_bytes());
    before.iter().filter(|byte| **byte == b'\n').count() + 1
}

/// A text that is ready for a parser.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Prepared<'a> {
    /// It begins with the first `<`; its lines are those of the file.
    pub text: Cow<'a, str>,
    /// Lines of the file before it.
    pub lines_before: usize,
}

/// Repairs what changes no value.
///
/// # Errors
/// When it has a document type with definitions, an element with more than [`MAX_ATTRIBUTES`] attributes, or anything behind
/// its outermost element.
pub fn prepare(file: &str) -> Result<Prepared<'_>, Fault> {
    let end = file.trim_end_matches(|letter: char| letter == '\0' || letter.is_whitespace()).len();
    let whole = file.get(..end).unwrap_or(file);
    let text = whole.trim_start_matches('\u{feff}').trim_start();
    let lines_before = line_of(whole, whole.len() - text.len()) - 1;
    let fault = |offset, what: String| {
        let Fault { line, what } = Fault::at(text, offset, what);
        Fault { line: line.map(|line| line + lines_before), what }
    };
    let mut blanked = Vec::new();
    let (mut used, mut bound) = (BTreeSet::new(), BTreeSet::from(["xml", "xmlns"]));
    let (mut prefixes, mut bindings) = (BTreeSet::new(), 0);
    let (mut root, mut depth, mut is_over) = (None, 0_usize, false);
    for part in parts(text) {
        let behind = |range: &Range<usize>| {
            let there = text.get(range.clone()).unwrap_or_default();
            let what = "something stands behind the end of the outermost element: delete it";
            fault(range.end - there.trim_start().len(), what.to_owned())
        };
        match part {
            Part::Comment(range) => {
                let inner = text.get(range.start + 4..range.end.saturating_sub(3)).unwrap_or_default();
                if inner.contains("--") || inner.ends_with('-') {
                    blanked.push(range);
                }
            }
            Part::Type(range) => {
                if text.get(range.clone()).unwrap_or_default().contains('[') {
                    let what = "a <!DOCTYPE with definitions, which are not read: delete it, and write what its \
                                entities stand for in their places";
                    return Err(fault(range.start, what.to_owned()));
                }
                blanked.push(range);
            }
            Part::Text(range)
                if is_over && !text.get(range.clone()).unwrap_or_default().trim().is_empty() =>
            {
                return Err(behind(&range));
            }
            Part::Text(_) | Part::Other => {}
            Part::Close(range) => {
                if is_over {
                    return Err(behind(&range));
                }
                depth = depth.saturating_sub(1);
                is_over = depth == 0 && root.is_some();
            }
            Part::Open(tag) => {
                if is_over {
                    return Err(behind(&tag.range));
                }
                let count = tag.attributes.len();
                if count > MAX_ATTRIBUTES {
                    let name = tag.name.chars().take(40).collect::<String>();
                    let what = format!(
                        "element {name} has {count} attributes, and at most {MAX_ATTRIBUTES} are read: delete some"
                    );
                    return Err(fault(tag.range.start, what));
                }
                let names = tag.attributes.iter().copied().chain([tag.name]);
                bindings +=
                    tag.attributes.iter().filter(|name| name.split(':').next() == Some("xmlns")).count();
                for (prefix, local) in names.filter_map(|name| name.split_once(':')) {
                    if prefix == "xmlns" {
                        prefixes.insert(local);
                        if root.is_none() {
                            bound.insert(local);
                        }
                    } else {
                        prefixes.insert(prefix);
                        used.insert(prefix);
                    }
                }
                if root.is_none() {
                    root = Some(tag.range.start + 1 + tag.name.len());
                }
                if !tag.is_empty {
                    depth += 1;
                } else if depth == 0 {
                    is_over = true;
                }
            }
        }
    }
    let is_name = |prefix: &&&str| {
        let mut letters = prefix.chars();
        letters.next().is_some_and(|first| first.is_alphabetic() || first == '_')
            && letters.all(|letter| letter.is_alphanumeric() || "-_.".contains(letter))
    };
    let unbound: Vec<_> = used.difference(&bound).filter(is_name).collect();
    let too_many = |count: usize, what: &str, most: usize| {
        let what =
            format!("it has {count} {what}, and at most {most} are read: delete those that nothing needs");
        Err(Fault { line: None, what })
    };
    if prefixes.len() > MAX_PREFIXES {
        return too_many(prefixes.len(), "prefixes of names", MAX_PREFIXES);
    }
    if bindings > MAX_BINDINGS {
        return too_many(bindings, "xmlns attributes", MAX_BINDINGS);
    }
    if blanked.is_empty() && unbound.is_empty() {
        return Ok(Prepared { text: Cow::Borrowed(text), lines_before });
    }
    let mut repaired = String::with_capacity(text.len() + 40 * unbound.len());
    let mut from = 0;
    let names =
        unbound.iter().map(|prefix| format!(" xmlns:{prefix}=\"unbound:{prefix}\"")).collect::<String>();
    let insert = root.filter(|_| !unbound.is_empty()).map(|at| at..at);
    let mut changes: Vec<_> = blanked.into_iter().chain(insert).collect();
    changes.sort_by_key(|range| range.start);
    for range in changes {
        repaired.push_str(text.get(from..range.start).unwrap_or_default());
        if range.is_empty() {
            repaired.push_str(&names);
        }
        let old = text.get(range.clone()).unwrap_or_default();
        repaired.extend(old.chars().map(|letter| if letter == '\n' { '\n' } else { ' ' }));
        from = range.end;
    }
    repaired.push_str(text.get(from..).unwrap_or_default());
    Ok(Prepared { text: Cow::Owned(repaired), lines_before })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn repaired(text: &str) -> String {
        prepare(text).unwrap().text.into_owned()
    }

    fn refused(text: &str) -> String {
        prepare(text).unwrap_err().to_string()
    }

    #[test]
    fn a_good_text_is_left_as_it_is() {
        let good = "<?xml version='1.0'?>\n<!-- a - b -->\n<r xmlns:s='x' a='>' s:b=\"<\"><s:e/>t<![CDATA[</r>]]></r>\n<!-- c -->";
        let prepared = prepare(good).unwrap();
        assert!(matches!(prepared.text, Cow::Borrowed(_)));
        assert_eq!(prepared.text, good);
        let before = prepare("\u{feff}\n\n <r/>\n").unwrap();
        assert_eq!((&*before.text, before.lines_before), ("<r/>", 2));
        assert_eq!(repaired("<r/>\n\0\0"), "<r/>");
    }

    #[test]
    fn prefixes_are_bound_at_the_outermost_element() {
        assert_eq!(
            repaired("<r n='1'><a drake:x='1'/><s:b/><s:b/></r>"),
            "<r xmlns:drake=\"unbound:drake\" xmlns:s=\"unbound:s\" n='1'><a drake:x='1'/><s:b/><s:b/></r>"
        );
        // A binding within the file stands for what is within it only.
        let inner = repaired("<r><a xmlns:s='x'/><s:b/></r>");
        assert!(inner.starts_with("<r xmlns:s=\"unbound:s\">"), "{inner}");
        let many: String = (0..65).map(|number| format!("<p{number}:a/>")).collect();
        assert!(refused(&format!("<r>{many}</r>")).contains("it has 65 prefixes of names, and at most 64"));
        let nested: String = (0..5_000).map(|number| format!("<x xmlns:a{number}='1'>")).collect();
        assert!(refused(&nested).contains("it has 5000 prefixes"));
        let again = "<x xmlns='1'/>".repeat(MAX_BINDINGS + 1);
        assert!(refused(&format!("<r>{again}</r>")).contains("it has 10001 xmlns attributes"));
    }

    #[test]
    fn comments_and_document_types_are_blanked() {
        assert_eq!(repaired("<r><!-- a\n -- b --><e/></r>"), "<r>      \n         <e/></r>");
        assert_eq!(repaired("<!DOCTYPE robot>\n<r/>"), "                \n<r/>");
        assert_eq!(repaired("<!DOCTYPE r SYSTEM \"a>b.dtd\"><r/>").trim_start(), "<r/>");
        assert_eq!(
            refused("\n<!DOCTYPE r [ <!ENTITY a \"]>\"> ]>\n<r/>"),
            "line 2: a <!DOCTYPE with definitions, which are not read: delete it, and write what its entities stand for in their places"
        );
    }

    #[test]
    fn nothing_stands_behind_the_outermost_element() {
        let behind = "line 2: something stands behind the end of the outermost element: delete it";
        for text in ["<r></r>\n<r/>", "<r/>\njunk", "<r><r/></r>\n</r>"] {
            assert_eq!(refused(text), behind, "{text}");
        }
    }

    #[test]
    fn many_attributes_are_counted_in_one_pass() {
        let element = |count: usize| {
            let attributes: String = (0..count).map(|number| format!(" a{number}=''")).collect();
            format!("<r>\n<e{attributes}/></r>")
        };
        assert!(prepare(&element(MAX_ATTRIBUTES)).is_ok());
        assert_eq!(
            refused(&element(50_000)),
            "line 2: element e has 50000 attributes, and at most 256 are read: delete some"
        );
    }
}
