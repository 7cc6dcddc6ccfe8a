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

use super::{ChainLink, PerComponent, Scalar, Wrench, due};
use crate::contact::MAX_JACOBIAN_STEPS;
use crate::kernel::Twist;

global_asm!(include_str!("cortex_m0.s"), options(raw));

/// Code of the assembly, which only the assembly jumps to.
type Handler = unsafe extern "C" fn();

unsafe extern "C" {
    fn skinbus_wrench(program: *const Program, positions: *const i16, jacobian: *mut i16);
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

/// What the assembly reads. The assembly knows this layout.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Program {
    /// Force x and y, moment x, y and z, force z of the contact.
    contact: [i32; 6],
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
    /// The constant theta_offset of the upper joint, as an unsigned word.
    offset: u32,
    d: i32,
    a: i32,
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
        Self { handler, offset: 0, d: 0, a: 0, twist: handler, shift: handler }
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
        let offset = u32::from(link.offset.to_bits().cast_unsigned());
        let [d, a] = [next.d, next.a].map(|length| i32::from(length.to_bits()));
        Some(Self { handler, offset, d, a, twist, shift })
    }
}

impl Program {
    /// A program for chains that are left to the Rust code.
    pub(super) const NONE: Self = Self { contact: [0; 6], joint: -1, steps: [Step::END; MAX_JOINTS] };

    /// Prepares the program for a contact and the links from the joint that moves the cell down to joint 1, if the
    /// assembly can compute J for them.
    pub(super) fn prepare<S: Scalar>(
        &mut self,
        contact: &PerComponent<S::Number>,
        links: &[ChainLink<S::Number>],
    ) {
        self.joint = self.translate::<S>(contact, links).unwrap_or(-1);
    }

    /// Writes contact and steps. Returns twice the index of the joint that moves the cell.
    fn translate<S: Scalar>(
        &mut self,
        contact: &PerComponent<S::Number>,
        links: &[ChainLink<S::Number>],
    ) -> Option<i32> {
        let PerComponent { force: [fx, fy, fz], moment: [mx, my, mz] } = *contact;
        for (to, number) in self.contact.iter_mut().zip([fx, fy, mx, my, mz, fz]) {
            *to = i32::from(S::cell_word(number)?.to_bits());
        }
        if links.len() > MAX_JOINTS || links.iter().any(|link| link.kind != RowKind::Revolute) {
            return None;
        }
        let last = links.len().checked_sub(1)?;
        for ((number, to), pair) in self.steps.iter_mut().enumerate().zip(links.windows(2)) {
            let [link, next] = pair else { return None };
            *to = Step::new(link, next, number + 1 == last)?;
        }
        *self.steps.get_mut(last)? = Step::END;
        i32::try_from(2 * last).ok()
    }

    /// Returns true if the assembly computes J.
    #[cfg(feature = "oracle")]
    pub(super) const fn is_prepared(&self) -> bool {
        self.joint >= 0
    }

    /// Writes J. Returns false if this chain is left to the Rust code.
    #[inline(always)]
    pub(super) fn write_jacobian<S: Scalar>(
        &self,
        joints: &[Q1_14; MAX_JOINTS],
        jacobian: &mut [S; MAX_JOINTS],
    ) -> bool {
        if self.joint < 0 {
            return false;
        }
        // SAFETY: a program was prepared only if `S` is the cell's word (`Scalar::cell_word`), which has the
        // representation of `i16`, as the joints have. The assembly reads the program up to its end mark, and from both
        // arrays the elements of joint 1 up to `self.joint`, which is within them.
        unsafe { skinbus_wrench(self, joints.as_ptr().cast(), jacobian.as_mut_ptr().cast()) };
        true
    }
}

impl<S: Scalar> Wrench<S> {
    /// Leaves this chain to the assembly, if it can compute J for it.
    pub(super) fn prepare_program(&mut self) {
        let is_bounded = self.bound < MAX_JACOBIAN_STEPS;
        let links = self.links.get(..self.rows).filter(|_| is_bounded).unwrap_or_default();
        self.program.prepare::<S>(&self.contact, links);
    }
}
