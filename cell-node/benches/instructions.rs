//! Instruction counts of one Jacobian, of the sines and of a reply: `cargo bench -p cell-node --bench instructions`
//!
//! Valgrind counts them, so the results do not depend on the load of the machine.
//! `docs/explanation/benchmarks.md` lists the required programs.

#![expect(
    missing_docs,
    unused_qualifications,
    clippy::disallowed_methods,
    reason = "gungraun's macros write them"
)]

use std::hint::black_box;

use cell_node::kernel::Kernel;
use cell_node::sine;
use gungraun::{library_benchmark, library_benchmark_group};
use protocol::can::{Format, Frame};
use protocol::fixed::Q1_14;
use protocol::parameters::MAX_JOINTS;

#[path = "../../protocol/benches/counted/mod.rs"]
mod counted;
mod reply;
mod setting;

use reply::PressedCell;
use setting::BenchSetting;

/// Creates the setting outside the counted part, and never drops it, so that neither is counted.
fn cell() -> &'static BenchSetting {
    Box::leak(Box::new(BenchSetting::new()))
}

/// Calls a function for all angles of the circle and combines the results into one word.
fn fold_full_circle(function: impl Fn(Q1_14) -> Q1_14) -> i16 {
    let word = |angle| function(black_box(Q1_14::from_bits(angle))).to_bits();
    // The rotation keeps a sine and its negative from cancelling out.
    (i16::MIN..=i16::MAX).fold(0_i16, |sum, angle| sum.rotate_left(1) ^ word(angle))
}

#[library_benchmark]
#[bench::k6(cell())]
fn wrench(cell: &BenchSetting) -> [Q1_14; MAX_JOINTS] {
    cell.wrench.jacobian(black_box(&cell.words))
}

#[library_benchmark]
#[bench::k6(cell())]
fn projection(cell: &BenchSetting) -> [Q1_14; MAX_JOINTS] {
    cell.projection.jacobian(black_box(&cell.words))
}

#[library_benchmark]
#[bench::k6(cell())]
fn nalgebra_f64(cell: &BenchSetting) -> [f64; MAX_JOINTS] {
    cell.double.jacobian(black_box(&cell.radians))
}

#[library_benchmark]
#[bench::k6(cell())]
fn nalgebra_f32(cell: &BenchSetting) -> [f32; MAX_JOINTS] {
    cell.single.jacobian(black_box(&cell.radians_f32))
}

#[library_benchmark]
fn by_eighths() -> i16 {
    fold_full_circle(sine::sine)
}

#[library_benchmark]
fn fifth_order() -> i16 {
    fold_full_circle(sine::paper_sine)
}

/// Creates a pressed cell outside the counted part, and never drops it.
fn pressed(format: Format) -> &'static mut PressedCell {
    Box::leak(Box::new(PressedCell::new(format)))
}

#[library_benchmark]
#[bench::fd(pressed(Format::Fd))]
#[bench::classic(pressed(Format::Classic))]
fn reply_to_joints(cell: &mut PressedCell) -> &Frame {
    cell.reply()
}

library_benchmark_group!(
    name = jacobian;
    compare_by_id = true;
    benchmarks = wrench, projection, nalgebra_f64, nalgebra_f32
);
library_benchmark_group!(name = sines; benchmarks = by_eighths, fifth_order);
library_benchmark_group!(name = replies; benchmarks = reply_to_joints);

/// Runs each benchmark once and checks its result.
fn check_all_once() {
    cell().check();
    assert_ne!(fold_full_circle(sine::sine), fold_full_circle(sine::paper_sine));
    for format in [Format::Fd, Format::Classic] {
        let last = *pressed(format).reply();
        assert_eq!((last.id(), last.format()), (0x20C, format));
    }
}

mod all {
    use super::{jacobian, replies, sines};

    gungraun::main!(library_benchmark_groups = jacobian, sines, replies);

    pub(super) fn run() {
        main();
    }
}

fn main() {
    counted::main(check_all_once, all::run);
}
