//! The wrench kernel in assembly, for ARMv6-M processors such as the Cortex-M0.
//!
//! It computes the same words as the Rust code in a bit more than half of the cycles. It is for chains of revolute
//! joints with twists of whole quarter turns, whose numbers cannot leave the range of a word: [`Program::prepare`]
//! translates such a chain into a list of steps. All other chains take the Rust code.
//!
//! A step carries the wrench from joint l to joint l - 1: the turn of joint l, then twist and shift of the row of joint
//! l - 1, after which the moment about z is the element of J. The step has the address of the code that does this. A
//! component that no row further down reads may be computed or left out, whichever takes less code.
#![expect(unsafe_code, reason = "the kernel is a function in assembly")]

use core::arch::global_asm;

use protocol::fixed::Q1_14;
use protocol::parameters::{MAX_JOINTS, RowKind};

use super::{ChainLink, Scalar, Wrench, due};
use crate::contact::MAX_JACOBIAN_STEPS;
use crate::kernel::Twist;

global_asm!(include_str!("cortex_m0.s"), options(raw));

/// Code of the assembly, which only the assembly jumps to.
type Handler = unsafe extern "C" fn();

unsafe extern "C" {
    fn skinbus_wrench(
        program: *const Program,
        positions: *const i16,
        jacobian: *mut i16,
        contact: *const i32,
    );
    // A turn, a twist and a shift.
    fn skinbus_wrench_ahead_d();
    fn skinbus_wrench_back_d();
    fn skinbus_wrench_a();
    fn skinbus_wrench_y_a();
    // A turn; then the twist and the shift of the step.
    fn skinbus_wrench_any();
    fn skinbus_wrench_twist_ahead();
    fn skinbus_wrench_twist_back();
    fn skinbus_wrench_twist_half();
    fn skinbus_wrench_shift_none();
    fn skinbus_wrench_shift_a();
    fn skinbus_wrench_shift_d();
    fn skinbus_wrench_shift_d_a();
    // Joint 1.
    fn skinbus_wrench_last_y();
    fn skinbus_wrench_last_minus_y();
    fn skinbus_wrench_last_z();
    fn skinbus_wrench_last_minus_z();
    fn skinbus_wrench_return();
}

/// The input of the assembly for one chain. The assembly is written for this layout.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Program {
    /// Twice the index of the joint that moves the cell; negative if this chain is left to the Rust code.
    joint: i32,
    /// The steps down to joint 1, and an end mark.
    steps: [Step; MAX_JOINTS],
}

/// The way of the wrench from one joint to the joint below.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
struct Step {
    handler: Handler,
    /// The constant theta_offset of the upper joint.
    offset: Q1_14,
    a: Q1_14,
    d: i32,
    twist: Handler,
    shift: Handler,
}

impl PartialEq for Step {
    fn eq(&self, other: &Self) -> bool {
        let addresses = |step: &Self| [step.handler, step.twist, step.shift].map(|handler| handler as usize);
        (addresses(self), self.offset, self.d, self.a) == (addresses(other), other.offset, other.d, other.a)
    }
}

impl Step {
    const END: Self = {
        let handler = skinbus_wrench_return;
        Self { handler, offset: Q1_14::ZERO, a: Q1_14::ZERO, d: 0, twist: handler, shift: handler }
    };

    /// Creates the step from the joint of one link to the joint of the next. Returns `None` for a next link whose twist
    /// is not a multiple of a quarter turn.
    fn new<N>(link: &ChainLink<N>, next: &ChainLink<N>, is_last: bool) -> Option<Self> {
        let shifts_by_d = next.due & due::NEEDS_SHIFT_BY_D != 0;
        let shifts_by_a = next.due & due::NEEDS_SHIFT_BY_A != 0;
        let shift: Handler = match (shifts_by_d, shifts_by_a) {
            (false, false) => skinbus_wrench_shift_none,
            (false, true) => skinbus_wrench_shift_a,
            (true, false) => skinbus_wrench_shift_d,
            (true, true) => skinbus_wrench_shift_d_a,
        };
        let (twist, last): (Handler, Handler) = match next.twist {
            Twist::None => (shift, skinbus_wrench_last_z),
            Twist::Ahead => (skinbus_wrench_twist_ahead, skinbus_wrench_last_y),
            Twist::Back => (skinbus_wrench_twist_back, skinbus_wrench_last_minus_y),
            Twist::Half => (skinbus_wrench_twist_half, skinbus_wrench_last_minus_z),
            Twist::Other { .. } => return None,
        };
        let reads_force_x = link.due & due::NEEDS_TURNED_FX != 0;
        let handler = match (&next.twist, shifts_by_d, shifts_by_a) {
            (_, _, false) if is_last => last,
            (Twist::Ahead, true, false) => skinbus_wrench_ahead_d,
            (Twist::Back, true, false) => skinbus_wrench_back_d,
            (Twist::None, false, true) if reads_force_x => skinbus_wrench_a,
            (Twist::None, false, true) => skinbus_wrench_y_a,
            _ => skinbus_wrench_any,
        };
        let (offset, a, d) = (link.offset, next.a, i32::from(next.d.to_bits()));
        Some(Self { handler, offset, a, d, twist, shift })
    }
}

impl Program {
    /// A program for chains that are left to the Rust code.
    pub(super) const NONE: Self = Self { joint: -1, steps: [Step::END; MAX_JOINTS] };

    /// Writes the steps for the links from the joint that moves the cell down to joint 1. Returns twice the index of
    /// that joint, or `None` if the assembly cannot compute J for them.
    fn translate<N>(&mut self, links: &[ChainLink<N>]) -> Option<i32> {
        if links.iter().any(|link| link.kind != RowKind::Revolute) {
            return None;
        }
        let last = links.len().checked_sub(1)?;
        *self.steps.get_mut(last)? = Step::END;
        for ((number, to), pair) in self.steps.iter_mut().enumerate().zip(links.windows(2)) {
            let [link, next] = pair else { return None };
            *to = Step::new(link, next, number + 1 == last)?;
        }
        i32::try_from(2 * last).ok()
    }

    /// Returns true if the assembly computes J.
    pub(super) const fn is_prepared(&self) -> bool {
        self.joint >= 0
    }
}

impl<S: Scalar> Wrench<S> {
    /// Leaves this chain to the assembly, if it can compute J for it.
    pub(super) fn prepare_program(&mut self) {
        let is_for_assembly = S::IS_CELL_WORD && self.bound < MAX_JACOBIAN_STEPS;
        let links = self.links.get(..self.rows).filter(|_| is_for_assembly);
        self.program.joint = links.and_then(|links| self.program.translate(links)).unwrap_or(-1);
    }

    /// Writes J. Returns false if this chain is left to the Rust code.
    #[inline(always)]
    pub(super) fn write_jacobian_in_assembly(
        &self,
        joints: &[Q1_14; MAX_JOINTS],
        jacobian: &mut [S; MAX_JOINTS],
    ) -> bool {
        let (program, contact) = (&self.program, &raw const self.contact);
        if program.is_prepared() {
            // SAFETY: a program was prepared only for the cell's word (`Scalar::IS_CELL_WORD`), which has the
            // representation of `i16`, as the joints have, and whose numbers have that of `i32`. The assembly reads the
            // whole contact, the program up to its end mark, and from both arrays the elements of joint 1 up to
            // `program.joint`, which is within them.
            unsafe {
                skinbus_wrench(program, joints.as_ptr().cast(), jacobian.as_mut_ptr().cast(), contact.cast());
            }
        }
        program.is_prepared()
    }
}
