//! The words of the field stand in code, help, documents and tests; those that only this project would understand do not.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use std::path::{Path, PathBuf};

/// Words that do not occur, and what stands in their place. Identifiers are taken apart: `in_force` and `InForce` are two
/// words. A `|` parts alternatives.
const EVERYWHERE: &[(&str, &str)] = &[
    ("aside", "deferred receive, without wake-up"),
    ("lane|lanes", "link id, or what it is: statistics, comparator, timing of a bus"),
    ("ear|ears", "subscriptions, receive filter"),
    ("felt|feeling|feelings", "contact state, or reference torque"),
    ("witness|witnesses", "oracle, operation count"),
    ("guest|guests", "test client"),
    ("stranger|strangers", "unknown node"),
    ("rival|rivals", "other gateway"),
    ("in force", "latched"),
    ("trunk|trunks", "root sums"),
    ("ledger|ledgers", "accounts"),
    ("cell number|cell numbers|cell s number|cells s numbers", "node id"),
    (
        "claim a number|claims a number|claiming a number|claimed a number|claim its number|claims its number",
        "address claim",
    ),
    ("claim of a number|claiming its number|claim the number|claims the number", "address claim"),
    ("halves|half a packet|half of a packet|first half of|second half of|other half", "segment"),
    ("pair of segments|incomplete pair|segments pair", "reassembly"),
    ("way up|ways up|without a way|no way|without way", "route to the root; unreachable"),
    ("patience|borne", "timeout, retry limit; tolerated"),
    ("mend|mends|mended|mending", "repair, restore, fix; link up"),
    ("anew|said again|say again|says again", "again, restart, resend"),
    ("let go|lets go|letting go|let it go|lets it go|let its torque go", "decays to zero; released"),
    ("epoch is whole|epochs are whole|whole epoch|whole epochs|wakings", "complete; wake-ups"),
    ("hall|teller|voice", "shared state, progress, log sender"),
    ("judge|judges|judged|judging", "comparator, compare; rate"),
    ("excuse|excuses|excused", "known deviation"),
    ("fate|fates", "broadcast status"),
    ("reel|reels|wearing", "replay plan, skin override"),
    ("roster|rosters|seat|seats", "address table, address owner"),
    ("greatest", "max, largest"),
    ("least", "min, smallest"),
    ("wanted", "target, requested"),
    ("remedy|remedies", "hint"),
    (
        "call the roll|let them organise|break things|break something",
        "wait for cells, wait for the tree, inject faults",
    ),
];

/// Words that have another meaning elsewhere: not in files whose path has one of these in it.
const SOMEWHERE: &[(&str, &str, &[&str])] = &[
    (
        "label|labels|seek|seeks",
        "rank and version; local repair",
        &["cell-node/src", "protocol/src/wire/port", "reference/tree.md", "model/src/network"],
    ),
    ("missed|ask", "NACK, probe", &["cell-node/src", "protocol/src/wire/port", "reference/tree.md"]),
    (
        "cut|cuts",
        "link down",
        &[
            "cell-node/src",
            "protocol/",
            "model/src/scenario",
            "run/network",
            "docs/reference/",
            "docs/tutorial",
        ],
    ),
];

/// Names of code that say nothing of what they are.
const NAMES: &[(&str, &str)] = &[
    ("told|Told", "reported"),
    ("news|News", "bus event, change"),
    ("Left", "result"),
    ("Asked", "request"),
];

/// Terms that have such a word in them: after this one, and before this one.
const AFTER: &[(&str, &str)] = &[("least", "at")];
const BEFORE: &[(&str, &str)] = &[("least", "significant"), ("least", "squares")];
/// Former names of faults, which are still read, and names of others' libraries.
const FORMER: &[(&str, &str)] = &[
    ("cut", "scenario"),
    ("mend", "scenario"),
    ("ear", "mesh/polygon"),
    ("ears", "mesh/polygon"),
    ("Left", "report/svg"),
];

struct Word<'a> {
    text: &'a str,
    lower: String,
    line: usize,
}

/// The words of a text: runs of letters and digits, taken apart where small letters meet capitals.
fn words(text: &str) -> Vec<Word<'_>> {
    let mut words = Vec::new();
    for (number, line) in text.lines().enumerate() {
        for run in line.split(|c: char| !c.is_alphanumeric()).filter(|run| !run.is_empty()) {
            let mut start = 0;
            let chars: Vec<_> = run.char_indices().collect();
            for pair in chars.windows(2) {
                if pair[0].1.is_lowercase() && pair[1].1.is_uppercase() {
                    words.push(Word {
                        text: run,
                        lower: run[start..pair[1].0].to_lowercase(),
                        line: number + 1,
                    });
                    start = pair[1].0;
                }
            }
            words.push(Word { text: run, lower: run[start..].to_lowercase(), line: number + 1 });
        }
    }
    words
}

/// Where one of the phrases begins.
fn find(words: &[Word<'_>], phrases: &str, mut found: impl FnMut(&Word<'_>, &str)) {
    for phrase in phrases.split('|') {
        let parts: Vec<_> = phrase.split(' ').collect();
        for (at, run) in words.windows(parts.len()).enumerate() {
            let is_it = run.iter().zip(&parts).all(|(word, part)| word.lower == **part);
            let before = at.checked_sub(1).map_or("", |before| words[before].lower.as_str());
            let after = words.get(at + parts.len()).map_or("", |after| after.lower.as_str());
            if is_it && !AFTER.contains(&(phrase, before)) && !BEFORE.contains(&(phrase, after)) {
                found(&run[0], phrase);
            }
        }
    }
}

/// Code without comments and texts.
fn names(text: &str) -> String {
    let lines = text.lines().map(|line| {
        let code = line.trim_start();
        if code.starts_with("//") { "" } else { line }
    });
    let lines: Vec<_> = lines.collect();
    let mut is_text = false;
    let parted = lines.join("\n").replace("'\"'", "");
    let mut kept = String::new();
    for part in parted.split('"') {
        if is_text {
            kept.extend(part.chars().filter(|c| *c == '\n'));
        } else {
            kept.push_str(part);
        }
        is_text = !is_text || part.ends_with('\\');
    }
    kept
}

fn files(folder: &Path, files_found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        let is_hidden = name.starts_with('.') && name != ".ci";
        if path.is_dir() && !is_hidden && name != "target" && name != "recordings" {
            files(&path, files_found);
        } else if [".rs", ".md", ".toml", ".py", ".sh"].iter().any(|end| name.ends_with(end)) {
            files_found.push(path);
        }
    }
}

#[test]
fn words_are_those_of_the_field() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let mut found = Vec::new();
    let mut all = Vec::new();
    files(root, &mut all);
    all.retain(|path| !path.ends_with("tests/src/words.rs") && !path.ends_with("CHANGELOG.md"));
    assert!(all.len() > 300, "{} files", all.len());
    for path in &all {
        let name = path.strip_prefix(root).unwrap().to_string_lossy().into_owned();
        let text = std::fs::read_to_string(path).unwrap();
        let of_text = words(&text);
        let mut note = |word: &Word<'_>, phrase: &str, instead: &str| {
            if FORMER.iter().any(|(former, path)| *former == phrase && name.contains(path)) {
                return;
            }
            found.push(format!("{name}:{}: {phrase:?} in {:?}: {instead}", word.line, word.text));
        };
        for (phrases, instead) in EVERYWHERE {
            find(&of_text, phrases, |word, phrase| note(word, phrase, instead));
        }
        for (phrases, instead, paths) in SOMEWHERE {
            if paths.iter().any(|path| name.contains(path)) {
                find(&of_text, phrases, |word, phrase| note(word, phrase, instead));
            }
        }
        if name.ends_with(".rs") {
            let code = names(&text);
            for (line, code) in code.lines().enumerate() {
                for run in code.split(|c: char| !c.is_alphanumeric() && c != '_') {
                    if let Some((_, instead)) =
                        NAMES.iter().find(|(names, _)| names.split('|').any(|name| name == run))
                    {
                        let word = Word { text: run, lower: String::new(), line: line + 1 };
                        note(&word, run, instead);
                    }
                }
            }
        }
    }
    found.sort();
    assert!(found.is_empty(), "{} words:\n{}", found.len(), found.join("\n"));
}
