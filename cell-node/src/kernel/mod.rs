//! The cell's kernel: the effect of one newton on the cell on each joint.
//!
//! It computes the paper's Eq. 8 for a cell on the link that joint k moves,
//!
//! ```text
//! J_l = (z_(l-1) x (t_i - t_(l-1))) . f      for l = 1..k,   0 beyond; of a prismatic joint z_(l-1) . f,
//! tau_l = J_l F_z
//! ```
//!
//! where z_(l-1) is the axis of joint l, t_i the cell's position and f the direction of the force. A
//! contact pushes *against* the outward normal, f = -normal: press a cell, and the joint gives way.
//! J is in m, so a newton on the cell makes J_l newton metres in joint l; of a prismatic joint it is a number, and
//! makes newtons.
//!
//! [`Wrench`] carries the contact's force and moment from the cell's link down to the base. J is at most 2 steps of
//! 2^-14 m from the nearest word on a UR5, and on arms of any shape that reach less than 2 m within the 8 steps that every
//! cell of up to 6 rows is allowed; each further row adds one. With the feature `oracle` there is a second kernel, the
//! paper's, `oracle::Projection`, which has 2.5 times the operations and a larger mean error: tests, benchmarks and the
//! paper's experiments compare the two.
//!
//! Any chain of 1 to 14 joints in up to 32 rows of standard Denavit-Hartenberg form will do: revolute, prismatic and
//! fixed ones. Angles are words that wrap, `theta_l = q_l + theta_offset_l`. Twists of whole quarter turns cost no multiplication, other
//! twists four for each vector; lengths that are zero cost nothing. Parameters that
//! [`Parameters::check`] refuses are safe: with a joint k that does not exist, every J is zero.

mod joint;
#[cfg(feature = "oracle")]
pub mod oracle;
mod rounding;
mod scalar;
mod wrench;

pub use scalar::{Number, Operations, Scalar, Steps, Word};
pub use wrench::Wrench;

use protocol::fixed::Q1_14;
use protocol::parameters::{MAX_JOINTS, Parameters, Row};

use crate::sine::FINE;

/// A way to compute the Jacobian of a cell's normal force.
pub trait Kernel<S: Scalar = Q1_14>: Sized {
    /// Prepares what does not depend on the joints: once per configuration, not in the loop.
    ///
    /// Never panics, whatever the words are.
    fn new(parameters: &Parameters) -> Self;

    /// Writes J_l in m, [-2, 2), for the joints l = 1..=k that move the cell, and leaves the others as they are: from
    /// joint positions in quarter turns; of prismatic joints a number, from positions in m.
    ///
    /// Never panics and never wraps: what does not fit is held at the ends of its range. Bounded work.
    fn write_jacobian(&self, joints: &[Q1_14; MAX_JOINTS], jacobian: &mut [S; MAX_JOINTS]);

    /// The same, returned; zero for l > k.
    #[must_use]
    fn jacobian(&self, joints: &[Q1_14; MAX_JOINTS]) -> [S; MAX_JOINTS] {
        let mut jacobian = [S::from_number(S::Number::zero()); MAX_JOINTS];
        self.write_jacobian(joints, &mut jacobian);
        jacobian
    }
}

/// The rows from the base to the cell; none where they have not the joints that are to move it, as in parameters that
/// [`Parameters::check`] refuses.
fn chain(parameters: &Parameters) -> &[Row] {
    let chain = parameters.chain();
    let joints = chain.iter().filter(|row| row.moves()).count();
    if joints == usize::from(parameters.joint) && joints <= MAX_JOINTS { chain } else { &[] }
}

/// A length of the robot's table; none where it is zero, for then it costs nothing.
fn length<N: Number>(word: Q1_14) -> Option<N> {
    (word != Q1_14::ZERO).then(|| N::word(word))
}

/// Where this is called the compiler keeps out of the straight path.
#[cold]
#[inline(always)]
const fn seldom() {}

/// Sine and cosine of a constant angle.
fn settled_turn<N: Number>(angle: Q1_14) -> [N; 2] {
    let [sine, cosine, _] = N::fine_turn(angle);
    [N::settle::<FINE>(sine), N::settle::<FINE>(cosine)]
}

/// How a link's twist alpha turns y and z into each other.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Twist<N> {
    /// Not at all.
    None,
    /// By a quarter turn.
    Ahead,
    /// By half a turn.
    Half,
    /// By a quarter turn the other way.
    Back,
    /// By any other angle.
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
                let [sine, cosine] = settled_turn(alpha);
                Self::Other { sine, cosine }
            }
        }
    }
}
