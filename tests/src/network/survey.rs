//! Queries of a wiring: the actual state of cells and wires, and the routes that cells report.

use std::collections::BTreeSet;

use protocol::id::{CellId, Command, Id};

use super::{PortEnd, Wiring};
use crate::life::PowerState;

impl Wiring {
    /// Returns true if a cell is on and does not hang.
    #[must_use]
    pub fn runs(&self, cell: usize) -> bool {
        self.cells[cell].life.runs()
    }

    /// Returns true if a cell is woken by its children and not by joints.
    #[must_use]
    pub fn waits_for_children(&self, cell: usize) -> bool {
        let joints = Id::command(Command::Joints);
        matches!(&self.cells[cell].life, PowerState::Runs(node) if node.may_receive_deferred(joints))
    }

    /// Returns the cells that have a route to the gateway over running cells and wires that work in both directions.
    #[must_use]
    pub fn reachable(&self) -> BTreeSet<usize> {
        let mut reached = BTreeSet::new();
        let mut next: Vec<usize> = self.roots.iter().copied().filter(|&root| self.runs(root)).collect();
        while let Some(cell) = next.pop() {
            if !reached.insert(cell) {
                continue;
            }
            for (port, end) in self.cells[cell].wires.iter().enumerate() {
                if let Some(PortEnd::Cell(other, at)) = *end {
                    let works = !self.cells[cell].deaf[port] && !self.cells[other].deaf[at];
                    if works && self.runs(other) {
                        next.push(other);
                    }
                }
            }
        }
        reached
    }

    /// Returns the route of a cell's sums to a root, by the cells' reports, or `None` if there is no route or a circle.
    #[must_use]
    pub fn route(&self, cell: usize) -> Option<Vec<usize>> {
        let mut route = vec![cell];
        loop {
            let at = *route.last()?;
            let tree = self.cells[at].tree?;
            match tree.parent? {
                0 => return Some(route),
                parent => {
                    let PortEnd::Cell(other, _) = self.cells[at].wires[usize::from(tree.parent_port)]? else {
                        return None;
                    };
                    if self.cells[other].node_id.map(CellId::get) != Some(parent) || route.contains(&other) {
                        return None;
                    }
                    route.push(other);
                }
            }
        }
    }

    /// Returns all routes, as text.
    #[must_use]
    pub fn routes(&self) -> String {
        let route = |cell: usize| {
            let place = &self.cells[cell];
            let tree =
                place.tree.map(|tree| (tree.parent, tree.parent_port, tree.depth, tree.round, tree.children));
            format!("{cell}={:?} {tree:?} {:?}", place.node_id.map(CellId::get), self.route(cell))
        };
        (0..self.cells.len()).map(route).collect::<Vec<_>>().join("; ")
    }

    /// Returns a mask with bit i set for each cell i in a set.
    #[must_use]
    pub fn bits(cells: &BTreeSet<usize>) -> u128 {
        cells.iter().map(|cell| 1 << cell).sum()
    }
}
