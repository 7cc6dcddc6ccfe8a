//! The kernel of a cell: it computes the torque that a force of one newton on the cell causes in each joint.
//!
//! It computes the paper's Eq. 8 for a cell on the link that joint k moves,
//!
//! ```text
//! J_l = (z_(l-1) x (t_i - t_(l-1))) . f      for l = 1..k,   0 beyond; of a prismatic joint z_(l-1) . f,
//! tau_l = J_l F_z
//! ```
//!
//! where z_(l-1) is the axis of joint l, t_i the cell's position and f the direction of the force. A contact
//! pushes *against* the outward normal, f = -normal: press a cell, and the joint yields. For revolute joints
//! J_l is in m: a force of one newton on the cell causes a torque of J_l newton metres. For prismatic joints
//! J_l is dimensionless, and the effect is a force in newtons.
//!
//! [`Wrench`] carries the contact's force and moment from the cell's link down to the base. On a UR5, its J
//! is at most 2 steps of 2^-14 m from the nearest word. On arms of any shape that reach less than 2 m it
//! stays within the 8 steps that every cell of up to 6 rows is allowed; each further row adds one. The
//! feature `oracle` adds a second kernel, the paper's `oracle::Projection`, which takes 2.5 times the
//! operations and has a larger mean error: tests, benchmarks and the paper's experiments compare the two.
//!
//! The kernels support any chain of 1 to 14 joints in up to 32 rows of standard Denavit-Hartenberg form:
//! revolute, prismatic and fixed. Angles are words that wrap, `theta_l = q_l + theta_offset_l`. Twists of
//! whole quarter turns need no multiplication, other twists four per vector; lengths of zero cost nothing.
//! Parameters that [`Parameters::check`] refuses are safe: for a joint k that does not exist, every J is
//! zero.

mod joint;
#[cfg(feature = "oracle")]
pub mod oracle;
mod rounding;
mod scalar;
mod wrench;

pub use scalar::{FixedPoint, Number, Operations, Scalar, Word};
pub use wrench::Wrench;

use protocol::fixed::Q1_14;
use protocol::parameters::{MAX_JOINTS, Parameters, Row};

use crate::sine::PRECISE_SINE_FRACTION_BITS;

/// A method to compute the Jacobian J of the contact force on a cell.
pub trait Kernel<S: Scalar = Q1_14>: Sized {
    /// Computes everything that does not depend on the joint positions, once per configuration.
    ///
    /// Never panics, whatever the words of the parameters are.
    fn new(parameters: &Parameters) -> Self;

    /// Writes J_l for the joints l = 1..=k that move the cell, and leaves the other elements unchanged. `joints` are
    /// positions in quarter turns, or in m for prismatic joints. J_l is in m and in the range [-2, 2); for prismatic
    /// joints it is dimensionless.
    ///
    /// Never panics and never wraps: out-of-range values saturate. The work is bounded.
    fn write_jacobian(&self, joints: &[Q1_14; MAX_JOINTS], jacobian: &mut [S; MAX_JOINTS]);

    /// Returns J_l for all joints l. It is zero for the joints after joint k, which do not move the cell.
    #[must_use]
    fn jacobian(&self, joints: &[Q1_14; MAX_JOINTS]) -> [S; MAX_JOINTS] {
        let mut jacobian = [S::from_number(S::Number::zero()); MAX_JOINTS];
        self.write_jacobian(joints, &mut jacobian);
        jacobian
    }
}

/// Returns the rows from the base to the cell. Returns no rows if the number of rows with a joint is inconsistent, as
/// in parameters that [`Parameters::check`] rejects.
fn checked_chain_rows(parameters: &Parameters) -> &[Row] {
    let chain = parameters.rows_to_cell();
    let joints = chain.iter().filter(|row| row.has_joint()).count();
    if joints == usize::from(parameters.joint) && joints <= MAX_JOINTS { chain } else { &[] }
}

/// Returns a length of the robot's table; `None` for zero, for which the multiplications are omitted.
fn nonzero_length<N: Number>(word: Q1_14) -> Option<N> {
    (word != Q1_14::ZERO).then(|| N::from_word(word))
}

/// Marks a branch as unlikely, so that the compiler keeps it out of the main path.
#[cold]
#[inline(always)]
const fn cold_path() {}

/// Returns sine and cosine of a constant angle.
fn constant_sine_cosine<N: Number>(angle: Q1_14) -> [N; 2] {
    let [sine, cosine, _] = N::unrounded_sine_cosine_one(angle);
    [
        N::round_constant::<PRECISE_SINE_FRACTION_BITS>(sine),
        N::round_constant::<PRECISE_SINE_FRACTION_BITS>(cosine),
    ]
}

/// The rotation of the y and z axes by the twist alpha of a link, by the operations that it needs.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Twist<N> {
    /// No rotation.
    None,
    /// A rotation by a quarter turn.
    Ahead,
    /// A rotation by half a turn.
    Half,
    /// A rotation by a quarter turn backwards.
    Back,
    /// A rotation by any other angle.
    Other { sine: N, cosine: N },
}

impl<N: Number> Twist<N> {
    fn new(alpha: Q1_14) -> Self {
        match alpha.to_bits() {
            0 => Self::None,
            0x4000 => Self::Ahead,
            i16::MIN => Self::Half,
            -0x4000 => Self::Back,
            _ => {
                let [sine, cosine] = constant_sine_cosine(alpha);
                Self::Other { sine, cosine }
            }
        }
    }
}
