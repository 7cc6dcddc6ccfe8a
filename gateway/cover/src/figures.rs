//! Measures how well the cells cover a link.

use crate::grid::PointGrid;
use crate::place::{CellPosition, median_spacing};
use crate::surface::{Sample, Surface, count_to_f64};
use crate::{LinkFigures, RobotLink};

/// Computes how well the cells at `spots` cover a link.
pub(crate) fn coverage_figures(
    link: &RobotLink,
    surface: &Surface<'_>,
    spots: &[CellPosition],
    pitch: f64,
) -> LinkFigures {
    let grid = PointGrid::with_points(pitch, spots.iter().map(|spot| &spot.point));
    let covered = |sample: &&Sample| {
        let mut near = grid.points_around(grid.cube_at(&sample.point)).filter_map(|index| spots.get(index));
        near.any(|spot| {
            // A cell covers only samples whose faces point to the same side, so not the other side of a thin wall.
            spot.normal.dot(&sample.face) > -0.5 && (spot.point - sample.point).norm() <= pitch
        })
    };
    let count = surface.samples.len();
    let share = |samples: usize| if count == 0 { 0.0 } else { count_to_f64(samples) / count_to_f64(count) };
    LinkFigures {
        name: link.name.clone(),
        cells: spots.len(),
        outer_area: count_to_f64(count) * surface.share,
        kept_out: share(
            surface.samples.iter().filter(|sample| surface.is_in_keep_out_box(&sample.point)).count(),
        ),
        covered: share(surface.samples.iter().filter(covered).count()),
        spacing: median_spacing(spots, pitch),
        tilt: spots.iter().map(|spot| spot.tilt).fold(0.0, f64::max),
    }
}
