//! The text of a skin with the poses that were found.

use protocol::skin::Skin;
use thiserror::Error;
use toml_edit::{Array, DocumentMut, Item, Value};

use crate::result::{Calibration, Found};

/// Why there is no text.
#[derive(Debug, Error)]
pub enum WriteError {
    /// The file is no longer what was read.
    #[error("the skin's text is not that of the skin that was read: {0}; calibrate again")]
    Text(String),
}

/// The text of a skin with the poses that were found, and everything else as it was: comments, order, omitted keys. Cells
/// whose pose was not determined keep theirs.
///
/// # Errors
/// When the text is not the skin's.
pub fn calibrated(skin: &Skin, text: &str, calibration: &Calibration) -> Result<String, WriteError> {
    let wrong = |why: String| WriteError::Text(why);
    let mut document: DocumentMut =
        text.parse().map_err(|error: toml_edit::TomlError| wrong(error.to_string()))?;
    let cells = document.get_mut("cell").and_then(Item::as_array_of_tables_mut);
    let cells = cells.ok_or_else(|| wrong("its cells are not [[cell]] tables".to_owned()))?;
    if cells.len() != skin.cells.len() {
        return Err(wrong(format!("{} cells, not {}", cells.len(), skin.cells.len())));
    }
    for ((table, cell), result) in cells.iter_mut().zip(&skin.cells).zip(&calibration.cells) {
        let Some(found) = result.found.filter(|_| result.is_written()) else { continue };
        let Found { joint, row, position, orientation, .. } = found;
        if joint != cell.joint {
            put(table.entry("joint"), Value::from(i64::from(joint)));
        }
        if table.contains_key("row") {
            put(table.entry("row"), Value::from(i64::from(row)));
        }
        put(table.entry("position"), array(&position));
        let keys: Vec<_> = table.iter().map(|(key, _)| key.to_owned()).collect();
        put(table.entry("orientation"), array(&orientation));
        // A cell has one of the two: the orientation takes the normal's place.
        if table.remove("normal").is_some() {
            let place = |key: &str| keys.iter().position(|it| it == key);
            let order = |key: &str| place(key).or_else(|| place("normal"));
            table.sort_values_by(|one, _, other, _| order(one.get()).cmp(&order(other.get())));
        }
    }
    Ok(document.to_string())
}

/// Puts a value in the place of another one, and keeps the white space and the comment around that.
fn put(entry: toml_edit::Entry<'_>, mut new: Value) {
    match entry {
        toml_edit::Entry::Occupied(mut entry) => {
            if let Some(old) = entry.get_mut().as_value_mut() {
                *new.decor_mut() = old.decor().clone();
                *old = new;
            }
        }
        toml_edit::Entry::Vacant(entry) => {
            entry.insert(Item::Value(new));
        }
    }
}

fn array(of: &[f64]) -> Value {
    Value::Array(of.iter().copied().collect::<Array>())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::result::CellResult;

    const SKIN: &str = r#"[robot]
joints = [{ d = 0.1, alpha = 1.5707963267948966 }, { a = 0.5 }]

# the first
[[cell]]
node = 1
joint = 2   # as typed
position = [-0.2, 0.0, 0.06]
normal = [0.0, 1.0, 0.0] # up
alpha_p = 0.5

[[cell]]
node = 2
joint = 1
position = [0.0, 0.0, 0.06]
orientation = [0.0, 0.0, 0.0, 1.0]
"#;

    #[test]
    fn poses_change_and_nothing_else() {
        let skin = Skin::parse("skin.toml", SKIN).unwrap();
        let found = Found {
            joint: 2,
            row: 2,
            position: [0.01, -0.02, 0.3],
            orientation: [0.0, 0.0, 0.6, 0.8],
            position_mm: 1.0,
            orientation_deg: 0.4,
            moved_mm: None,
            turned_deg: None,
        };
        let mut cells: Vec<_> =
            skin.cells.iter().map(|cell| CellResult::unknown(&skin, cell, 9_000)).collect();
        cells[0].found = Some(found);
        let calibration = |cells: &[CellResult]| Calibration {
            summary: Default::default(),
            cells: cells.to_vec(),
            zero_offsets: None,
        };
        let text = calibrated(&skin, SKIN, &calibration(&cells)).unwrap();
        let expected = SKIN
            .replace("[-0.2, 0.0, 0.06]", "[0.01, -0.02, 0.3]")
            .replace("normal = [0.0, 1.0, 0.0] # up", "orientation = [0.0, 0.0, 0.6, 0.8]");
        assert_eq!(text, expected);
        cells[1].found = Some(found);
        let text = calibrated(&skin, SKIN, &calibration(&cells)).unwrap();
        let new = Skin::parse("new.toml", &text).unwrap();
        assert_eq!((new.cells[1].joint, new.cells[1].orientation), (2, Some([0.0, 0.0, 0.6, 0.8])));
    }

    #[test]
    fn another_text_is_refused() {
        let skin = Skin::parse("skin.toml", SKIN).unwrap();
        let calibration = Calibration { summary: Default::default(), cells: Vec::new(), zero_offsets: None };
        let (one, _) = SKIN.rsplit_once("[[cell]]").unwrap();
        let error = calibrated(&skin, one, &calibration).unwrap_err();
        assert_eq!(
            error.to_string(),
            "the skin's text is not that of the skin that was read: 1 cells, not 2; calibrate again"
        );
    }
}
