//! Assigns cells to buses and node ids, and wires them.
//!
//! Cells are numbered by link, along the link in rings of one row each, and around it. A bus gets consecutive cells, so
//! that it is one patch of each link. Wires join neighbours on the same bus and link: first the fewest and shortest
//! wires that reach all cells, then further ones, shortest first, while both cells have a free port.

mod ports;

use nalgebra::{Matrix3, Point3, SymmetricEigen, Vector3};
use std::collections::VecDeque;

use crate::grid::PointGrid;
use crate::place::CellPosition;
use crate::surface::{count_to_f64, tangents};
use crate::{CoverCell, CoverOptions};

/// The number of ports of a cell.
pub const PORTS_PER_CELL: usize = 4;

/// The maximum number of cells per bus.
pub const MAX_CELLS_PER_BUS: usize = 250;

const MAX_WIRE_LENGTH_PITCHES: f64 = 1.5;

/// The minimum cosine between the normals of two wired cells. Cells are wired around a sharp edge, but not through a
/// wall.
const MIN_WIRED_NORMAL_COSINE: f64 = -0.2;

/// The maximum deviation from a bus' even share that lets the bus end with a link, relative to its budget of nodes.
const MAX_BUS_SHARE_DEVIATION: f64 = 0.1;

/// Returns the cells of all links with their wires, and the number of buses.
pub(crate) fn wire_cells(placed: &[Vec<CellPosition>], options: &CoverOptions) -> (Vec<CoverCell>, usize) {
    let sizes: Vec<_> = placed.iter().map(Vec::len).collect();
    let buses = cells_per_bus(&sizes, options.nodes_per_bus);
    let all = placed.iter().enumerate().flat_map(|(link, spots)| {
        let limb = Limb::from_cells(spots);
        limb.order_by_ring(spots, options.pitch).into_iter().map(move |spot| UnwiredCell {
            link,
            spot,
            axis: limb.axis,
        })
    });
    let mut all = all.collect::<Vec<_>>().into_iter();
    let mut cells = Vec::new();
    for (bus, &size) in buses.iter().enumerate() {
        let places: Vec<_> = all.by_ref().take(size).collect();
        cells.extend(wire_bus(bus, &places, options.pitch));
    }
    (cells, buses.len())
}

/// Returns the number of cells of each bus, for links with these numbers of cells.
fn cells_per_bus(links: &[usize], budget: usize) -> Vec<usize> {
    let mut ends = Vec::with_capacity(links.len());
    let mut total = 0;
    for size in links {
        total += size;
        ends.push(total);
    }
    let mut shares = Vec::new();
    let mut from = 0;
    // Before each bus, the rest of the cells fits on the remaining buses, but not on one fewer.
    for buses in (1..=total.div_ceil(budget)).rev() {
        let rest = total - from;
        let even = rest.div_ceil(buses);
        let possible = rest.saturating_sub((buses - 1) * budget).max(1)..=budget.min(rest);
        let off = |share: &usize| share.abs_diff(even);
        let of_links =
            ends.iter().map(|end| end.saturating_sub(from)).filter(|share| possible.contains(share));
        let share = of_links
            .filter(|share| count_to_f64(off(share)) <= MAX_BUS_SHARE_DEVIATION * count_to_f64(budget))
            .min_by_key(off)
            .unwrap_or(even);
        shares.push(share);
        from += share;
    }
    shares
}

/// A cell before it has wires.
#[derive(Clone, Copy, Debug)]
struct UnwiredCell {
    link: usize,
    spot: CellPosition,
    axis: Vector3<f64>,
}

/// A link reduced to the axis along which its cells lie.
#[derive(Clone, Copy, Debug)]
struct Limb {
    middle: Point3<f64>,
    axis: Vector3<f64>,
}

impl Limb {
    /// Computes the axis: the direction in which the cells spread farthest, away from the link's origin.
    fn from_cells(spots: &[CellPosition]) -> Self {
        let count = count_to_f64(spots.len().max(1));
        let middle = Point3::from(spots.iter().map(|spot| spot.point.coords).sum::<Vector3<f64>>() / count);
        let spread: Matrix3<f64> = spots
            .iter()
            .map(|spot| {
                let off = spot.point - middle;
                off * off.transpose()
            })
            .sum();
        let eigen = SymmetricEigen::new(spread);
        let axis: Vector3<f64> = eigen.eigenvectors.column(eigen.eigenvalues.imax()).into_owned();
        let axis = if axis.dot(&middle.coords) < 0.0 { -axis } else { axis };
        Self { middle, axis }
    }

    /// Orders cells by ring along the axis, and around it within a ring.
    fn order_by_ring(&self, spots: &[CellPosition], pitch: f64) -> Vec<CellPosition> {
        let along = |spot: &CellPosition| (spot.point - self.middle).dot(&self.axis);
        let first = spots.iter().map(along).min_by(f64::total_cmp).unwrap_or_default();
        let row = pitch * 0.75_f64.sqrt();
        let (s, t) = tangents(&self.axis);
        let mut keyed: Vec<_> = spots
            .iter()
            .map(|spot| {
                let off = spot.point - self.middle;
                let ring = ((along(spot) - first) / row).floor();
                (ring, off.dot(&t).atan2(off.dot(&s)), *spot)
            })
            .collect();
        keyed.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
        keyed.into_iter().map(|(.., spot)| spot).collect()
    }
}

/// Wires the cells of one bus.
fn wire_bus(bus: usize, places: &[UnwiredCell], pitch: f64) -> Vec<CoverCell> {
    let wires = wires_by_cell(places.len(), &nearby_pairs(places, pitch));
    let roots = choose_roots(&wires);
    let cell = |(index, place): (usize, &UnwiredCell)| {
        let others = wires.get(index).map_or(&[][..], Vec::as_slice);
        let directions: Vec<_> = others
            .iter()
            .filter_map(|&other| Some((other, places.get(other)?.spot.point - place.spot.point)))
            .collect();
        CoverCell {
            link: place.link,
            position: place.spot.point.coords.into(),
            normal: place.spot.normal.into(),
            bus,
            node: node_id(index),
            neighbors: ports::assign_ports(&place.spot.normal, &place.axis, &directions)
                .map(|other| other.map(node_id)),
            root: roots.contains(&index),
        }
    };
    places.iter().enumerate().map(cell).collect()
}

/// Returns the node id for an index on a bus.
fn node_id(index: usize) -> u8 {
    // A bus has at most MAX_NODES cells.
    u8::try_from(index + 1).unwrap_or(u8::MAX)
}

/// Returns pairs of cells that a wire may join, the nearest ones first.
fn nearby_pairs(places: &[UnwiredCell], pitch: f64) -> Vec<[usize; 2]> {
    let longest = MAX_WIRE_LENGTH_PITCHES * pitch;
    let mut found = Vec::new();
    let grid = PointGrid::with_points(longest, places.iter().map(|place| &place.spot.point));
    for (index, place) in places.iter().enumerate() {
        for other in grid.points_around(grid.cube_at(&place.spot.point)).filter(|&other| other > index) {
            let Some(there) = places.get(other).filter(|there| there.link == place.link) else { continue };
            let distance = (there.spot.point - place.spot.point).norm();
            if distance <= longest && there.spot.normal.dot(&place.spot.normal) > MIN_WIRED_NORMAL_COSINE {
                found.push((distance, [index, other]));
            }
        }
    }
    found.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    found.into_iter().map(|(_, pair)| pair).collect()
}

fn wires_by_cell(count: usize, pairs: &[[usize; 2]]) -> Vec<Vec<usize>> {
    let mut wires: Vec<Vec<usize>> = vec![Vec::new(); count];
    let mut groups: Vec<_> = (0..count).collect();
    let join = |wires: &mut Vec<Vec<usize>>, [a, b]: [usize; 2], most: usize| {
        let free = |cell: usize| wires.get(cell).is_some_and(|wires| wires.len() < most);
        let there = wires.get(a).is_some_and(|wires| wires.contains(&b));
        if there || !free(a) || !free(b) {
            return false;
        }
        for (cell, other) in [(a, b), (b, a)] {
            if let Some(wires) = wires.get_mut(cell) {
                wires.push(other);
            }
        }
        true
    };
    // At first one port of each cell stays free, for cells without other neighbours.
    for (most, &[a, b]) in [PORTS_PER_CELL - 1, PORTS_PER_CELL]
        .into_iter()
        .flat_map(|most| pairs.iter().map(move |pair| (most, pair)))
    {
        let group = |cell: usize| groups.get(cell).copied();
        let (Some(from), Some(to)) = (group(b), group(a)) else { continue };
        if from != to && join(&mut wires, [a, b], most) {
            groups.iter_mut().filter(|group| **group == from).for_each(|group| *group = to);
        }
    }
    for &pair in pairs {
        join(&mut wires, pair, PORTS_PER_CELL);
    }
    wires
}

/// Returns one cell of each wired group: the first one with the smallest distance to its farthest cell.
fn choose_roots(wires: &[Vec<usize>]) -> Vec<usize> {
    let mut seen = vec![false; wires.len()];
    let mut roots = Vec::new();
    for first in 0..wires.len() {
        if seen.get(first).is_none_or(|seen| *seen) {
            continue;
        }
        let mut group: Vec<_> = reachable_cells(wires, first).into_iter().map(|(cell, _)| cell).collect();
        group.sort_unstable();
        for &cell in &group {
            if let Some(seen) = seen.get_mut(cell) {
                *seen = true;
            }
        }
        let depth = |&from: &usize| reachable_cells(wires, from).last().map_or(0, |&(_, depth)| depth);
        roots.extend(group.into_iter().min_by_key(depth));
    }
    roots
}

/// Returns the cells that are connected to a cell, with the number of wires between them, the nearest first.
fn reachable_cells(wires: &[Vec<usize>], from: usize) -> Vec<(usize, usize)> {
    let mut seen = vec![false; wires.len()];
    let mut found = Vec::new();
    let mut next = VecDeque::from([(from, 0)]);
    while let Some((cell, depth)) = next.pop_front() {
        let (Some(seen @ false), Some(others)) = (seen.get_mut(cell), wires.get(cell)) else { continue };
        *seen = true;
        found.push((cell, depth));
        next.extend(others.iter().map(|&other| (other, depth + 1)));
    }
    found
}

#[cfg(test)]
mod tests;
