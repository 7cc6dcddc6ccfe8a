//! Positions and wiring of the cells on an arm.
//!
//! ```text
//!   a limb, unrolled; numbers run back and forth, so that each cell is wired to the next
//!
//!   ring 2    6 - 7 - 8          ports   0 previous in the ring    2 in the ring before
//!            /   /   /                   1 next in the ring        3 in the ring after
//!   ring 1    5 - 4 - 3
//!              \   \   \         each ring is closed around the limb, and turned by half a cell
//!   ring 0    0 - 1 - 2          against the one before
//! ```

use core::f64::consts::TAU;
use std::collections::VecDeque;

use protocol::skin::DenavitHartenberg;

use super::GenerateError;

/// Distance between the centres of adjacent cells, in mm, as on the published skin.
const CELL_PITCH_MM: usize = 28;
/// The smallest distance in mm that is plausible for hardware.
const MIN_CELL_PITCH_MM: usize = 3;
const PORTS_PER_CELL: usize = 4;

/// An arm that can carry a skin.
#[derive(Debug)]
pub(super) struct ArmShape {
    pub(super) name: &'static str,
    /// Standard Denavit-Hartenberg rows, base to tip.
    pub(super) joints: [DenavitHartenberg; 6],
    /// The upper arm and the forearm, from base to tip.
    pub(super) limbs: [Limb; 2],
}

/// A round limb of an arm. It lies along the x axis of its joint's frame; the origin of that frame is at the limb's far
/// end.
#[derive(Debug)]
pub(super) struct Limb {
    /// Name of the limb.
    pub(super) name: &'static str,
    /// The joint that moves the limb, from 1.
    pub(super) joint: u8,
    /// The middle of the limb, in m: along x, and offset along z.
    middle: [f64; 2],
    /// Length that the skin may cover, in m.
    length: f64,
    /// The minimum distance of a cell from the limb's own axis, in m.
    radius: f64,
}

/// The UR5. Its limbs are offset from the joints' frames: the shoulder is 135.85 mm wide, and the elbow leads back by
/// 119.7 mm; the table has all of this in the d of joint 4. The tubes' radii are 60 and 50 mm, and the cells sit 5 mm
/// above them; the joints' housings stay uncovered.
pub(super) const UR5: ArmShape = ArmShape {
    name: "UR5",
    joints: [
        denavit_hartenberg_row(0.0, core::f64::consts::FRAC_PI_2, 0.089_159),
        denavit_hartenberg_row(-0.425, 0.0, 0.0),
        denavit_hartenberg_row(-0.392_25, 0.0, 0.0),
        denavit_hartenberg_row(0.0, core::f64::consts::FRAC_PI_2, 0.109_15),
        denavit_hartenberg_row(0.0, -core::f64::consts::FRAC_PI_2, 0.094_65),
        denavit_hartenberg_row(0.0, 0.0, 0.082_3),
    ],
    limbs: [
        Limb { name: "upper arm", joint: 2, middle: [0.2125, 0.135_85], length: 0.285, radius: 0.065 },
        Limb { name: "forearm", joint: 3, middle: [0.196_125, 0.016_15], length: 0.245, radius: 0.055 },
    ],
};

const fn denavit_hartenberg_row(a: f64, alpha: f64, d: f64) -> DenavitHartenberg {
    DenavitHartenberg { a, alpha, d, theta_offset: 0.0 }
}

/// An arm with the cells that lie on it.
#[derive(Debug)]
pub(super) struct CoveredArm {
    pub(super) name: &'static str,
    pub(super) joints: [DenavitHartenberg; 6],
    pub(super) pitch_mm: usize,
    /// Name and number of cells of each limb.
    pub(super) limbs: [(&'static str, usize); 2],
    pub(super) buses: Vec<Vec<PlacedCell>>,
}

/// A cell on the arm; its node id is its index on its bus, plus 1.
#[derive(Clone, Debug)]
pub(super) struct PlacedCell {
    pub(super) joint: u8,
    pub(super) position: [f64; 3],
    /// Angle of the cell around the limb in rad, from the z axis to the y axis.
    pub(super) turn: f64,
    /// For each port, the neighbour at it, as an index on the bus.
    pub(super) wires: [Option<usize>; PORTS_PER_CELL],
    pub(super) root: bool,
}

/// Places the cells in rings around the limbs, at the distance of the published skin, or closer if they do not fit.
pub(super) fn place_cells(arm: &ArmShape, cells: usize, buses: usize) -> Result<CoveredArm, GenerateError> {
    let (pitch_mm, shares) = (MIN_CELL_PITCH_MM..=CELL_PITCH_MM)
        .rev()
        .find_map(|pitch_mm| {
            Some((pitch_mm, divide_cells(&arm.limbs, mm_to_metres(pitch_mm), cells, buses)?))
        })
        .ok_or(GenerateError::NoRoom { cells, min_mm: MIN_CELL_PITCH_MM })?;
    let mut on_buses = Vec::with_capacity(buses);
    for (limb, share) in arm.limbs.iter().zip(&shares) {
        let rings = CellRings::for_limb(limb, mm_to_metres(pitch_mm));
        for bus in 0..share.buses {
            let from = bus * share.cells / share.buses;
            on_buses.push(rings.wired_cells(limb, share.cells, from..(bus + 1) * share.cells / share.buses));
        }
    }
    if let (1, [upper, lower]) = (buses, on_buses.as_mut_slice()) {
        join_limbs(upper, lower);
        on_buses.truncate(1);
    }
    on_buses.retain(|places| !places.is_empty());
    on_buses.iter_mut().for_each(|places| choose_root(places));
    let [upper, lower] = &arm.limbs;
    let limbs = [(upper.name, shares[0].cells), (lower.name, shares[1].cells)];
    Ok(CoveredArm { name: arm.name, joints: arm.joints, pitch_mm, limbs, buses: on_buses })
}

/// The number of cells and of buses on one limb.
#[derive(Debug)]
struct LimbShare {
    cells: usize,
    buses: usize,
}

/// Divides the cells by the limbs' capacity. A bus stays on one limb, unless there is only one bus. Returns `None` if
/// the cells do not fit.
fn divide_cells(limbs: &[Limb; 2], pitch: f64, cells: usize, buses: usize) -> Option<[LimbShare; 2]> {
    let [upper, lower] = limbs.each_ref().map(|limb| CellRings::for_limb(limb, pitch).capacity());
    let nearest = |whole: usize, part: usize, of: usize| (2 * whole * part + of) / (2 * of);
    let shares = if buses == 1 {
        let cells_upper = nearest(cells, upper, upper + lower);
        [LimbShare { cells: cells_upper, buses: 1 }, LimbShare { cells: cells - cells_upper, buses: 1 }]
    } else {
        let buses_upper = nearest(buses, upper, upper + lower).clamp(1, buses - 1);
        let cells_upper = nearest(cells, buses_upper, buses);
        [
            LimbShare { cells: cells_upper, buses: buses_upper },
            LimbShare { cells: cells - cells_upper, buses: buses - buses_upper },
        ]
    };
    (shares[0].cells <= upper && shares[1].cells <= lower).then_some(shares)
}

/// The rings of cells that fit around a limb.
#[derive(Clone, Copy, Debug)]
struct CellRings {
    /// Number of cells in a ring, at least 3.
    cells_per_ring: usize,
    /// Number of rings that fit on the limb.
    count: usize,
    pitch: f64,
}

impl CellRings {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "small and positive")]
    fn for_limb(limb: &Limb, pitch: f64) -> Self {
        let around = (TAU * limb.radius / pitch).ceil() as usize;
        let count = (limb.length / Self { cells_per_ring: around, count: 0, pitch }.ring_distance()).floor()
            as usize
            + 1;
        Self { cells_per_ring: around, count, pitch }
    }

    /// Returns the distance between rings, in m.
    fn ring_distance(&self) -> f64 {
        self.pitch * 0.75_f64.sqrt()
    }

    const fn capacity(&self) -> usize {
        self.cells_per_ring * self.count
    }

    /// Returns the ring of a cell and its index in that ring; odd rings are counted backwards.
    const fn ring_and_index(&self, number: usize) -> (usize, usize) {
        let (ring, place) = (number / self.cells_per_ring, number % self.cells_per_ring);
        (ring, if ring % 2 == 0 { place } else { self.cells_per_ring - 1 - place })
    }

    /// Returns the number of the cell at a place, given as ring and index in the ring.
    const fn cell_number(&self, (ring, place): (usize, usize)) -> usize {
        ring * self.cells_per_ring + if ring % 2 == 0 { place } else { self.cells_per_ring - 1 - place }
    }

    /// Returns the cells with these `numbers`, wired to each other; `all` is the number of cells on the limb.
    fn wired_cells(&self, limb: &Limb, all: usize, numbers: core::ops::Range<usize>) -> Vec<PlacedCell> {
        let rings = all.div_ceil(self.cells_per_ring);
        let place = |number| {
            let (ring, place) = self.ring_and_index(number);
            let last = self.cells_per_ring - 1;
            let neighbors = [
                Some((ring, if place == 0 { last } else { place - 1 })),
                Some((ring, if place == last { 0 } else { place + 1 })),
                ring.checked_sub(1).map(|ring| (ring, place)),
                Some((ring + 1, place)),
            ];
            let within = |spot| Some(self.cell_number(spot)).filter(|number| numbers.contains(number));
            let turn = TAU * (count_to_f64(place) + count_to_f64(ring % 2) / 2.0)
                / count_to_f64(self.cells_per_ring);
            let radius = count_to_f64(self.cells_per_ring) * self.pitch / TAU;
            let [x, z] = limb.middle;
            PlacedCell {
                joint: limb.joint,
                position: [
                    x + (count_to_f64(rings - 1) / 2.0 - count_to_f64(ring)) * self.ring_distance(),
                    radius * turn.sin(),
                    z + radius * turn.cos(),
                ],
                turn,
                wires: neighbors.map(|spot| Some(within(spot?)? - numbers.start)),
                root: false,
            }
        };
        numbers.clone().map(place).collect()
    }
}

/// Puts the cells of two limbs on one bus. A cable connects the free port 3 of the last cell with the free port 2 of
/// the first cell of the other limb.
fn join_limbs(upper: &mut Vec<PlacedCell>, lower: &mut Vec<PlacedCell>) {
    let shift = upper.len();
    for wire in lower.iter_mut().flat_map(|place| &mut place.wires).flatten() {
        *wire += shift;
    }
    if let (Some(last), Some(first)) = (upper.last_mut(), lower.first_mut()) {
        (last.wires[3], first.wires[2]) = (Some(shift), Some(shift - 1));
    }
    upper.append(lower);
}

/// Wires the gateway to a central cell of a bus: the first one with the fewest wires to its farthest cell, so that sums
/// have the shortest path.
fn choose_root(places: &mut [PlacedCell]) {
    let nearest = (0..places.len()).min_by_key(|&from| tree_depth_from(places, from));
    if let Some(root) = nearest.and_then(|at| places.get_mut(at)) {
        root.root = true;
    }
}

/// Returns the number of wires from a cell to the farthest cell that it can reach.
pub(super) fn tree_depth_from(places: &[PlacedCell], from: usize) -> usize {
    let mut distance = vec![None; places.len()];
    let mut next = VecDeque::from([(from, 0)]);
    let mut deepest = 0;
    while let Some((at, steps)) = next.pop_front() {
        let (Some(seen), Some(place)) = (distance.get_mut(at), places.get(at)) else { continue };
        if seen.is_none() {
            *seen = Some(steps);
            deepest = steps;
            next.extend(place.wires.iter().flatten().map(|&wire| (wire, steps + 1)));
        }
    }
    deepest
}

fn mm_to_metres(pitch_mm: usize) -> f64 {
    count_to_f64(pitch_mm) / 1e3
}

#[expect(clippy::cast_precision_loss, reason = "counts of cells")]
fn count_to_f64(count: usize) -> f64 {
    count as f64
}
