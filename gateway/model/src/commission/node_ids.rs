//! Rewrites the text of a skin description, so that it has the node ids that its cells have on their buses.

use std::collections::BTreeMap;

use protocol::id::CellId;
use protocol::skin::Skin;
use protocol::skin::file::{EditError, SkinEdit, Value};
use thiserror::Error;

/// The error for a description that cannot be renumbered.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum NodeIdsError {
    /// Cells of a bus did not send a heartbeat.
    #[error(
        "{missing} of the {cells} cells on {bus} sent no heartbeat, so their node ids are unknown: start them"
    )]
    Missing {
        /// Name of the bus.
        bus: String,
        /// Number of cells without a heartbeat.
        missing: usize,
        /// Number of cells of the bus.
        cells: usize,
    },
    /// The text does not describe the skin that was read.
    #[error("cannot write node ids into the text of the skin file: {0}")]
    Text(String),
}

/// Node ids by serial number; `None` for cells without a heartbeat.
pub type NodeIds = BTreeMap<u32, Option<CellId>>;

/// Returns the text of a description with the node ids in `node_ids`, and everything else unchanged: comments, order,
/// omitted keys. Cells that are not in `node_ids` keep their node ids. Neighbor lists are renumbered with the cells.
///
/// # Errors
/// Returns [`NodeIdsError`] if the node id of a cell is `None`, or if the text does not describe the skin.
pub fn renumber_nodes(skin: &Skin, text: &str, node_ids: &NodeIds) -> Result<String, NodeIdsError> {
    for (bus, described) in skin.buses.iter().enumerate() {
        let here = || skin.cells_on_bus(bus).filter_map(|cell| node_ids.get(&cell.serial));
        let missing = here().filter(|number| number.is_none()).count();
        if missing > 0 {
            return Err(NodeIdsError::Missing {
                bus: described.name.clone(),
                missing,
                cells: here().count(),
            });
        }
    }
    let number = |serial: u32, own: CellId| node_ids.get(&serial).copied().flatten().unwrap_or(own);
    // The new node id of each cell, by its bus and its node id in the file.
    let renamed: BTreeMap<_, _> =
        skin.cells.iter().map(|cell| ((cell.bus, cell.node), number(cell.serial, cell.node))).collect();
    let not_the_text = |error: EditError| NodeIdsError::Text(error.to_string());
    let mut edit = SkinEdit::new(skin, text).map_err(not_the_text)?;
    for (index, cell) in skin.cells.iter().enumerate() {
        let new = number(cell.serial, cell.node);
        if new != cell.node {
            edit.set(index, "node", node_id_value(new));
            // An omitted serial number would change with the node id.
            if !edit.has_key(index, "serial") {
                edit.insert_key_after(index, "serial", Value::Integer(i64::from(cell.serial)), "node");
            }
        }
        for (port, neighbor) in cell.neighbors.iter().enumerate() {
            let Some(neighbor) = *neighbor else { continue };
            if let Some(&renamed) = renamed.get(&(cell.bus, neighbor))
                && renamed != neighbor
            {
                edit.set_element(index, "neighbors", port, node_id_value(renamed));
            }
        }
    }
    Ok(edit.edited_text())
}

fn node_id_value(node: CellId) -> Value<'static> {
    Value::Integer(i64::from(node.get()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::generate::{SkinRequest, generate};

    fn cell(node: u8) -> CellId {
        CellId::new(node.into()).unwrap()
    }

    /// Three cells in a row. The serial number of the second one is omitted, which makes it 2.
    const CELLS: &str = r#"
[[cell]]
bus = "vcan0"
serial = 7
node   = 1   # at the elbow
joint = 1
position = [0.0, 0.0, 0.1]
orientation = [0.0, 0.0, 0.0, 1.0]
neighbors = [2, 0, 0, 0] # a cable

# The next one was replaced.
[[cell]]
bus = "vcan0"
node = 2
joint = 1
position = [0.0, 0.1, 0.1]
orientation = [0.0, 0.0, 0.0, 1.0]
neighbors = [0, 1, 3, 0]

[[cell]]
bus = "vcan0"
node = 3
serial = 9
joint = 1
position = [0.0, 0.1, 0.2]
orientation = [0.0, 0.0, 0.0, 1.0]
neighbors = [2, 0, 0, 0]
"#;

    fn text() -> String {
        let text = generate(&SkinRequest { cells: 3, ..SkinRequest::default() }).unwrap();
        let (head, _) = text.split_once("\n[[cell]]").unwrap();
        format!("{head}{CELLS}")
    }

    #[test]
    fn only_node_ids_and_neighbors_change() {
        let text = text();
        let skin = Skin::parse("skin.toml", &text).unwrap();
        let node_ids = NodeIds::from([(7, Some(cell(2))), (2, Some(cell(50))), (9, Some(cell(3)))]);
        let expected = text
            .replace("node   = 1   # at the elbow", "node   = 2   # at the elbow")
            .replace("neighbors = [2, 0, 0, 0] # a cable", "neighbors = [50, 0, 0, 0] # a cable")
            .replace("node = 2\njoint", "node = 50\nserial = 2\njoint")
            .replace("neighbors = [0, 1, 3, 0]", "neighbors = [0, 2, 3, 0]")
            .replace(
                "[0.0, 0.1, 0.2]\norientation = [0.0, 0.0, 0.0, 1.0]\nneighbors = [2,",
                "[0.0, 0.1, 0.2]\norientation = [0.0, 0.0, 0.0, 1.0]\nneighbors = [50,",
            );
        let copy = renumber_nodes(&skin, &text, &node_ids).unwrap();
        assert_eq!(copy, expected);
        // Both skins have the same cells by serial number, with the same wiring.
        let copied = Skin::parse("copy.toml", &copy).unwrap();
        for (old, new) in skin.cells.iter().zip(&copied.cells) {
            assert_eq!((old.serial, node_ids[&old.serial]), (new.serial, Some(new.node)));
            assert_eq!(skin.parameters(old), copied.parameters(new));
        }
    }

    #[test]
    fn unchanged_node_ids_leave_the_text_as_it_is() {
        let text = text();
        let skin = Skin::parse("skin.toml", &text).unwrap();
        let node_ids = skin.cells.iter().map(|cell| (cell.serial, Some(cell.node))).collect();
        assert_eq!(renumber_nodes(&skin, &text, &node_ids).unwrap(), text);
    }

    #[test]
    fn a_cell_without_a_heartbeat_is_an_error() {
        let text = text();
        let skin = Skin::parse("skin.toml", &text).unwrap();
        let node_ids = NodeIds::from([(7, Some(cell(2))), (2, None), (9, Some(cell(3)))]);
        let said = renumber_nodes(&skin, &text, &node_ids).unwrap_err().to_string();
        assert_eq!(
            said,
            "1 of the 3 cells on vcan0 sent no heartbeat, so their node ids are unknown: start them"
        );
    }
}
