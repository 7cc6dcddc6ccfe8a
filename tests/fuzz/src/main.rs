//! A libFuzzer program for one of the targets of `skinbus_tests::fuzz`, which `SKINBUS_FUZZ` names.
#![no_main]

use std::sync::LazyLock;

use skinbus_tests::fuzz::{TARGETS, Target};

static TARGET: LazyLock<Target> = LazyLock::new(|| {
    let name = std::env::var("SKINBUS_FUZZ").unwrap_or_default();
    let found = TARGETS.iter().find(|(target, _)| *target == name);
    found.map_or_else(|| panic!("SKINBUS_FUZZ={name}: no target has this name"), |(_, target)| *target)
});

libfuzzer_sys::fuzz_target!(|data: &[u8]| TARGET(data));
