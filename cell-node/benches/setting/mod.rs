//! The setting of the benches: a cell on the last link of a UR5, with each kernel that computes its Jacobian.

#[path = "../../src/tests/kernel/oracle.rs"]
mod oracle;
mod peer;

use cell_node::kernel::oracle::Projection;
use cell_node::kernel::{Kernel, Wrench};
use protocol::fixed::Q1_14;
use protocol::parameters::MAX_JOINTS;

use oracle::Case;
use peer::NalgebraKernel;

/// The kernels of a cell moved by joint 6, and the joint positions as input.
pub(crate) struct BenchSetting {
    pub(crate) wrench: Wrench,
    pub(crate) projection: Projection,
    pub(crate) double: NalgebraKernel<f64>,
    pub(crate) single: NalgebraKernel<f32>,
    /// Joint positions in quarter turns.
    pub(crate) words: [Q1_14; MAX_JOINTS],
    /// Joint positions in rad.
    pub(crate) radians: [f64; MAX_JOINTS],
    /// Joint positions in rad, in single precision.
    pub(crate) radians_f32: [f32; MAX_JOINTS],
}

impl BenchSetting {
    /// Creates the setting from the first test vector whose cell is on joint 6.
    pub(crate) fn new() -> Self {
        let case = Case::all().into_iter().find(|case| case.joint == 6).expect("there are some");
        let parameters = case.parameters();
        let words = case.words();
        let radians = words.map(Q1_14::to_radians);
        #[expect(clippy::cast_possible_truncation, reason = "the nearest number")]
        let radians_f32 = radians.map(|angle| angle as f32);
        Self {
            wrench: Wrench::new(&parameters),
            projection: Projection::new(&parameters),
            double: NalgebraKernel::new(&parameters),
            single: NalgebraKernel::new(&parameters),
            words,
            radians,
            radians_f32,
        }
    }

    /// Checks that all kernels compute the same Jacobian.
    ///
    /// # Panics
    /// Panics if a kernel differs by more than 5e-4 m from double precision, or the f32 kernel by more than 1e-6 m.
    pub(crate) fn check(&self) {
        let target = self.double.jacobian(&self.radians);
        let wrench = self.wrench.jacobian(&self.words).map(Q1_14::to_f64);
        let projection = self.projection.jacobian(&self.words).map(Q1_14::to_f64);
        let single = self.single.jacobian(&self.radians_f32).map(f64::from);
        for (name, got, most) in
            [("wrench", wrench, 5e-4), ("projection", projection, 5e-4), ("nalgebra, f32", single, 1e-6)]
        {
            let near = got.iter().zip(&target).all(|(got, target)| (got - target).abs() < most);
            assert!(near && target.iter().any(|j| j.abs() > 0.05), "{name}: {got:?}, not {target:?}");
        }
    }
}
