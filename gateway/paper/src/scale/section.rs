//! Writes the section on benches of up to ten thousand cells.

use super::{
    ACTIVE_SHARE, BenchFigures, MIN_IN_TIME_SHARE, ScaleMeasurements, SizeFigures, cell_count_as_float,
};
use crate::distributed::{self, TickTimes};
use analysis::report::figure::{Axis, Figure, Finding, Section, SeriesShape, Table, format_number};

/// The limits for the verdicts: the time to start in s, the gateway's memory in MB, and the time of a tick with the
/// most cells. The latter is relative to a tick with the fewest cells, on their own buses and on as many as the most
/// cells need.
const MAX_START_S: f64 = 10.0;
const MAX_MEMORY_MB: f64 = 200.0;
const MAX_TICK_RATIO: f64 = 4.0;
const MAX_TICK_RATIO_SAME_BUSES: f64 = 1.2;

/// Writes the section with figures, findings and a table.
#[must_use]
pub fn scale_section(measured: &ScaleMeasurements) -> Section {
    let ScaleMeasurements { sizes, ticks, beside } = measured;
    let most = sizes.last();
    Section::new("scale", "Benches by number of cells")
        .with_paragraph(format!(
            "Each bench has as few embedded buses as have enough node ids, and one process for all cells of a bus. \
             It first runs with {} % of the cells touched. If fewer than {} % of the replies arrive in time, it runs \
             again at half the rate, and if necessary once more at half of that. Then it runs with no cell touched, \
             at the same rate.",
            ACTIVE_SHARE * 100.0,
            MIN_IN_TIME_SHARE * 100.0
        ))
        .with_paragraph(
            "The time of a tick of a bench is the median of the ticks without a central computation. The times of a \
             tick by number of cells are those of a loop without threads, with every cell active and the same number \
             of buses for all numbers of cells; the central computation is timed in the same rounds.",
        )
        .with_figures(bench_figures(sizes))
        .with_figures([tick_time_figure(ticks)])
        .with_findings(most.map(largest_bench_findings).into_iter().flatten())
        .with_findings(tick_findings(sizes, beside))
        .with_findings(distributed::slope_findings("active cell", ticks))
        .with_tables([bench_table(sizes)])
}

/// The caption of a curve, and the function that returns its value for a bench.
type BenchCurve<'a> = (&'a str, fn(&SizeFigures) -> f64);

/// Returns a figure over the number of cells, with one curve for each element of the array.
fn figure_over_cells<const N: usize>(
    (name, title): (&str, &str),
    y: Axis,
    sizes: &[SizeFigures],
    series: [BenchCurve<'_>; N],
) -> Figure {
    let figure = Figure::new(format!("scale-{name}"), title, Axis::new("cells", ""), y).with_half_width();
    series.into_iter().fold(figure, |figure, (caption, value)| {
        let points = sizes.iter().map(|size| (cell_count_as_float(size), value(size)));
        figure.draw_series(caption, SeriesShape::Line, points.collect())
    })
}

fn bench_figures(sizes: &[SizeFigures]) -> [Figure; 7] {
    [
        figure_over_cells(
            ("start", "Time from the program's start to the first joints message"),
            Axis::new("time", "s"),
            sizes,
            [("none active", |size| size.quiet.start_s), ("5 % active", |size| size.active.start_s)],
        ),
        figure_over_cells(
            ("processor", "Processor use, 5 % active"),
            Axis::new("processor", "cores"),
            sizes,
            [
                ("all, none active", |size| size.quiet.cores.iter().sum()),
                ("all", |size| size.active.cores.iter().sum()),
                ("gateway", |size| size.active.cores[0]),
                ("buses", |size| size.active.cores[1]),
                ("cells", |size| size.active.cores[2]),
            ],
        ),
        figure_over_cells(
            ("memory", "Private memory, 5 % active"),
            Axis::new("memory", "MB"),
            sizes,
            [
                ("gateway", |size| size.active.memory_mb[0]),
                ("all bus servers", |size| size.active.memory_mb[1]),
                ("the largest process of cells", |size| size.active.memory_mb[2]),
            ],
        ),
        figure_over_cells(
            ("tick", "Median time of a distributed tick"),
            Axis::new("time in a tick", "µs"),
            sizes,
            [("none active", |size| size.quiet.tick_us), ("5 % active", |size| size.active.tick_us)],
        ),
        figure_over_cells(
            ("late", "99th percentile of the lateness of ticks"),
            Axis::new("lateness", "µs"),
            sizes,
            [
                ("none active", |size| size.quiet.late_us[0]),
                ("5 % active", |size| size.active.late_us[0]),
                ("an idle thread", |size| size.quiet.late_us[1]),
            ],
        ),
        figure_over_cells(
            ("replies", "Replies in time, 5 % active, at the highest rate that is met"),
            Axis::new("replies in time", "%").with_ends(0.0, 100.0),
            sizes,
            [("", |size| size.active.in_time_share() * 100.0)],
        ),
        figure_over_cells(
            ("rate", "Highest rate that is met, or the lowest rate tried"),
            Axis::new("rate", "Hz"),
            sizes,
            [("", |size| size.hz)],
        ),
    ]
}

fn tick_time_figure(over: &TickTimes) -> Figure {
    let micros = |place: fn(&[f64; 3]) -> f64| {
        over.points.iter().map(|point| (point[0], place(point) * 1e-3)).collect::<Vec<_>>()
    };
    let title = "Time of a tick by number of cells, all active, on the same number of buses";
    Figure::new(
        "scale-loop",
        title,
        Axis::new("cells", ""),
        Axis::new("time in a tick", "µs").with_log_scale(),
    )
    .draw_series("central T_skin", SeriesShape::Points, micros(|point| point[2]))
    .draw_series("distributed: the whole tick", SeriesShape::Points, micros(|point| point[1]))
}

/// Returns the findings on the bench with the largest number of cells.
fn largest_bench_findings(size: &SizeFigures) -> Vec<Finding> {
    let SizeFigures { cells, hz, holds, quiet, active, .. } = size;
    let of = |what: &str| format!("{what}, {cells} cells");
    let BenchFigures { start_s, memory_mb, .. } = active;
    let at = format!("replies in time at {} Hz, 5 % active", format_number(*hz));
    let bar = format!("at least {} %, none missing for no known reason", MIN_IN_TIME_SHARE * 100.0);
    vec![
        Finding::new_unrated(
            of("time from the program's start to the first joints message"),
            (*start_s, "s"),
        )
        .at_most(MAX_START_S),
        Finding::new_unrated(of(&at), (active.in_time_share() * 100.0, "%")).with_requirement(bar, *holds),
        Finding::new_unrated(
            of("replies and packets missing for no known reason"),
            active.unknown + quiet.unknown,
        )
        .at_most(0.0),
        Finding::new_unrated(of("private memory of the gateway"), (memory_mb[0], "MB"))
            .at_most(MAX_MEMORY_MB),
        Finding::new_unrated(of("processor, none active"), (quiet.cores.iter().sum::<f64>(), "cores")),
        Finding::new_unrated(of("processor, 5 % active"), (active.cores.iter().sum::<f64>(), "cores")),
    ]
}

/// Compares the time of a tick with the most cells with that of a tick with the fewest.
fn tick_findings(sizes: &[SizeFigures], [few, few_on_as_many, most]: &[f64; 3]) -> Vec<Finding> {
    let (Some(fewest), Some(largest)) = (sizes.first(), sizes.last()) else { return Vec::new() };
    let (cells, buses, fewest_cells) = (largest.cells, largest.buses, fewest.cells);
    let beside =
        |what: &str| format!("distributed tick of {cells} cells, relative to that of {fewest_cells}{what}");
    vec![
        Finding::new_unrated(beside(", without threads, all active"), most / few).at_most(MAX_TICK_RATIO),
        Finding::new_unrated(
            beside(&format!(" also on {buses} buses, measured the same way")),
            most / few_on_as_many,
        )
        .at_most(MAX_TICK_RATIO_SAME_BUSES),
        Finding::new_unrated(
            beside(", medians of benches, 5 % active"),
            largest.active.tick_us / fewest.active.tick_us,
        ),
    ]
}

fn bench_table(sizes: &[SizeFigures]) -> Table {
    let row = |size: &SizeFigures| {
        let SizeFigures { cells, buses, hz, holds, quiet, active } = size;
        let both = |value: fn(&BenchFigures) -> f64| {
            format!("{}; {}", format_number(value(quiet)), format_number(value(active)))
        };
        [
            cells.to_string(),
            buses.to_string(),
            format!("{}{}", format_number(*hz), if *holds { "" } else { " (not met)" }),
            both(|figures| figures.start_s),
            both(|figures| figures.cores.iter().sum()),
            both(|figures| figures.memory_mb[0]),
            both(|figures| figures.tick_us),
            both(|figures| figures.late_us[0]),
            format!("{} of {}", active.in_time, active.due),
        ]
    };
    let head = [
        "cells",
        "buses",
        "rate, Hz",
        "start, s",
        "processor, cores",
        "gateway, MB",
        "tick, µs",
        "99th percentile of lateness, µs",
        "replies in time, 5 % active",
    ];
    let title = "Benches by number of cells; of two numbers, the first is with none active, the second with 5 % active";
    Table::new(title, head, sizes.iter().map(row))
}
