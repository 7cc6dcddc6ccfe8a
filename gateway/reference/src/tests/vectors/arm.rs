//! Reproducible arms with a cell on them, and Eq. 8 for them in double precision.

use crate::ReferenceCell;
use nalgebra::{IsometryMatrix3, Point3, Rotation3, Translation3, Unit, Vector3};
use protocol::fixed::{Q, Q1_14, Q3_12, Q5_10};
use protocol::message::SkinSensors;
use protocol::packet::{self, Length, WORDS};
use protocol::parameters::{Contact, MAX_JOINTS, MAX_ROWS, Parameter, Parameters, Pose, Row};

/// A configuration, joint positions and a touch.
#[derive(Clone, Debug)]
pub(crate) struct ArmCase {
    pub(crate) parameters: Parameters,
    pub(crate) q: [Q1_14; MAX_JOINTS],
    contact: [Q5_10; 3],
}

/// A reproducible generator of numbers in [-1, 1) (Knuth's MMIX).
struct Generator(u64);

impl Generator {
    fn real(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        f64::from(u32::try_from(self.0 >> 32).unwrap()) / f64::from(1_u32 << 31) - 1.0
    }

    fn within(&mut self, max: f64) -> Q1_14 {
        Q1_14::nearest(self.real() * max)
    }
}

/// Returns arms of 1 to 6 joints, each with a cell on each of its links.
pub(crate) fn cases() -> impl Iterator<Item = ArmCase> {
    let mut dice = Generator(1);
    let sizes = (1..=6_u8).flat_map(|joints| (1..=joints).map(move |joint| (joint, joints)));
    sizes.map(move |(joint, joints)| {
        let mut rows = [Row::default(); MAX_ROWS];
        for row in rows.iter_mut().take(usize::from(joints)) {
            let (a, d) = (dice.within(0.15), dice.within(0.15));
            *row = Row { a, d, alpha: dice.within(2.0), theta_offset: dice.within(2.0), ..Row::default() };
        }
        let normal = Vector3::from_fn(|_, _| dice.real()).normalize();
        let pose = Pose {
            position: core::array::from_fn(|_| dice.within(0.15)),
            normal: [normal.x, normal.y, normal.z].map(Q1_14::nearest),
        };
        let rule = Contact { alpha_c: Q3_12::nearest(1.0), ..Contact::default() };
        let mut q = [Q1_14::ZERO; MAX_JOINTS];
        q.iter_mut().take(usize::from(joints)).for_each(|q| *q = dice.within(2.0));
        let contact = core::array::from_fn(|_| Q5_10::nearest(1.0 + dice.real()));
        ArmCase {
            parameters: Parameters {
                joint,
                joints,
                pose,
                contact: rule,
                period_us: 16_000,
                rows,
                ..Parameters::default()
            },
            q,
            contact,
        }
    })
}

impl ArmCase {
    /// Returns the parameter words of the rows in use.
    pub(crate) fn rows(&self) -> Vec<[i16; WORDS]> {
        (0..self.parameters.joints).map(|row| self.parameters.words(Parameter::Row(row))).collect()
    }

    /// Returns the values, of one for each joint, that fit into a packet of this chain.
    pub(crate) fn of_chain(&self, all: [i16; MAX_JOINTS]) -> Vec<i16> {
        all[..Length::for_joints(self.parameters.joints.into()).words()].to_vec()
    }

    /// Returns the words of sensors page 0.
    pub(crate) fn sensors(&self) -> [i16; WORDS] {
        packet::padded_words(self.contact.map(Q::to_bits))
    }

    /// Returns the words of the Jacobian and of the torques that the cell computes.
    pub(crate) fn answer(&self) -> ([Q1_14; MAX_JOINTS], [i16; MAX_JOINTS]) {
        let sensors = SkinSensors { contact: self.contact, ..SkinSensors::default() };
        let cell = ReferenceCell::new(&self.parameters);
        (cell.jacobian(&self.q), cell.torque(&self.q, &sensors))
    }

    /// Returns the Jacobian in double precision, rounded once.
    pub(crate) fn exact_jacobian(&self) -> [Q1_14; MAX_JOINTS] {
        let mut real = self.under(1.0).into_iter();
        core::array::from_fn(|_| Q1_14::nearest(real.next().unwrap_or(0.0)))
    }

    /// Returns the torques in Nm: the moments of a force against the normal about each axis below the cell.
    pub(crate) fn real(&self) -> Vec<f64> {
        self.under(self.contact.iter().map(|word| word.to_f64()).sum())
    }

    /// Returns the torques in Nm of a force in N against the normal.
    fn under(&self, force_n: f64) -> Vec<f64> {
        let Pose { position, normal } = self.parameters.pose;
        let turn =
            |axis: Unit<Vector3<f64>>, angle: Q1_14| Rotation3::from_axis_angle(&axis, angle.to_radians());
        let mut frames = vec![IsometryMatrix3::identity()];
        for (row, q) in self.parameters.rows_to_cell().iter().zip(self.q) {
            let about_z = turn(Vector3::z_axis(), row.theta_offset.wrapping_add(q));
            let link = Translation3::new(row.a.to_f64(), 0.0, row.d.to_f64());
            let next = frames.last().unwrap() * about_z * link * turn(Vector3::x_axis(), row.alpha);
            frames.push(next);
        }
        let last = frames.pop().unwrap();
        let at = last * Point3::from(position.map(Q::to_f64));
        let force = last.rotation * Vector3::from(normal.map(Q::to_f64)) * -force_n;
        let torque = |frame: &IsometryMatrix3<f64>| {
            let arm = at - Point3::from(frame.translation.vector);
            (frame.rotation * Vector3::z()).cross(&arm).dot(&force)
        };
        frames.iter().map(torque).collect()
    }
}
