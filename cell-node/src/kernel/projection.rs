//! The projection kernel: the paper's own, with the frames carried up to the cell.
//!
//! The axes of each frame l in the base frame (Eq. 20) give the cell's position relative to each frame
//! from the tip down (Eq. 22 to 24), and with the force in the base frame (Eq. 25) the triple product of
//! Eq. 8:
//!
//! ```text
//! x_l = c X + s Y     v_l = c Y - s X          X, Y: the axes before the turn by theta_l
//! y_l, z_l from v_l, z_(l-1) by the twist alpha_l
//!
//! f = R_k f_k         p_k = R_k t_k
//! p_(l-1) = p_l + a_l x_l + d_l z_(l-1)        J_l = (z_(l-1) x p_(l-1)) . f
//! ```
//!
//! Reused as in the paper's count: `a_l x_l` is the joint's own translation without a further product;
//! joints whose axes are parallel (alpha = 0) turn by one sum of angles, so that X and Y are those of
//! the first of them; and components that are 0 or 1 whatever the joints ([`Component`]) are neither
//! multiplied nor added. What no later step reads is not computed.

use protocol::fixed::Q1_14;
use protocol::parameters::{MAX_JOINTS, MAX_ROWS, Parameters, Row, RowKind};

use super::{Kernel, Number, Scalar, Twist, chain, length};

/// The projection kernel, of one cell.
///
/// For a UR5 and a cell on its last link: 103 multiplications, 56 additions or subtractions, 6 sines and
/// 6 cosines; the paper counts 103, 57, 6 and 6 (Eq. 27).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Projection<S: Scalar = Q1_14> {
    /// The joint that moves the cell; 0 when there is none.
    joint: usize,
    /// Whether all axes are upright: then the cell's height and the vertical force are unused.
    upright: bool,
    /// The cell in the frame of joint k.
    position: [S::Number; 3],
    /// Where the contact pushes, in the same frame.
    force: [S::Number; 3],
    /// From the first row up; those of `rows` are in use.
    links: [Link<S::Number>; MAX_ROWS],
    rows: usize,
}

/// One row of the robot's table.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Link<N> {
    kind: RowKind,
    /// d of a prismatic joint, to which its position is added.
    slide: Q1_14,
    /// theta_offset.
    offset: Q1_14,
    twist: Twist<N>,
    a: Option<N>,
    /// Absent for joint 1 too: it shifts along the axis of joint 1, which has no moment about it.
    d: Option<N>,
    /// Whether x_l is used.
    x: bool,
    /// Whether this ends a group of parallel axes; then v_l is used.
    ends: bool,
}

/// A component of an axis in the base frame.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Component<N> {
    /// 0, whatever the joints are.
    Zero,
    /// 1, whatever the joints are.
    One,
    /// -1, whatever the joints are.
    MinusOne,
    /// It depends on the joints.
    Varies(N),
}

type Axis<N> = [Component<N>; 3];

/// What the way down needs of joint l: x_l and z_(l-1).
#[derive(Clone, Copy, Debug)]
struct Step<N> {
    x: Axis<N>,
    z: Axis<N>,
    /// The joint's; zero of a fixed row.
    position: Q1_14,
}

impl<S: Scalar> Kernel<S> for Projection<S> {
    fn new(parameters: &Parameters) -> Self {
        let chain = chain(parameters);
        let links = core::array::from_fn(|index| {
            let row = parameters.rows.get(index).copied().unwrap_or_default();
            Link::new(&row, index == 0, index + 1 == chain.len())
        });
        let (_, below) = chain.split_last().unzip();
        let upright = |row: &Row| matches!(row.alpha.to_bits(), 0 | i16::MIN);
        let slides = chain.iter().any(|row| row.kind == RowKind::Prismatic);
        Self {
            joint: if chain.is_empty() { 0 } else { parameters.joint.into() },
            rows: chain.len(),
            upright: !slides && below.unwrap_or_default().iter().all(upright),
            position: parameters.pose.position.map(S::Number::word),
            force: parameters.pose.normal.map(|word| S::Number::word(word).negative()),
            links,
        }
    }

    fn write_jacobian(&self, joints: &[Q1_14; MAX_JOINTS], jacobian: &mut [S; MAX_JOINTS]) {
        let links = self.links.get(..self.rows).unwrap_or_default();
        let position_of = |link: &Link<S::Number>, moving: &mut core::slice::Iter<'_, Q1_14>| {
            if link.kind == RowKind::Fixed { None } else { moving.next() }.copied().unwrap_or_default()
        };

        let [mut x, mut y, mut z] = Component::BASE;
        let mut steps = [Step { x, z, position: Q1_14::ZERO }; MAX_ROWS];
        let mut group = None;
        let mut moving = joints.iter();
        for (step, link) in steps.iter_mut().zip(links) {
            step.position = position_of(link, &mut moving);
            let angle = link.angle(group, step.position);
            group = (!link.ends).then_some(angle);
            step.z = z;
            if !link.x {
                continue;
            }
            let [sine, cosine] = S::Number::sine_cosine(angle);
            step.x = combine(x, y, |x, y| Sum::Nothing.plus(cosine, x).plus(sine, y));
            if link.ends {
                let v = combine(x, y, |x, y| Sum::Nothing.plus(cosine, y).minus(sine, x));
                x = step.x;
                [y, z] = link.twist.turn_axes(v, z);
            }
        }

        let ([x0, x1, x2], [y0, y1, y2], [z0, z1, z2]) = (x, y, z);
        let to_base = |[a, b, c]: [S::Number; 3]| {
            let row = |x, y, z| Sum::Nothing.plus(a, x).plus(b, y).plus(c, z).component().number();
            [row(x0, y0, z0), row(x1, y1, z1), if self.upright { S::Number::zero() } else { row(x2, y2, z2) }]
        };
        let force = to_base(self.force);
        let mut position = to_base(self.position);
        let mut moving = jacobian.get_mut(..self.joint).unwrap_or_default().iter_mut().rev();
        for (step, link) in steps.iter().zip(links).rev() {
            position = link.shift(position, step, self.upright);
            let entry = match link.kind {
                RowKind::Revolute => triple_product(step.z, position, force),
                RowKind::Prismatic => along(step.z, force),
                RowKind::Fixed => continue,
            };
            if let Some(row) = moving.next() {
                *row = S::from_number(entry);
            }
        }
    }
}

impl<N: Number> Link<N> {
    fn new(row: &Row, first: bool, last: bool) -> Self {
        let ends = last || row.alpha != Q1_14::ZERO;
        let a = length(row.a);
        Self {
            kind: row.kind,
            slide: row.d,
            offset: row.theta_offset,
            twist: Twist::new(row.alpha),
            a,
            d: if first { None } else { length(row.d) },
            x: ends || a.is_some(),
            ends,
        }
    }

    /// The angle from the axes before the group of parallel joints to this joint's.
    fn angle(&self, group: Option<Q1_14>, position: Q1_14) -> Q1_14 {
        let own = match self.kind {
            RowKind::Revolute => N::plus_angle(position, self.offset),
            RowKind::Prismatic | RowKind::Fixed => self.offset,
        };
        group.map_or(own, |group| N::plus_angle(group, own))
    }

    /// p_(l-1) from p_l (Eq. 24).
    fn shift(&self, [p0, p1, p2]: [N; 3], step: &Step<N>, upright: bool) -> [N; 3] {
        let ([x0, x1, x2], [z0, z1, z2]) = (step.x, step.z);
        let slides = self.kind == RowKind::Prismatic;
        let d = if slides { Some(N::word(self.slide.saturating_add(step.position))) } else { self.d };
        let shift = |p: N, x, z| {
            let sum = self.a.map_or(Sum::Word(p), |a| Sum::Word(p).plus(a, x));
            d.map_or(sum, |d| sum.plus(d, z)).component().number()
        };
        [shift(p0, x0, z0), shift(p1, x1, z1), if upright { p2 } else { shift(p2, x2, z2) }]
    }
}

impl<N: Number> Twist<N> {
    /// The second and the third axis after the twist, from those before it.
    fn turn_axes(self, v: Axis<N>, z: Axis<N>) -> [Axis<N>; 2] {
        match self {
            Self::None => [v, z],
            Self::Ahead => [z, v.map(Component::negative)],
            Self::Half => [v.map(Component::negative), z.map(Component::negative)],
            Self::Back => [z.map(Component::negative), v],
            Self::Other { sine, cosine } => [
                combine(v, z, |v, z| Sum::Nothing.plus(cosine, v).plus(sine, z)),
                combine(v, z, |v, z| Sum::Nothing.plus(cosine, z).minus(sine, v)),
            ],
        }
    }
}

/// z . f, of a prismatic joint.
fn along<N: Number>([z0, z1, z2]: Axis<N>, [f0, f1, f2]: [N; 3]) -> N {
    Sum::Nothing.plus(f0, z0).plus(f1, z1).plus(f2, z2).component().number()
}

/// (z x p) . f (Eq. 8).
fn triple_product<N: Number>([z0, z1, z2]: Axis<N>, [p0, p1, p2]: [N; 3], [f0, f1, f2]: [N; 3]) -> N {
    let m0 = Sum::Nothing.plus(p2, z1).minus(p1, z2).component();
    let m1 = Sum::Nothing.plus(p0, z2).minus(p2, z0).component();
    let m2 = Sum::Nothing.plus(p1, z0).minus(p0, z1).component();
    Sum::Nothing.plus(f0, m0).plus(f1, m1).plus(f2, m2).component().number()
}

/// One sum for each component of two axes.
fn combine<N: Number>(
    [a0, a1, a2]: Axis<N>,
    [b0, b1, b2]: Axis<N>,
    sum: impl Fn(Component<N>, Component<N>) -> Sum<N>,
) -> Axis<N> {
    [sum(a0, b0).component(), sum(a1, b1).component(), sum(a2, b2).component()]
}

impl<N: Number> Component<N> {
    /// The base frame's own axes.
    const BASE: [Axis<N>; 3] = [
        [Self::One, Self::Zero, Self::Zero],
        [Self::Zero, Self::One, Self::Zero],
        [Self::Zero, Self::Zero, Self::One],
    ];

    fn negative(self) -> Self {
        match self {
            Self::Zero => Self::Zero,
            Self::One => Self::MinusOne,
            Self::MinusOne => Self::One,
            Self::Varies(number) => Self::Varies(number.negative()),
        }
    }

    fn number(self) -> N {
        match self {
            Self::Zero => N::zero(),
            Self::One => N::one(),
            Self::MinusOne => N::one().negative(),
            Self::Varies(number) => number,
        }
    }
}

/// A sum of products that is as wide as it has to be.
#[derive(Clone, Copy)]
enum Sum<N: Number> {
    Nothing,
    Word(N),
    Wide(N::Wide),
}

impl<N: Number> Sum<N> {
    /// With the product of a number and a component.
    fn plus(self, factor: N, component: Component<N>) -> Self {
        match component {
            Component::Zero => self,
            Component::One => match self.wide() {
                None => Self::Word(factor),
                Some(sum) => Self::Wide(N::plus(sum, factor.widen())),
            },
            Component::MinusOne => match self.wide() {
                None => Self::Word(factor.negative()),
                Some(sum) => Self::Wide(N::minus(sum, factor.widen())),
            },
            Component::Varies(number) => Self::Wide(match self.wide() {
                None => factor.times(number),
                Some(sum) => N::plus(sum, factor.times(number)),
            }),
        }
    }

    /// Without the product of a number and a component.
    fn minus(self, factor: N, component: Component<N>) -> Self {
        let Component::Varies(number) = component else { return self.plus(factor, component.negative()) };
        Self::Wide(match self.wide() {
            None => factor.negative().times(number),
            Some(sum) => N::minus(sum, factor.times(number)),
        })
    }

    fn wide(self) -> Option<N::Wide> {
        match self {
            Self::Nothing => None,
            Self::Word(word) => Some(word.widen()),
            Self::Wide(sum) => Some(sum),
        }
    }

    /// The sum, rounded once.
    fn component(self) -> Component<N> {
        match self {
            Self::Nothing => Component::Zero,
            Self::Word(word) => Component::Varies(word),
            Self::Wide(sum) => Component::Varies(N::round(sum)),
        }
    }
}
