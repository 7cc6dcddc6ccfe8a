//! Distributes sites evenly on the samples of a surface by Lloyd's relaxation: each site moves to the mean of the
//! samples that are nearest to it, until the sites form a honeycomb.

use core::f64::consts::FRAC_PI_3;
use std::collections::VecDeque;

use nalgebra::{Point3, Rotation3, Unit, Vector3};

use crate::grid::PointGrid;
use crate::surface::{Sample, tangents};

/// The cosine of the largest angle between the normals of a site and of a sample that may belong to it. It separates
/// the two sides of a thin wall, and the faces at a sharp edge.
const MIN_NORMAL_COSINE: f64 = 0.3;

/// The minimum distance between sites while they grow, in steps. It matters where a honeycomb that grows around a tube
/// meets itself.
const MIN_GROWTH_DISTANCE_STEPS: f64 = 0.75;

/// The number of rounds in which all sites are moved.
const RELAXATION_ROUNDS: usize = 60;

/// The number of rounds after which new sites are added at samples that are far from every site.
const ROUNDS_PER_ADDITION: usize = 15;

/// A point that is the center of the samples nearest to it. A cell is placed there at the end.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CellSite {
    pub(crate) point: Point3<f64>,
    pub(crate) normal: Vector3<f64>,
}

impl CellSite {
    /// Returns the squared distance to a sample in m²; `None` if the sample faces another way.
    pub(crate) fn squared_distance(&self, sample: &Sample) -> Option<f64> {
        (self.normal.dot(&sample.smooth) > MIN_NORMAL_COSINE)
            .then(|| (self.point - sample.point).norm_squared())
    }
}

/// The samples at which cells may be placed, and the maximum distance from a site to its samples.
#[derive(Debug)]
pub(crate) struct SampleField<'a> {
    pub(crate) samples: Vec<&'a Sample>,
    grid: PointGrid,
    reach: f64,
}

impl<'a> SampleField<'a> {
    pub(crate) fn new(samples: Vec<&'a Sample>, reach: f64) -> Self {
        let grid = PointGrid::with_points(reach, samples.iter().map(|sample| &sample.point));
        Self { samples, grid, reach }
    }

    /// Adds a site at each sample, in the given order, that is farther than `apart` (in m) from all sites.
    pub(crate) fn add_sites(&self, order: &[usize], apart: f64, sites: &mut Vec<CellSite>) {
        let mut grid = PointGrid::with_points(apart, sites.iter().map(|site| &site.point));
        for sample in order.iter().filter_map(|&index| self.samples.get(index)) {
            let near = grid.points_around(grid.cube_at(&sample.point)).filter_map(|index| sites.get(index));
            let free = !near
                .filter_map(|site| site.squared_distance(sample))
                .any(|distance| distance < apart * apart);
            if free {
                grid.insert(&sample.point, sites.len());
                sites.push(CellSite { point: sample.point, normal: sample.smooth });
            }
        }
    }

    /// Grows a honeycomb of sites whose distance is `step`, in m. Growth begins at those samples, in the given order,
    /// that have no site nearby. `turn` is the direction of the first row, in rad.
    pub(crate) fn grow_honeycomb(&self, order: &[usize], step: f64, turn: f64) -> Vec<CellSite> {
        let mut sites: Vec<CellSite> = Vec::new();
        let mut grid = PointGrid::new(step);
        let free = |site: &CellSite, apart: f64, sites: &[CellSite], grid: &PointGrid| {
            let mut near = grid.points_around(grid.cube_at(&site.point)).filter_map(|index| sites.get(index));
            near.all(|other| {
                other.normal.dot(&site.normal) <= MIN_NORMAL_COSINE
                    || (other.point - site.point).norm() >= apart
            })
        };
        for sample in order.iter().filter_map(|&index| self.samples.get(index)) {
            let first = CellSite { point: sample.point, normal: sample.smooth };
            if !free(&first, step, &sites, &grid) {
                continue;
            }
            let (s, t) = tangents(&first.normal);
            let mut open = VecDeque::from([(first, s * turn.cos() + t * turn.sin())]);
            while let Some((site, row)) = open.pop_front() {
                if !free(&site, MIN_GROWTH_DISTANCE_STEPS * step, &sites, &grid) {
                    continue;
                }
                grid.insert(&site.point, sites.len());
                sites.push(site);
                for sixth in 0..6 {
                    let turn = Rotation3::from_axis_angle(
                        &Unit::new_unchecked(site.normal),
                        f64::from(sixth) * FRAC_PI_3,
                    );
                    let direction = turn * row;
                    let next = CellSite { point: site.point + direction * step, normal: site.normal };
                    let Some(next) = self.snap_to_surface(&next, 0.4 * step) else { continue };
                    let flat = Unit::try_new(direction - next.normal * direction.dot(&next.normal), 0.0);
                    open.extend(flat.map(|flat| (next, flat.into_inner())));
                }
            }
        }
        sites
    }

    /// Moves a site onto the surface at the nearest sample; `None` if no sample is within `within`, in m.
    fn snap_to_surface(&self, site: &CellSite, within: f64) -> Option<CellSite> {
        let near = self
            .grid
            .points_around(self.grid.cube_at(&site.point))
            .filter_map(|index| self.samples.get(index));
        let near = near.filter_map(|sample| Some((site.squared_distance(sample)?, sample)));
        let (distance, sample) = near.min_by(|a, b| a.0.total_cmp(&b.0))?;
        let height = (site.point - sample.point).dot(&sample.smooth);
        let point = site.point - sample.smooth * height;
        (distance <= within * within).then_some(CellSite { point, normal: sample.smooth })
    }

    /// Returns the index of the nearest site for each sample; `None` if no site is near enough.
    pub(crate) fn nearest_sites(&self, sites: &[CellSite]) -> Vec<Option<usize>> {
        let mut owners = vec![None; self.samples.len()];
        let grid = PointGrid::with_points(self.reach, sites.iter().map(|site| &site.point));
        for (cube, members) in self.grid.filled_cubes() {
            let near: Vec<_> =
                grid.points_around(cube).filter_map(|index| Some((index, sites.get(index)?))).collect();
            for &member in members {
                let Some(sample) = self.samples.get(member) else { continue };
                let mut best = None;
                let mut within = self.reach * self.reach;
                for &(index, site) in &near {
                    if let Some(distance) =
                        site.squared_distance(sample).filter(|&distance| distance <= within)
                    {
                        within = distance;
                        best = Some(index);
                    }
                }
                if let Some(owner) = owners.get_mut(member) {
                    *owner = best;
                }
            }
        }
        owners
    }

    /// Moves the sites until they are distributed evenly. Removes those that have no samples. New sites are at least
    /// `apart` (in m) from others.
    pub(crate) fn relax_sites(&self, sites: &mut Vec<CellSite>, apart: f64) {
        for round in 1..=RELAXATION_ROUNDS {
            let owners = self.nearest_sites(sites);
            let mut sums = vec![(0.0, Vector3::zeros(), Vector3::zeros()); sites.len()];
            let mut alone = Vec::new();
            for (index, (owner, sample)) in owners.iter().zip(&self.samples).enumerate() {
                match owner.and_then(|owner| sums.get_mut(owner)) {
                    Some((count, points, normals)) => {
                        *count += 1.0;
                        *points += sample.point.coords;
                        *normals += sample.smooth;
                    }
                    None => alone.push(index),
                }
            }
            *sites = sums
                .into_iter()
                .filter(|&(count, ..)| count > 0.0)
                .filter_map(|(count, points, normals)| {
                    let normal = Unit::try_new(normals, 0.0)?.into_inner();
                    Some(CellSite { point: Point3::from(points / count), normal })
                })
                .collect();
            if round % ROUNDS_PER_ADDITION == 0 && round < RELAXATION_ROUNDS {
                self.add_sites(&alone, apart, sites);
            }
        }
    }
}
