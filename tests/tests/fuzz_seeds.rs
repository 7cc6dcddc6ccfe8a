//! Runs every fuzz target with its seeds, and with some variations of each; `tests/fuzz/run` does the search.
#![allow(clippy::unwrap_used, reason = "a test may stop")]

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skinbus_tests::fuzz::TARGETS;

/// The number of variations of each seed.
const CHANGES: usize = 8;

fn change(data: &mut Vec<u8>, dice: &mut Pcg64Mcg) {
    for _ in 0..dice.random_range(1..=4) {
        if data.is_empty() {
            return;
        }
        let at = dice.random_range(0..data.len());
        match dice.random_range(0..4) {
            0 => data.truncate(at),
            1 => data.splice(at..at, [dice.random()]).for_each(drop),
            2 => data.extend_from_within(at..),
            _ => {
                if let Some(byte) = data.get_mut(at) {
                    *byte = dice.random();
                }
            }
        }
        data.truncate(1 << 20);
    }
}

#[test]
fn every_target_takes_its_seeds() {
    // A panic in a thread of a server would otherwise only be printed.
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |what| {
        hook(what);
        std::process::abort();
    }));
    let seeds = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/seeds");
    let folders = fs::read_dir(&seeds).unwrap();
    let folders: BTreeSet<_> = folders.map(|it| it.unwrap().file_name().into_string().unwrap()).collect();
    assert_eq!(folders, TARGETS.iter().map(|(name, _)| (*name).to_owned()).collect());
    let mut dice = Pcg64Mcg::seed_from_u64(19);
    for (name, target) in TARGETS {
        let mut files: Vec<_> =
            fs::read_dir(seeds.join(name)).unwrap().map(|it| it.unwrap().path()).collect();
        files.sort();
        assert!(!files.is_empty(), "{name} has no seed");
        target(&[]);
        for file in files {
            let seed = fs::read(&file).unwrap();
            println!("{}", file.display());
            target(&seed);
            for _ in 0..CHANGES {
                let mut changed = seed.clone();
                change(&mut changed, &mut dice);
                fs::write(std::env::temp_dir().join("skinbus-changed-seed"), &changed).unwrap();
                target(&changed);
            }
        }
    }
}
