//! Which crate may use which: the arrows of `docs/architecture.md`.

#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;

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
