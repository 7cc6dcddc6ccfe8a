//! 3D page of a calibration, with the poses found beside those that the skin describes.

use std::path::Path;

use calibration::Calibration;
use calibration::result::{CellResult, EstimatedCellPlace};
use protocol::skin::Skin;
use view::{CellShades, FindingPart, PreviousCellPlace, Scene};

use crate::print::count_with_noun;
use crate::skin::still_page;
use crate::visuals::PackageOptions;

/// Returns the HTML page, which shows the cells at the positions found, each with a line from the position that the
/// skin describes.
pub(super) fn calibration_page(file: &Path, skin: &Skin, calibration: &Calibration) -> String {
    let mut found = skin.clone();
    for (cell, result) in found.cells.iter_mut().zip(&calibration.cells) {
        let Some(pose) = result.found.filter(|_| result.is_pose_written()) else { continue };
        let [x, y, z, w] = pose.orientation;
        (cell.joint, cell.row, cell.position) = (pose.joint, pose.row, pose.position);
        cell.orientation = Some(pose.orientation);
        cell.normal = [2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)];
    }
    let mut still = still_page(file, &found, &PackageOptions::search_beside_urdf());
    let described = Scene::from_skin(skin, false);
    for (index, (old, result)) in described.cells.into_iter().zip(&calibration.cells).enumerate() {
        let chain = described.buses.get(old.bus).map_or(0, |bus| bus.chain);
        if result.found.is_some_and(|_| result.is_pose_written()) {
            let (position, normal) = (old.position, old.normal);
            still.moved.push(PreviousCellPlace { cell: index, chain, row: old.row, position, normal });
        }
        let Some(details) = still.details.get_mut(index) else { continue };
        let mut detail = |name: &str, value: String| details.push((name.to_owned(), value));
        if let Some(pose) = result.found {
            let certain = format!("{} mm and {}°", pose.position_mm, pose.orientation_deg);
            detail("Uncertainty", certain);
            if let (Some(mm), Some(degrees)) = (pose.moved_mm, pose.turned_deg) {
                detail("Distance from the skin's pose", format!("{mm} mm, {degrees}°"));
            }
        }
        result.troubles.iter().for_each(|trouble| detail("Unreliable", trouble.to_string()));
    }
    still.shades = Some(shift_shades(calibration));
    still.findings = findings(calibration);
    still.scene.name = format!("{}, calibrated", skin.name);
    still.to_html()
}

/// Maximum number of uncertain cells that are named.
const MAX_NAMED_CELLS: usize = 12;
/// The share of cells whose shifts the colours cover at least, and the factor by which the largest shift may exceed
/// theirs before it is cut off.
const COVERED_SHARE: f64 = 0.95;
const MAX_OUTLIER_FACTOR: f64 = 3.0;

/// Returns the pose found for a cell, if it replaces that of the skin.
fn written_place(result: &CellResult) -> Option<EstimatedCellPlace> {
    result.found.filter(|_| result.is_pose_written())
}

/// Returns the distance of each cell from its place in the skin, as its colour. A cell on another link than in the skin
/// has the last colour.
fn shift_shades(calibration: &Calibration) -> CellShades {
    let places = || calibration.cells.iter().map(written_place);
    let mut shifts: Vec<f64> = places().flatten().filter_map(|place| place.moved_mm).collect();
    shifts.sort_by(f64::total_cmp);
    let max = shifts.last().copied().unwrap_or(0.0);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "an index of the list")]
    let covered = shifts.get((shifts.len() as f64 * COVERED_SHARE) as usize).copied().unwrap_or(max);
    let high = if max > MAX_OUTLIER_FACTOR * covered { covered } else { max };
    // Without any shift the scale still needs a length.
    let high = if high > 0.0 { high } else { 1.0 };
    CellShades {
        caption: "Distance from the skin's place".to_owned(),
        unit: "mm".to_owned(),
        high,
        more: max > high || places().flatten().any(|place| place.moved_mm.is_none()),
        values: places().map(|place| place.map(|place| place.moved_mm.unwrap_or(high))).collect(),
        unknown: "uncertain: keeps its place in the skin".to_owned(),
    }
}

/// Returns sentences on the cells that moved, on the largest shift, and on what is left uncertain.
fn findings(calibration: &Calibration) -> Vec<FindingPart> {
    let cells = || calibration.cells.iter();
    let moved = |result: &&CellResult| {
        written_place(result)
            .is_some_and(|place| place.moved_mm.is_none_or(|moved_mm| moved_mm > place.position_mm))
    };
    let total = count_with_noun(cells().len(), "cell");
    let mut parts = vec![FindingPart::text(format!(
        "{} of {total} moved by more than their uncertainty",
        cells().filter(moved).count()
    ))];
    let shifts = cells().filter_map(|cell| Some((cell, written_place(cell)?.moved_mm?)));
    if let Some((cell, moved_mm)) = shifts.max_by(|(_, one), (_, other)| one.total_cmp(other)) {
        let text = format!("; largest shift {moved_mm} mm: cell ");
        parts.extend([FindingPart::text(text), FindingPart::cell(&cell.bus, cell.node)]);
    }
    add_cells(
        &mut parts,
        ". On another link than in the skin: ",
        cells().filter(|cell| written_place(cell).is_some_and(|place| place.moved_mm.is_none())),
    );
    let summary = &calibration.summary;
    if let (Some(mm), Some(degrees)) = (summary.position_mm, summary.orientation_deg) {
        let text = format!(". Left uncertain: {mm} mm and {degrees}° (median of the 95 % limits)");
        parts.push(FindingPart::text(text));
    }
    if cells().all(|cell| written_place(cell).is_some()) {
        parts.push(FindingPart::text("; every cell has a new place"));
    }
    add_cells(
        &mut parts,
        "; places kept because the new ones are not known: ",
        cells().filter(|cell| written_place(cell).is_none()),
    );
    add_cells(
        &mut parts,
        "; placed, but unreliable: ",
        cells().filter(|cell| written_place(cell).is_some() && !cell.troubles.is_empty()),
    );
    parts.push(FindingPart::text("."));
    parts
}

/// Adds the names of cells, if there are any.
fn add_cells<'a>(parts: &mut Vec<FindingPart>, before: &str, cells: impl Iterator<Item = &'a CellResult>) {
    let cells: Vec<_> = cells.collect();
    for (at, cell) in cells.iter().take(MAX_NAMED_CELLS).enumerate() {
        let text = if at == 0 { before } else { ", " };
        parts.extend([FindingPart::text(text), FindingPart::cell(&cell.bus, cell.node)]);
    }
    if cells.len() > MAX_NAMED_CELLS {
        parts.push(FindingPart::text(format!(" and {} more", cells.len() - MAX_NAMED_CELLS)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use calibration::result::{Diagnosis, SensorResult, Summary};

    fn cell(node: u8, moved_mm: Option<f64>, troubles: Vec<Diagnosis>) -> CellResult {
        let found = EstimatedCellPlace {
            joint: 2,
            row: 2,
            position: [0.0; 3],
            orientation: [0.0, 0.0, 0.0, 1.0],
            position_mm: 1.0,
            orientation_deg: 0.5,
            moved_mm,
            turned_deg: moved_mm,
        };
        CellResult {
            bus: "can0".to_owned(),
            node,
            serial: node.into(),
            readings: 100,
            troubles,
            found: Some(found),
            sensor: SensorResult::default(),
            pose: None,
        }
    }

    fn calibration(cells: Vec<CellResult>) -> Calibration {
        let summary = Summary {
            cells: cells.len(),
            position_mm: Some(1.0),
            orientation_deg: Some(0.5),
            ..Summary::default()
        };
        Calibration { summary, cells, zero_offsets: None }
    }

    fn text(calibration: &Calibration) -> String {
        findings(calibration).into_iter().map(|part| part.text).collect()
    }

    #[test]
    fn the_summary_names_shifts_and_what_is_left_uncertain() {
        let cells = [
            cell(1, Some(0.4), vec![]),
            cell(2, Some(7.25), vec![]),
            cell(3, Some(90.0), vec![Diagnosis::Dead]),
            cell(4, None, vec![]),
            cell(5, Some(2.0), vec![Diagnosis::Swapped { node: 2 }]),
        ];
        let result = calibration(cells.into());
        assert_eq!(
            text(&result),
            "3 of 5 cells moved by more than their uncertainty; largest shift 7.25 mm: cell can0:2. On another \
             link than in the skin: can0:4. Left uncertain: 1 mm and 0.5° (median of the 95 % limits); \
             places kept because the new ones are not known: can0:3; placed, but unreliable: can0:5."
        );
        let shades = shift_shades(&result);
        assert_eq!(shades.values, [Some(0.4), Some(7.25), None, Some(7.25), Some(2.0)]);
        assert!(shades.more && (shades.high - 7.25).abs() < 1e-12);
        let links = findings(&result).into_iter().filter(|part| part.is_cell).count();
        assert_eq!(links, 4);
        let well = text(&calibration(vec![cell(1, Some(0.0), vec![])]));
        assert!(well.starts_with("0 of 1 cell moved"), "{well}");
        assert!(well.ends_with("; every cell has a new place."), "{well}");
    }

    #[test]
    fn one_cell_that_is_far_off_does_not_hide_the_shifts_of_the_others() {
        let mut cells: Vec<_> =
            (1..=40).map(|node| cell(node, Some(f64::from(node) / 10.0), vec![])).collect();
        cells.push(cell(41, Some(150.0), vec![]));
        let shades = shift_shades(&calibration(cells));
        assert!(shades.more && shades.high <= 4.0, "{}", shades.high);
    }
}
