//! The central computation: the joint torques of every cell from joint positions and sensor words, in `f64` and by
//! forward kinematics (paper, Algorithm 1 and Eq. 8). The errors of the torques that cells compute are measured against
//! it, and its running time is the time that the distributed computation saves the gateway.
//!
//! ```text
//!   joint words ─> CentralComputation::link_frames ───> LinkFrames ─┐
//!                                                                   ├─> CentralComputation::cell_torque ─> Nm
//!  sensor words ─> CentralComputation::contact_force ─> F_z ────────┘
//! ```
//!
//! [`CentralComputation::new`] computes with the quantised parameters, as the cells do, so that a difference is the
//! error of the cells' arithmetic. [`CentralComputation::without_quantisation`] computes with the numbers of the file:
//! the difference then includes the rounding of poses, lengths and angles to words.
//!
//! A contact pushes against the outward normal: force = -F_z * normal.

use nalgebra::{IsometryMatrix3, Matrix4, Point3, Rotation3, Translation3, Vector3};
use protocol::fixed::{Q, Q1_14};
use protocol::message::SkinSensors;
use protocol::parameters::{Contact, MAX_JOINTS, MAX_ROWS, Parameters, Row, RowKind};
use protocol::skin::{Cell, Chain, ChainBase, Skin};

/// The central computation for the cells of one chain. Cells are named by their index in [`Skin::cells`].
#[derive(Clone, Debug)]
pub struct CentralComputation {
    /// Pose of frame 0 in the robot's base frame.
    base: IsometryMatrix3<f64>,
    links: Vec<ChainLink>,
    cells: Vec<CellGeometry>,
}

/// One row of the chain's table.
#[derive(Clone, Copy, Debug)]
struct ChainLink {
    kind: RowKind,
    /// The part of the transform that does not depend on the joint: `Tz(d) Tx(a) Rx(alpha)`.
    fixed: IsometryMatrix3<f64>,
    /// Angle added to the joint's word, in the cells' arithmetic.
    offset_word: Q1_14,
    /// Angle added to the joint's angle, in rad.
    offset: f64,
}

/// The pose of a cell in the frame of the row that carries it, and its contact thresholds.
#[derive(Clone, Copy, Debug)]
struct CellGeometry {
    row: usize,
    position: Point3<f64>,
    normal: Vector3<f64>,
    contact: Contact,
}

/// Poses of all links for one set of joint positions: frame 0 (the base), then one frame per row, all in the robot's
/// base frame.
#[derive(Clone, Debug)]
pub struct LinkFrames {
    frames: [IsometryMatrix3<f64>; MAX_ROWS + 1],
    kinds: [RowKind; MAX_ROWS],
}

/// The reference for the summed torque of a whole skin, computed centrally.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ReferenceTorque {
    /// The sum of all cells' torques in Nm or N, by joint of the chain (paper, Eq. 1).
    pub torque: [f64; MAX_JOINTS],
    /// Number of cells with a force above zero.
    pub active: u32,
}

impl CentralComputation {
    /// Builds the reference from the quantised words that the cells compute with. All cells of the skin must sit on one
    /// chain; for a skin with several buses, pass [`Skin::with_cells_of_bus`] of one bus.
    #[must_use]
    pub fn new(skin: &Skin) -> Self {
        let mut links = Vec::new();
        let cells = skin.cells.iter().map(|cell| {
            let parameters = skin.parameters(cell);
            if links.is_empty() {
                links.extend(parameters.all_rows().iter().map(ChainLink::from_row));
            }
            let pose = parameters.pose;
            CellGeometry::new(cell, pose.position.map(Q::to_f64), pose.normal.map(Q::to_f64))
        });
        let cells = cells.collect();
        Self { base: base_pose(skin), links, cells }
    }

    /// Builds the reference from the unrounded numbers of the skin's file. All cells must sit on one chain, as in
    /// [`Self::new`].
    #[must_use]
    pub fn without_quantisation(skin: &Skin) -> Self {
        let rows = |chain: &Chain| {
            let link = |row: &protocol::skin::ChainRow| {
                let table = row.table;
                let word = Q1_14::from_radians(table.theta_offset).unwrap_or_default();
                ChainLink::new(row.kind, table.a, table.d, table.alpha, word, table.theta_offset)
            };
            chain.rows.iter().map(link).collect()
        };
        let cells = skin.cells.iter().map(|cell| CellGeometry::new(cell, cell.position, cell.normal));
        let links = skin.cells.first().map_or_else(Vec::new, |cell| rows(skin.chain(cell.bus)));
        Self { base: base_pose(skin), links, cells: cells.collect() }
    }

    /// Builds the reference for a single cell (index 0) with these parameters, in frame 0 of its chain.
    #[must_use]
    pub fn for_single_cell(parameters: &Parameters) -> Self {
        let Parameters { pose, contact, .. } = *parameters;
        let position = pose.position.map(Q::to_f64).into();
        let normal = pose.normal.map(Q::to_f64).into();
        let place = CellGeometry { row: parameters.rows_to_cell().len(), position, normal, contact };
        let links = parameters.all_rows().iter().map(ChainLink::from_row).collect();
        Self { base: IsometryMatrix3::identity(), links, cells: vec![place] }
    }

    /// Returns the poses of all links for these joint words. Bounded work, no allocation.
    #[must_use]
    pub fn link_frames(&self, joints: &[Q1_14]) -> LinkFrames {
        self.chain_frames(joints, |link, word| match (link.kind, word) {
            (RowKind::Revolute, Some(word)) => (word.wrapping_add(link.offset_word).to_radians(), 0.0),
            (RowKind::Prismatic, Some(word)) => (link.offset_word.to_radians(), word.to_f64()),
            (RowKind::Fixed, _) | (_, None) => (link.offset_word.to_radians(), 0.0),
        })
    }

    /// Returns the poses of all links for these joint positions, in rad or m. Bounded work, no allocation.
    #[must_use]
    pub fn frames_at_positions(&self, q: &[f64]) -> LinkFrames {
        self.chain_frames(q, |link, q| match (link.kind, q) {
            (RowKind::Revolute, Some(angle)) => (angle + link.offset, 0.0),
            (RowKind::Prismatic, Some(slide)) => (link.offset, *slide),
            (RowKind::Fixed, _) | (_, None) => (link.offset, 0.0),
        })
    }

    /// Converts joint words to joint positions, in rad or m.
    #[must_use]
    pub fn joint_positions(&self, joints: &[Q1_14]) -> [f64; MAX_JOINTS] {
        let mut positions = [0.0; MAX_JOINTS];
        let moving = self.links.iter().filter(|link| link.kind != RowKind::Fixed);
        for ((position, link), word) in positions.iter_mut().zip(moving).zip(joints) {
            *position = if link.kind == RowKind::Prismatic { word.to_f64() } else { word.to_radians() };
        }
        positions
    }

    /// Multiplies the transforms of the rows, base to tip. `place` returns the joint angle in rad and the displacement
    /// in m of a row.
    fn chain_frames<T>(
        &self,
        joints: &[T],
        place: impl Fn(&ChainLink, Option<&T>) -> (f64, f64),
    ) -> LinkFrames {
        let mut tip = self.base;
        let mut frames = LinkFrames { frames: [tip; MAX_ROWS + 1], kinds: [RowKind::Fixed; MAX_ROWS] };
        let mut joints = joints.iter();
        let each = frames.frames.iter_mut().skip(1).zip(&mut frames.kinds);
        for ((frame, kind), link) in each.zip(&self.links) {
            let joint = if link.kind == RowKind::Fixed { None } else { joints.next() };
            let (theta, slide) = place(link, joint);
            if link.kind == RowKind::Prismatic {
                tip *= Translation3::new(0.0, 0.0, slide);
            }
            tip = tip * Rotation3::from_axis_angle(&Vector3::z_axis(), theta) * link.fixed;
            (*frame, *kind) = (tip, link.kind);
        }
        frames
    }

    /// Returns the force F_z in N that a cell computes from its sensor words, exactly by Algorithm 1. Returns zero
    /// without contact and for an unknown cell.
    #[must_use]
    pub fn cell_force(&self, cell: usize, sensors: &SkinSensors) -> f64 {
        self.cells.get(cell).map_or(0.0, |place| contact_force(&place.contact, sensors))
    }

    /// Returns the position of a cell in the base frame, in m; zero for an unknown cell.
    #[must_use]
    pub fn cell_position(&self, cell: usize, frames: &LinkFrames) -> [f64; 3] {
        let place =
            self.cells.get(cell).and_then(|place| Some(frames.frames.get(place.row)? * place.position));
        place.map_or([0.0; 3], |position| position.coords.into())
    }

    /// Returns the joint torques in Nm (forces in N for prismatic joints) of one cell with the force `f_z` on it
    /// (paper, Eq. 8). Joints that do not move the cell get zero, as does an unknown cell. Bounded work, no allocation.
    #[must_use]
    pub fn cell_torque(&self, cell: usize, frames: &LinkFrames, f_z: f64) -> [f64; MAX_JOINTS] {
        let mut torque = [0.0; MAX_JOINTS];
        if let Some(place) = self.cells.get(cell) {
            frames.add_torque(place, f_z, &mut torque);
        }
        torque
    }

    /// Returns the torque of the whole skin, summed cell by cell; `sensors` are in the order of [`Skin::cells`]. A
    /// gateway whose cells do not compute torques must do this work in every tick. The work grows with the number of
    /// cells and with the number of active ones. No allocation.
    #[must_use]
    pub fn total_torque(&self, frames: &LinkFrames, sensors: &[SkinSensors]) -> ReferenceTorque {
        let mut reference_torque = ReferenceTorque::default();
        for (place, sensors) in self.cells.iter().zip(sensors) {
            let f_z = contact_force(&place.contact, sensors);
            if f_z > 0.0 {
                frames.add_torque(place, f_z, &mut reference_torque.torque);
                reference_torque.active += 1;
            }
        }
        reference_torque
    }
}

/// Returns the pose of frame 0 of the cells' chain in the robot's base frame.
fn base_pose(skin: &Skin) -> IsometryMatrix3<f64> {
    let base = skin.cells.first().map_or_else(ChainBase::default, |cell| skin.chain(cell.bus).base);
    let turn = Matrix4::from(base.transform_matrix()).fixed_view::<3, 3>(0, 0).into_owned();
    Translation3::from(base.position) * Rotation3::from_matrix_unchecked(turn)
}

impl LinkFrames {
    /// Returns the frame of a row, counted from 1, in the robot's base frame; row 0 is frame 0 of the chain.
    #[must_use]
    pub fn row_frame(&self, row: usize) -> Option<&IsometryMatrix3<f64>> {
        self.frames.get(row)
    }

    /// Adds the torques about joints 1 to k of a cell at `place` with the force `f_z` on it:
    /// `z_(l-1) x (t - t_(l-1)) . force`, for prismatic joints `z_(l-1) . force`.
    fn add_torque(&self, place: &CellGeometry, f_z: f64, torque: &mut [f64; MAX_JOINTS]) {
        let Some(limb) = self.frames.get(place.row) else { return };
        let position = limb * place.position;
        let force = limb.rotation * place.normal * -f_z;
        let rows = self.kinds.iter().zip(&self.frames).take(place.row);
        let moving = rows.filter(|(kind, _)| **kind != RowKind::Fixed);
        for (torque, (kind, below)) in torque.iter_mut().zip(moving) {
            let axis = below.rotation.matrix().column(2);
            *torque += if *kind == RowKind::Prismatic {
                axis.dot(&force)
            } else {
                axis.cross(&(position.coords - below.translation.vector)).dot(&force)
            };
        }
    }
}

impl ChainLink {
    fn from_row(row: &Row) -> Self {
        let (a, d, alpha) = (row.a.to_f64(), row.d.to_f64(), row.alpha.to_radians());
        Self::new(row.kind, a, d, alpha, row.theta_offset, row.theta_offset.to_radians())
    }

    fn new(kind: RowKind, a: f64, d: f64, alpha: f64, offset_word: Q1_14, offset: f64) -> Self {
        let twist = Rotation3::from_axis_angle(&Vector3::x_axis(), alpha);
        Self { kind, fixed: Translation3::new(a, 0.0, d) * twist, offset_word, offset }
    }
}

impl CellGeometry {
    fn new(cell: &Cell, position: [f64; 3], normal: [f64; 3]) -> Self {
        let Cell { row, contact, .. } = *cell;
        Self { row: row.into(), position: position.into(), normal: normal.into(), contact }
    }
}

/// Returns the force F_z in N by Algorithm 1 of the paper. Every word, sum and product is exact in `f64`.
pub(crate) fn contact_force(contact: &Contact, sensors: &SkinSensors) -> f64 {
    let above = |value: f64, threshold: f64| if value < threshold { 0.0 } else { value };
    let touch = sensors.contact.iter().map(|word| word.to_f64()).sum();
    let touch = above(touch, contact.contact_threshold.to_f64());
    let near = above(sensors.proximity.to_f64(), contact.proximity_threshold.to_f64());
    let fused = contact.alpha_c.to_f64() * touch + contact.alpha_p.to_f64() * near;
    above(fused, contact.force_threshold.to_f64())
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "words, their sums and their products are exact in f64")]
mod tests;
