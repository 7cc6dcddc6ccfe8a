//! The tree according to the cells' reports: depths, unreachable cells, and cycles.

use std::collections::{BTreeMap, BTreeSet};

use protocol::id::CellId;
use protocol::message::TreePage;
use protocol::port::UPLINK;

/// The tree of a bus by the reports of its cells.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct ReportedTree {
    /// Number of wires from each reachable cell to its root; a root has 0.
    pub depths: BTreeMap<CellId, u8>,
    /// True if every reachable cell reports the depth that follows from the parents.
    pub agree: bool,
    /// Cells that send but have no route to a root, including those in cycles.
    pub unreachable: Vec<CellId>,
    /// Cells whose parents form a cycle.
    pub cycles: Vec<Vec<CellId>>,
}

impl ReportedTree {
    /// Returns the depth of the deepest cell.
    #[must_use]
    pub fn max_depth(&self) -> Option<u8> {
        self.depths.values().copied().max()
    }
}

/// Computes the tree from each cell's node id, a flag that is true if the cell sends now, and the cell's report of its
/// place.
pub fn tree_from_reports(cells: impl Iterator<Item = (CellId, bool, Option<TreePage>)>) -> ReportedTree {
    let alive: BTreeMap<_, _> =
        cells.filter(|(_, alive, _)| *alive).map(|(node, _, tree)| (node, tree)).collect();
    let parent = |node: &CellId| {
        let tree = alive.get(node).copied().flatten()?;
        Some((tree, tree.parent.and_then(|parent| CellId::new(parent.into()).ok())))
    };
    let mut places = ReportedTree { agree: true, ..ReportedTree::default() };
    let mut circling = BTreeSet::new();
    for &node in alive.keys() {
        let (mut route, mut at, mut steps) = (Vec::new(), node, 0_u8);
        loop {
            if route.contains(&at) {
                let circle: Vec<_> = route.iter().copied().skip_while(|&cell| cell != at).collect();
                if circle.iter().all(|&cell| circling.insert(cell)) {
                    places.cycles.push(rotate_to_smallest(circle));
                }
                break places.unreachable.push(node);
            }
            route.push(at);
            match parent(&at) {
                Some((tree, _)) if is_root(&tree) => {
                    let says = alive.get(&node).copied().flatten().map(|tree| tree.depth);
                    places.agree &= says == Some(steps);
                    places.depths.insert(node, steps);
                    break;
                }
                Some((_, Some(next))) => (at, steps) = (next, steps.saturating_add(1)),
                Some((_, None)) | None => break places.unreachable.push(node),
            }
        }
    }
    places
}

/// Returns true if the cell is wired to the gateway and uses that wire to send its sums.
fn is_root(tree: &TreePage) -> bool {
    tree.parent == Some(0) && usize::from(tree.parent_port) == UPLINK
}

fn rotate_to_smallest(mut circle: Vec<CellId>) -> Vec<CellId> {
    let min = circle.iter().enumerate().min_by_key(|(_, cell)| **cell).map_or(0, |(place, _)| place);
    circle.rotate_left(min);
    circle
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cell(node: i64) -> CellId {
        CellId::new(node).unwrap()
    }

    fn says(node: i64, parent: Option<u8>, up: u8, depth: u8) -> (CellId, bool, Option<TreePage>) {
        (cell(node), true, Some(TreePage { parent, parent_port: up, depth, ..TreePage::default() }))
    }

    #[test]
    fn depths_are_counted_along_parents() {
        let cells = [says(1, Some(0), 4, 0), says(2, Some(1), 0, 1), says(3, Some(2), 1, 2)];
        let found = tree_from_reports(cells.into_iter());
        assert_eq!((found.max_depth(), found.agree), (Some(2), true));
        assert_eq!((found.unreachable, found.cycles), (vec![], vec![]));
        // A report with another depth is out of date.
        let cells = [says(1, Some(0), 4, 0), says(2, Some(1), 0, 2)];
        assert!(!tree_from_reports(cells.into_iter()).agree);
    }

    #[test]
    fn a_cell_without_a_parent_or_below_a_silent_one_or_a_circle_is_unreachable() {
        let cells = [
            says(1, Some(0), 4, 0),
            says(2, None, 0, 0),
            says(3, Some(2), 0, 1),
            says(4, Some(9), 0, 1),
            (cell(5), false, Some(TreePage { parent: Some(0), parent_port: 4, ..TreePage::default() })),
            says(6, Some(5), 0, 1),
            (cell(7), true, None),
            says(8, Some(0), 2, 0),
            says(12, Some(11), 0, 1),
            says(11, Some(10), 0, 1),
            says(10, Some(12), 0, 1),
            says(13, Some(12), 0, 2),
        ];
        let found = tree_from_reports(cells.into_iter());
        let without: Vec<_> = found.unreachable.iter().map(|cell| cell.get()).collect();
        assert_eq!(without, [2, 3, 4, 6, 7, 8, 10, 11, 12, 13]);
        assert_eq!(found.cycles, [vec![cell(10), cell(12), cell(11)]]);
        assert_eq!(found.depths.keys().collect::<Vec<_>>(), [&cell(1)]);
    }
}
