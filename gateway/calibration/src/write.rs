//! The text of a skin file with the calibrated poses.

use protocol::skin::Skin;
use protocol::skin::file::{SkinEdit, Value};
use thiserror::Error;

use crate::result::{Calibration, EstimatedCellPlace};

/// The error for a skin whose text cannot be changed.
#[derive(Debug, Error)]
pub enum WriteError {
    /// The text differs from that of the skin that was read.
    #[error("the skin file does not match the skin that was calibrated: {0}; calibrate again")]
    Text(String),
}

/// Returns the text of a skin with the calibrated poses and everything else unchanged: comments, order, omitted keys.
/// Cells without a determined pose keep the pose that they have in the text.
///
/// # Errors
/// Returns [`WriteError`] if the text does not belong to the skin.
pub fn calibrated_text(skin: &Skin, text: &str, calibration: &Calibration) -> Result<String, WriteError> {
    let mut edit = SkinEdit::new(skin, text).map_err(|error| WriteError::Text(error.to_string()))?;
    for (index, (cell, result)) in skin.cells.iter().zip(&calibration.cells).enumerate() {
        let Some(found) = result.found.filter(|_| result.is_pose_written()) else { continue };
        let EstimatedCellPlace { joint, row, position, orientation, .. } = found;
        if joint != cell.joint {
            set_or_insert(&mut edit, index, "joint", Value::Integer(i64::from(joint)), "node");
        }
        edit.set(index, "row", Value::Integer(i64::from(row)));
        edit.set(index, "position", Value::Numbers(&position));
        // A cell has one of the two keys: the orientation replaces the normal.
        let orientation = Value::Numbers(&orientation);
        if edit.has_key(index, "normal") {
            edit.replace_key(index, "normal", "orientation", orientation);
        } else {
            set_or_insert(&mut edit, index, "orientation", orientation, "position");
        }
    }
    Ok(edit.edited_text())
}

/// Sets the value of a cell's key. Inserts the key after another one if the cell does not have it.
fn set_or_insert(edit: &mut SkinEdit<'_>, cell: usize, key: &str, value: Value<'_>, after: &str) {
    if edit.has_key(cell, key) {
        edit.set(cell, key, value);
    } else {
        edit.insert_key_after(cell, key, value, after);
    }
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
        let found = EstimatedCellPlace {
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
            skin.cells.iter().map(|cell| CellResult::without_estimate(&skin, cell, 9_000)).collect();
        cells[0].found = Some(found);
        let calibration = |cells: &[CellResult]| Calibration {
            summary: Default::default(),
            cells: cells.to_vec(),
            zero_offsets: None,
        };
        let text = calibrated_text(&skin, SKIN, &calibration(&cells)).unwrap();
        let expected = SKIN
            .replace("[-0.2, 0.0, 0.06]", "[0.01, -0.02, 0.3]")
            .replace("normal = [0.0, 1.0, 0.0]", "orientation = [0.0, 0.0, 0.6, 0.8]");
        assert_eq!(text, expected);
        cells[1].found = Some(found);
        let text = calibrated_text(&skin, SKIN, &calibration(&cells)).unwrap();
        let new = Skin::parse("new.toml", &text).unwrap();
        assert_eq!((new.cells[1].joint, new.cells[1].orientation), (2, Some([0.0, 0.0, 0.6, 0.8])));
    }

    #[test]
    fn another_text_is_refused() {
        let skin = Skin::parse("skin.toml", SKIN).unwrap();
        let calibration = Calibration { summary: Default::default(), cells: Vec::new(), zero_offsets: None };
        let (one, _) = SKIN.rsplit_once("[[cell]]").unwrap();
        let error = calibrated_text(&skin, one, &calibration).unwrap_err();
        assert_eq!(
            error.to_string(),
            "the skin file does not match the skin that was calibrated: it has 1 cells, not 2; calibrate \
             again"
        );
    }
}
