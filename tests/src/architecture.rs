//! Tests of the structure of the workspace: the dependencies between crates are those of the graph in
//! `docs/explanation/architecture.md`.

#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;

use quote::ToTokens;
use syn::{Attribute, Item};

use crate::tree::files;

const DOCUMENT: &str = include_str!("../../docs/explanation/architecture.md");

/// The crates that may use the cell's code directly. The gateway knows cells only by their frames.
const USES_CELLS: [&str; 3] = ["paper", "reference", "skinbus-tests"];

/// Returns the crates of the document's graph, with the targets of their arrows; panics if the graph has a cycle.
fn arrows() -> BTreeMap<&'static str, BTreeSet<&'static str>> {
    let (_, graph) = DOCUMENT.split_once("```mermaid\n").unwrap();
    let mut arrows = BTreeMap::<_, BTreeSet<_>>::new();
    for line in graph.lines().take_while(|line| *line != "```") {
        if let Some((from, to)) = line.trim().split_once(" --> ") {
            arrows.entry(to).or_default();
            arrows.entry(from).or_default().insert(to);
        }
    }
    let mut left = arrows.clone();
    while !left.is_empty() {
        let lowest = left.iter().find(|(_, uses)| uses.iter().all(|name| !left.contains_key(name)));
        let lowest = *lowest.unwrap_or_else(|| panic!("a cycle among {:?}", left.keys())).0;
        left.remove(lowest);
    }
    arrows
}

/// Returns all crates that arrows from a crate lead to, directly or indirectly.
fn reach<'a>(arrows: &'a BTreeMap<&str, BTreeSet<&str>>, from: &str) -> BTreeSet<&'a str> {
    let direct = arrows[from].iter();
    direct.flat_map(|&to| reach(arrows, to).into_iter().chain([to])).collect()
}

/// Returns cargo's metadata of the workspace.
fn metadata() -> serde_json::Value {
    let cargo = Command::new(env!("CARGO"))
        .args(["metadata", "--no-deps", "--format-version", "1", "--offline", "--manifest-path"])
        .arg(concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml"))
        .output()
        .unwrap();
    assert!(cargo.status.success(), "{}", String::from_utf8_lossy(&cargo.stderr));
    serde_json::from_slice(&cargo.stdout).unwrap()
}

/// Returns the crates of the workspace, each with the other crates that it or its tests use. A crate may be listed
/// under itself, if its tests enable features that its programs do not.
fn used() -> BTreeMap<String, BTreeSet<String>> {
    let metadata = metadata();
    let packages = metadata["packages"].as_array().unwrap();
    let name = |value: &serde_json::Value| value["name"].as_str().unwrap().to_owned();
    let ours: BTreeSet<_> = packages.iter().map(name).collect();
    let of = |package: &serde_json::Value| {
        let (of, dependencies) = (name(package), package["dependencies"].as_array().unwrap().iter());
        let others = dependencies.map(name).filter(|name| *name != of && ours.contains(name)).collect();
        (of, others)
    };
    packages.iter().map(of).collect()
}

#[test]
fn ten_integration_programs_are_enough() {
    let metadata = metadata();
    let targets =
        metadata["packages"].as_array().unwrap().iter().flat_map(|it| it["targets"].as_array().unwrap());
    let programs: Vec<_> =
        targets.filter(|target| target["kind"][0] == "test").map(|it| &it["name"]).collect();
    assert!(programs.len() <= 10, "each links most of the workspace; make modules of {programs:?}");
}

#[test]
fn crates_use_what_the_documents_arrows_lead_to_only() {
    let (used, arrows) = (used(), arrows());
    let known: BTreeSet<_> = used.keys().map(String::as_str).collect();
    assert_eq!(known, arrows.keys().copied().collect(), "every crate is in the graph, and nothing else");
    for (name, uses) in &used {
        let allowed = reach(&arrows, name);
        for other in uses {
            assert!(allowed.contains(other.as_str()), "{name} must not use {other}");
            let of_cells = other != "cell-node" || USES_CELLS.contains(&name.as_str());
            assert!(of_cells, "{name} must not use {other} directly");
        }
    }
    for (from, to) in arrows.iter().flat_map(|(from, all)| all.iter().map(move |to| (*from, *to))) {
        assert!(used[from].contains(to), "{from} does not use {to}: the arrow leads nowhere");
        let round = arrows[from].iter().any(|&other| other != to && reach(&arrows, other).contains(to));
        assert!(!round, "{from} --> {to}: other arrows lead there");
    }
}

/// The feature `oracle` of `cell-node` computes a reference for comparison, which cells must not use.
#[test]
fn only_the_papers_experiments_and_tests_have_the_cells_oracle() {
    let metadata = metadata();
    let packages = metadata["packages"].as_array().unwrap();
    let lists = |features: &serde_json::Value| features.as_array().unwrap().iter().any(|it| it == "oracle");
    let cell = packages.iter().find(|package| package["name"] == "cell-node").unwrap();
    let mut features = cell["features"].as_object().unwrap().iter();
    assert_eq!(features.find(|(_, enabled)| lists(enabled)), None, "no other feature has it");
    let is_program = |it: &serde_json::Value| it["name"] == "cell-node" && it["kind"].is_null();
    let has = |package: &&serde_json::Value| {
        let mut dependencies = package["dependencies"].as_array().unwrap().iter();
        dependencies.any(|it| is_program(it) && lists(&it["features"]))
    };
    let having: Vec<_> = packages.iter().filter(has).map(|package| &package["name"]).collect();
    assert_eq!(having, ["paper"]);
}

/// Returns the Rust sources of the workspace, each with its path from the top.
fn sources() -> Vec<(String, String)> {
    let found = files("rs");
    assert!(found.len() > 300, "there is something to look at");
    found
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

/// A struct that is printed as JSON has as many fields as the JSON has keys.
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

/// `std::thread::spawn` and a scope's `spawn` panic if the system has no thread; `thread::Builder` returns an error.
#[test]
fn programs_start_threads_where_the_error_can_be_told() {
    let of_tests =
        |name: &str| name.split('/').any(|part| ["tests", "tests.rs", "examples", "benches"].contains(&part));
    let mut found = Vec::new();
    for (name, text) in
        sources().into_iter().filter(|(name, _)| !of_tests(name) && !name.starts_with("tests/"))
    {
        // Unit tests are at the end of a file.
        let program = text.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default();
        let lines =
            program.lines().filter(|line| line.contains("thread::spawn(") || line.contains("scope.spawn("));
        found.extend(lines.map(|line| format!("{name}: {}", line.trim())));
    }
    assert_eq!(found, Vec::<String>::new());
}
