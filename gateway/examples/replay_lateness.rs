//! Lateness of a replay that sends a frame every 2 ms on an embedded bus with a reader, for several spinning times:
//! `cargo run --release -p gateway --example replay_lateness [SECONDS]`
//!
//! The output also shows the lateness at which the same machine wakes an idle thread.
#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a measurement may stop")]

use std::fmt::Write as _;
use std::time::Duration;

use bench::bus::time::BusTimeChoice;
use bench::replay::player::ReplaySpeed;
use bench::replay::replay_plan::SenderFilter;
use bench::replay::survey::TimeRange;
use bench::replay::{ReplayOptions, replay};
use protocol::bus::{Bus, BusKind, BusOptions, Inbox, KindChoice, KindChoices};
use rustix::time::{ClockId, clock_gettime};
use vcan_setup::embedded::Server;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let seconds: u32 =
        protocol::usage::command_line().into_iter().nth(1).map_or(Ok(10), |word| word.parse())?;
    let name = "lateness";
    let server = Server::bind(name)?;
    let (stop, stopped) = std::os::unix::net::UnixStream::pair()?;
    let serving = std::thread::spawn(move || server.run(stopped));
    let kind = KindChoice::Only(BusKind::Embedded);
    let reader = Bus::open(name, kind, &BusOptions::default())?;
    std::thread::spawn(move || {
        let mut inbox = Inbox::new();
        while reader.wait(None).is_ok() && reader.receive(&mut inbox).is_ok() {}
    });

    let mut grid = String::new();
    for number in 0..seconds * 500 {
        let us = number * 2_000;
        writeln!(grid, "({}.{:06}) {name} 001##1{number:032X}", 1 + us / 1_000_000, us % 1_000_000)?;
    }
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("grid.log");
    std::fs::write(&file, grid)?;

    println!("spin, us   late 50 % / 90 % / 99 % / maximum, us   idle        processor, cores");
    for spin in [0, 20, 50, 100, 150, 300] {
        let options = ReplayOptions {
            files: vec![file.clone()],
            kinds: KindChoices::same_for_all(kind),
            bus_time: BusTimeChoice::None,
            only: SenderFilter::All,
            buses: Vec::new(),
            map: Vec::new(),
            part: TimeRange::default(),
            passes: Some(1),
            pace: ReplaySpeed::Timed(1.0),
            spin: Duration::from_micros(spin),
            lockstep: false,
            expect: None,
            spawn: None,
            test_mode: false,
            timeout: Duration::from_millis(100),
            receive_buffer: 1 << 20,
            quiet: true,
        };
        let before = clock_gettime(ClockId::ProcessCPUTime);
        let summary = replay(&options)?;
        let after = clock_gettime(ClockId::ProcessCPUTime);
        #[expect(clippy::cast_precision_loss, reason = "seconds")]
        let spent = (after.tv_sec - before.tv_sec) as f64 + (after.tv_nsec - before.tv_nsec) as f64 * 1e-9;
        let (late, idle) = (summary.late_us.unwrap(), summary.idle_late_us.unwrap());
        println!(
            "{spin:8}   {:5.0} / {:5.0} / {:5.0} / {:5.0}              {:3.0} / {:3.0}   {:.3}",
            late.p50,
            late.p90,
            late.p99,
            late.max,
            idle.p50,
            idle.p90,
            spent / summary.duration_s
        );
    }
    drop(stop);
    let _ = serving.join();
    Ok(())
}
