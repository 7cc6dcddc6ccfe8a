//! Run time of one Jacobian and one sine in ns: `cargo bench -p cell-node --bench kernels`
//!
//! The results depend on the processor's floating-point unit. For a microcontroller without one, `--bench instructions`
//! is more meaningful.

use std::hint::black_box;
use std::time::Duration;

use cell_node::kernel::Kernel;
use cell_node::sine::{paper_sine, sine};
use criterion::{Criterion, Throughput};
use protocol::fixed::Q1_14;

mod setting;

use setting::BenchSetting;

fn main() {
    let mut criterion = Criterion::default()
        .sample_size(30)
        .warm_up_time(Duration::from_millis(300))
        .measurement_time(Duration::from_secs(1))
        .configure_from_args();

    let setting = BenchSetting::new();
    setting.check();
    let mut group = criterion.benchmark_group("jacobian");
    group.bench_function("wrench", |bencher| {
        bencher.iter(|| setting.wrench.jacobian(black_box(&setting.words)));
    });
    group.bench_function("projection", |bencher| {
        bencher.iter(|| setting.projection.jacobian(black_box(&setting.words)));
    });
    group.bench_function("nalgebra f64", |bencher| {
        bencher.iter(|| setting.double.jacobian(black_box(&setting.radians)));
    });
    group.bench_function("nalgebra f32", |bencher| {
        bencher.iter(|| setting.single.jacobian(black_box(&setting.radians_f32)));
    });
    group.finish();

    let mut group = criterion.benchmark_group("sine");
    let angles: Vec<_> = (i16::MIN..=i16::MAX).step_by(64).map(Q1_14::from_bits).collect();
    group.throughput(Throughput::Elements(angles.len() as u64));
    for (name, function) in
        [("by eighths of a turn", sine as fn(Q1_14) -> Q1_14), ("fifth order", paper_sine)]
    {
        group.bench_function(name, |bencher| {
            bencher.iter(|| angles.iter().fold(0, |sum, &angle| sum ^ function(angle).to_bits()));
        });
    }
    group.finish();
    criterion.final_summary();
}
