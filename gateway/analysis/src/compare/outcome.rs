//! Adds up the results of a comparison over all epochs and cells, into its report.

use protocol::id::CellId;
use protocol::quantiles::Quantiles;

use super::numbering::JointsKey;
use super::report::{CaptureFigures, CellLosses, CompareReport, ComparedCellRow, ExtraCell, ReplyCounts};
use super::side::{ComparedCapture, ComparedCell};
use super::{COMPARED_ASPECTS, CaptureSide, Comparison, PerCapture};

impl Comparison<'_> {
    /// Returns the report; call it after both captures have ended.
    #[must_use]
    pub fn report(self) -> CompareReport {
        let captures = PerCapture { a: capture_figures(&self.sides.a), b: capture_figures(&self.sides.b) };
        let mut report = CompareReport {
            equal: false,
            differs: Vec::new(),
            captures,
            epochs: self.epochs,
            joints: Default::default(),
            halts: Default::default(),
            contacts: Default::default(),
            torques: ReplyCounts::default(),
            sums: ReplyCounts::default(),
            cells: Vec::new(),
            extra_cells: self.extra_cells(),
            first: None,
        };
        for tally in &self.tallies {
            report.joints.equal += tally.joints.equal;
            report.joints.tolerated += tally.joints.tolerated;
            report.joints.different += tally.joints.different;
            report.joints.max_steps = report.joints.max_steps.max(tally.joints.max_steps);
            report.halts.only_a += tally.halts.only_a;
            report.halts.only_b += tally.halts.only_b;
            report.contacts.both += tally.contacts.both;
            report.contacts.only.only_a += tally.contacts.only.only_a;
            report.contacts.only.only_b += tally.contacts.only.only_b;
            report.torques.add_counts(&tally.torques);
            report.sums.add_counts(&tally.sums);
        }
        report.cells = self.differing_cells();
        let epochs = &report.epochs;
        let lost = epochs.missing_in_a + epochs.missing_in_b;
        let are_missing =
            lost + report.torques.missing_count() + report.sums.missing_count() > self.options.missing;
        report.differs = differing_aspects(&report, lost, are_missing);
        report.equal = report.differs.is_empty();
        let firsts = [self.first, self.first_missing.filter(|_| are_missing)];
        let first = firsts.into_iter().flatten().min_by_key(|(key, bus, _)| (*key, *bus));
        report.first = first.map(|(.., first)| first);
        report
    }

    /// Returns the cells with differences or losses.
    fn differing_cells(&self) -> Vec<ComparedCellRow> {
        let mut rows = Vec::new();
        for (at, (bus, tally)) in self.skin.buses.iter().zip(&self.tallies).enumerate() {
            for (node, replies) in tally.cells.iter() {
                let of = |which| self.compared_cell(which, at, node).map(losses).unwrap_or_default();
                let losses = PerCapture { a: of(CaptureSide::A), b: of(CaptureSide::B) };
                let is_quiet = losses == PerCapture::default()
                    && replies.different + replies.tolerated + replies.missing_count() == 0;
                if !is_quiet {
                    rows.push(ComparedCellRow {
                        bus: bus.name.clone(),
                        node: node.get(),
                        replies: *replies,
                        losses,
                    });
                }
            }
        }
        rows
    }

    fn compared_cell(&self, which: CaptureSide, bus: usize, node: CellId) -> Option<&ComparedCell> {
        self.sides.get(which).buses.get(bus)?.cells.get(node)
    }

    /// Returns the cells that send packets in only one of the captures, although both cover the time.
    fn extra_cells(&self) -> Vec<ExtraCell> {
        let range = |which| {
            let side = self.sides.get(which);
            side.first.map(|(first, _)| first).zip(side.newest())
        };
        let (Some(a), Some(b)) = (range(CaptureSide::A), range(CaptureSide::B)) else { return Vec::new() };
        let common: (JointsKey, JointsKey) = (a.0.max(b.0), a.1.min(b.1));
        let mut extra = Vec::new();
        for (at, bus) in self.skin.buses.iter().enumerate() {
            for node in CellId::all() {
                let heard = |which| self.compared_cell(which, at, node).and_then(|cell| cell.active_range);
                let (span, only_in) = match (heard(CaptureSide::A), heard(CaptureSide::B)) {
                    (Some(span), None) => (span, "a"),
                    (None, Some(span)) => (span, "b"),
                    _ => continue,
                };
                if span.0 <= common.1 && span.1 >= common.0 {
                    extra.push(ExtraCell { bus: bus.name.clone(), node: node.get(), only_in });
                }
            }
        }
        extra
    }
}

/// Returns the names of the aspects in which the captures differ.
fn differing_aspects(report: &CompareReport, lost: u64, are_missing: bool) -> Vec<&'static str> {
    let CompareReport { epochs, joints, halts, contacts, torques, sums, extra_cells, .. } = report;
    let replies = |it: &ReplyCounts| it.different > 0 || are_missing && it.missing_count() > 0;
    let differs = [
        epochs.compared == 0 || are_missing && lost > 0,
        joints.different > 0,
        halts.total() > 0,
        contacts.only.total() > 0,
        replies(torques),
        replies(sums),
        !extra_cells.is_empty(),
    ];
    COMPARED_ASPECTS.into_iter().zip(differs).filter_map(|(name, differs)| differs.then_some(name)).collect()
}

fn losses(cell: &ComparedCell) -> CellLosses {
    let uplink = cell.tracked.account.uplink();
    CellLosses {
        late: cell.late,
        too_late: cell.too_late,
        lost: uplink.lost,
        restarts: uplink.restarts.into(),
    }
}

fn capture_figures(side: &ComparedCapture<'_>) -> CaptureFigures {
    let mut source = side.counts.clone();
    source.first = side.first.map(|(first, _)| first.number);
    source.last = side.newest().map(|last| last.number);
    source.last_s = side.last_joints_s();
    for cell in side.buses.iter().flat_map(|bus| bus.cells.iter()).map(|(_, cell)| losses(cell)) {
        source.late += cell.late;
        source.too_late += cell.too_late;
        source.lost += cell.lost;
        source.restarts += cell.restarts;
    }
    let histogram = side.reply_times().histogram();
    source.reply_us =
        (side.has_times && !histogram.is_empty()).then(|| Quantiles::from_histogram(histogram, 1e-3));
    source
}
