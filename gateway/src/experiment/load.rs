//! How much of a real bus a skin needs, over the number of cells and by bit rate: worst-case frames, every cell in contact.

use protocol::can::Format;
use protocol::wire_time::{BitRates, Coding, Shape as Frame};

use super::line::count;
use crate::report::figure::{
    Axis, Figure, Finding, Mark, On, Quantity, Section, Series, Shape, Table, number,
};

/// From joints to joints, in s.
const PERIOD_S: f64 = 0.016;
/// From one heartbeat of a cell to its next, in s.
const HEARTBEAT_S: f64 = 0.25;
/// Cells of the paper's arm.
const CELLS: usize = 253;
/// Nodes that common transceivers drive.
const NODES: f64 = 110.0;
/// Cells in the figure.
const MOST: usize = 300;

/// Two bit rates and what a packet travels in.
#[derive(Clone, Copy, Debug)]
pub struct Rates {
    /// How people call it.
    pub name: &'static str,
    /// One FD frame a packet, or two classic ones.
    pub format: Format,
    rates: BitRates,
}

impl Rates {
    /// The common ones.
    #[must_use]
    pub fn all() -> Vec<Self> {
        let fd = [
            ("500k/2M", 500_000, 2_000_000),
            ("500k/5M", 500_000, 5_000_000),
            ("1M/2M", 1_000_000, 2_000_000),
            ("1M/5M", 1_000_000, 5_000_000),
            ("1M/8M", 1_000_000, 8_000_000),
        ];
        let fd = fd.into_iter().filter_map(|(name, nominal, data)| {
            Some(Self { name, format: Format::Fd, rates: BitRates::new(nominal, data).ok()? })
        });
        let classic = BitRates::classic(1_000_000).ok();
        fd.chain(classic.map(|rates| Self { name: "classic 1M", format: Format::Classic, rates })).collect()
    }

    /// How long a packet takes at most, in s: its one frame, or its two.
    #[must_use]
    pub fn packet_s(&self) -> f64 {
        let (coding, len, frames) = match self.format {
            Format::Fd => (Coding::FdSwitched, 16, 1.0),
            Format::Classic => (Coding::Classic, 8, 2.0),
        };
        frames * Frame { coding, extended: false, len }.worst().seconds(self.rates)
    }

    /// The part of a bus that the joints and so many cells' replies need; more than 1 does not fit.
    #[must_use]
    pub fn replies(&self, cells: usize) -> f64 {
        self.packet_s() * (1.0 + count(cells)) / PERIOD_S
    }

    /// The same with the cells' heartbeats.
    #[must_use]
    pub fn load(&self, cells: usize) -> f64 {
        self.replies(cells) + self.packet_s() * count(cells) / HEARTBEAT_S
    }

    /// The most cells whose load fits.
    #[must_use]
    pub fn most_cells(&self) -> usize {
        (1..=10_000).take_while(|&cells| self.load(cells) <= 1.0).last().unwrap_or(0)
    }
}

/// Loads over cells.
#[must_use]
pub fn section() -> Section {
    let all = Rates::all();
    let series = |rates: &Rates| {
        let points = (0..=MOST).step_by(10).map(|cells| (count(cells), 100.0 * rates.load(cells)));
        Series::new(rates.name, Shape::Line, points.collect())
    };
    let findings = all.iter().map(|rates| {
        let what = format!("load of {CELLS} cells on one bus at {}, heartbeats included", rates.name);
        let load = rates.load(CELLS);
        Finding::told(what, Quantity::new(100.0 * load, "%")).must("at most 100 %", load <= 1.0)
    });
    Section {
        name: "load".to_owned(),
        title: "Bus load over the number of cells".to_owned(),
        text: vec![
            "What joints, replies and heartbeats need of a bus when every cell is in contact: 62.5 epochs and 4 heartbeats of \
             each cell a second, 16 bytes in a packet, 11-bit identifiers, and as many stuff bits as a frame can have. Above \
             100 % it does not fit, whatever the order. Sums along the tree need as many frames on one shared bus. A load \
             below 100 % says that a bus keeps up in the long run, not that every reply comes in time."
                .to_owned(),
        ],
        figures: vec![Figure {
            name: "load".to_owned(),
            title: "Load of one bus, every cell in contact, worst case".to_owned(),
            x: Axis::new("cells", "").between(0.0, count(MOST)),
            y: Axis::new("load", "%").between(0.0, 200.0),
            series: all.iter().map(series).collect(),
            marks: vec![
                Mark { on: On::Y, at: 100.0, label: "full".to_owned() },
                Mark { on: On::X, at: NODES, label: "nodes electrically".to_owned() },
                Mark { on: On::X, at: count(CELLS), label: "the paper's arm".to_owned() },
            ],
            ..Figure::default()
        }],
        findings: findings.collect(),
        tables: vec![Table {
            title: "One bus, worst case".to_owned(),
            head: [
                "bit rates",
                "packet, µs",
                "load of 253 cells, replies, %",
                "with heartbeats, %",
                "most cells",
                "buses for 253 cells",
            ]
            .map(str::to_owned)
            .to_vec(),
            rows: all
                .iter()
                .map(|rates| {
                    vec![
                        rates.name.to_owned(),
                        format!("{:.1}", rates.packet_s() * 1e6),
                        number(100.0 * rates.replies(CELLS)),
                        number(100.0 * rates.load(CELLS)),
                        rates.most_cells().to_string(),
                        CELLS.div_ceil(rates.most_cells().max(1)).to_string(),
                    ]
                })
                .collect(),
        }],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Worst cases that others computed, in µs; of two classic frames, whose CRC cannot be what would stuff most, 2 less.
    #[test]
    fn a_packet_takes_what_it_takes() {
        let wanted = [160.0, 102.4, 128.0, 70.4, 56.0, 266.0];
        for (rates, wanted) in Rates::all().iter().zip(wanted) {
            assert!((rates.packet_s() * 1e6 - wanted).abs() < 0.05, "{}: {}", rates.name, rates.packet_s());
        }
        assert_eq!(Rates::all().len(), wanted.len());
    }

    #[test]
    fn the_papers_arm_does_not_fit_one_bus_at_5_megabit_but_at_8() {
        let all = Rates::all();
        let fits: Vec<_> = all.iter().map(|rates| rates.load(CELLS) <= 1.0).collect();
        assert_eq!(fits, [false, false, false, false, true, false]);
        for rates in &all {
            let most = rates.most_cells();
            assert!(rates.load(most) <= 1.0 && rates.load(most + 1) > 1.0, "{}", rates.name);
        }
        assert!((all[3].replies(CELLS) - 1.1176).abs() < 1e-3);
        assert!((all[3].load(CELLS) - 1.1176 - 0.0712).abs() < 1e-3, "four heartbeats of each cell a second");
    }
}
