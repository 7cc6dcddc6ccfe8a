//! The load of a real bus by the paper's arm in the worst case, over the number of cells and for different bit rates.
//! It is computed by [`analysis::fit`].

use super::arm;
use super::line::count_to_f64;
use analysis::fit::limits::MAX_NODES_PER_BUS;
use analysis::fit::verdict::FitSummary;
use analysis::fit::{self, PAPER_COMPUTATION_NS, RatesRow};
use analysis::report::figure::{Axis, Figure, Finding, MarkLine, Section, Series, SeriesShape, Table};

/// The maximum number of cells in the figure.
const MAX_CELLS: u32 = 300;

/// Writes the section on the load of a bus over the number of cells.
#[must_use]
pub fn load_section() -> Section {
    let skin = arm::paper_skin();
    let rows = fit::rates_table(&skin, None, PAPER_COMPUTATION_NS);
    let cells = skin.cells.len();
    let series = |row: &RatesRow| {
        let rated = &row.fullest.rated;
        let load = |cells| (f64::from(cells), 100.0 * rated.case.with_cells(cells).load().total());
        let points = (0..=MAX_CELLS).step_by(10).map(load).collect();
        Series::new(FitSummary::worst_case(rated).rates, SeriesShape::Line, points)
    };
    // The bit rates are defaults that no user has chosen, so the findings get no verdict.
    let finding = |row: &RatesRow| {
        let FitSummary { load, rates, cells, verdict } = FitSummary::worst_case(&row.fullest.rated);
        let what = format!("worst case of one bus at {rates}: {verdict} ({cells})");
        Finding::new_unrated(what, (100.0 * load, "%"))
    };
    let figure = Figure::new(
        "load",
        "Load of one bus in the worst case, with every cell in contact",
        Axis::new("cells", "").with_ends(0.0, f64::from(MAX_CELLS)),
        Axis::new("load", "%").with_ends(0.0, 200.0),
    );
    let marks = [
        MarkLine::at_y(100.0, "full"),
        MarkLine::at_x(f64::from(MAX_NODES_PER_BUS - 1), "maximum number of nodes"),
        MarkLine::at_x(count_to_f64(cells), "the paper's arm"),
    ];
    Section::new("load", "Bus load by number of cells")
        .with_paragraph(
            "The load is the share of time that joints messages, replies and heartbeats occupy a bus when every cell \
             is in contact: with 62.5 epochs and 4 heartbeats of each cell a second, 16 bytes in a packet, 11-bit \
             identifiers, and as many stuff bits as a frame can have. A load above 100 % is not possible. Sums along \
             the tree need as many frames on one shared bus. These are the numbers of `skinbus fit`, which shows \
             more about one skin.",
        )
        .with_paragraph(format!(
            "The paper considers time only. Transceivers can drive about {MAX_NODES_PER_BUS} nodes, one of which is \
             the gateway. So the table has the number of buses that {cells} cells need for time alone, and the \
             number for all limits, with the limit that decides."
        ))
        .with_figures([figure.with_series(rows.iter().map(series)).with_marks(marks)])
        .with_findings(rows.iter().map(finding))
        .with_tables([load_table(&rows, cells)])
}

fn load_table(rows: &[RatesRow], cells: usize) -> Table {
    let row = |row: &RatesRow| {
        let rated = &row.fullest.rated;
        let FitSummary { load, rates, .. } = FitSummary::worst_case(rated);
        [
            rates,
            format!("{:.1}", rated.case.longest_packet_ns() as f64 / 1e3),
            format!("{:.1}", 100.0 * (load - rated.load.heartbeats)),
            format!("{:.1}", 100.0 * load),
            row.fullest.most.max_cells_in_time().to_string(),
            row.need.buses_for_timing().map_or_else(|| "none".to_owned(), |buses| buses.to_string()),
            row.need.short_text(),
        ]
    };
    let head = [
        "bit rates",
        "packet, µs",
        "joints and replies, %",
        "with heartbeats, %",
        "cells per bus",
        "buses needed, by bus time alone",
        "buses needed",
    ];
    let title = format!(
        "Worst case: load of one bus with {cells} cells, maximum number of cells per bus that answer in time, and \
         number of buses for {cells} cells"
    );
    Table::new(title, head, rows.iter().map(row))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bus_counts_match_fit_and_default_rates_are_not_rated() {
        let section = load_section();
        let column = |at: usize| section.tables[0].rows.iter().map(move |row| row[at].as_str());
        let named: Vec<_> = column(0).zip(column(5)).zip(column(6)).collect();
        assert_eq!(
            named,
            [
                (("classic 500k", "10"), "10 (time)"),
                (("classic 1M", "5"), "5 (time)"),
                (("500k/2M", "3"), "3 (time, nodes)"),
                (("500k/5M", "2"), "3 (nodes)"),
                (("1M/2M", "3"), "3 (time, nodes)"),
                (("1M/5M", "2"), "3 (nodes)"),
                (("1M/8M", "1"), "3 (nodes)"),
            ]
        );
        assert!(section.findings.iter().all(|finding| finding.bar.is_none()), "{:?}", section.findings);
        let what = |at: usize| section.findings[at].what.as_str();
        assert_eq!(
            (what(5), what(6)),
            (
                "worst case of one bus at 1M/5M: does not fit: bandwidth (all 253 cells answer)",
                "worst case of one bus at 1M/8M: in time, but 254 nodes (all 253 cells answer)"
            )
        );
        assert!((section.findings[5].ours.value - 118.9).abs() < 0.05);
    }
}
