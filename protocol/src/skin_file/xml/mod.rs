//! XML that other programs read and a strict parser refuses, made readable; and files that are something else.
//!
//! [`text`] decodes a file by its byte order mark or its declaration. [`prepare`] repairs what changes no value: it binds
//! prefixes that the file does not, blanks comments with `--` inside and a document type without definitions, and takes
//! NUL bytes off the end. Lines stay where they are. [`foreign`] names files that are no XML or the wrong one. [`escaped`] makes
//! a text safe to be written into XML or HTML.

mod encoding;
mod escape;
mod foreign;
mod tags;

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::fmt;
use std::ops::Range;

pub use encoding::{text, utf16};
pub use escape::escaped;
pub use foreign::{Foreign, foreign, kind_of_root};
use tags::{Part, Tag, parts};

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
        Self { line: Some(line_of(text.as_bytes(), offset)), what: what.into() }
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

/// Returns the line, from 1, of a place in a text.
fn line_of(text: &[u8], offset: usize) -> usize {
    let before = text.get(..offset).unwrap_or(text);
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
/// Returns an error if it has a document type with definitions, an element with more than [`MAX_ATTRIBUTES`]
/// attributes, or anything behind its outermost element.
pub fn prepare(file: &str) -> Result<Prepared<'_>, Fault> {
    let end = file.trim_end_matches(|letter: char| letter == '\0' || letter.is_whitespace()).len();
    let whole = file.get(..end).unwrap_or(file);
    let text = whole.trim_start_matches('\u{feff}').trim_start();
    let before = whole.len() - text.len();
    let mut survey = Survey::default();
    for part in parts(text) {
        survey.take(text, part).map_err(|(offset, what)| Fault::at(whole, before + offset, what))?;
    }
    survey.check()?;
    Ok(Prepared { text: survey.repaired(text), lines_before: line_of(whole.as_bytes(), before) - 1 })
}

/// The findings of one pass over the parts of a text.
#[derive(Debug, Default)]
struct Survey<'a> {
    /// Comments and document types that become blanks.
    blanked: Vec<Range<usize>>,
    /// Prefixes of elements and attributes.
    used: BTreeSet<&'a str>,
    /// Prefixes that the outermost element binds.
    bound: BTreeSet<&'a str>,
    /// All prefixes, and how often the text binds one.
    prefixes: BTreeSet<&'a str>,
    bindings: usize,
    /// The end of the outermost element's name.
    root: Option<usize>,
    depth: usize,
    /// The outermost element has ended.
    is_over: bool,
}

impl<'a> Survey<'a> {
    /// Takes the next part; an error has the offset of what it is about.
    fn take(&mut self, text: &str, part: Part<'a>) -> Result<(), (usize, String)> {
        let of = |range: &Range<usize>| text.get(range.clone()).unwrap_or_default();
        let content = match &part {
            Part::Text(range) => Some(range).filter(|range| !of(range).trim().is_empty()),
            Part::Close(range) => Some(range),
            Part::Open(tag) => Some(&tag.range),
            Part::Comment(_) | Part::Type(_) | Part::Other => None,
        };
        if self.is_over
            && let Some(range) = content
        {
            let what = "something stands behind the end of the outermost element: delete it";
            return Err((range.end - of(range).trim_start().len(), what.to_owned()));
        }
        match part {
            Part::Comment(range) => {
                let inner = text.get(range.start + 4..range.end.saturating_sub(3)).unwrap_or_default();
                if inner.contains("--") || inner.ends_with('-') {
                    self.blanked.push(range);
                }
            }
            Part::Type(range) => {
                if of(&range).contains('[') {
                    let what = "a <!DOCTYPE with definitions, which are not read: delete it, and write what its \
                                entities stand for in their places";
                    return Err((range.start, what.to_owned()));
                }
                self.blanked.push(range);
            }
            Part::Text(_) | Part::Other => {}
            Part::Close(_) => {
                self.depth = self.depth.saturating_sub(1);
                self.is_over = self.depth == 0 && self.root.is_some();
            }
            Part::Open(tag) => self.open(&tag)?,
        }
        Ok(())
    }

    fn open(&mut self, tag: &Tag<'a>) -> Result<(), (usize, String)> {
        let count = tag.attributes.len();
        if count > MAX_ATTRIBUTES {
            let name = tag.name.chars().take(40).collect::<String>();
            let what = format!(
                "element {name} has {count} attributes, and at most {MAX_ATTRIBUTES} are read: delete some"
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

    /// Checks what a parser's time grows with.
    fn check(&self) -> Result<(), Fault> {
        for (count, what, most) in [
            (self.prefixes.len(), "prefixes of names", MAX_PREFIXES),
            (self.bindings, "xmlns attributes", MAX_BINDINGS),
        ] {
            if count > most {
                let what = format!(
                    "it has {count} {what}, and at most {most} are read: delete those that nothing needs"
                );
                return Err(Fault { line: None, what });
            }
        }
        Ok(())
    }

    /// Binds the prefixes that the outermost element does not, and blanks what a parser refuses.
    fn repaired(self, text: &str) -> Cow<'_, str> {
        let unbound = self.used.difference(&self.bound).filter(|prefix| is_name(prefix));
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

/// Returns true for a prefix that a file may bind; `xml` and `xmlns` are bound to begin with.
fn is_name(prefix: &str) -> bool {
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
