//! The part of a timed bus in the accounts: frames that transmit queues refused.

use protocol::can::STANDARD_MASK;
use protocol::id::{CellId, Id, Kind, Node};
use vcan_setup::embedded::TimedReport;

use super::{BusSummary, CellSummary, RepliesSummary};

impl BusSummary {
    /// Returns the summary with the figures of its timed bus, to which losses are attributed.
    #[must_use]
    pub fn with_time(mut self, report: TimedReport) -> Self {
        let counts = || report.refused_by_id.iter().chain(&report.waiting_by_id);
        let of_cells = counts().filter(|(id, _)| sender(id).is_some());
        self.uplink.attribute_losses_to_queues(of_cells.map(|(_, count)| count).sum());
        self.uplink.cancel_overtaken();
        self.timed = Some(report);
        self
    }
}

/// Load of a bus from which on late replies are attributed to it.
const FULL_LOAD: f64 = 0.95;

impl BusSummary {
    /// Returns the likely cause of late replies.
    pub(super) fn lateness_cause(&self) -> String {
        match self.timed.as_ref().and_then(|timed| timed.load).filter(|&load| load >= FULL_LOAD) {
            Some(load) => {
                format!("the bus is full, with a load of {:.1} %: see `skinbus fit SKIN`", 100.0 * load)
            }
            None => "this machine was busy, or the cells are slow".to_owned(),
        }
    }
}

impl CellSummary {
    /// Attributes missing replies of the cell to refusals of a timed bus.
    pub fn attribute_refusals(&mut self, report: &TimedReport) {
        let refused = refused_torques(report, self.node);
        let lost = self.missing.get("lost").copied().unwrap_or(0).min(refused);
        let unknown = self.missing.get("unknown").copied().unwrap_or(0).min(refused - lost);
        for (reason, count) in [("lost", lost), ("unknown", unknown)] {
            if let Some(missing) = self.missing.get_mut(reason) {
                *missing -= count;
            }
        }
        if lost + unknown > 0 {
            self.missing.insert("refused", lost + unknown);
        }
        self.missing.retain(|_, count| *count > 0);
    }
}

impl RepliesSummary {
    /// Attributes missing replies to refusals of a timed bus, as they are attributed in the cells of the bus.
    pub fn attribute_refusals<'a>(&mut self, cells: impl IntoIterator<Item = &'a CellSummary>) {
        let missing = |cell: &CellSummary, reason| cell.missing.get(reason).copied().unwrap_or(0);
        let [mut lost, mut unknown] = [0; 2];
        self.refused = 0;
        for cell in cells {
            lost += missing(cell, "lost");
            unknown += missing(cell, "unknown");
            self.refused += missing(cell, "refused");
        }
        (self.lost, self.unknown) = (lost, unknown);
    }
}

/// Returns the number of torques of a cell that its transmit queue refused.
fn refused_torques(report: &TimedReport, node: u8) -> u64 {
    let torque = CellId::new(node.into()).map(|cell| id_text(Id::new(Kind::Torque, Node::Cell(cell))));
    torque.ok().and_then(|id| report.refused_by_id.get(&id)).copied().unwrap_or(0)
}

fn id_text(id: Id) -> String {
    format!("{:X}", id.to_bits())
}

/// Returns the cell that sends frames with an identifier in hexadecimal.
fn sender(id: &str) -> Option<CellId> {
    let id = u32::from_str_radix(id, 16).ok().filter(|id| id & !STANDARD_MASK == 0)?;
    Id::from_bits(u16::try_from(id).ok()?).sender()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::summary::UplinkSummary;

    #[test]
    fn missing_replies_and_packets_are_attributed_to_refusals() {
        let report = TimedReport {
            refused_by_id: BTreeMap::from([("203".to_owned(), 7), ("001".to_owned(), 9)]),
            waiting_by_id: BTreeMap::from([("403".to_owned(), 2), ("81234567".to_owned(), 4)]),
            ..TimedReport::default()
        };
        let cell = |node, lost, unknown| CellSummary {
            node,
            missing: BTreeMap::from([("lost", lost), ("unknown", unknown)]),
            ..CellSummary::default()
        };
        let mut cells = [cell(3, 5, 4), cell(4, 1, 0)];
        cells.iter_mut().for_each(|cell| cell.attribute_refusals(&report));
        assert_eq!(cells[0].missing, BTreeMap::from([("refused", 7), ("unknown", 2)]));
        assert_eq!(cells[1].missing, BTreeMap::from([("lost", 1)]));
        let uplink = UplinkSummary { unknown: 20, surplus: 8, ..UplinkSummary::default() };
        let mut bus = BusSummary { uplink, ..BusSummary::default() }.with_time(report);
        bus.replies.attribute_refusals(&cells);
        assert_eq!((bus.replies.refused, bus.replies.lost, bus.replies.unknown), (7, 1, 2));
        let up = bus.uplink;
        assert_eq!((up.queues, up.overtaken, up.surplus, up.unknown), (9, 8, 0, 3));
    }
}
