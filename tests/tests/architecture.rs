//! Which crate may use which: the arrows of `docs/explanation/architecture.md`.

#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use quote::ToTokens;
use syn::{Attribute, Item};

/// Each crate of the workspace, and the others that it may use.
const MAY_USE: [(&str, &[&str]); 12] = [
    ("protocol", &[]),
    ("cell-node", &["protocol"]),
    ("vcan-setup", &["protocol"]),
    ("model", &["protocol"]),
    ("control", &["model", "protocol"]),
    ("trace", &["model", "protocol"]),
    ("analysis", &["model", "protocol", "trace"]),
    ("bench", &["control", "model", "protocol", "trace", "vcan-setup"]),
    ("paper", &["analysis", "cell-node", "control", "model", "protocol", "trace"]),
    ("reference", &["cell-node", "model", "protocol"]),
    ("gateway", &["analysis", "bench", "control", "model", "paper", "protocol", "trace", "vcan-setup"]),
    // Whole benches are made of everything.
    ("skinbus-tests", &["analysis", "bench", "cell-node", "control", "model", "paper", "protocol", "trace"]),
];

/// The crates of the workspace, and what each uses of the others, its tests included.
fn used() -> BTreeMap<String, BTreeSet<String>> {
    let cargo = Command::new(env!("CARGO"))
        .args(["metadata", "--no-deps", "--format-version", "1", "--offline", "--manifest-path"])
        .arg(concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml"))
        .output()
        .unwrap();
    assert!(cargo.status.success(), "{}", String::from_utf8_lossy(&cargo.stderr));
    let metadata: serde_json::Value = serde_json::from_slice(&cargo.stdout).unwrap();
    let packages = metadata["packages"].as_array().unwrap();
    let name = |value: &serde_json::Value| value["name"].as_str().unwrap().to_owned();
    let ours: BTreeSet<_> = packages.iter().map(name).collect();
    let of = |package: &serde_json::Value| {
        let dependencies = package["dependencies"].as_array().unwrap().iter();
        (name(package), dependencies.map(name).filter(|name| ours.contains(name)).collect())
    };
    packages.iter().map(of).collect()
}

#[test]
fn crates_use_what_is_below_them_only() {
    let used = used();
    let allowed = BTreeMap::from(MAY_USE);
    let known: BTreeSet<_> = used.keys().map(String::as_str).collect();
    assert_eq!(known, allowed.keys().copied().collect(), "every crate says what it may use");
    for (name, uses) in &used {
        for other in uses {
            assert!(allowed[name.as_str()].contains(&other.as_str()), "{name} must not use {other}");
        }
    }
}

#[test]
fn the_allowed_directions_have_no_cycle() {
    let mut left = BTreeMap::from(MAY_USE);
    while !left.is_empty() {
        let lowest = left.iter().find(|(_, uses)| uses.iter().all(|name| !left.contains_key(name)));
        let lowest = *lowest.unwrap_or_else(|| panic!("a cycle among {:?}", left.keys())).0;
        left.remove(lowest);
    }
}

/// Rust sources of the workspace, each with its path from the top.
fn sources() -> Vec<(String, String)> {
    fn walk(folder: &Path, found: &mut Vec<PathBuf>) {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let hidden = path.file_name().unwrap().to_str().unwrap().starts_with('.');
            if path.is_dir() && !hidden && !path.ends_with("target") {
                walk(&path, found);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                found.push(path);
            }
        }
    }
    let top = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let mut found = Vec::new();
    walk(top, &mut found);
    assert!(found.len() > 300, "there is something to look at");
    let read = |path: PathBuf| {
        let name = path.strip_prefix(top).unwrap().display().to_string();
        (name, fs::read_to_string(path).unwrap())
    };
    found.into_iter().map(read).collect()
}

#[test]
fn no_file_is_longer_than_500_lines() {
    let long: Vec<_> = sources()
        .into_iter()
        .map(|(name, text)| (text.lines().count(), name))
        .filter(|(lines, _)| *lines > 500)
        .collect();
    assert_eq!(long, [], "split them by what they are about");
}

/// What is printed as JSON has as many fields as that has keys.
#[test]
fn no_struct_has_more_than_20_fields_but_what_is_serialised() {
    fn wide(items: &[Item], found: &mut Vec<(String, usize)>) {
        for item in items {
            if let Item::Mod(module) = item {
                wide(module.content.as_ref().map_or(&[], |(_, items)| items), found);
            } else if let Item::Struct(one) = item
                && one.fields.len() > 20
                && !is_serialised(&one.attrs)
            {
                found.push((one.ident.to_string(), one.fields.len()));
            }
        }
    }
    fn is_serialised(attributes: &[Attribute]) -> bool {
        let derives = attributes.iter().filter(|attribute| attribute.path().is_ident("derive"));
        derives.into_iter().any(|derive| derive.meta.to_token_stream().to_string().contains("Serialize"))
    }
    let mut found = Vec::new();
    for (name, text) in sources() {
        let file = syn::parse_file(&text).unwrap_or_else(|error| panic!("{name}: {error}"));
        let mut here = Vec::new();
        wide(&file.items, &mut here);
        found.extend(here.into_iter().map(|(ident, fields)| format!("{name}: {ident} has {fields} fields")));
    }
    assert_eq!(found, Vec::<String>::new(), "give parts of them owners");
}
