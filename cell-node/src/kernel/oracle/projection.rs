//! The projection kernel: the paper's method, which carries the frames up to the cell.
//!
//! The axes of each frame l in the base frame (Eq. 20) give the cell's position relative to each frame from
//! the tip down (Eq. 22 to 24), and with the force in the base frame (Eq. 25) the triple product of Eq. 8:
//!
//! ```text
//! x_l = c X + s Y     v_l = c Y - s X          X, Y: the axes before the turn by theta_l
//! y_l, z_l from v_l, z_(l-1) by the twist alpha_l
//!
//! f = R_k f_k         p_k = R_k t_k
//! p_(l-1) = p_l + a_l x_l + d_l z_(l-1)        J_l = (z_(l-1) x p_(l-1)) . f
//! ```
//!
//! The savings are those of the paper's count: `a_l x_l` is the joint's own translation without a further
//! product; joints with parallel axes (alpha = 0) turn by one sum of angles, so that X and Y are those of the
//! first of them; and components that are 0 or 1 for all joint positions are neither multiplied nor added.
//! [`AxisFrame`] records these, once per configuration. Values that no later step reads are not computed.

mod axes;
mod range;
mod sums;

use protocol::fixed::Q1_14;
use protocol::parameters::{MAX_JOINTS, MAX_ROWS, Parameters, Row, RowKind};

use self::axes::{
    Axis, AxisFrame, BaseTransform, HorizontalTerms, Rotation, RotationProducts, Vector, VerticalTerms,
    negate_axis,
};
use self::range::stays_in_word_range;
use self::sums::VectorSums;
use crate::kernel::joint::Joint;
use crate::kernel::rounding::{NonSaturatingRounding, SaturatingRounding};
use crate::kernel::{Kernel, Number, Scalar, Twist, checked_chain_rows, cold_path};
use crate::sine::QUARTER_TURN;

/// The projection kernel of one cell, for comparison.
///
/// For a UR5 and a cell on its last link: 103 multiplications, 56 additions or subtractions, 6 sines and 6
/// cosines; the paper counts 103, 57, 6 and 6 (Eq. 27).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Projection<S: Scalar = Q1_14> {
    /// The direction of the contact force, in the frame of joint k.
    force: Vector<S::Number>,
    /// The position of the cell, in the frame of joint k.
    position: Vector<S::Number>,
    /// The transform of a vector from the frame of joint k to the base.
    to_base: BaseTransform,
    /// True if no number can leave the range of a word. Saturation is then omitted.
    bounded: bool,
    /// The links from the first row up to the cell. Only the first `rows` are in use.
    links: [ChainLink<S::Number>; MAX_ROWS],
    rows: usize,
}

/// The computation for one row of the robot's table.
// In this order, the fields that are read first are in reach of a short instruction of a Cortex-M0.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq)]
struct ChainLink<N> {
    /// The values to compute for this row: bits of [`due`].
    due: u32,
    /// The joint of the row; without meaning for a fixed row.
    joint: Joint,
    /// The products needed to rotate x and y by the turn, and the other two axes by the twist.
    mixes: [RotationProducts; 2],
    /// The components of z_(l-1) that are known for all joint positions.
    axis: Axis,
    kind: RowKind,
    a: Q1_14,
    /// The offset d, without the position of a prismatic joint. It is zero for the first row, because an offset along
    /// the axis of joint 1 does not change any moment about that axis.
    d: Q1_14,
    /// The constant theta_offset of the row.
    offset: Q1_14,
    twist: Twist<N>,
}

/// Bits for the values that are computed for a row.
mod due {
    /// Axis x_l, which requires a sine.
    pub(super) const NEEDS_X_AXIS: u32 = 1;
    /// All three axes, because the row ends a group of parallel axes.
    pub(super) const ENDS_AXIS_GROUP: u32 = 2;
    /// Axis z_(l-1), stored for the joints of this group of parallel axes.
    pub(super) const NEEDS_Z_AXIS: u32 = 4;
    /// The shift by the length a, for which x_l is stored.
    pub(super) const NEEDS_SHIFT_BY_A: u32 = 8;
    /// The shift by the offset d.
    pub(super) const NEEDS_SHIFT_BY_D: u32 = 16;
    /// The row has a revolute joint.
    pub(super) const IS_REVOLUTE: u32 = 32;
    /// The row continues a group of parallel axes. Its turn starts from the axes before the group.
    pub(super) const CONTINUES_AXIS_GROUP: u32 = 64;
}

/// The axes that are stored for the way down: z_(l-1) of each group of parallel axes, and x_l of its rows.
type StoredAxes<N> = heapless::Vec<Vector<N>, { 2 * MAX_ROWS }>;

impl<S: Scalar> Kernel<S> for Projection<S> {
    fn new(parameters: &Parameters) -> Self {
        let chain = checked_chain_rows(parameters);
        let (mut frame, mut goes_on) = (AxisFrame::BASE, false);
        let mut joints = Joint::ALL.into_iter();
        let mut links = [ChainLink::new(&Row::default(), Joint::J1, frame, false); MAX_ROWS];
        for (index, (link, row)) in links.iter_mut().zip(chain).enumerate() {
            let joint = if row.has_joint() { joints.next() } else { None }.unwrap_or(Joint::J1);
            *link = ChainLink::new(row, joint, frame, index + 1 == chain.len());
            if goes_on {
                link.due |= due::CONTINUES_AXIS_GROUP;
            }
            if index == 0 && row.kind != RowKind::Prismatic {
                (link.due, link.d) = (link.due & !due::NEEDS_SHIFT_BY_D, Q1_14::ZERO);
            }
            goes_on = !link.has_due_bit(due::ENDS_AXIS_GROUP);
            if !goes_on {
                (frame, _) = frame.after_twist(link.twist);
            }
        }
        let (_, below) = chain.split_last().unzip();
        let is_upright = |row: &Row| matches!(row.alpha.to_bits(), 0 | i16::MIN);
        let slides = chain.iter().any(|row| row.kind == RowKind::Prismatic);
        let position = parameters.pose.position.map(S::Number::from_word);
        let force = parameters.pose.normal.map(|word| S::Number::from_word(word).negated());
        Self {
            force,
            position,
            to_base: BaseTransform::new(frame, !slides && below.unwrap_or_default().iter().all(is_upright)),
            bounded: !slides
                && stays_in_word_range(force, position, links.get(..chain.len()).unwrap_or_default()),
            links,
            rows: chain.len(),
        }
    }

    #[inline(always)]
    fn write_jacobian(&self, joints: &[Q1_14; MAX_JOINTS], jacobian: &mut [S; MAX_JOINTS]) {
        let mut kept = StoredAxes::new();
        let [zero, one] = [S::Number::zero(), S::Number::from_word(QUARTER_TURN)];
        let mut axes = [[one, zero, zero], [zero, one, zero], [zero, zero, one]];
        let axes = self.compute_cell_axes(joints, axes.each_mut(), &mut kept);
        if self.bounded {
            self.write_jacobian_from_axes::<NonSaturatingRounding>(axes, &kept, None, jacobian);
        } else {
            cold_path();
            self.write_jacobian_saturating(axes, &kept, joints, jacobian);
        }
    }
}

impl<S: Scalar> Projection<S> {
    /// Returns the rows from the base to the cell.
    #[inline(always)]
    fn links(&self) -> &[ChainLink<S::Number>] {
        self.links.get(..self.rows).unwrap_or_default()
    }

    /// Computes the axes x, y, z of the cell's frame in base coordinates, from the base up.
    #[inline(always)]
    fn compute_cell_axes<'a>(
        &self,
        joints: &[Q1_14; MAX_JOINTS],
        [x, mut y, mut z]: [&'a mut Vector<S::Number>; 3],
        kept: &mut StoredAxes<S::Number>,
    ) -> [&'a Vector<S::Number>; 3] {
        let mut group = Q1_14::ZERO;
        for link in self.links() {
            group = link.angle_in_group(group, joints);
            if !link.has_due_bit(due::NEEDS_X_AXIS) {
                continue;
            }
            let turn = Rotation(S::Number::sine_cosine(group));
            let [mix, _] = link.mixes;
            // The capacity is two vectors per row.
            if !link.has_due_bit(due::ENDS_AXIS_GROUP) {
                let _ = kept.push(turn.rotated_first_axis(mix, x, y));
                continue;
            }
            turn.rotate_both_axes(mix, x, y);
            if link.has_due_bit(due::NEEDS_SHIFT_BY_A) {
                let _ = kept.push(*x);
            }
            if link.has_due_bit(due::NEEDS_Z_AXIS) {
                let _ = kept.push(*z);
            }
            link.twist_by_alpha(&mut y, &mut z);
        }
        [x, y, z]
    }

    /// Computes J, from the cell down to the base. `slides` are the joint positions, or `None` if the chain has no
    /// prismatic joints.
    #[inline(always)]
    fn write_jacobian_from_axes<R: VectorSums>(
        &self,
        axes: [&Vector<S::Number>; 3],
        kept: &StoredAxes<S::Number>,
        slides: Option<&[Q1_14; MAX_JOINTS]>,
        jacobian: &mut [S; MAX_JOINTS],
    ) {
        let [force, mut position] = self.force_and_position_in_base::<R>(axes);
        let [.., mut z] = axes;
        let mut kept = kept.iter().rev();
        for link in self.links().iter().rev() {
            if link.has_due_bit(due::NEEDS_Z_AXIS) {
                let Some(axis) = kept.next() else { return };
                z = axis;
            }
            let slides = slides.filter(|_| link.kind == RowKind::Prismatic);
            let d = match slides.and_then(|joints| link.joint.element_of(joints)) {
                Some(position) => Some(S::Number::from_word(link.d.saturating_add(*position))),
                None => link.has_due_bit(due::NEEDS_SHIFT_BY_D).then(|| S::Number::from_word(link.d)),
            };
            let turned = link.step_towards_base::<R>(&mut position, &force, z, d, || kept.next());
            let entry = match turned {
                Some(entry) => entry,
                None if slides.is_some() => link.force_along_axis::<R>(z, &force),
                None => continue,
            };
            if let Some(row) = link.joint.element_of_mut(jacobian) {
                *row = S::from_number(entry);
            }
        }
    }

    /// Like `write_jacobian_from_axes`, with saturation, for chains in which numbers may leave the range of a word.
    #[inline(never)]
    fn write_jacobian_saturating(
        &self,
        axes: [&Vector<S::Number>; 3],
        kept: &StoredAxes<S::Number>,
        joints: &[Q1_14; MAX_JOINTS],
        jacobian: &mut [S; MAX_JOINTS],
    ) {
        self.write_jacobian_from_axes::<SaturatingRounding>(axes, kept, Some(joints), jacobian);
    }

    /// Transforms the force and the cell's position to the base frame.
    #[inline(always)]
    fn force_and_position_in_base<R: VectorSums>(
        &self,
        [x, y, z]: [&Vector<S::Number>; 3],
    ) -> [Vector<S::Number>; 2] {
        let ([x0, x1, x2], [y0, y1, y2], [z0, z1, z2]) = (*x, *y, *z);
        let vectors = [self.force, self.position];
        let two = |a: S::Number, x, b: S::Number, y| R::round(R::plus::<S::Number>(a.times(x), b.times(y)));
        let three = |[a, b, c]: Vector<S::Number>, x, y, z| {
            R::round(R::plus::<S::Number>(R::plus::<S::Number>(a.times(x), b.times(y)), c.times(z)))
        };
        let level = match self.to_base.level {
            HorizontalTerms::Xz => vectors.map(|[a, _, c]| [two(a, x0, c, z0), two(a, x1, c, z1)]),
            HorizontalTerms::Xy => vectors.map(|[a, b, _]| [two(a, x0, b, y0), two(a, x1, b, y1)]),
            HorizontalTerms::All => {
                vectors.map(|vector| [three(vector, x0, y0, z0), three(vector, x1, y1, z1)])
            }
        };
        let height = match self.to_base.height {
            VerticalTerms::Nothing => [S::Number::zero(); 2],
            VerticalTerms::Y => vectors.map(|[_, b, _]| b),
            VerticalTerms::MinusY => vectors.map(|[_, b, _]| R::negated(b)),
            VerticalTerms::Z => vectors.map(|[_, _, c]| c),
            VerticalTerms::MinusZ => vectors.map(|[_, _, c]| R::negated(c)),
            VerticalTerms::Yz => vectors.map(|[_, b, c]| two(b, y2, c, z2)),
            VerticalTerms::Xz => vectors.map(|[a, _, c]| two(a, x2, c, z2)),
            VerticalTerms::Xy => vectors.map(|[a, b, _]| two(a, x2, b, y2)),
            VerticalTerms::All => vectors.map(|vector| three(vector, x2, y2, z2)),
        };
        let ([[f0, f1], [p0, p1]], [f2, p2]) = (level, height);
        [[f0, f1, f2], [p0, p1, p2]]
    }
}

impl<N: Number> ChainLink<N> {
    /// Creates the computation for a row above `frame`. `last` is true for the row that carries the cell.
    fn new(row: &Row, joint: Joint, frame: AxisFrame, last: bool) -> Self {
        let ends = last || row.alpha != Q1_14::ZERO;
        let (a, d) = (row.a != Q1_14::ZERO, row.d != Q1_14::ZERO);
        let twist = Twist::new(row.alpha);
        let axis = frame.z_axis();
        let (_, twisting) = frame.after_twist(twist);
        let due = [
            (ends || a, due::NEEDS_X_AXIS),
            (ends, due::ENDS_AXIS_GROUP),
            (ends && !axis.is_vertical(), due::NEEDS_Z_AXIS),
            (a, due::NEEDS_SHIFT_BY_A),
            (d, due::NEEDS_SHIFT_BY_D),
            (row.kind == RowKind::Revolute, due::IS_REVOLUTE),
        ];
        Self {
            due: due.into_iter().fold(0, |all, (is_due, bit)| if is_due { all | bit } else { all }),
            joint,
            mixes: [frame.z_rotation_products(), twisting],
            axis,
            kind: row.kind,
            a: row.a,
            d: row.d,
            offset: row.theta_offset,
            twist,
        }
    }

    fn has_due_bit(&self, bit: u32) -> bool {
        self.due & bit != 0
    }

    /// Returns the angle between the axes before the group of parallel joints and those after this joint. `group` is
    /// that angle for the previous joint.
    #[inline(always)]
    fn angle_in_group(&self, group: Q1_14, joints: &[Q1_14; MAX_JOINTS]) -> Q1_14 {
        let mut angle = self.offset;
        if self.has_due_bit(due::IS_REVOLUTE)
            && let Some(position) = self.joint.element_of(joints)
        {
            angle = N::add_angles(*position, angle);
        }
        if self.has_due_bit(due::CONTINUES_AXIS_GROUP) { N::add_angles(group, angle) } else { angle }
    }

    /// Computes y_l and z_l from v_l and the previous z axis, in place. For quarter turns the references y and z are
    /// swapped.
    #[inline(always)]
    fn twist_by_alpha<'a>(&self, y: &mut &'a mut Vector<N>, z: &mut &'a mut Vector<N>) {
        match self.twist {
            Twist::None => {}
            Twist::Ahead => {
                negate_axis(y);
                core::mem::swap(y, z);
            }
            Twist::Half => {
                negate_axis(y);
                negate_axis(z);
            }
            Twist::Back => {
                negate_axis(z);
                core::mem::swap(y, z);
            }
            Twist::Other { sine, cosine } => {
                cold_path();
                rotate_yz_by_twist(Rotation([sine, cosine]), self.mixes, y, z);
            }
        }
    }

    /// Computes p_(l-1) from p_l (Eq. 24), and J of a revolute joint: (z x p) . f (Eq. 8).
    #[inline(always)]
    fn step_towards_base<'a, R: VectorSums>(
        &self,
        p: &mut Vector<N>,
        &[f0, f1, f2]: &Vector<N>,
        z: &Vector<N>,
        d: Option<N>,
        mut kept: impl FnMut() -> Option<&'a Vector<N>>,
    ) -> Option<N>
    where
        N: 'a,
    {
        let ([p0, p1, p2], [z0, z1, z2]) = (p, *z);
        let a = || N::from_word(self.a);
        let level = |m0: N, m1: N| R::plus::<N>(f0.times(m0), f1.times(m1));
        let moment = match self.axis {
            // Below an upright axis all axes are upright, and no height is needed.
            Axis::Up | Axis::Down => {
                if self.has_due_bit(due::NEEDS_SHIFT_BY_A) {
                    let ([x0, x1, _], a) = (*kept()?, a());
                    *p0 = R::add_product(*p0, a.times(x0));
                    *p1 = R::add_product(*p1, a.times(x1));
                }
                if !self.has_due_bit(due::IS_REVOLUTE) {
                    return None;
                }
                if self.axis == Axis::Up { level(R::negated(*p1), *p0) } else { level(*p1, R::negated(*p0)) }
            }
            Axis::Level => {
                if self.has_due_bit(due::NEEDS_SHIFT_BY_A) {
                    let ([x0, x1, x2], a) = (*kept()?, a());
                    shift_position::<R, N>(p0, a.times(x0), d, z0);
                    shift_position::<R, N>(p1, a.times(x1), d, z1);
                    *p2 = R::add_product(*p2, a.times(x2));
                } else if let Some(d) = d {
                    *p0 = R::add_product(*p0, d.times(z0));
                    *p1 = R::add_product(*p1, d.times(z1));
                }
                if !self.has_due_bit(due::IS_REVOLUTE) {
                    return None;
                }
                let [m0, m1] = [R::round(p2.times(z1)), R::round(R::negated(*p2).times(z0))];
                let m2 = R::rounded_difference(p1.times(z0), p0.times(z1));
                R::plus::<N>(level(m0, m1), f2.times(m2))
            }
            Axis::Any => {
                if self.has_due_bit(due::NEEDS_SHIFT_BY_A) {
                    let ([x0, x1, x2], a) = (*kept()?, a());
                    shift_position::<R, N>(p0, a.times(x0), d, z0);
                    shift_position::<R, N>(p1, a.times(x1), d, z1);
                    shift_position::<R, N>(p2, a.times(x2), d, z2);
                } else if let Some(d) = d {
                    *p0 = R::add_product(*p0, d.times(z0));
                    *p1 = R::add_product(*p1, d.times(z1));
                    *p2 = R::add_product(*p2, d.times(z2));
                }
                if !self.has_due_bit(due::IS_REVOLUTE) {
                    return None;
                }
                let m0 = R::rounded_difference(p2.times(z1), p1.times(z2));
                let m1 = R::rounded_difference(p0.times(z2), p2.times(z0));
                let m2 = R::rounded_difference(p1.times(z0), p0.times(z1));
                R::plus::<N>(level(m0, m1), f2.times(m2))
            }
        };
        Some(R::round(moment))
    }

    /// Returns z . f, for a prismatic joint.
    fn force_along_axis<R: VectorSums>(&self, &[z0, z1, z2]: &Vector<N>, &[f0, f1, f2]: &Vector<N>) -> N {
        match self.axis {
            Axis::Up => f2,
            Axis::Down => R::negated(f2),
            Axis::Level => R::round(R::plus::<N>(f0.times(z0), f1.times(z1))),
            Axis::Any => R::round(R::plus::<N>(R::plus::<N>(f0.times(z0), f1.times(z1)), f2.times(z2))),
        }
    }
}

/// Adds the products with the length a and the offset d to a component of the position.
#[inline(always)]
fn shift_position<R: VectorSums, N: Number>(position: &mut N, by_a: N::WideSum, d: Option<N>, z: N) {
    *position = match d {
        None => R::add_product(*position, by_a),
        Some(d) => R::add_products(*position, by_a, d.times(z)),
    };
}

/// Rotates y and z by a twist that is not a multiple of quarter turns.
#[inline(never)]
fn rotate_yz_by_twist<N: Number>(
    turn: Rotation<N>,
    [_, mix]: [RotationProducts; 2],
    y: &mut Vector<N>,
    z: &mut Vector<N>,
) {
    turn.rotate_both_axes(mix, y, z);
}
