//! A test that finds circular dependencies: files of one crate that use each other in a circle, so that none of them
//! can be read or changed alone.
//!
//! ```text
//!   files ─> tokens: paths, imports ─> modules: arrows to definitions ─> circles
//! ```
//!
//! An arrow leads from a file to each file that defines a name it uses; re-exports, renamed ones and globs too, are
//! followed to the definition. A module and the modules inside it count as one place, so arrows between them are left
//! out, and so are unit tests. Method calls do not name the file that defines the method. The methods of one type in
//! several files can therefore form circles that are not found.

#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]
#![allow(
    clippy::wildcard_enum_match_arm,
    reason = "a syntax tree has a hundred kinds of items and expressions"
)]

mod modules;
mod tests;
mod tokens;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use modules::Modules;

use crate::tree::top;

/// Accepted circles, each with the reason.
const KNOWN: &[(&[&str], &str)] = &[];

/// The path of a module or an item, from the crate's root.
type Names = Vec<String>;

/// Returns the circles of one crate, each as a sorted list of its files.
fn circles(modules: &Modules) -> Vec<Vec<&Path>> {
    let mut arrows = modules.arrows();
    for (from, all) in &mut arrows {
        all.retain(|to| !to.starts_with(from) && !from.starts_with(to));
    }
    let reach = |from| {
        let (mut seen, mut next) = (BTreeSet::new(), vec![from]);
        while let Some(at) = next.pop() {
            next.extend(arrows.get(at).into_iter().flatten().filter(|to| seen.insert(**to)));
        }
        seen
    };
    let reached: BTreeMap<_, _> = arrows.keys().map(|names| (*names, reach(*names))).collect();
    let mut found = BTreeSet::new();
    for (from, all) in &reached {
        if all.contains(from) {
            found.insert(all.iter().copied().filter(|to| reached[to].contains(from)).collect::<Vec<_>>());
        }
    }
    if std::env::var_os("SKINBUS_CIRCLES").is_some() {
        let arrow = |from| arrows[from].iter().map(move |to: &&Names| (from, *to));
        for (from, to) in found.iter().flatten().flat_map(|from| arrow(*from)) {
            if reached[to].contains(from) {
                println!("  {} -> {}", from.join("::"), to.join("::"));
            }
        }
    }
    let files = |circle: Vec<&Names>| circle.iter().map(|names| modules.files[*names].as_path()).collect();
    found.into_iter().map(files).collect()
}

#[test]
fn files_of_one_crate_use_each_other_in_one_direction() {
    let top = top();
    let manifest: String = fs::read_to_string(top.join("Cargo.toml")).unwrap();
    let (_, members) = manifest.split_once("members = [").unwrap();
    let members = members.split_once(']').unwrap().0.split('"').skip(1).step_by(2);
    let mut found = Vec::new();
    for member in members {
        for root in ["lib.rs", "main.rs"] {
            let root = top.join(member).join("src").join(root);
            if root.exists() {
                let modules = Modules::read(&root);
                let name = |file: &Path| file.strip_prefix(top).unwrap().display().to_string();
                found
                    .extend(circles(&modules).into_iter().map(|files| files.into_iter().map(name).collect()));
            }
        }
    }
    let known: Vec<Vec<String>> =
        KNOWN.iter().map(|(files, _)| files.iter().map(|&file| file.to_owned()).collect()).collect();
    let new: Vec<_> = found.iter().filter(|circle| !known.contains(circle)).collect();
    assert!(new.is_empty(), "new circles of files, see SKINBUS_CIRCLES=1 for their arrows: {new:#?}");
    let gone: Vec<_> = known.iter().filter(|circle| !found.contains(circle)).collect();
    assert!(gone.is_empty(), "remove these circles from KNOWN, they are gone: {gone:#?}");
}
