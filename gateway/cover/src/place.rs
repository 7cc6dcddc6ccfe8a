//! Places cells on the surface of a link.

use core::f64::consts::FRAC_PI_3;

use nalgebra::{Point3, Rotation3, Unit, Vector3};
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::CoverOptions;
use crate::grid::PointGrid;
use crate::relax::{CellSite, SampleField};
use crate::surface::{Sample, Surface, cell_area, count_to_f64};

/// The maximum angle between the normal of a cell and that of the mesh at its center, in rad: 9 degrees.
const MAX_TILT_RAD: f64 = 0.157;

/// The distance between cells before relaxation, in pitches. It is larger than 1, because relaxation adds further cells
/// between them.
const INITIAL_SPACING_PITCHES: f64 = 1.15;

/// The maximum number of attempts to reach a median distance of one pitch, each with another initial distance.
const MAX_ATTEMPTS: usize = 4;

/// The relative difference between the median distance of cells and the pitch at which the attempts end.
const SPACING_TOLERANCE: f64 = 0.015;

/// The cost of tilting a cell, relative to that of moving it: 1 minus the cosine of the angle, times this factor, is
/// compared with the square of the distance in pitches. A tilt of 9 degrees costs as much as moving the cell by a fifth
/// of a pitch.
const TILT_COST_FACTOR: f64 = 3.0;

/// The minimum distance between two cells on the same side, in pitches. Relaxation leaves a few cells closer together
/// where a surface is folded or narrow.
const MIN_SPACING_PITCHES: f64 = 0.6;

/// The cosine of the largest angle between the normals of two cells that count as being on the same side.
const MIN_SAME_SIDE_COSINE: f64 = 0.5;

/// The place of a cell, in the frame of its link.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct CellPosition {
    pub(crate) point: Point3<f64>,
    pub(crate) normal: Vector3<f64>,
    /// The angle between the normal of the cell and that of the mesh, in rad.
    pub(crate) tilt: f64,
}

/// Returns the places of the cells on a link.
pub(crate) fn place_cells(surface: &Surface<'_>, options: &CoverOptions, link: usize) -> Vec<CellPosition> {
    let pitch = options.pitch;
    let field = SampleField::new(surface.samples.iter().filter(|sample| sample.free).collect(), 1.2 * pitch);
    if count_to_f64(field.samples.len()) * surface.share < cell_area(pitch) / 4.0 {
        return Vec::new();
    }
    let stream = u64::try_from(link).unwrap_or_default().wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let mut dice = Pcg64Mcg::seed_from_u64(options.seed ^ stream);
    let mut order: Vec<_> = (0..field.samples.len()).collect();
    order.shuffle(&mut dice);
    let mut apart = INITIAL_SPACING_PITCHES * pitch;
    let mut best: Option<(f64, Vec<CellPosition>)> = None;
    for _ in 0..MAX_ATTEMPTS {
        let mut sites = field.grow_honeycomb(&order, apart, dice.random_range(0.0..FRAC_PI_3));
        field.relax_sites(&mut sites, apart);
        let spots = remove_close_cells(cell_positions(surface, &field, &sites, pitch), pitch);
        let Some(spacing) = median_spacing(&spots, pitch) else {
            return spots;
        };
        let off = (spacing / pitch - 1.0).abs();
        if best.as_ref().is_none_or(|(min, _)| off < *min) {
            best = Some((off, spots));
        }
        if off < SPACING_TOLERANCE {
            break;
        }
        apart *= (pitch / spacing).clamp(0.7, 1.3);
    }
    best.map_or_else(Vec::new, |(_, spots)| spots)
}

/// Removes places that are closer than [`MIN_SPACING_PITCHES`] to an earlier place on the same side.
fn remove_close_cells(spots: Vec<CellPosition>, pitch: f64) -> Vec<CellPosition> {
    let apart = MIN_SPACING_PITCHES * pitch;
    let mut grid = PointGrid::new(apart);
    let mut kept: Vec<CellPosition> = Vec::new();
    for spot in spots {
        let near = |other: &CellPosition| {
            other.normal.dot(&spot.normal) > MIN_SAME_SIDE_COSINE && (other.point - spot.point).norm() < apart
        };
        let is_crowded =
            grid.points_around(grid.cube_at(&spot.point)).filter_map(|index| kept.get(index)).any(near);
        if !is_crowded {
            grid.insert(&spot.point, kept.len());
            kept.push(spot);
        }
    }
    kept
}

/// Returns the median distance from a place to the nearest other place on the same side, in m.
pub(crate) fn median_spacing(spots: &[CellPosition], pitch: f64) -> Option<f64> {
    let nearest = |spot: &CellPosition| {
        let same = spots.iter().filter(|other| *other != spot && other.normal.dot(&spot.normal) > 0.0);
        same.map(|other| (other.point - spot.point).norm()).min_by(f64::total_cmp)
    };
    // A cell without other cells on its side has no distance to them, and does not count.
    let nearest = spots.iter().filter_map(nearest).filter(|&distance| distance < 3.0 * pitch);
    median(&mut nearest.collect::<Vec<_>>())
}

/// Returns the median of the values. For an even number of values, returns the larger of the two in the middle.
fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    if values.is_empty() {
        return None;
    }
    let (_, median, _) = values.select_nth_unstable_by(middle, f64::total_cmp);
    Some(*median)
}

/// Returns the places of cells on the mesh, one for each site that relaxation has found.
fn cell_positions(
    surface: &Surface<'_>,
    field: &SampleField<'_>,
    sites: &[CellSite],
    pitch: f64,
) -> Vec<CellPosition> {
    let mut best: Vec<Option<(f64, &Sample)>> = vec![None; sites.len()];
    for (owner, sample) in field.nearest_sites(sites).into_iter().zip(&field.samples) {
        let Some((site, best)) = owner.and_then(|owner| Some((sites.get(owner)?, best.get_mut(owner)?)))
        else {
            continue;
        };
        let tilt = 1.0 - sample.face.dot(&sample.smooth);
        let cost = (site.point - sample.point).norm_squared() + TILT_COST_FACTOR * pitch * pitch * tilt;
        if best.is_none_or(|(min, _)| cost < min) {
            *best = Some((cost, *sample));
        }
    }
    let spot = |(site, best): (&CellSite, Option<(f64, &Sample)>)| {
        let (_, sample) = best?;
        let projected = surface.project_to_mesh(&site.point, sample);
        let straight = projected.filter(|(_, face)| face.angle(&sample.smooth) < MAX_TILT_RAD);
        let (point, face) = straight.unwrap_or((sample.point, sample.face));
        let normal = limit_tilt(&face, &sample.smooth);
        Some(CellPosition { point, normal, tilt: normal.angle(&face) })
    };
    sites.iter().zip(best).filter_map(spot).collect()
}

/// Returns the unit vector that is nearest to `requested` and at most [`MAX_TILT_RAD`] away from `face`.
fn limit_tilt(face: &Vector3<f64>, requested: &Vector3<f64>) -> Vector3<f64> {
    let angle = face.angle(requested);
    if angle <= MAX_TILT_RAD {
        return *requested;
    }
    // Opposite vectors would have no rotation axis, but the vectors of samples are never opposite.
    let axis = Unit::try_new(face.cross(requested), 0.0);
    axis.map_or(*face, |axis| Rotation3::from_axis_angle(&axis, MAX_TILT_RAD) * face)
}
