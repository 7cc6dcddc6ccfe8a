//! 3D page of a calibration, with the poses found beside those that the skin describes.

use std::path::Path;

use calibration::Calibration;
use protocol::skin::Skin;
use view::{PreviousCellPlace, Scene};

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
            let certain = format!("{} mm and {} degrees", pose.position_mm, pose.orientation_deg);
            detail("Uncertainty", certain);
            if let (Some(mm), Some(degrees)) = (pose.moved_mm, pose.turned_deg) {
                detail("Distance from the skin's pose", format!("{mm} mm, {degrees} degrees"));
            }
        }
        result.troubles.iter().for_each(|trouble| detail("Unreliable", trouble.to_string()));
    }
    still.scene.name = format!("{}, calibrated", skin.name);
    still.to_html()
}
