//! The wrench kernel: it carries the force and the moment of the contact from the cell down to the base.
//!
//! Eq. 8 is a scalar triple product, and a contact on a link is a constant wrench in that link's frame: the
//! force f and its moment m = t x f about the frame's origin. From frame l to frame l-1, whose transform is
//! `Rz(theta_l) Tz(d_l) Tx(a_l) Rx(alpha_l)`, the wrench is transformed in three steps:
//!
//! ```text
//! twist   f, m by Rx(alpha_l)
//! shift   m_x -= d f_y     m_y += d f_x - a f_z     m_z += a f_y
//!         J_l = m_z, of a prismatic joint f_z
//! turn    f, m by Rz(theta_l)
//! ```
//!
//! A prismatic joint adds its position to d, a revolute joint to theta; a fixed row has neither. The turn
//! does not change m_z and f_z, so J_l can be read before it, and the base's own angle theta_1 is never
//! needed. Twist and shift of the row that carries the cell are constant, except for the position of a
//! prismatic joint, as are fixed rows right below it: they are folded into the six stored words. Components
//! that no row further down reads are not computed: [`UsedComponents`] tracks them, once per configuration.

#[cfg(armv6m)]
mod cortex_m0;
mod due;
mod fold;
mod range;
mod turn;
mod variant;

use protocol::fixed::{Q1_14, TorqueFormat};
use protocol::parameters::{MAX_JOINTS, MAX_ROWS, Parameters, Row, RowKind};
#[cfg(feature = "earlier-sine")]
use protocol::sine::SineMethod;

use self::fold::constant_wrench;
use self::range::moment_bound;
#[cfg(feature = "earlier-sine")]
use self::turn::SeventhOrderSine;
use self::turn::{CellSine, Rotation, SineFunction};
use super::joint::Joint;
use super::rounding::{NonSaturatingRounding, Rounding, SaturatingRounding};
use super::{
    Kernel, Number, Scalar, Twist, checked_chain_rows, cold_path, constant_sine_cosine, nonzero_length,
};
use crate::contact::{MAX_JACOBIAN_STEPS, TorqueRounding};

/// The wrench kernel of one cell.
///
/// For a UR5 and a cell on its last link: 40 multiplications, 24 additions or subtractions, 5 sines and 5
/// cosines. Over 300 poses of a UR5 the mean torque error is 1.2e-4 Nm and the maximum 1.5e-3 Nm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wrench<S: Scalar = Q1_14> {
    /// Number of the joint that moves the cell; 0 if there is none.
    joint: usize,
    /// Force and moment of the contact in the frame below the row of joint k, before the turn of that joint.
    contact: PerComponent<S::Number>,
    /// The links from joint k's row down to the base. Only the first `rows` are in use.
    links: [ChainLink<S::Number>; MAX_ROWS],
    rows: usize,
    /// Upper bound of |J| in steps of 2^-14, for any joint positions. If it is below [`MAX_JACOBIAN_STEPS`], no
    /// intermediate number can leave the range of a word, and saturation is omitted.
    bound: u16,
    /// The conversion of the torques for this J to words.
    rounding: TorqueRounding,
    #[cfg(armv6m)]
    program: cortex_m0::Program,
    #[cfg(feature = "earlier-sine")]
    sine: SineMethod,
}

/// A force of one newton and its moment in m (Nm per N), or one property of each of their components.
// Assembly reads it.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq)]
struct PerComponent<T> {
    force: [T; 3],
    moment: [T; 3],
}

/// For each component of a wrench, true if it is used.
type UsedComponents = PerComponent<bool>;

impl UsedComponents {
    const NONE_USED: Self = Self { force: [false; 3], moment: [false; 3] };
    const ALL_USED: Self = Self { force: [true; 3], moment: [true; 3] };

    /// Applies a function to the components of the force and to those of the moment.
    fn map_vectors(self, before: impl Fn([bool; 3]) -> [bool; 3]) -> Self {
        Self { force: before(self.force), moment: before(self.moment) }
    }
}

/// The computation that carries a wrench from the frame of a row to the frame below.
// In this order, the fields that are read first are in reach of a short instruction of a Cortex-M0.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq)]
struct ChainLink<N> {
    /// The values to compute for this row: bits of [`due`].
    due: u32,
    /// The joint of the row; for a fixed row, the next joint above it.
    joint: Joint,
    kind: RowKind,
    a: Q1_14,
    /// The offset d, without the position of a prismatic joint.
    d: Q1_14,
    /// The constant theta_offset of the row.
    offset: Q1_14,
    twist: Twist<N>,
    /// Sine and cosine of theta_offset, if the row has no revolute joint; `None` for an offset of zero.
    constant: Option<[N; 2]>,
}

impl<S: Scalar> Wrench<S> {
    /// Returns an upper bound of |J| in steps of 2^-14, for any joint positions; [`MAX_JACOBIAN_STEPS`] if it is
    /// unknown.
    #[must_use]
    pub const fn jacobian_bound(&self) -> u16 {
        self.bound
    }

    /// Returns the conversion of torques of J to words, in the format of the parameters.
    #[must_use]
    pub const fn rounding(&self) -> &TorqueRounding {
        &self.rounding
    }

    /// Returns a kernel without a cell, for which every J is zero.
    pub(crate) fn empty() -> Self {
        Self {
            joint: 0,
            contact: PerComponent { force: [S::Number::zero(); 3], moment: [S::Number::zero(); 3] },
            links: const { [ChainLink::UNUSED_LINK; MAX_ROWS] },
            rows: 0,
            bound: MAX_JACOBIAN_STEPS,
            rounding: TorqueRounding::new(TorqueFormat::default(), MAX_JACOBIAN_STEPS),
            #[cfg(armv6m)]
            program: cortex_m0::Program::NONE,
            #[cfg(feature = "earlier-sine")]
            sine: SineMethod::default(),
        }
    }

    /// Prepares the kernel for these parameters. This is done in place, because a kernel is too large for a small
    /// stack.
    pub(crate) fn prepare(&mut self, parameters: &Parameters) {
        let chain = checked_chain_rows(parameters);
        let mut read = UsedComponents::NONE_USED; // by the rows further down: nothing below joint 1
        let mut joints = Joint::ALL.into_iter().peekable();
        for (index, link) in self.links.iter_mut().enumerate() {
            let row = chain.get(index).copied().unwrap_or_default();
            (*link, read) = ChainLink::new(&row, read);
            let joint = if row.has_joint() { joints.next() } else { joints.peek().copied() };
            link.joint = joint.unwrap_or(Joint::J14);
        }
        let nothing = PerComponent { force: [S::Number::zero(); 3], moment: [S::Number::zero(); 3] };
        let mut contact = chain.last().map_or(nothing, |last| constant_wrench(&parameters.pose, last));
        // Fold fixed rows between the cell and the joint that moves it.
        let mut rows = chain.len();
        let is_fixed = |row: Option<&Row>| row.is_some_and(|row| row.kind == RowKind::Fixed);
        while is_fixed(rows.checked_sub(1).and_then(|last| chain.get(last))) {
            let above: ChainLink<S::Number> =
                ChainLink::new(&chain.get(rows - 1).copied().unwrap_or_default(), UsedComponents::ALL_USED).0;
            rows -= 1;
            above.turn_by_offset(&mut contact);
            if let Some(row) = rows.checked_sub(1).and_then(|last| chain.get(last)) {
                // Without the position of a prismatic joint.
                let link = ChainLink::new(row, UsedComponents::ALL_USED).0;
                link.twist_and_shift::<SaturatingRounding>(&mut contact, nonzero_length(row.d));
            }
        }
        self.links.get_mut(..rows).unwrap_or_default().reverse();
        let slides = chain.iter().any(|row| row.kind == RowKind::Prismatic);
        let below = chain.get(..rows.saturating_sub(1)).unwrap_or_default();
        self.bound = if slides { None } else { moment_bound(&contact, below) }.unwrap_or(MAX_JACOBIAN_STEPS);
        self.rounding = TorqueRounding::new(parameters.torque_format, self.bound);
        self.joint = if rows == 0 { 0 } else { parameters.joint.into() };
        (self.contact, self.rows) = (contact, rows);
        #[cfg(armv6m)]
        self.prepare_program();
    }
}

impl<S: Scalar> Kernel<S> for Wrench<S> {
    fn new(parameters: &Parameters) -> Self {
        let mut kernel = Self::empty();
        kernel.prepare(parameters);
        kernel
    }

    #[inline(always)]
    fn write_jacobian(&self, joints: &[Q1_14; MAX_JOINTS], jacobian: &mut [S; MAX_JOINTS]) {
        #[cfg(armv6m)]
        if self.write_jacobian_in_assembly(joints, jacobian) {
            return;
        }
        self.write_jacobian_in_rust(joints, jacobian);
    }
}

impl<S: Scalar> Wrench<S> {
    // Where assembly does the work, the registers that this code needs are not to be saved for it.
    #[cfg_attr(armv6m, cold, inline(never))]
    #[cfg_attr(not(armv6m), inline(always))]
    fn write_jacobian_in_rust(&self, joints: &[Q1_14; MAX_JOINTS], jacobian: &mut [S; MAX_JOINTS]) {
        #[cfg(feature = "earlier-sine")]
        if self.sine == SineMethod::SeventhOrder {
            cold_path();
            return self.write_jacobian_with::<SeventhOrderSine>(joints, jacobian);
        }
        self.write_jacobian_with::<CellSine>(joints, jacobian);
    }

    #[inline(always)]
    fn write_jacobian_with<F: SineFunction>(
        &self,
        joints: &[Q1_14; MAX_JOINTS],
        jacobian: &mut [S; MAX_JOINTS],
    ) {
        let links = self.links.get(..self.rows).unwrap_or_default();
        // Assembly has left nearly all chains without a bound; the code for the others saves flash.
        if self.bound < MAX_JACOBIAN_STEPS && !cfg!(armv6m) {
            write_jacobian_bounded::<F, S>(self.contact, links, joints, jacobian);
        } else {
            let moving = jacobian.get_mut(..self.joint).unwrap_or_default().iter_mut().rev();
            let positions = joints.get(..self.joint).unwrap_or_default().iter().rev();
            cold_path();
            write_jacobian_saturating::<F, S>(self.contact, links, moving, positions);
        }
    }
}

/// Carries the wrench of the contact down to the base and writes J, without saturation. It is for chains of revolute
/// joints and fixed rows in which no number can leave the range of a word.
#[inline(always)]
fn write_jacobian_bounded<F: SineFunction, S: Scalar>(
    mut wrench: PerComponent<S::Number>,
    links: &[ChainLink<S::Number>],
    joints: &[Q1_14; MAX_JOINTS],
    jacobian: &mut [S; MAX_JOINTS],
) {
    let mut links = links.iter();
    let Some(mut link) = links.next() else { return };
    loop {
        let (Some(row), Some(position)) =
            (link.joint.element_of_mut(jacobian), link.joint.element_of(joints))
        else {
            return;
        };
        let [.., moment] = wrench.moment;
        *row = S::from_number(moment);
        let Some(next) = links.next() else { return };
        link.turn_about_z::<F, NonSaturatingRounding>(&mut wrench, *position);
        link = next;
        if link.has_due_bit(due::HAS_TWIST_OR_NO_JOINT) {
            while link.has_due_bit(due::HAS_NO_JOINT) {
                cold_path();
                link.apply_fixed_row(&mut wrench);
                let Some(next) = links.next() else { return };
                link = next;
            }
            link.twist_by_alpha::<NonSaturatingRounding>(&mut wrench);
        }
        // Only now, because it would delay the twist.
        ChainLink::shift_moment::<NonSaturatingRounding>(&mut wrench, link.offset_d(), link.length_a());
    }
}

/// Like [`write_jacobian_bounded`], with saturation, for any chain.
#[inline(never)]
fn write_jacobian_saturating<'a, F: SineFunction, S: Scalar + 'a>(
    mut wrench: PerComponent<S::Number>,
    links: &[ChainLink<S::Number>],
    mut moving: impl Iterator<Item = &'a mut S>,
    mut positions: impl Iterator<Item = &'a Q1_14>,
) {
    for (index, link) in links.iter().enumerate() {
        let (mut row, mut position) = (None, Q1_14::ZERO);
        if link.kind != RowKind::Fixed {
            (row, position) = (moving.next(), positions.next().copied().unwrap_or_default());
        }
        let slide = (link.kind == RowKind::Prismatic).then_some(position);
        if index > 0 {
            let d = slide.map_or_else(
                || link.offset_d(),
                |slide| Some(S::Number::from_word(link.d.saturating_add(slide))),
            );
            link.twist_and_shift::<SaturatingRounding>(&mut wrench, d);
        } else if let Some(slide) = slide {
            // The own row is folded without the position of its joint.
            let d = Some(S::Number::from_word(slide));
            ChainLink::shift_moment::<SaturatingRounding>(&mut wrench, d, None);
        }
        let PerComponent { force: [.., force], moment: [.., moment] } = wrench;
        if let Some(row) = &mut row {
            **row = S::from_number(if slide.is_some() { force } else { moment });
        }
        match link.kind {
            RowKind::Revolute if link.has_due_bit(due::TURN_RESULTS_MASK) => {
                link.turn_about_z::<F, SaturatingRounding>(&mut wrench, position)
            }
            RowKind::Revolute => {}
            RowKind::Prismatic | RowKind::Fixed => link.turn_by_offset(&mut wrench),
        }
    }
}

impl<N: Number> ChainLink<N> {
    /// The initial value of links that are not in use.
    const UNUSED_LINK: Self = {
        let (joint, kind, zero) = (Joint::J1, RowKind::Revolute, Q1_14::ZERO);
        Self { due: 0, joint, kind, a: zero, d: zero, offset: zero, twist: Twist::None, constant: None }
    };

    /// Creates the computation for a row, given the components that the rows below read. Also returns the components
    /// that this row reads.
    fn new(row: &Row, read: UsedComponents) -> (Self, UsedComponents) {
        let twist = Twist::new(row.alpha);
        let (a, d) = (row.a != Q1_14::ZERO, row.d != Q1_14::ZERO);
        let turns = row.kind == RowKind::Revolute;
        let constant =
            (!turns && row.theta_offset != Q1_14::ZERO).then(|| constant_sine_cosine(row.theta_offset));
        let slides = row.kind == RowKind::Prismatic;

        // Backwards: the turn, the shift (whose m_z is J), the twist.
        let shifted =
            if turns || constant.is_some() { read.map_vectors(needed_components_before_turn) } else { read };
        let ([fx, fy, mut fz], [mx, my, mut mz]) = (shifted.force, shifted.moment);
        (fz, mz) = (fz || slides, mz || turns);
        let moves = slides || d;
        let twisted = UsedComponents {
            force: [fx || (my && moves), fy || (mx && moves) || (mz && a), fz || (my && a)],
            moment: [mx, my, mz],
        };
        let [_, twisted_fy, twisted_fz] = twisted.force;
        let ([turned_fx, turned_fy, _], [turned_mx, turned_my, _]) = (read.force, read.moment);
        let due = [
            (turned_fx, due::NEEDS_TURNED_FX),
            (turned_fy, due::NEEDS_TURNED_FY),
            (turned_mx, due::NEEDS_TURNED_MX),
            (turned_my, due::NEEDS_TURNED_MY),
            ((mx || my) && moves, due::NEEDS_SHIFT_BY_D),
            ((my || mz) && a, due::NEEDS_SHIFT_BY_A),
            (twisted_fy, due::NEEDS_TWISTED_FY),
            (twisted_fz, due::NEEDS_TWISTED_FZ),
            (my, due::NEEDS_TWISTED_MY),
            (mz, due::NEEDS_TWISTED_MZ),
            (twist == Twist::Ahead, due::TWISTS_QUARTER_TURN),
            (twist == Twist::Back, due::TWISTS_QUARTER_TURN_BACK),
            (twist == Twist::Half, due::TWISTS_HALF_TURN),
            (row.kind == RowKind::Fixed, due::HAS_NO_JOINT),
            (row.kind == RowKind::Fixed || twist != Twist::None, due::HAS_TWIST_OR_NO_JOINT),
            (turned_fx && turned_fy && turned_mx && turned_my, due::ALL_TURN_RESULTS_READ),
        ];
        let due = due.into_iter().fold(0, |all, (is_due, bit)| if is_due { all | bit } else { all });
        let (kind, offset) = (row.kind, row.theta_offset);
        let link = Self { kind, joint: Joint::J1, due, twist, a: row.a, d: row.d, offset, constant };
        (link, twisted.map_vectors(|live| needed_components_before_twist(twist, live)))
    }

    fn has_due_bit(&self, bit: u32) -> bool {
        self.due & bit != 0
    }

    /// Returns the offset d; `None` if no row reads the shift by d, or if d includes the position of a prismatic joint.
    #[inline(always)]
    fn offset_d(&self) -> Option<N> {
        self.has_due_bit(due::NEEDS_SHIFT_BY_D).then(|| N::from_word(self.d))
    }

    /// Returns the length a; `None` if no row reads the shift by a.
    #[inline(always)]
    fn length_a(&self) -> Option<N> {
        self.has_due_bit(due::NEEDS_SHIFT_BY_A).then(|| N::from_word(self.a))
    }

    /// Transforms the wrench by `Tz(d) Tx(a) Rx(alpha)`.
    #[inline(always)]
    fn twist_and_shift<R: Rounding>(&self, wrench: &mut PerComponent<N>, d: Option<N>) {
        self.twist_by_alpha::<R>(wrench);
        Self::shift_moment::<R>(wrench, d, self.length_a());
    }

    /// Transforms the wrench by `Rx(alpha)`.
    #[inline(always)]
    fn twist_by_alpha<R: Rounding>(&self, wrench: &mut PerComponent<N>) {
        let PerComponent { force: [_, fy, fz], moment: [_, my, mz] } = wrench;
        if self.has_due_bit(due::TWISTS_QUARTER_TURN) {
            (*fy, *fz) = (R::negated(*fz), *fy);
            (*my, *mz) = (R::negated(*mz), *my);
        } else if self.has_due_bit(due::TWISTS_QUARTER_TURN_BACK) {
            (*fy, *fz) = (*fz, R::negated(*fy));
            (*my, *mz) = (*mz, R::negated(*my));
        } else if self.has_due_bit(due::TWISTS_HALF_TURN) {
            (*fy, *fz) = (R::negated(*fy), R::negated(*fz));
            (*my, *mz) = (R::negated(*my), R::negated(*mz));
        } else if let Twist::Other { sine, cosine } = self.twist {
            cold_path();
            self.twist_by([sine, cosine], wrench);
        }
    }

    /// Transforms the wrench by `Rx` with an angle that is not a multiple of quarter turns. Computes only the
    /// components that are read later.
    #[inline(never)]
    fn twist_by(&self, [sine, cosine]: [N; 2], wrench: &mut PerComponent<N>) {
        let PerComponent { force: [_, fy, fz], moment: [_, my, mz] } = *wrench;
        let along = |y: N, z: N| N::rounded_difference(cosine.times(y), sine.times(z));
        let across = |y: N, z: N| N::rounded_sum(sine.times(y), cosine.times(z));
        let PerComponent { force: [_, new_fy, new_fz], moment: [_, new_my, new_mz] } = wrench;
        if self.has_due_bit(due::NEEDS_TWISTED_FY) {
            *new_fy = along(fy, fz);
        }
        if self.has_due_bit(due::NEEDS_TWISTED_FZ) {
            *new_fz = across(fy, fz);
        }
        if self.has_due_bit(due::NEEDS_TWISTED_MY) {
            *new_my = along(my, mz);
        }
        if self.has_due_bit(due::NEEDS_TWISTED_MZ) {
            *new_mz = across(my, mz);
        }
    }

    /// Moves the point about which the moment is taken by (a, 0, d) towards the base.
    #[inline(always)]
    fn shift_moment<R: Rounding>(wrench: &mut PerComponent<N>, d: Option<N>, a: Option<N>) {
        let PerComponent { force: [fx, fy, fz], moment: [mx, my, mz] } = wrench;
        match (d, a) {
            (None, None) => {}
            (Some(d), None) => {
                *mx = R::subtract_product(*mx, d.times(*fy));
                *my = R::add_product(*my, d.times(*fx));
            }
            (None, Some(a)) => {
                *my = R::subtract_product(*my, a.times(*fz));
                *mz = R::add_product(*mz, a.times(*fy));
            }
            (Some(d), Some(a)) => {
                *mx = R::subtract_product(*mx, d.times(*fy));
                *my = R::add_and_subtract(*my, d.times(*fx), a.times(*fz));
                *mz = R::add_product(*mz, a.times(*fy));
            }
        }
    }

    /// Transforms the wrench by `Rz(theta)` of a revolute joint at this position. Computes only the components that are
    /// read later.
    #[inline(always)]
    fn turn_about_z<F: SineFunction, R: Rounding>(&self, wrench: &mut PerComponent<N>, position: Q1_14) {
        let turn = Rotation::new(F::sine_cosine(N::add_angles(position, self.offset)));
        if self.has_due_bit(due::ALL_TURN_RESULTS_READ) {
            turn.rotate_all_components::<R>(wrench);
        } else {
            turn.rotate_due_components::<R>(wrench, self.due);
        }
    }

    /// Transforms the wrench by `Rz(theta_offset)` of a row without a revolute joint.
    fn turn_by_offset(&self, wrench: &mut PerComponent<N>) {
        if let Some(turn) = self.constant
            && self.has_due_bit(due::TURN_RESULTS_MASK)
        {
            Rotation::new(turn).rotate_due_components::<SaturatingRounding>(wrench, self.due);
        }
    }

    /// Transforms the wrench by a whole row without a joint.
    #[inline(never)]
    fn apply_fixed_row(&self, wrench: &mut PerComponent<N>) {
        self.twist_and_shift::<SaturatingRounding>(wrench, self.offset_d());
        self.turn_by_offset(wrench);
    }
}

/// Returns the components before a twist that are needed to compute the given components after it.
fn needed_components_before_twist<N>(twist: Twist<N>, [x, y, z]: [bool; 3]) -> [bool; 3] {
    match twist {
        Twist::None | Twist::Half => [x, y, z],
        Twist::Ahead | Twist::Back => [x, z, y],
        Twist::Other { .. } => [x, y || z, y || z],
    }
}

/// Returns the components before a turn about z that are needed to compute the given components after it.
fn needed_components_before_turn([x, y, z]: [bool; 3]) -> [bool; 3] {
    [x || y, x || y, z]
}
