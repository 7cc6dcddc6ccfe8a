//! Copies the linker script of the chosen board to the linker's search path.

use std::path::PathBuf;
use std::{env, fs};

fn main() {
    println!("cargo::rerun-if-changed=memory");
    println!("cargo::rerun-if-changed=build.rs");
    if env::var("CARGO_CFG_TARGET_OS").as_deref() != Ok("none") {
        return;
    }
    let boards = [("CARGO_FEATURE_MICROBIT", "microbit.x"), ("CARGO_FEATURE_STM32G4", "stm32g4.x")];
    let mut chosen = boards.iter().filter(|(feature, _)| env::var_os(feature).is_some());
    let (Some((_, memory)), None) = (chosen.next(), chosen.next()) else {
        println!("cargo::error=choose one board: --features microbit or --features stm32g4");
        return;
    };
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    for (from, to) in [(*memory, "memory.x"), ("cell.x", "cell.x")] {
        fs::copy(PathBuf::from("memory").join(from), out.join(to)).expect("a file of this folder is copied");
    }
    println!("cargo::rustc-link-search={}", out.display());
    println!("cargo::rustc-link-arg-bins=-Tlink.x");
    println!("cargo::rustc-link-arg-bins=-Tcell.x");
}
