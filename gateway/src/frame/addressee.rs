//! Addressee of a packet.

use model::decode::pick::NodeSelector;
use protocol::id::{CellId, Node};

/// Returns the cell that a packet addresses, or `None` if it addresses all cells.
pub(super) const fn single_cell(addressee: &NodeSelector) -> Option<CellId> {
    if let Node::Cell(cell) = addressee.node { Some(cell) } else { None }
}

/// Parses an addressee: a cell or all cells, but not the gateway.
pub(super) fn addressee(text: &str) -> Result<NodeSelector, String> {
    let party = text.parse().ok().filter(|party: &NodeSelector| party.node != Node::Gateway);
    party.ok_or_else(|| "use a node id from 1 to 254, BUS:NODE, or everyone".to_owned())
}
