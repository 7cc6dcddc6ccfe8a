//! The account of the packets that the cells of a bus have sent.

use model::table::BusTable;
use serde::Serialize;

/// Packets from the cells. They add up: sent = delivered + rejected + unheard + lost - surplus, and lost = dropped +
/// backlog + outage + hosts + queues + unknown.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct UplinkSummary {
    /// Packets sent, according to the counts in the cells' last heartbeats.
    pub sent: u64,
    /// Packets that arrived and were decoded.
    pub delivered: u64,
    /// Packets that arrived and were rejected.
    pub rejected: u64,
    /// Sums for another cell, which the filter of the gateway's socket excluded.
    pub unheard: u64,
    /// Packets lost because the bus dropped frames that this program did not read in time.
    pub dropped: u64,
    /// Packets lost for which drops in the kernel's backlog are the likely reason.
    pub backlog: u64,
    /// Packets lost during losses of the bus.
    pub outage: u64,
    /// Packets lost between hosts.
    pub hosts: u64,
    /// Packets that transmit queues of a timed bus refused, or that waited there at the end.
    pub queues: u64,
    /// Packets that overtook a heartbeat of their cell on a timed bus.
    pub overtaken: u64,
    /// Packets lost for an unknown reason.
    pub unknown: u64,
    /// Packets that arrived beyond the number sent.
    pub surplus: u64,
    /// Heartbeats of other senders under a cell's node id, included in the surplus.
    pub outsiders: u64,
    /// Packets that arrived and were sent after a cell's last heartbeat before its restart. The number of packets sent
    /// in this time is unknown.
    pub in_doubt: u64,
    /// Packets that arrived after a cell's last heartbeat, so that no count of the cell includes them.
    pub unsettled: u64,
    /// Number of restarts of cells.
    pub restarts: u32,
}

impl UplinkSummary {
    /// Creates the summary from the table of a bus, for which the bus dropped a number of frames.
    pub(super) fn new(table: &BusTable, dropped_by_bus: u64) -> Self {
        let total = table.uplink();
        let unexplained = total.lost - total.outage;
        let dropped = unexplained.min(dropped_by_bus);
        Self {
            sent: total.sent,
            delivered: total.delivered,
            rejected: total.rejected,
            unheard: total.unheard,
            dropped,
            backlog: 0,
            outage: total.outage,
            hosts: 0,
            queues: 0,
            overtaken: 0,
            unknown: unexplained - dropped,
            surplus: total.surplus,
            outsiders: total.outsiders,
            in_doubt: total.in_doubt,
            unsettled: total.unsettled,
            restarts: total.restarts,
        }
    }

    /// Takes up to `at_most` from the unknown losses, and returns their number.
    fn explain_losses(&mut self, at_most: u64) -> u64 {
        let explained = self.unknown.min(at_most);
        self.unknown -= explained;
        explained
    }

    /// Attributes up to `at_most` of the unknown losses to transmit queues of a timed bus.
    pub(super) fn attribute_losses_to_queues(&mut self, at_most: u64) {
        self.queues += self.explain_losses(at_most);
    }

    /// Cancels unknown losses against the surplus. On a timed bus, packets of a cell overtake its heartbeat: they are
    /// a surplus before it, and seem lost after it.
    pub(super) fn cancel_overtaken(&mut self) {
        let overtaken = self.explain_losses(self.surplus);
        self.surplus -= overtaken;
        self.overtaken += overtaken;
    }

    /// Attributes up to `at_most` of the unknown losses to links between hosts.
    pub fn attribute_losses_to_hosts(&mut self, at_most: u64) {
        self.hosts += self.explain_losses(at_most);
    }

    /// Attributes up to `at_most` of the unknown losses to the kernel's backlog. Returns the number of packets
    /// attributed.
    pub fn attribute_losses_to_backlog(&mut self, at_most: u64) -> u64 {
        let explained = self.explain_losses(at_most);
        self.backlog += explained;
        explained
    }
}
