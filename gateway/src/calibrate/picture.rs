//! What was found beside what was described, in 3D.

use std::path::Path;

use calibration::Calibration;
use cover::drawing::page as drawn;
use protocol::skin::Skin;

use crate::skin::drawing;
use crate::visuals::Packages;

/// The page: cells where they were found, and a line from where each of them was described.
pub(super) fn page(file: &Path, skin: &Skin, calibration: &Calibration) -> String {
    let mut found = skin.clone();
    for (cell, result) in found.cells.iter_mut().zip(&calibration.cells) {
        let Some(pose) = result.found.filter(|_| result.is_written()) else { continue };
        let [x, y, z, w] = pose.orientation;
        (cell.joint, cell.row, cell.position) = (pose.joint, pose.row, pose.position);
        cell.orientation = Some(pose.orientation);
        cell.normal = [2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)];
    }
    let packages = Packages::beside();
    let described = drawing(file, skin, &packages);
    let mut picture = drawing(file, &found, &packages);
    for ((cell, old), result) in picture.cells.iter_mut().zip(&described.cells).zip(&calibration.cells) {
        picture.segments.push([old.position, cell.position]);
        let mut detail = |name: &str, value: String| cell.details.push((name.to_owned(), value));
        if let Some(pose) = result.found {
            let certain = format!("within {} mm and {} degrees", pose.position_mm, pose.orientation_deg);
            detail("Certain", certain);
            if let (Some(mm), Some(degrees)) = (pose.moved_mm, pose.turned_deg) {
                detail("From its description", format!("{mm} mm, {degrees} degrees"));
            }
        }
        result.troubles.iter().for_each(|trouble| detail("Not to be trusted", trouble.to_string()));
    }
    picture.name = format!("{}, calibrated", skin.name);
    drawn(&picture)
}
