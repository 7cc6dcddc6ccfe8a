//! Complete skins at the exact timing of a real bus, in virtual time: those that fit, those that do not, and the
//! agreement with the bus model.

#![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::panic, reason = "a test may stop")]

use analysis::shadow::{BusShadow, FrameTiming, Shadow, ShadowOptions};
use model::table::Replies;
use protocol::can::Format;
use protocol::id::{Command, Id};
use protocol::message::StimulusStart;
use protocol::wire_time::BitRates;
use skinbus_tests::bench::Bench;
use skinbus_tests::gateway::epoch_of;
use skinbus_tests::skins;

/// The number of epochs that are evaluated, after all cells have been pressed.
const EPOCHS: u64 = 40;

fn rates(text: &str) -> BitRates {
    text.parse().unwrap()
}

/// Returns a bench on a real bus, with every cell pressed.
fn pressed(cells: u8, format: Format, rates: BitRates, seed: u64) -> Bench {
    let mut bench = Bench::new(&skins::arm(cells, format), seed).on_a_bus(rates).started();
    // From the same joints on: stimuli have the lowest priority on a bus, and on a full one the last of them never
    // pass.
    let from = StimulusStart::Epoch(epoch_of(bench.gateway.broadcasts() + 4));
    for place in 0..usize::from(cells) {
        bench.press_from(place, 1.0 + 0.005 * place as f64, from);
    }
    bench.run_epochs(8);
    bench
}

fn replies(bench: &Bench) -> Replies {
    Replies::total(bench.gateway.table.cells().iter().map(|cell| cell.replies))
}

/// Returns the numbers of answers due, in time and late, over some epochs.
fn over_epochs(bench: &mut Bench, epochs: u64) -> (u64, u64, u64) {
    let before = replies(bench);
    bench.run_epochs(epochs);
    let after = replies(bench);
    (after.due - before.due, after.in_time - before.in_time, after.late - before.late)
}

/// Runs the traffic of a bench, as a capture, through the bus model.
fn shadow(bench: &Bench, rates: BitRates) -> (Vec<FrameTiming>, BusShadow) {
    // This bus carried stimuli too.
    let options = ShadowOptions { each_frame: true, bench_traffic: true, ..ShadowOptions::new(rates) };
    let mut shadow = Shadow::new(options).unwrap();
    bench.requested().iter().for_each(|(at, frame)| shadow.receive("vcan0", at.0 * 1_000, frame));
    shadow.finish();
    let frames = std::iter::from_fn(|| shadow.poll()).collect();
    (frames, shadow.report().buses.remove(0))
}

/// Returns the share of time in which the bus was busy, from some time on.
fn taken_since(bench: &Bench, nanos: u64) -> f64 {
    let attempts = bench.attempts().iter().filter(|attempt| attempt.start >= nanos);
    let taken: u64 = attempts.map(|attempt| attempt.end - attempt.start).sum();
    taken as f64 / (bench.now().0 * 1_000 - nanos) as f64
}

/// Checks that every frame was sent at the time that the bus model computes.
fn assert_shaded_alike(bench: &Bench, frames: &[FrameTiming]) {
    assert!(bench.attempts().len() > 1_000);
    for attempt in bench.attempts() {
        let frame = &frames[usize::try_from(attempt.tag).unwrap()];
        assert_eq!(frame.sent, Some((attempt.start, attempt.end)), "{frame:?}");
    }
}

/// Checks that every cell answers every epoch in time; returns the share of time in which the bus is busy.
fn fits(cells: u8, rates: BitRates) -> f64 {
    let mut bench = pressed(cells, Format::Fd, rates, 1);
    let since = bench.now().0 * 1_000;
    let (due, in_time, late) = over_epochs(&mut bench, EPOCHS);
    assert_eq!((due, in_time, late), (EPOCHS * u64::from(cells), due, 0), "{cells} at {rates}");
    let taken = taken_since(&bench, since);
    let (frames, bus) = shadow(&bench, rates);
    assert_shaded_alike(&bench, &frames);
    let replies = bus.replies.unwrap();
    assert_eq!((replies.late, replies.late_before), (0, 0), "{bus:?}");
    assert!(replies.after_joints_us.max < 16_000.0 && replies.count > EPOCHS * u64::from(cells), "{bus:?}");
    taken
}

#[test]
fn the_whole_skin_fits_one_bus_at_1m_8m() {
    let taken = fits(253, rates("1M/8M"));
    assert!((0.85..0.97).contains(&taken), "{taken}");
}

#[test]
fn the_whole_skin_fits_three_buses_at_1m_5m() {
    for cells in [85, 84, 84] {
        let taken = fits(cells, rates("1M/5M"));
        assert!((0.30..0.45).contains(&taken), "{cells}: {taken}");
    }
}

#[test]
fn the_whole_skin_is_too_much_for_one_bus_at_1m_5m_and_the_shadow_says_so() {
    let rates = rates("1M/5M");
    let mut bench = pressed(253, Format::Fd, rates, 1);
    let since = bench.now().0 * 1_000;
    // More than a second.
    let (due, in_time, late) = over_epochs(&mut bench, 2 * EPOCHS);
    assert!(due > 0 && in_time < due, "{in_time} of {due}, {late} late");
    let taken = taken_since(&bench, since);
    assert!(taken > 0.999, "{taken}");
    let (frames, bus) = shadow(&bench, rates);
    assert_shaded_alike(&bench, &frames);
    assert!((1.05..1.2).contains(&bus.load.worst_1_s.value), "{:?}", bus.load);
    let replies = bus.replies.unwrap();
    assert!(replies.late > 400, "{replies:?}");
    // Joints win every arbitration: they wait for one frame at most, so the robot's side is not affected.
    let joints = Id::command(Command::Joints).to_bits();
    let longest = frames.iter().filter_map(|frame| Some((frame, frame.sent?)));
    let longest = longest.map(|(_, (start, end))| end - start).max().unwrap();
    for frame in frames.iter().filter(|frame| frame.id == u32::from(joints)) {
        let (start, end) = frame.sent.unwrap();
        assert!(start - frame.nanos <= longest && end > start, "{frame:?}");
    }
}

#[test]
fn a_classic_bus_carries_fifty_cells_and_not_seventy() {
    let rates = rates("1M");
    let mut few = pressed(50, Format::Classic, rates, 1);
    let (due, in_time, _) = over_epochs(&mut few, EPOCHS);
    assert_eq!((due, in_time), (50 * EPOCHS, due));
    let mut many = pressed(70, Format::Classic, rates, 1);
    let (due, in_time, late) = over_epochs(&mut many, EPOCHS);
    assert!(in_time < due, "{in_time} of {due}, {late} late");
}

#[test]
fn a_bench_on_a_real_bus_is_the_same_every_time() {
    let run = |seed| {
        let mut bench = pressed(60, Format::Fd, rates("500k/2M"), seed);
        bench.run_epochs(10);
        (bench.attempts().to_vec(), bench.transcript())
    };
    assert_eq!(run(3), run(3));
}
