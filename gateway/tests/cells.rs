//! The gateway meets cells on the bus only: but for its experiments, none of its code calls theirs.

#![allow(clippy::unwrap_used, reason = "a test may stop")]

use std::fs;
use std::path::{Path, PathBuf};

fn sources(folder: &Path) -> Vec<PathBuf> {
    let paths = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    paths.flat_map(|path| if path.is_dir() { sources(&path) } else { vec![path] }).collect()
}

#[test]
fn only_experiments_call_the_cells_code() {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let all = sources(&source);
    let calls = |path: &PathBuf| fs::read_to_string(path).unwrap().contains("cell_node::");
    let (experiments, others): (Vec<_>, Vec<_>) =
        all.into_iter().filter(calls).partition(|path| path.starts_with(source.join("experiment")));
    assert!(!experiments.is_empty(), "there is something to find");
    assert_eq!(others, Vec::<PathBuf>::new());
}
