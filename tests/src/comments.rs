//! A test of doc comments: nearly all begin with a noun or a verb, and state what a thing is instead of what it is not.

use crate::tree::files;

/// Words that begin a clause without a subject.
const HEADLESS: &[&str] = &["What", "Whether", "So many", "Of", "The same", "How many", "Who"];
/// Phrases that name a thing by its absence.
const ABSENT: &[&str] = &["is no ", "nobody", "somebody", "what there is"];
/// Largest share of headless doc comments, and of doc comments' lines with such a phrase, in percent.
const MAX_PERCENT: usize = 3;

/// Doc comments and lines of a source text, and those among them that break the rule.
#[derive(Debug, Default, PartialEq)]
struct Counts {
    comments: usize,
    headless: usize,
    lines: usize,
    absent: usize,
}

impl Counts {
    fn add(&mut self, source: &str) {
        let mut is_inside = false;
        for line in source.lines() {
            let Some(text) = text_of(line) else {
                is_inside = false;
                continue;
            };
            self.lines += 1;
            self.absent += usize::from(ABSENT.iter().any(|phrase| text.contains(phrase)));
            if !is_inside && !text.is_empty() {
                self.comments += 1;
                self.headless += usize::from(HEADLESS.iter().any(|words| begins_with(text, words)));
                is_inside = true;
            }
        }
    }
}

/// Returns the text of a line if it is a doc comment.
fn text_of(line: &str) -> Option<&str> {
    let line = line.trim_start();
    let text = line.strip_prefix("///").or_else(|| line.strip_prefix("//!"))?;
    Some(text.trim())
}

/// Returns true if a text begins with these whole words.
fn begins_with(text: &str, words: &str) -> bool {
    let rest = text.strip_prefix(words);
    rest.is_some_and(|rest| !rest.starts_with(|next: char| next.is_alphanumeric() || next == '_'))
}

#[test]
fn doc_comments_begin_with_a_noun_or_a_verb() {
    let mut counts = Counts::default();
    files("rs").iter().for_each(|(_, source)| counts.add(source));
    println!("{counts:?}");
    assert!(counts.comments > 10_000, "{counts:?}");
    assert!(counts.headless * 100 < counts.comments * MAX_PERCENT, "{counts:?}");
    assert!(counts.absent * 100 < counts.lines * MAX_PERCENT, "{counts:?}");
}

#[test]
fn headless_comments_and_absent_things_are_counted() {
    let mut counts = Counts::default();
    counts.add(concat!(
        "//! Of the bus.\n//! Whether it is.\n\nuse x;\n",
        "/// What it is.\nstruct A;\n    /// Offset of a byte; there is no other.\n    a: u8,\n",
        "// Who reads this.\n/// The same.\n"
    ));
    assert_eq!(counts, Counts { comments: 4, headless: 3, lines: 5, absent: 1 });
}
