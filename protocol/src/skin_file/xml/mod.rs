//! Reading of XML that a strict parser rejects, and detection of files that are not XML.
//!
//! [`decode`] decodes a file by its byte order mark or its declaration. [`prepare`] repairs common errors without
//! changing any value: it binds undeclared prefixes, blanks comments that contain `--` and document types without
//! definitions, and strips trailing NUL bytes. Line numbers do not change. [`detect_unexpected_file`] detects files
//! that are not XML or not of the expected kind. [`escaped`] escapes a text for XML or HTML.

mod encoding;
mod escape;
mod foreign;
mod tags;

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::fmt;
use std::ops::Range;

pub use encoding::{decode, utf16_encoding_name};
pub use escape::escaped;
pub use foreign::{UnexpectedFileKind, detect_unexpected_file, format_of_root_element};
use tags::{Tag, XmlPart, xml_parts};

/// Maximum number of attributes of an element. The limit exists because a parser compares each attribute with all
/// others.
pub const MAX_ATTRIBUTES: usize = 256;

/// Maximum number of prefixes in a file, and of their bindings. The limit exists because a parser compares each binding
/// with all others in scope.
const MAX_PREFIXES: usize = 64;
const MAX_PREFIX_BINDINGS: usize = 10_000;

/// An error in an XML file, with advice for the user.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct XmlFault {
    /// The line, from 1, if it is known.
    pub line: Option<usize>,
    /// The problem and the remedy, in one line.
    pub what: String,
}

impl XmlFault {
    fn at_offset(text: &str, offset: usize, what: impl Into<String>) -> Self {
        Self { line: Some(line_of(text.as_bytes(), offset)), what: what.into() }
    }
}

impl fmt::Display for XmlFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.line {
            Some(line) => write!(f, "line {line}: {}", self.what),
            None => f.write_str(&self.what),
        }
    }
}

/// Returns the line number, from 1, of an offset.
fn line_of(text: &[u8], offset: usize) -> usize {
    let before = text.get(..offset).unwrap_or(text);
    before.iter().filter(|byte| **byte == b'\n').count() + 1
}

/// A text that is ready for a parser.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct PreparedXml<'a> {
    /// The text from the first `<` of the file on, with the line breaks of the file.
    pub text: Cow<'a, str>,
    /// Number of lines of the file before the first `<`.
    pub lines_before: usize,
}

/// Repairs a text without changing a value.
///
/// # Errors
/// Returns an error if the text has a document type with definitions, an element with more than
/// [`MAX_ATTRIBUTES`] attributes, or content after the root element.
pub fn prepare(file: &str) -> Result<PreparedXml<'_>, XmlFault> {
    let end = file.trim_end_matches(|letter: char| letter == '\0' || letter.is_whitespace()).len();
    let whole = file.get(..end).unwrap_or(file);
    let text = whole.trim_start_matches('\u{feff}').trim_start();
    let before = whole.len() - text.len();
    let mut survey = XmlSurvey::default();
    for part in xml_parts(text) {
        survey
            .visit_part(text, part)
            .map_err(|(offset, what)| XmlFault::at_offset(whole, before + offset, what))?;
    }
    survey.check_limits()?;
    Ok(PreparedXml { text: survey.repair_text(text), lines_before: line_of(whole.as_bytes(), before) - 1 })
}

/// Prefixes and ranges found in one pass over a text, for the limits and the repairs.
#[derive(Debug, Default)]
struct XmlSurvey<'a> {
    /// Byte ranges of the comments and document types to be blanked.
    blanked: Vec<Range<usize>>,
    /// Prefixes that elements and attributes use.
    used: BTreeSet<&'a str>,
    /// Prefixes that the root element binds.
    bound: BTreeSet<&'a str>,
    /// All prefixes that the text binds, and the number of bindings.
    prefixes: BTreeSet<&'a str>,
    bindings: usize,
    /// Byte offset of the end of the root element's name.
    root: Option<usize>,
    depth: usize,
    /// True after the root element has ended.
    is_over: bool,
}

impl<'a> XmlSurvey<'a> {
    /// Processes the next part of the text. An error consists of a byte offset and the reason.
    fn visit_part(&mut self, text: &str, part: XmlPart<'a>) -> Result<(), (usize, String)> {
        let of = |range: &Range<usize>| text.get(range.clone()).unwrap_or_default();
        let content = match &part {
            XmlPart::Text(range) => Some(range).filter(|range| !of(range).trim().is_empty()),
            XmlPart::Close(range) => Some(range),
            XmlPart::Open(tag) => Some(&tag.range),
            XmlPart::Comment(_) | XmlPart::DocType(_) | XmlPart::Other => None,
        };
        if self.is_over
            && let Some(range) = content
        {
            let what = "there is content after the root element: delete it";
            return Err((range.end - of(range).trim_start().len(), what.to_owned()));
        }
        match part {
            XmlPart::Comment(range) => {
                let inner = text.get(range.start + 4..range.end.saturating_sub(3)).unwrap_or_default();
                if inner.contains("--") || inner.ends_with('-') {
                    self.blanked.push(range);
                }
            }
            XmlPart::DocType(range) => {
                if of(&range).contains('[') {
                    let what = "the <!DOCTYPE contains definitions, which this program does not read: delete it, and \
                                replace its entities by their values";
                    return Err((range.start, what.to_owned()));
                }
                self.blanked.push(range);
            }
            XmlPart::Text(_) | XmlPart::Other => {}
            XmlPart::Close(_) => {
                self.depth = self.depth.saturating_sub(1);
                self.is_over = self.depth == 0 && self.root.is_some();
            }
            XmlPart::Open(tag) => self.visit_tag(&tag)?,
        }
        Ok(())
    }

    fn visit_tag(&mut self, tag: &Tag<'a>) -> Result<(), (usize, String)> {
        let count = tag.attributes.len();
        if count > MAX_ATTRIBUTES {
            let name = tag.name.chars().take(40).collect::<String>();
            let what = format!(
                "element {name} has {count} attributes, but at most {MAX_ATTRIBUTES} are allowed: delete some"
            );
            return Err((tag.range.start, what));
        }
        self.bindings += tag.attributes.iter().filter(|name| name.split(':').next() == Some("xmlns")).count();
        let names = tag.attributes.iter().copied().chain([tag.name]);
        for (prefix, local) in names.filter_map(|name| name.split_once(':')) {
            if prefix == "xmlns" {
                self.prefixes.insert(local);
                if self.root.is_none() {
                    self.bound.insert(local);
                }
            } else {
                self.prefixes.insert(prefix);
                self.used.insert(prefix);
            }
        }
        self.root.get_or_insert(tag.range.start + 1 + tag.name.len());
        if !tag.is_empty {
            self.depth += 1;
        } else if self.depth == 0 {
            self.is_over = true;
        }
        Ok(())
    }

    /// Checks the numbers of prefixes and bindings, on which a parser's running time depends.
    fn check_limits(&self) -> Result<(), XmlFault> {
        for (count, what, most) in [
            (self.prefixes.len(), "prefixes of names", MAX_PREFIXES),
            (self.bindings, "xmlns attributes", MAX_PREFIX_BINDINGS),
        ] {
            if count > most {
                let what =
                    format!("it has {count} {what}, but at most {most} are allowed: delete the unused ones");
                return Err(XmlFault { line: None, what });
            }
        }
        Ok(())
    }

    /// Returns the text with undeclared prefixes bound at the root element, and with spaces in place of the blanked
    /// ranges.
    fn repair_text(self, text: &str) -> Cow<'_, str> {
        let unbound = self.used.difference(&self.bound).filter(|prefix| is_bindable_prefix(prefix));
        let names = unbound.map(|prefix| format!(" xmlns:{prefix}=\"unbound:{prefix}\"")).collect::<String>();
        let insert = self.root.filter(|_| !names.is_empty()).map(|at| at..at);
        let mut changes: Vec<_> = self.blanked.into_iter().chain(insert).collect();
        if changes.is_empty() {
            return Cow::Borrowed(text);
        }
        changes.sort_by_key(|range| range.start);
        let mut repaired = String::with_capacity(text.len() + names.len());
        let mut from = 0;
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
        Cow::Owned(repaired)
    }
}

/// Returns true for a prefix that a file may bind: a valid name other than the predefined `xml` and `xmlns`.
fn is_bindable_prefix(prefix: &str) -> bool {
    let mut letters = prefix.chars();
    !matches!(prefix, "xml" | "xmlns")
        && letters.next().is_some_and(|first| first.is_alphabetic() || first == '_')
        && letters.all(|letter| letter.is_alphanumeric() || "-_.".contains(letter))
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
        // A binding inside the file applies only within its element.
        let inner = repaired("<r><a xmlns:s='x'/><s:b/></r>");
        assert!(inner.starts_with("<r xmlns:s=\"unbound:s\">"), "{inner}");
        let many: String = (0..65).map(|number| format!("<p{number}:a/>")).collect();
        assert!(refused(&format!("<r>{many}</r>")).contains("it has 65 prefixes of names, but at most 64"));
        let nested: String = (0..5_000).map(|number| format!("<x xmlns:a{number}='1'>")).collect();
        assert!(refused(&nested).contains("it has 5000 prefixes"));
        let again = "<x xmlns='1'/>".repeat(MAX_PREFIX_BINDINGS + 1);
        assert!(refused(&format!("<r>{again}</r>")).contains("it has 10001 xmlns attributes"));
    }

    #[test]
    fn comments_and_document_types_are_blanked() {
        assert_eq!(repaired("<r><!-- a\n -- b --><e/></r>"), "<r>      \n         <e/></r>");
        assert_eq!(repaired("<!DOCTYPE robot>\n<r/>"), "                \n<r/>");
        assert_eq!(repaired("<!DOCTYPE r SYSTEM \"a>b.dtd\"><r/>").trim_start(), "<r/>");
        assert_eq!(
            refused("\n<!DOCTYPE r [ <!ENTITY a \"]>\"> ]>\n<r/>"),
            "line 2: the <!DOCTYPE contains definitions, which this program does not read: delete it, and \
             replace its entities by their values"
        );
    }

    #[test]
    fn nothing_stands_behind_the_outermost_element() {
        let behind = "line 2: there is content after the root element: delete it";
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
            "line 2: element e has 50000 attributes, but at most 256 are allowed: delete some"
        );
    }
}
