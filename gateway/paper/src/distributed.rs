//! The time of the distributed computation: of the control loop's ticks, as a function of the number of cells and of
//! active cells. For comparison, also the time of the central computation in the same ticks, and the time for receiving
//! a torque, which the paper leaves out.
//!
//! The number of buses is fixed, so that only the number of cells grows. The time of the distributed computation is
//! that of the whole tick, which includes more than the skin: it reads the sums of the receivers, runs the controller
//! and the robot, and encodes and sends the joints.

use std::hint::black_box;

use protocol::can::{Format, Frame};
use protocol::message::{Joints, Message};
use protocol::packet::{Epoch, WORDS};
use protocol::skin::Skin;
use protocol::time::Micros;

use super::line::{LinearFit, count_to_f64};
use super::samples;
use super::ticks::{BUSES, TickBench, nanos_to_float, skin_with_fewer_cells};
use analysis::report::figure::{Axis, Figure, Finding, Section, SeriesShape, format_number};
use model::scenario::TorqueSource;
use model::table::BusTable;

/// The number of measurements.
#[derive(Clone, Copy, Debug)]
pub struct DistributedMeasurementPlan {
    /// The number of different numbers of cells besides one cell per bus, and of active cells besides 0.
    pub steps: usize,
    /// The number of measurements for each of these numbers.
    pub rounds: usize,
}

/// The times of ticks for different numbers of cells, and the lines fitted to them. All times are in ns.
#[derive(Clone, Debug)]
pub struct TickTimes {
    /// For each number of cells: that number, the time of a distributed tick, and the time of the central computation
    /// in a tick that compares both.
    pub points: Vec<[f64; 3]>,
    /// The line fitted to the times of distributed ticks.
    pub distributed: LinearFit,
    /// The line fitted to the times of central computations.
    pub central: LinearFit,
}

impl TickTimes {
    /// Returns the upper end of the 95 % interval of the distributed line's slope, divided by the slope of the central
    /// line.
    #[must_use]
    pub fn slope_ratio_at_most(&self) -> f64 {
        self.distributed.slope_at_most() / self.central.slope
    }
}

/// All measurements of the experiment.
#[derive(Clone, Debug)]
pub struct DistributedMeasurements {
    /// Times for different numbers of cells, none of which is active.
    pub cells: TickTimes,
    /// Times for different numbers of active cells on the whole skin.
    pub active: TickTimes,
    /// The line fitted to the times of distributed ticks in ns as a function of the number of buses.
    pub buses: LinearFit,
    /// The number of cells of the whole skin.
    pub of: usize,
    /// The time that the thread of a receiver needs for a torque in ns, from the frame to the sum of the bus.
    pub receiving: f64,
}

/// Measures times on parts of a skin. Returns `None` if `extent` has fewer than two steps.
#[must_use]
pub fn measure_distributed(
    skin: &Skin,
    extent: DistributedMeasurementPlan,
    now: impl Fn() -> u64 + Copy,
) -> Option<DistributedMeasurements> {
    let most = skin.cells.len();
    let step = |step| most * step / extent.steps.max(1);
    // Each bus has at least one cell, because a bus without cells has no chain to be computed.
    let min = skin.buses.len().min(most);
    let cells: Vec<usize> = (0..=extent.steps).map(|place| step(place).max(min)).collect();
    let active: Vec<usize> = (0..=extent.steps).map(step).collect();
    let parts: Vec<Skin> = cells.iter().map(|&cells| skin_with_fewer_cells(skin, cells)).collect();
    let of_part = |place: usize, mode| TickBench::new(parts.get(place).unwrap_or(skin), 0, mode);
    let of_touch = |place: usize, mode| TickBench::new(skin, active.get(place).copied().unwrap_or(0), mode);
    let (cells, active) = (
        measure_tick_times(&cells, extent.rounds, 11, of_part, now)?,
        measure_tick_times(&active, extent.rounds, 12, of_touch, now)?,
    );
    Some(DistributedMeasurements {
        cells,
        active,
        buses: measure_over_buses(skin, extent, now)?,
        of: most,
        receiving: torque_receiving_time_ns(&skin.with_cells_of_bus(0), extent.rounds, now),
    })
}

/// Measures ticks with and without the central computation, for each of several numbers of cells. `ticks` creates the
/// loop for the number with this index and for a mode.
pub(super) fn measure_tick_times(
    numbers: &[usize],
    rounds: usize,
    seed: u64,
    ticks: impl Fn(usize, TorqueSource) -> TickBench,
    now: impl Fn() -> u64 + Copy,
) -> Option<TickTimes> {
    let (distributed, central) = (TorqueSource::Distributed, TorqueSource::Compare);
    let things = (0..numbers.len()).flat_map(|place| [(place, distributed), (place, central)]);
    let mut loops: Vec<_> = things.map(|(place, mode)| (ticks(place, mode), mode)).collect();
    let measured = samples::measure_interleaved(loops.len(), rounds, seed, |thing| {
        let Some((ticks, mode)) = loops.get_mut(thing) else { return f64::NAN };
        // The first epoch is not measured. It fills the caches with the code and data of this loop.
        ticks.run_epoch(now);
        let took = ticks.run_epoch(now);
        if *mode == distributed { took.tick } else { took.central }
    });
    let medians = samples::medians(&measured);
    let pairs = numbers.iter().zip(medians.as_chunks().0);
    let points: Vec<_> =
        pairs.map(|(&number, &[tick, central])| [count_to_f64(number), tick, central]).collect();
    let line = |place: fn(&[f64; 3]) -> f64| {
        LinearFit::fit_unweighted(&points.iter().map(|point| (point[0], place(point))).collect::<Vec<_>>())
    };
    Some(TickTimes { distributed: line(|point| point[1])?, central: line(|point| point[2])?, points })
}

/// Measures distributed ticks of a skin without cells, for different numbers of buses.
fn measure_over_buses(
    skin: &Skin,
    extent: DistributedMeasurementPlan,
    now: impl Fn() -> u64 + Copy,
) -> Option<LinearFit> {
    let bare = |buses: usize| Skin {
        buses: skin.buses.iter().take(buses).cloned().collect(),
        cells: Vec::new(),
        ..skin.clone()
    };
    let numbers: Vec<usize> = (1..=skin.buses.len()).collect();
    let mut loops: Vec<_> =
        numbers.iter().map(|&buses| TickBench::new(&bare(buses), 0, TorqueSource::Distributed)).collect();
    let measured = samples::measure_interleaved(loops.len(), extent.rounds, 13, |thing| {
        let Some(ticks) = loops.get_mut(thing) else { return f64::NAN };
        ticks.run_epoch(now);
        ticks.run_epoch(now).tick
    });
    let medians = samples::medians(&measured);
    LinearFit::fit_unweighted(
        &numbers.iter().map(|&buses| count_to_f64(buses)).zip(medians).collect::<Vec<_>>(),
    )
}

/// Measures the time for handling a torque, in ns: its packet is checked and decoded, and the torque replaces the
/// previous one of the cell in the sum. Every cell of a bus replies in every epoch, each time with a different torque.
fn torque_receiving_time_ns(skin: &Skin, rounds: usize, now: impl Fn() -> u64) -> f64 {
    let mut table = BusTable::new(skin, 0);
    let mut epoch = Epoch(0);
    let mut took = Vec::with_capacity(rounds);
    for round in 0..rounds {
        epoch = epoch.next();
        let at = Micros(16_000 * round as u64);
        let joints = Joints { in_use: 6, ..Joints::default() };
        let frames = |message: Message| message.encode().frames(Format::Fd).collect::<Vec<Frame>>();
        for frame in frames(Message::Joints { epoch, joints }) {
            table.handle_frame(at, true, &frame, &mut |_| None);
        }
        let torque = [if round % 2 == 0 { 409 } else { -77 }; WORDS].into();
        let replies =
            skin.cells.iter().flat_map(|cell| frames(Message::Torque { from: cell.node, epoch, torque }));
        let replies: Vec<Frame> = replies.collect();
        let began = now();
        for frame in &replies {
            table.handle_frame(at, false, black_box(frame), &mut |_| None);
        }
        took.push(nanos_to_float(now().saturating_sub(began)) / count_to_f64(replies.len()));
        debug_assert_eq!(
            table.snapshot().sums.contributing as usize,
            skin.cells.len(),
            "every cell is in the sum"
        );
    }
    super::line::quantile(&mut took, 0.5)
}

/// The maximum slope of the distributed line, relative to that of the central line.
const MAX_SLOPE_RATIO: f64 = 0.01;

pub(super) fn slope_findings(what: &str, over: &TickTimes) -> [Finding; 3] {
    let TickTimes { distributed, central, .. } = over;
    [
        Finding::new_unrated(format!("central T_skin for each {what}"), central.slope_in("ns")),
        Finding::new_unrated(format!("distributed tick for each {what}"), distributed.slope_in("ns"))
            .with_paper_value(0.0),
        Finding::new_unrated(
            format!("slope of the distributed tick over {what}s, relative to that of the central one: upper 95 % limit"),
            (over.slope_ratio_at_most() * 100.0, "%"),
        )
        .with_requirement(
            format!("at most {} %", MAX_SLOPE_RATIO * 100.0),
            over.slope_ratio_at_most() <= MAX_SLOPE_RATIO,
        ),
    ]
}

/// Writes the section on the times of the distributed computation.
#[must_use]
pub fn distributed_section(measured: &DistributedMeasurements) -> Section {
    let DistributedMeasurements { cells, active, buses, of, receiving } = measured;
    let figure = |name: &str, title: String, what: &str, over: &TickTimes| {
        let micros = |place: fn(&[f64; 3]) -> f64| {
            over.points.iter().map(|point| (point[0], place(point) * 1e-3)).collect::<Vec<_>>()
        };
        let most = over.points.last().map_or(0.0, |point| point[0]);
        let law = |line: &LinearFit| [0.0, most].map(|x| (x, line.value_at(x) * 1e-3)).to_vec();
        Figure::new(name, title, Axis::new(what, ""), Axis::new("time in a tick", "µs"))
            .draw_series("central T_skin", SeriesShape::Points, micros(|point| point[2]))
            .draw_series("distributed: the whole tick", SeriesShape::Points, micros(|point| point[1]))
            .draw_series("", SeriesShape::Line, law(&over.central))
            .draw_series("", SeriesShape::Line, law(&over.distributed))
    };
    let findings = [
        Finding::new_unrated("distributed tick for each further bus", buses.slope_in("ns")),
        Finding::new_unrated(
            "the same, divided by the maximum number of cells on a bus (254)",
            (buses.slope / 254.0, "ns"),
        ),
        Finding::new_unrated(
            "checking, decoding and adding a received torque in the receiver thread (not counted in the paper)",
            (*receiving, "ns"),
        ),
        Finding::new_unrated(
            "receiving the torque of an active cell, relative to computing it centrally in the 8 ticks of an epoch",
            receiving / (8.0 * active.central.slope),
        ),
    ];
    Section::new("distributed", "Distributed computation by number of cells and of active cells")
        .with_paragraph(format!(
            "The skin has up to {of} cells on {BUSES} buses. For the distributed computation the whole tick is \
             timed: sums of all buses, controller, robot, joints; for the central computation only T_skin, the part \
             that computes torques. Both are timed in the same run, in random order. The robot does not move.",
        ))
        .with_paragraph(format!(
            "A tick of the distributed computation receives one sum per bus and no data of single cells, so only \
             more buses make it longer: {} ns each, with or without cells. More cells mean more work for the \
             receivers, which run in threads of their own: {} ns per received torque, once per epoch, and only for \
             cells in contact. The time that the kernel needs to deliver a frame to the receiver is not included.",
            format_number(buses.slope),
            format_number(*receiving)
        ))
        .with_figures([
            figure(
                "distributed-cells",
                "Time of a tick by number of cells, none active".to_owned(),
                "cells",
                cells,
            ),
            figure(
                "distributed-active",
                format!("Time of a tick by number of active cells, of {of} cells"),
                "active cells",
                active,
            ),
        ])
        .with_findings(slope_findings("cell", cells))
        .with_findings(slope_findings("active cell", active))
        .with_findings(findings)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ticks;

    /// The clock advances by 1 ns per reading. A distributed tick reads it twice, whatever the number of cells.
    #[test]
    fn both_ways_are_measured_over_both_numbers() {
        let skin = ticks::generated_skin(48, BUSES).unwrap();
        let clock = std::cell::Cell::new(0);
        let now = || {
            clock.set(clock.get() + 1);
            clock.get()
        };
        let measured =
            measure_distributed(&skin, DistributedMeasurementPlan { steps: 4, rounds: 3 }, now).unwrap();
        for (over, target) in [
            (&measured.cells, ["12", "12", "24", "36", "48"]),
            (&measured.active, ["0", "12", "24", "36", "48"]),
        ] {
            let numbers: Vec<_> = over.points.iter().map(|point| point[0].to_string()).collect();
            assert_eq!(numbers, target);
            assert!(
                over.points
                    .iter()
                    .all(|[_, tick, central]| (tick - 1.0).abs() + (central - 1.0).abs() < 1e-9)
            );
        }
        assert!((measured.receiving - 0.25).abs() < 1e-9, "four cells between two looks");
        let section = distributed_section(&measured);
        assert_eq!(section.figures.len(), 2);
        assert!(
            measure_distributed(&skin, DistributedMeasurementPlan { steps: 1, rounds: 3 }, now).is_none()
        );
    }
}
