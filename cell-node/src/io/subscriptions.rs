//! Subscriptions: the cells of a process that receive each identifier and link id.

use std::collections::{BTreeMap, BTreeSet};

use protocol::bus::Filter;
use protocol::can::{EXTENDED, REMOTE};
use protocol::id::Id;
use protocol::port::{LinkId, WIRE_FLAG};

use super::sockets::ReceiveFilters;

/// Filter that passes the frames of all simulated wires on a bus.
const ALL_WIRES_FILTER: Filter = Filter { id: EXTENDED | WIRE_FLAG, mask: EXTENDED | REMOTE | WIRE_FLAG };

/// For each identifier and link id, the cells that receive it, as indices within the process.
#[derive(Debug, Default)]
pub(super) struct Subscriptions {
    by_id: BTreeMap<Id, Subscribers>,
    by_link_id: BTreeMap<LinkId, (usize, usize)>,
}

/// The cells that receive one identifier.
#[derive(Debug, Default)]
struct Subscribers {
    by: Vec<usize>,
    /// True if frames with this identifier must wake the process for at least one of the cells.
    wakes: bool,
}

impl Subscriptions {
    /// Subscribes the port of a cell to a link id. The subscription is permanent.
    pub(super) fn subscribe_port(&mut self, link_id: LinkId, cell: usize, port: usize) {
        self.by_link_id.insert(link_id, (cell, port));
    }

    /// Replaces all subscriptions to identifiers. Each item is a cell, an identifier, and true if the cell can receive
    /// it deferred.
    pub(super) fn replace_subscriptions(&mut self, hears: impl Iterator<Item = (usize, Id, bool)>) {
        self.by_id.clear();
        for (cell, id, deferred) in hears {
            let heard = self.by_id.entry(id).or_default();
            heard.by.push(cell);
            heard.wakes |= !deferred;
        }
    }

    /// Returns the cells that receive an identifier.
    pub(super) fn cells_for_id(&self, id: Id) -> &[usize] {
        self.by_id.get(&id).map_or(&[], |heard| &heard.by)
    }

    /// Returns the cell, and the port of the cell, that receive a link id.
    pub(super) fn port_for_link(&self, link_id: LinkId) -> Option<(usize, usize)> {
        self.by_link_id.get(&link_id).copied()
    }

    /// Returns the filters for all subscriptions: one exact filter for each identifier and link id. If these are more
    /// than a socket accepts, returns one filter for each received kind, and one for all wires.
    pub(super) fn filters(&self) -> ReceiveFilters {
        let ids = |wakes| self.by_id.iter().filter(move |(_, heard)| heard.wakes == wakes).map(|(id, _)| *id);
        let link_ids = self.by_link_id.keys().copied();
        if self.by_id.len() + link_ids.len() <= Filter::MAX_COUNT {
            return ReceiveFilters {
                at_once: ids(true).map(Filter::exact).chain(link_ids.map(Filter::for_link)).collect(),
                deferred: ids(false).map(Filter::exact).collect(),
            };
        }
        let kinds: BTreeSet<_> = self.by_id.keys().map(|id| id.kind).collect();
        let wires = (link_ids.len() > 0).then_some(ALL_WIRES_FILTER);
        ReceiveFilters {
            at_once: kinds.into_iter().map(Filter::for_kind).chain(wires).collect(),
            deferred: Vec::new(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::id::{CellId, Kind, Node};

    fn passes(filters: &[Filter], raw_id: u32) -> bool {
        filters.iter().any(|filter| raw_id & filter.mask == filter.id & filter.mask)
    }

    fn subscriptions(cells: usize) -> Subscriptions {
        let mut subscriptions = Subscriptions::default();
        let id = |kind, cell| Id::new(kind, Node::Cell(cell));
        let cells = || CellId::all().take(cells).enumerate();
        let hears = |(at, cell)| [Kind::Network, Kind::Sum].map(|kind| (at, id(kind, cell), false));
        subscriptions.replace_subscriptions(cells().flat_map(hears));
        for (at, cell) in cells() {
            subscriptions.subscribe_port(LinkId { wire: cell.get().into(), back: true }, at, 2);
        }
        subscriptions
    }

    #[test]
    fn each_identifier_and_link_id_has_an_exact_filter_as_long_as_they_fit() {
        let link_id = |wire, back| LinkId { wire, back }.raw_id();
        let filters = subscriptions(100).filters().at_once;
        assert_eq!(filters.len(), 300);
        for id in [0x401, 0x464, 0x101, link_id(1, true), link_id(100, true)] {
            assert!(passes(&filters, id), "{id:X}");
        }
        for id in [
            0x465,
            0x201,
            0x165,
            link_id(1, false),
            link_id(101, true),
            link_id(1, true) | REMOTE,
            0x401 | EXTENDED,
        ] {
            assert!(!passes(&filters, id), "{id:X}");
        }
    }

    #[test]
    fn too_many_become_kinds_and_all_wires() {
        let link_id = |wire, back| LinkId { wire, back }.raw_id();
        let filters = subscriptions(254).filters().at_once;
        assert_eq!(filters.len(), 3);
        for id in [0x401, 0x4FE, 0x101, link_id(1, false), link_id(65_535, true)] {
            assert!(passes(&filters, id), "{id:X}");
        }
        for id in [0x201, 0x001, link_id(1, true) | REMOTE, 0x401 | EXTENDED, WIRE_FLAG | 0x101 | REMOTE] {
            assert!(!passes(&filters, id), "{id:X}");
        }
    }

    #[test]
    fn subscriptions_to_identifiers_are_replaced_and_those_to_link_ids_stay() {
        let mut subscriptions = subscriptions(3);
        let id = |kind, number| Id::new(kind, Node::Cell(CellId::new(number).unwrap()));
        assert_eq!(subscriptions.cells_for_id(id(Kind::Sum, 2)), [1]);
        subscriptions
            .replace_subscriptions([(0, id(Kind::Sum, 2), false), (2, id(Kind::Sum, 2), true)].into_iter());
        assert_eq!(subscriptions.cells_for_id(id(Kind::Sum, 2)), [0, 2]);
        assert_eq!(subscriptions.cells_for_id(id(Kind::Sum, 1)), [0; 0]);
        assert_eq!(subscriptions.port_for_link(LinkId { wire: 2, back: true }), Some((1, 2)));
        assert_eq!(subscriptions.port_for_link(LinkId { wire: 2, back: false }), None);
    }

    #[test]
    fn an_identifier_is_deferred_only_if_all_its_receivers_defer_it() {
        let mut subscriptions = Subscriptions::default();
        let id = |number| Id::new(Kind::Sum, Node::Cell(CellId::new(number).unwrap()));
        subscriptions.replace_subscriptions(
            [(0, id(1), true), (1, id(2), true), (2, id(2), false), (2, id(3), false)].into_iter(),
        );
        let ReceiveFilters { at_once, deferred } = subscriptions.filters();
        assert_eq!(at_once, [id(2), id(3)].map(Filter::exact));
        assert_eq!(deferred, [id(1)].map(Filter::exact));
        assert_eq!(subscriptions.cells_for_id(id(2)), [1, 2]);
    }
}
