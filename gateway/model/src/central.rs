//! The central computation: every cell's joint torques from joint positions and sensor words, in `f64`
//! and by forward kinematics (paper, Algorithm 1 and Eq. 8). It is the reference that the distributed
//! torques are compared with, and the work that the distributed computation saves.
//!
//! ```text
//!   joint words ─> Central::frames ─> Frames ─┐
//!                                             ├─> Central::torque ─> Nm
//!  sensor words ─> Central::force  ─> F_z ────┘
//! ```
//!
//! [`Central::new`] computes with the quantised parameters, as the cells do: what remains is the error
//! of the cells' arithmetic. [`Central::unquantised`] computes with the numbers of the file: the
//! difference then also holds what rounding poses, lengths and angles to words does.
//!
//! A contact pushes against the outward normal: force = -F_z * normal.

use nalgebra::{IsometryMatrix3, Point3, Rotation3, Translation3, Vector3};
use protocol::fixed::{Q, Q1_14};
use protocol::message::SkinSensors;
use protocol::parameters::{Contact, MAX_JOINTS};
use protocol::skin::Skin;

/// The reference for one skin. Cells are named by their index in [`Skin::cells`].
#[derive(Clone, Debug)]
pub struct Central {
    links: Vec<Link>,
    cells: Vec<Place>,
}

/// One row of the robot's table.
#[derive(Clone, Copy, Debug)]
struct Link {
    /// What does not move: `Tz(d) Tx(a) Rx(alpha)`.
    fixed: IsometryMatrix3<f64>,
    /// Added to the joint's word, as the cells do it.
    offset_word: Q1_14,
    /// Added to the joint's angle in rad.
    offset: f64,
}

/// The pose of a cell in the frame of joint k, and its contact thresholds.
#[derive(Clone, Copy, Debug)]
struct Place {
    joint: usize,
    position: Point3<f64>,
    normal: Vector3<f64>,
    contact: Contact,
}

/// Where all links are, for one set of joint positions: frames 0 (the base) to 6 seen from the base.
/// Those beyond the robot's last joint are the base's.
#[derive(Clone, Copy, Debug)]
pub struct Frames([IsometryMatrix3<f64>; MAX_JOINTS + 1]);

/// The torque of the whole skin.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ReferenceTorque {
    /// The sum of all cells' torques in Nm (paper, Eq. 1).
    pub torque: [f64; MAX_JOINTS],
    /// Cells with a force above zero.
    pub active: u32,
}

impl Central {
    /// The reference on the words that the cells compute with.
    #[must_use]
    pub fn new(skin: &Skin) -> Self {
        let mut links = Vec::with_capacity(MAX_JOINTS);
        let cells = skin.cells.iter().map(|cell| {
            let parameters = skin.parameters(cell);
            if links.is_empty() {
                let rows = parameters.rows.iter().take(skin.robot.joints.len());
                links.extend(rows.map(|row| {
                    let (a, d, alpha) = (row.a.to_f64(), row.d.to_f64(), row.alpha.to_radians());
                    Link::new(a, d, alpha, row.theta_offset, row.theta_offset.to_radians())
                }));
            }
            let pose = parameters.pose;
            Place::new(cell.joint, pose.position.map(Q::to_f64), pose.normal.map(Q::to_f64), cell.contact)
        });
        let cells = cells.collect();
        Self { links, cells }
    }

    /// The reference on the numbers of the skin's file.
    #[must_use]
    pub fn unquantised(skin: &Skin) -> Self {
        let links = skin.robot.joints.iter().map(|row| {
            let word = Q1_14::from_radians(row.theta_offset).unwrap_or_default();
            Link::new(row.a, row.d, row.alpha, word, row.theta_offset)
        });
        let cells =
            skin.cells.iter().map(|cell| Place::new(cell.joint, cell.position, cell.normal, cell.contact));
        Self { links: links.collect(), cells: cells.collect() }
    }

    /// Where all links are when the joints stand as these words say. Bounded work, no allocation.
    #[must_use]
    pub fn frames(&self, joints: &[Q1_14; MAX_JOINTS]) -> Frames {
        self.chain(joints, |link, &word| word.wrapping_add(link.offset_word).to_radians())
    }

    /// Where all links are when the joints stand at these angles in rad. Bounded work, no allocation.
    #[must_use]
    pub fn frames_at(&self, q: &[f64; MAX_JOINTS]) -> Frames {
        self.chain(q, |link, angle| angle + link.offset)
    }

    fn chain<T>(&self, joints: &[T; MAX_JOINTS], theta: impl Fn(&Link, &T) -> f64) -> Frames {
        let mut frames = [IsometryMatrix3::identity(); MAX_JOINTS + 1];
        let mut tip = IsometryMatrix3::identity();
        for ((frame, link), joint) in frames.iter_mut().skip(1).zip(&self.links).zip(joints) {
            tip = tip * Rotation3::from_axis_angle(&Vector3::z_axis(), theta(link, joint)) * link.fixed;
            *frame = tip;
        }
        Frames(frames)
    }

    /// The force F_z in N that a cell computes from its sensor words: Algorithm 1, exactly. Zero means not in
    /// contact, as for a cell that does not exist.
    #[must_use]
    pub fn force(&self, cell: usize, sensors: &SkinSensors) -> f64 {
        self.cells.get(cell).map_or(0.0, |place| force(&place.contact, sensors))
    }

    /// Where a cell is, seen from the base, in m; the base itself for a cell that does not exist.
    #[must_use]
    pub fn position(&self, cell: usize, frames: &Frames) -> [f64; 3] {
        let place = self.cells.get(cell).and_then(|place| Some(frames.0.get(place.joint)? * place.position));
        place.map_or([0.0; 3], |position| position.coords.into())
    }

    /// The joint torques in Nm of one cell with the force `f_z` on it (paper, Eq. 8); zero in joints that do not
    /// move it, and for a cell that does not exist. Bounded work, no allocation.
    #[must_use]
    pub fn torque(&self, cell: usize, frames: &Frames, f_z: f64) -> [f64; MAX_JOINTS] {
        let mut torque = [0.0; MAX_JOINTS];
        if let Some(place) = self.cells.get(cell) {
            frames.add_torque(place, f_z, &mut torque);
        }
        torque
    }

    /// The torque of the whole skin, computed cell by cell; `sensors` are in the order of [`Skin::cells`]. This is the
    /// work of a gateway without computing cells in every tick. It grows with the cells and again with the active
    /// ones; no allocation.
    #[must_use]
    pub fn total(&self, frames: &Frames, sensors: &[SkinSensors]) -> ReferenceTorque {
        let mut reference_torque = ReferenceTorque::default();
        for (place, sensors) in self.cells.iter().zip(sensors) {
            let f_z = force(&place.contact, sensors);
            if f_z > 0.0 {
                frames.add_torque(place, f_z, &mut reference_torque.torque);
                reference_torque.active += 1;
            }
        }
        reference_torque
    }
}

impl Frames {
    /// Adds the torques of a cell at `place` with the force `f_z` on it about joints 1 to k:
    /// `z_(l-1) x (t - t_(l-1)) . force`.
    fn add_torque(&self, place: &Place, f_z: f64, torque: &mut [f64; MAX_JOINTS]) {
        let Some(limb) = self.0.get(place.joint) else { return };
        let position = limb * place.position;
        let force = limb.rotation * place.normal * -f_z;
        for (torque, below) in torque.iter_mut().zip(&self.0).take(place.joint) {
            let axis = below.rotation.matrix().column(2);
            let arm = position.coords - below.translation.vector;
            *torque += axis.cross(&arm).dot(&force);
        }
    }
}

impl Link {
    fn new(a: f64, d: f64, alpha: f64, offset_word: Q1_14, offset: f64) -> Self {
        let twist = Rotation3::from_axis_angle(&Vector3::x_axis(), alpha);
        Self { fixed: Translation3::new(a, 0.0, d) * twist, offset_word, offset }
    }
}

impl Place {
    fn new(joint: u8, position: [f64; 3], normal: [f64; 3], contact: Contact) -> Self {
        Self { joint: joint.into(), position: position.into(), normal: normal.into(), contact }
    }
}

/// Algorithm 1. Every word, sum and product is exact in `f64`.
pub(crate) fn force(contact: &Contact, sensors: &SkinSensors) -> f64 {
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
