//! The wires of a bus: the two ports that each wire connects, and the link id that each end sends with.
//!
//! Wires are numbered in the order in which their cells name them: cells in the order of the file, ports 0 to 3. After
//! them comes one wire for each root, to the gateway's side, in the order of the file. If two wires connect the same
//! two cells, their ports are paired in ascending order. The end that is named first sends with [`LinkId::back`] =
//! false, the other end with true. The cell is the first end of a root's wire.
//!
//! ```text
//!   cell 1   neighbors = [2, 2, 0, 0], root = true      wire 0   1 port 0 <-> 2 port 1
//!   cell 2   neighbors = [3, 1, 1, 0]                        1   1 port 1 <-> 2 port 2
//!   cell 3   neighbors = [0, 0, 0, 2]                        2   2 port 0 <-> 3 port 3
//!                                                            3   1 uplink <-> the gateway's side
//! ```

use std::collections::VecDeque;

use super::{Cell, Skin};
use crate::id::CellId;
use crate::port::{LinkId, MAX_WIRES, PORTS, UPLINK};

/// One end of a wire: a cell and its port; the port is [`UPLINK`] for a root's wire to the gateway's side.
type WireEnd = (CellId, usize);

// A bus never has more wires than link ids.
const _: () = assert!(CellId::COUNT * (PORTS + 1) <= MAX_WIRES);

/// The wires of one bus.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct BusWires {
    /// Link id that each port sends with, by cell ([`CellId::index`]) and port; `None` for a free port.
    link_ids: Vec<[Option<LinkId>; PORTS + 1]>,
    /// The two ends of each wire: the end named first, and the other, which is `None` at the gateway's side.
    ends: Vec<(WireEnd, Option<WireEnd>)>,
}

impl Skin {
    /// Returns the wires of a bus, given as an index into [`Skin::buses`].
    #[must_use]
    pub fn wires(&self, bus: usize) -> BusWires {
        let cells: Vec<_> = self.cells_on_bus(bus).collect();
        BusWires::new(&cells)
    }
}

impl BusWires {
    /// Returns the wires between these cells, all of one bus. A port is free if its neighbour does not name the cell in
    /// turn, which does not happen in a checked skin.
    pub(super) fn new(cells: &[&Cell]) -> Self {
        let mut wires = Self { link_ids: vec![[None; PORTS + 1]; CellId::COUNT], ends: Vec::new() };
        for cell in cells {
            for (port, neighbor) in cell.neighbors.iter().enumerate() {
                let Some(neighbor) = *neighbor else { continue };
                if wires.link_id(cell.node, port).is_some() {
                    continue;
                }
                let other = cells.iter().find(|other| other.node == neighbor);
                let back = other.and_then(|other| {
                    let mut ports = (0..PORTS).zip(&other.neighbors);
                    let names_us = |&(port, back): &(usize, &Option<CellId>)| {
                        *back == Some(cell.node) && wires.link_id(neighbor, port).is_none()
                    };
                    ports.find(names_us).map(|(port, _)| port)
                });
                if let Some(back) = back {
                    wires.add_wire((cell.node, port), Some((neighbor, back)));
                }
            }
        }
        for cell in cells.iter().filter(|cell| cell.root) {
            wires.add_wire((cell.node, UPLINK), None);
        }
        wires
    }

    fn add_wire(&mut self, first: WireEnd, second: Option<WireEnd>) {
        let Ok(wire) = u16::try_from(self.ends.len()) else { return };
        self.ends.push((first, second));
        for (end, back) in [(Some(first), false), (second, true)] {
            let slot = end.and_then(|(cell, port)| {
                self.link_ids.get_mut(cell.index()).and_then(|link_ids| link_ids.get_mut(port))
            });
            if let Some(slot) = slot {
                *slot = Some(LinkId { wire, back });
            }
        }
    }

    fn link_id(&self, cell: CellId, port: usize) -> Option<LinkId> {
        *self.link_ids.get(cell.index())?.get(port)?
    }

    /// Returns the link id that each port of a cell sends with; the port [`UPLINK`] is a root's wire to the gateway's
    /// side. The cell receives with the reversed link ids.
    #[must_use]
    pub fn link_ids_of(&self, cell: CellId) -> [Option<LinkId>; PORTS + 1] {
        self.link_ids.get(cell.index()).copied().unwrap_or_default()
    }

    /// Returns the roots in the order of the file, each with the link id that the gateway's side sends with.
    pub fn roots_with_link_ids(&self) -> impl Iterator<Item = (CellId, LinkId)> {
        let uplinks = self.ends.iter().filter(|(_, second)| second.is_none());
        uplinks.filter_map(|&((cell, port), _)| Some((cell, self.link_id(cell, port)?.reversed())))
    }

    /// Returns the cell and port at the other end of a port; `None` for a free port and for an uplink.
    #[must_use]
    pub fn other_end(&self, cell: CellId, port: usize) -> Option<(CellId, usize)> {
        let link_id = self.link_id(cell, port)?;
        let &(first, second) = self.ends.get(usize::from(link_id.wire))?;
        if link_id.back { Some(first) } else { second }
    }

    /// Returns the number of wires, including those of the roots.
    #[must_use]
    pub const fn wire_count(&self) -> usize {
        self.ends.len()
    }

    /// Returns the depth of each cell ([`CellId::index`]): the number of wires to the nearest root, whose
    /// depth is 0; `None` without a path to a root.
    #[must_use]
    pub fn cell_depths(&self) -> [Option<u8>; CellId::COUNT] {
        let mut depths = [None; CellId::COUNT];
        let mut next: VecDeque<_> = self.roots_with_link_ids().map(|(root, _)| (root, 0_u8)).collect();
        while let Some((cell, depth)) = next.pop_front() {
            let Some(slot @ None) = depths.get_mut(cell.index()) else { continue };
            *slot = Some(depth);
            let ends = (0..PORTS).filter_map(|port| self.other_end(cell, port));
            next.extend(ends.map(|(other, _)| (other, depth.saturating_add(1))));
        }
        depths
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use proptest::prelude::*;

    use super::*;
    use crate::skin::tests::wired;

    fn id(number: usize) -> CellId {
        CellId::new(i64::try_from(number).unwrap()).unwrap()
    }

    fn link_id(wire: u16, back: bool) -> Option<LinkId> {
        Some(LinkId { wire, back })
    }

    #[test]
    fn wires_are_numbered_as_they_are_mentioned_and_roots_come_last() {
        let skin = wired(&[([2, 2, 0, 0], true), ([3, 1, 1, 0], false), ([0, 0, 0, 2], true)]);
        let wires = skin.wires(0);
        assert_eq!(wires.wire_count(), 5);
        let none = None;
        assert_eq!(
            wires.link_ids_of(id(1)),
            [link_id(0, false), link_id(1, false), none, none, link_id(3, false)]
        );
        assert_eq!(
            wires.link_ids_of(id(2)),
            [link_id(2, false), link_id(0, true), link_id(1, true), none, none]
        );
        assert_eq!(wires.link_ids_of(id(3)), [none, none, none, link_id(2, true), link_id(4, false)]);
        let roots: Vec<_> = wires.roots_with_link_ids().collect();
        assert_eq!(roots, [(id(1), LinkId { wire: 3, back: true }), (id(3), LinkId { wire: 4, back: true })]);
        assert_eq!(wires.other_end(id(1), 1), Some((id(2), 2)));
        assert_eq!(wires.other_end(id(1), 2), None, "a free port");
        assert_eq!(wires.other_end(id(1), UPLINK), None, "the gateway's side");
        assert_eq!(wires.link_ids_of(id(200)), [None; PORTS + 1], "no such cell");
    }

    #[test]
    fn a_cell_is_as_deep_as_its_shortest_way_to_a_root() {
        // 1 - 2 - 3 - 4 - 1 form a ring; 5 is connected to 3.
        let skin = wired(&[
            ([2, 4, 0, 0], true),
            ([1, 3, 0, 0], false),
            ([2, 4, 5, 0], false),
            ([3, 1, 0, 0], false),
            ([3, 0, 0, 0], false),
        ]);
        let depths = skin.wires(0).cell_depths();
        assert_eq!(depths[..6], [Some(0), Some(1), Some(2), Some(1), Some(3), None]);
    }

    /// Generates cells with random wires between their ports, and with random roots.
    fn wiring() -> impl Strategy<Value = Vec<([i64; PORTS], bool)>> {
        let joints = proptest::collection::vec((0..24_usize, 0..PORTS, 0..24_usize, 0..PORTS), 0..60);
        (joints, proptest::collection::vec(any::<bool>(), 24)).prop_map(|(joints, roots)| {
            let mut cells: Vec<_> = roots.into_iter().map(|root| ([0; PORTS], root)).collect();
            for (a, p, b, q) in joints {
                if a != b && cells[a].0[p] == 0 && cells[b].0[q] == 0 {
                    cells[a].0[p] = i64::try_from(b + 1).unwrap();
                    cells[b].0[q] = i64::try_from(a + 1).unwrap();
                }
            }
            cells
        })
    }

    proptest! {
        #[test]
        fn every_wire_has_two_ends_with_opposite_link_ids(cells in wiring()) {
            let wires = wired(&cells).wires(0);
            let mut senders = HashMap::new();
            for (at, (neighbors, root)) in cells.iter().enumerate() {
                let cell = id(at + 1);
                let link_ids = wires.link_ids_of(cell);
                prop_assert_eq!(link_ids[UPLINK].is_some(), *root);
                for (port, link_id) in link_ids.into_iter().enumerate().filter_map(|(port, link_id)| Some((port, link_id?))) {
                    prop_assert_eq!(senders.insert(link_id, cell), None, "one sender for a link id");
                    if port == UPLINK {
                        continue;
                    }
                    let (other, back) = wires.other_end(cell, port).unwrap();
                    prop_assert_eq!(i64::from(other.get()), neighbors[port]);
                    prop_assert_eq!(wires.other_end(other, back), Some((cell, port)));
                    prop_assert_eq!(wires.link_ids_of(other)[back], Some(link_id.reversed()));
                }
                let wired = neighbors.iter().filter(|&&neighbor| neighbor != 0).count();
                prop_assert_eq!(link_ids[..PORTS].iter().flatten().count(), wired, "no end is left out");
            }
            for (root, link_id) in wires.roots_with_link_ids() {
                prop_assert_eq!(senders.insert(link_id, root), None, "the gateway's side has its own link ids");
            }
            prop_assert_eq!(senders.len(), 2 * wires.wire_count());
            prop_assert!(senders.keys().all(|link_id| usize::from(link_id.wire) < wires.wire_count()), "dense");
        }

        #[test]
        fn depths_differ_by_one_wire_at_most(cells in wiring()) {
            let wires = wired(&cells).wires(0);
            let depths = wires.cell_depths();
            for (at, (_, root)) in cells.iter().enumerate() {
                let others = (0..PORTS).filter_map(|port| wires.other_end(id(at + 1), port));
                let nearest = others.map(|(other, _)| depths[other.index()]).min_by_key(|depth| depth.unwrap_or(u8::MAX));
                let expected = if *root { Some(0) } else { nearest.flatten().map(|depth| depth + 1) };
                prop_assert_eq!(depths[at], expected);
            }
        }
    }
}
