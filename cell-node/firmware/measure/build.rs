//! Converts the test vectors to tables of words, and writes the linker's memory layout for the emulated machines.

#![allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "wrapped or held before")]
#![allow(clippy::indexing_slicing, clippy::unwrap_used, clippy::panic, reason = "a build may stop")]

use std::f64::consts::{FRAC_PI_2, TAU};
use std::fmt::Write as _;
use std::path::PathBuf;
use std::{env, fs};

const UR5: &str = "../../tests/vectors/ur5_torque.csv";
const CHAINS: &str = "../../tests/vectors/chains.csv";
/// Memory layout of the micro:bit, whose nRF51822 has the least flash and RAM of all emulated machines.
const MICROBIT: &str =
    "MEMORY { FLASH : ORIGIN = 0, LENGTH = 256K  RAM : ORIGIN = 0x20000000, LENGTH = 16K }";
const MPS2: &str = "MEMORY { FLASH : ORIGIN = 0, LENGTH = 4M  RAM : ORIGIN = 0x20000000, LENGTH = 4M }";

fn word(value: f64) -> i16 {
    (value * 16_384.0).round().clamp(-32_768.0, 32_767.0) as i16
}

/// Converts an angle in rad to a word in quarter turns, wrapped into one turn.
fn angle(radians: f64) -> i16 {
    (radians / TAU % 1.0 * 65_536.0).round() as i32 as i16
}

/// Returns the rows of the UR5's table as words: a, d, alpha, theta offset, kind.
fn ur5() -> Vec<[i16; 5]> {
    let d = [0.089_159, 0.0, 0.0, 0.109_15, 0.094_65, 0.082_3];
    let a = [0.0, -0.425, -0.392_25, 0.0, 0.0, 0.0];
    let alpha = [FRAC_PI_2, 0.0, 0.0, FRAC_PI_2, -FRAC_PI_2, 0.0];
    (0..6).map(|row| [word(a[row]), word(d[row]), angle(alpha[row]), 0, 0]).collect()
}

/// Returns a chain of `joints` joints: the rows of a seven-joint arm, repeated and shortened so that the reach stays
/// below 2 m.
fn repeated(rows: &[[i16; 5]], joints: usize) -> Vec<[i16; 5]> {
    let shorter = |[a, d, alpha, offset, kind]: [i16; 5]| [a / 3, d / 3, alpha, offset, kind];
    rows.iter().cycle().take(joints).copied().map(shorter).collect()
}

struct Tables {
    chains: String,
    cases: String,
}

impl Tables {
    fn chain(&mut self, name: &str, rows: &[[i16; 5]]) -> usize {
        let _ = writeln!(self.chains, "    Chain {{ name: {name:?}, rows: &{rows:?} }},");
        self.chains.lines().count() - 1
    }

    fn case(&mut self, chain: usize, carries: (u8, u8), pose: &[i16], joints: &[i16], force: i32) {
        let (joint, row) = carries;
        let mut all = [0; 14];
        all[..joints.len()].copy_from_slice(joints);
        let _ = writeln!(
            self.cases,
            "    Case {{ chain: {chain}, joint: {joint}, row: {row}, pose: {pose:?}, joints: {all:?}, force: {force} }},"
        );
    }
}

fn main() {
    let mut tables = Tables { chains: String::new(), cases: String::new() };

    let chain = tables.chain("ur5", &ur5());
    let text = fs::read_to_string(UR5).expect("the vectors of the UR5");
    for line in text.lines().skip(1) {
        let n: Vec<f64> = line.split(',').map(|number| number.parse().expect("a number")).collect();
        let pose = [word(n[7]), word(n[8]), word(n[9]), word(-n[10]), word(-n[11]), word(-n[12])];
        let joints: Vec<i16> = n[1..7].iter().copied().map(angle).collect();
        tables.case(chain, (n[0] as u8, n[0] as u8), &pose, &joints, (n[13] * 65_536.0).round() as i32);
    }

    // robot; joint, row, pose, force; joints; rows of five: words.
    let text = fs::read_to_string(CHAINS).expect("the words of other robots");
    let mut known: Vec<(String, usize, Vec<[i16; 5]>)> = Vec::new();
    for line in text.lines().skip(1) {
        let parts: Vec<&str> = line.split(',').collect();
        let words =
            |text: &str| text.split(' ').map(|word| word.parse().expect("a word")).collect::<Vec<i32>>();
        let short = |text: &str| words(text).into_iter().map(|word| word as i16).collect::<Vec<i16>>();
        let rows: Vec<[i16; 5]> =
            short(parts[6]).chunks(5).map(|row| row.try_into().expect("five")).collect();
        if known.last().is_none_or(|(name, ..)| name != parts[0]) {
            let chain = tables.chain(parts[0], &rows);
            known.push((parts[0].to_owned(), chain, rows));
        }
        let (_, chain, _) = known.last().expect("one is there");
        let carries = (words(parts[1])[0] as u8, words(parts[2])[0] as u8);
        tables.case(*chain, carries, &short(parts[3]), &short(parts[5]), words(parts[4])[0]);
    }

    // Long chains, to measure their cost, with a cell on the last joint.
    let panda = &known.iter().find(|(name, ..)| name == "panda").expect("the panda").2;
    let seven: Vec<[i16; 5]> = panda.iter().filter(|row| row[4] != 2).copied().collect();
    for joints in [7_u8, 10, 14] {
        let chain = tables.chain(&format!("chain-{joints}"), &repeated(&seven, joints.into()));
        let mut random = 1_u32;
        let mut next = || {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (random >> 16) as u16 as i16
        };
        for case in 0..20 {
            let positions: Vec<i16> = (0..joints).map(|_| next()).collect();
            let pose = [
                next() / 16,
                next() / 16,
                next() / 16,
                9_830,
                0,
                if case % 2 == 0 { 13_107 } else { -13_107 },
            ];
            tables.case(chain, (joints, joints), &pose, &positions, 100_000 + 17_321 * case);
        }
    }

    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    let text = format!(
        "pub(crate) static CHAINS: &[Chain] = &[\n{}];\npub(crate) static CASES: &[Case] = &[\n{}];\n",
        tables.chains, tables.cases
    );
    fs::write(out.join("cases.rs"), text).expect("cargo's folder is writable");
    let memory = if env::var("TARGET").is_ok_and(|it| it.starts_with("thumbv6m")) { MICROBIT } else { MPS2 };
    fs::write(out.join("memory.x"), memory).expect("cargo's folder is writable");
    // The linker arguments of the cell name this file, which this program does not need.
    fs::write(out.join("cell.x"), "").expect("cargo's folder is writable");
    println!("cargo::rustc-link-search={}", out.display());
    for file in ["build.rs", UR5, CHAINS] {
        println!("cargo::rerun-if-changed={file}");
    }
}
