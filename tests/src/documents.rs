//! Checks of the documents: links lead to existing files and headings, the pages stay short, and every block of
//! commands is run by a test or states why not.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use std::collections::{BTreeSet, HashMap};
use std::fs;

use crate::tree::{files, top};

/// The pages with requirements; their length is not limited.
const NORMATIVE: [&str; 6] = [
    "docs/reference/cell.md",
    "docs/reference/commissioning.md",
    "docs/reference/embedded-bus.md",
    "docs/reference/protocol.md",
    "docs/reference/sensing.md",
    "docs/reference/tree.md",
];
/// The maximum number of words of all other pages together.
const MAX_WORDS: usize = 40_000;
/// The page whose blocks of commands the test `process_readme` runs.
const RUN_AS_A_WHOLE: &str = "README.md";

/// A document of the project.
struct Page {
    /// The path from the top of the project.
    name: String,
    text: String,
}

/// Returns the documents of all folders, except hidden ones and build output.
fn pages() -> Vec<Page> {
    let found: Vec<_> = files("md").into_iter().map(|(name, text)| Page { name, text }).collect();
    assert!(found.len() > 40, "{} documents", found.len());
    found
}

/// A fenced block of a page.
#[derive(Debug, Eq, PartialEq)]
struct Block<'a> {
    language: &'a str,
    /// The number of the line that opens it.
    line: usize,
    /// The last non-empty line before it.
    before: &'a str,
}

/// Separates the lines of text from the fenced blocks.
fn parse(text: &str) -> (Vec<&str>, Vec<Block<'_>>) {
    let (mut prose, mut blocks) = (Vec::new(), Vec::new());
    let (mut before, mut is_open) = ("", false);
    for (number, line) in text.lines().enumerate() {
        let trimmed = line.trim();
        if let Some(language) = trimmed.strip_prefix("```") {
            if !is_open {
                blocks.push(Block { language, line: number + 1, before });
            }
            is_open = !is_open;
        } else if !is_open {
            prose.push(line);
        }
        if !trimmed.is_empty() {
            before = trimmed;
        }
    }
    assert!(!is_open, "a block is not closed");
    (prose, blocks)
}

/// Removes the targets of links: `[text](target)` becomes `[text]`.
fn without_targets(line: &str) -> String {
    let mut parts = line.split("](");
    let first = parts.next().unwrap().to_owned();
    parts.fold(first, |text, part| text + "]" + part.split_once(')').map_or("", |(_, rest)| rest))
}

/// Returns the anchors of a page's headings by GitHub's rules.
fn anchors(text: &str) -> BTreeSet<String> {
    let mut seen = HashMap::<String, usize>::new();
    let mut anchors = BTreeSet::new();
    for line in parse(text).0.into_iter().filter(|line| line.starts_with('#')) {
        let heading = without_targets(line.trim_start_matches('#').trim()).to_lowercase();
        let kept = heading.chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c));
        let anchor: String = kept.map(|c| if c == ' ' { '-' } else { c }).collect();
        let count = seen.entry(anchor.clone()).or_default();
        anchors.insert(if *count == 0 { anchor } else { format!("{anchor}-{count}") });
        *count += 1;
    }
    anchors
}

/// Returns the targets of links and images, in Markdown and in HTML, outside code.
fn targets(text: &str) -> Vec<String> {
    let prose = parse(text).0.join("\n");
    assert_eq!(prose.matches('`').count() % 2, 0, "code is not closed in\n{prose}");
    let outside_code: String = prose.split('`').step_by(2).collect();
    let after = |mark: &str, end: [char; 2]| -> Vec<String> {
        let links = outside_code.split(mark).skip(1);
        links.map(|rest| rest.split(end).next().unwrap().to_owned()).collect()
    };
    [
        after("](", [')', ' ']),
        after("src=\"", ['"', '"']),
        after("srcset=\"", ['"', '"']),
        after("href=\"", ['"', '"']),
    ]
    .concat()
}

#[test]
fn links_lead_to_files_and_headings() {
    let pages = pages();
    let anchors_of: HashMap<_, _> = pages
        .iter()
        .map(|page| (top().join(&page.name).canonicalize().unwrap(), anchors(&page.text)))
        .collect();
    let mut wrong = Vec::new();
    let mut count = 0;
    for page in &pages {
        for link in targets(&page.text) {
            if ["https://", "http://", "mailto:"].iter().any(|scheme| link.starts_with(scheme)) {
                continue;
            }
            count += 1;
            let (file, anchor) = link.split_once('#').unwrap_or((&link, ""));
            let from = top().join(&page.name);
            let target = if file.is_empty() { from } else { from.parent().unwrap().join(file) };
            let exists = target.canonicalize().is_ok_and(|target| {
                anchor.is_empty() || anchors_of.get(&target).is_some_and(|anchors| anchors.contains(anchor))
            });
            if !exists {
                wrong.push(format!("{}: {link}", page.name));
            }
        }
    }
    assert!(count > 200, "{count} links");
    assert!(wrong.is_empty(), "{} links:\n{}", wrong.len(), wrong.join("\n"));
}

#[test]
fn documents_without_requirements_stay_short() {
    let pages = pages();
    let names: Vec<_> = pages.iter().map(|page| page.name.as_str()).collect();
    assert!(NORMATIVE.iter().all(|name| names.contains(name)), "{names:?}");
    let others = pages.iter().filter(|page| !NORMATIVE.contains(&page.name.as_str()));
    let mut words: Vec<_> =
        others.map(|page| (page.text.split_whitespace().count(), page.name.as_str())).collect();
    words.sort_unstable();
    let sum: usize = words.iter().map(|(count, _)| count).sum();
    assert!(sum <= MAX_WORDS, "{sum} words; the longest pages: {:?}", &words[words.len() - 12..]);
}

/// Checks the comment before a block of commands: `<!-- not run: REASON -->`, or `<!-- run by: TEST -->` with the path
/// of a test that names the page.
fn check_mark(page: &str, mark: &str) -> Result<(), String> {
    let comment = mark.strip_prefix("<!-- ").and_then(|rest| rest.strip_suffix(" -->")).unwrap_or_default();
    if comment.strip_prefix("not run: ").is_some_and(|reason| !reason.trim().is_empty()) {
        return Ok(());
    }
    let Some(test) = comment.strip_prefix("run by: ") else {
        return Err("neither `<!-- not run: REASON -->` nor `<!-- run by: TEST -->` is before it".to_owned());
    };
    match fs::read_to_string(top().join(test)) {
        Err(error) => Err(format!("{test}: {error}")),
        Ok(text) if !text.contains(page) => Err(format!("{test} does not read {page}")),
        Ok(_) => Ok(()),
    }
}

#[test]
fn commands_are_run_or_state_why_not() {
    let mut wrong = Vec::new();
    let mut count = 0;
    for page in pages() {
        let has_blocks = page.name.starts_with("docs/") || page.name.ends_with("README.md");
        if !has_blocks || page.name == RUN_AS_A_WHOLE {
            continue;
        }
        for block in parse(&page.text).1 {
            let at = format!("{}:{}", page.name, block.line);
            if ["bash", "shell", "zsh"].contains(&block.language) {
                wrong.push(format!("{at}: {} is named sh", block.language));
            } else if block.language == "sh" {
                count += 1;
                check_mark(&page.name, block.before)
                    .unwrap_or_else(|error| wrong.push(format!("{at}: {error}")));
            }
        }
    }
    assert!(count > 10, "{count} blocks");
    assert!(wrong.is_empty(), "{} blocks:\n{}", wrong.len(), wrong.join("\n"));
}

#[test]
fn wrong_links_and_marks_are_found() {
    let text = "# A `b`-c\n\n## Who, and [why](x.md#y)?\n\n```sh\n# no heading\n```\n\n## A b-c\n\nsee [`a`](<a.md)\n";
    assert_eq!(anchors(text), ["a-b-c", "a-b-c-1", "who-and-why"].map(str::to_owned).into());
    assert_eq!(targets(text), ["x.md#y", "<a.md"]);
    assert_eq!(
        targets("[<img src=\"v.png\">](v.md) `[no](link)` [t](u.md \"title\")"),
        ["v.md", "u.md", "v.png"]
    );
    assert_eq!(
        parse("a\n\n  ```sh\n  ls\n  ```\n").1,
        [Block { language: "sh", line: 3, before: "a" }],
        "also in a list"
    );
    let page = "docs/how-to/several-hosts.md";
    check_mark(page, "<!-- not run: needs a real adapter -->").unwrap();
    check_mark(page, "<!-- run by: tests/tests/hosts/secured.rs -->").unwrap();
    for wrong in [
        "",
        "text",
        "<!-- not run:  -->",
        "<!-- run by: tests/tests/hosts/main.rs -->",
        "<!-- run by: no.rs -->",
    ] {
        check_mark(page, wrong).unwrap_err();
    }
}
