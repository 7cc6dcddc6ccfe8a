//! Assigns the wires of a cell to its ports.

use core::f64::consts::{FRAC_PI_2, PI, TAU};

use nalgebra::{Unit, Vector3};

use super::PORTS_PER_CELL;
use crate::surface::tangents;

/// Returns the wired cell of each port, for the directions of all wired cells from the cell's center. Port 0 points
/// along `axis`, projected to the cell's plane, and the others follow counterclockwise as seen from outside.
pub(super) fn assign_ports(
    normal: &Vector3<f64>,
    axis: &Vector3<f64>,
    others: &[(usize, Vector3<f64>)],
) -> [Option<usize>; PORTS_PER_CELL] {
    let flat = Unit::try_new(axis - normal * axis.dot(normal), 1e-3);
    let (forward, left) =
        flat.map_or_else(|| tangents(normal), |flat| (flat.into_inner(), normal.cross(&flat)));
    let turns: Vec<_> = others.iter().map(|(_, to)| to.dot(&left).atan2(to.dot(&forward))).collect();
    let (_, wires) = best_assignment(&turns, [None; PORTS_PER_CELL], 0);
    wires.map(|wire| others.get(wire?).map(|&(other, _)| other))
}

/// Returns the smallest sum of squared angles between wires and their ports, and the assignment that has it, for this
/// wire and those after it, if some ports are taken.
fn best_assignment(
    turns: &[f64],
    taken: [Option<usize>; PORTS_PER_CELL],
    wire: usize,
) -> (f64, [Option<usize>; PORTS_PER_CELL]) {
    let Some(&turn) = turns.get(wire) else { return (0.0, taken) };
    let mut min = (f64::INFINITY, taken);
    let mut direction = 0.0;
    for port in 0..PORTS_PER_CELL {
        let off = (turn - direction + PI).rem_euclid(TAU) - PI;
        direction += FRAC_PI_2;
        let mut with = taken;
        let Some(slot @ None) = with.get_mut(port) else { continue };
        *slot = Some(wire);
        let (cost, with) = best_assignment(turns, with, wire + 1);
        if cost + off * off < min.0 {
            min = (cost + off * off, with);
        }
    }
    min
}
