//! The wrench kernel: the contact, carried down the chain.
//!
//! Eq. 8 is a scalar triple product, and a contact on a link is a constant wrench in that link's frame:
//! the force f and its moment m = t x f about the frame's origin. From frame l to frame l-1, whose
//! transform is `Rz(theta_l) Tz(d_l) Tx(a_l) Rx(alpha_l)`, the wrench goes in three steps:
//!
//! ```text
//! twist   f, m by Rx(alpha_l)
//! shift   m_x -= d f_y     m_y += d f_x - a f_z     m_z += a f_y
//!         J_l = m_z, of a prismatic joint f_z
//! turn    f, m by Rz(theta_l)
//! ```
//!
//! A prismatic joint adds its position to d, a revolute one to theta; a fixed row has neither. The turn leaves m_z and
//! f_z alone, so J_l can be read before it, and the base's own angle theta_1 is never needed. Twist and shift of the row
//! that carries the cell are constant, but for a slide, as are fixed rows right below it: they are folded into the six
//! stored words. What nobody reads further down the chain is not computed: [`Live`] says what is, worked out once.

use core::ops::{Add, Mul, Neg, Sub};

use protocol::fixed::Q1_14;
use protocol::parameters::{MAX_JOINTS, MAX_ROWS, Parameters, Pose, Row, RowKind};

use super::{Kernel, Number, Scalar, Twist, length, settled_turn};

/// The wrench kernel, of one cell.
///
/// For a UR5 and a cell on its last link: 40 multiplications, 24 additions or subtractions, 5 sines and
/// 5 cosines. Over 300 poses of a UR5 the torques err by 1.2e-4 Nm in the mean and 1.5e-3 Nm at most.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wrench<S: Scalar = Q1_14> {
    /// The joint that moves the cell; 0 when there is none.
    joint: usize,
    /// The contact's wrench, twisted and shifted by the row of joint k.
    contact: Wrenched<S::Number>,
    /// From joint k's row down to the base, in the table's order; the first `rows` are in use.
    links: [Link<S::Number>; MAX_ROWS],
    rows: usize,
}

/// A force of one newton and its moment in m (that is, Nm per N); or something that is known of each of their
/// components.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Wrenched<T> {
    force: [T; 3],
    moment: [T; 3],
}

/// Which components of a wrench are used.
type Live = Wrenched<bool>;

impl Live {
    const NOTHING: Self = Self { force: [false; 3], moment: [false; 3] };
    const ALL: Self = Self { force: [true; 3], moment: [true; 3] };

    /// The same of both.
    fn each(self, before: impl Fn([bool; 3]) -> [bool; 3]) -> Self {
        Self { force: before(self.force), moment: before(self.moment) }
    }
}

/// The steps from the frame of a row to the one below.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Link<N> {
    kind: RowKind,
    /// What the twist computes.
    twisted: Live,
    twist: Twist<N>,
    a: Q1_14,
    /// Without the position of a prismatic joint.
    d: Q1_14,
    /// What the turn computes.
    turned: Live,
    /// theta_offset.
    offset: Q1_14,
    /// Sine and cosine of theta_offset, where the row does not turn; none of a zero.
    constant: Option<[N; 2]>,
}

impl<S: Scalar> Kernel<S> for Wrench<S> {
    fn new(parameters: &Parameters) -> Self {
        let chain = parameters.chain();
        let mut read = Live::NOTHING; // by the rows further down: nothing below joint 1
        let links = core::array::from_fn(|index| {
            let link;
            (link, read) = Link::new(&chain.get(index).copied().unwrap_or_default(), read);
            link
        });
        let nothing = Wrenched { force: [S::Number::zero(); 3], moment: [S::Number::zero(); 3] };
        let mut contact = chain.last().map_or(nothing, |last| fold(&parameters.pose, last));
        // Fixed rows between the cell and the joint that moves it.
        let mut rows = chain.len();
        let is_fixed = |row: Option<&Row>| row.is_some_and(|row| row.kind == RowKind::Fixed);
        while is_fixed(rows.checked_sub(1).and_then(|last| chain.get(last))) {
            let above: Link<S::Number> =
                Link::new(&chain.get(rows - 1).copied().unwrap_or_default(), Live::ALL).0;
            rows -= 1;
            contact = above.turn(contact, Q1_14::ZERO);
            if let Some(row) = rows.checked_sub(1).and_then(|last| chain.get(last)) {
                // Not the slide of a prismatic joint.
                contact = Link::new(row, Live::ALL).0.twist_and_shift(contact, None);
            }
        }
        Self { joint: if rows == 0 { 0 } else { parameters.joint.into() }, contact, links, rows }
    }

    fn jacobian(&self, joints: &[Q1_14; MAX_JOINTS]) -> [S; MAX_JOINTS] {
        let mut jacobian = [S::from_number(S::Number::zero()); MAX_JOINTS];
        let mut wrench = self.contact;
        let links = self.links.get(..self.rows).unwrap_or_default();
        let moving = jacobian.get_mut(..self.joint).unwrap_or_default();
        let mut moving = moving.iter_mut().zip(joints).rev();
        for (index, link) in links.iter().rev().enumerate() {
            let joint = if link.kind == RowKind::Fixed { None } else { moving.next() };
            let position = joint.as_ref().map_or(Q1_14::ZERO, |(_, position)| **position);
            let slide = (link.kind == RowKind::Prismatic).then_some(position);
            if index > 0 {
                wrench = link.twist_and_shift(wrench, slide);
            } else if slide.is_some() {
                // Its own row is folded, without the slide.
                let moment = link.shift_along(wrench.force, wrench.moment, slide.map(S::Number::word));
                wrench = Wrenched { moment, ..wrench };
            }
            let Wrenched { force: [.., force], moment: [.., moment] } = wrench;
            if let Some((row, _)) = joint {
                *row = S::from_number(if slide.is_some() { force } else { moment });
            }
            wrench = link.turn(wrench, position);
        }
        jacobian
    }
}

impl<N: Number> Link<N> {
    /// The link of a row, when the rows below it read `read` of what it turned; and what it reads itself.
    fn new(row: &Row, read: Live) -> (Self, Live) {
        let twist = Twist::new(row.alpha);
        let (a, d) = (row.a != Q1_14::ZERO, row.d != Q1_14::ZERO);
        let turns = row.kind == RowKind::Revolute;
        let constant = (!turns && row.theta_offset != Q1_14::ZERO).then(|| settled_turn(row.theta_offset));
        let slides = row.kind == RowKind::Prismatic;

        // Backwards: the turn, the shift, whose m_z is J, the twist.
        let shifted = if turns || constant.is_some() { read.each(before_turn) } else { read };
        let ([fx, fy, mut fz], [mx, my, mut mz]) = (shifted.force, shifted.moment);
        (fz, mz) = (fz || slides, mz || turns);
        let moves = slides || d;
        let twisted = Live {
            force: [fx || (my && moves), fy || (mx && moves) || (mz && a), fz || (my && a)],
            moment: [mx, my, mz],
        };
        let link = Self {
            kind: row.kind,
            twisted,
            twist,
            a: row.a,
            d: row.d,
            turned: read,
            offset: row.theta_offset,
            constant,
        };
        (link, twisted.each(|live| before_twist(twist, live)))
    }

    /// `Tz(d) Tx(a) Rx(alpha)`, but only what is live.
    #[inline]
    fn twist_and_shift(&self, wrench: Wrenched<N>, slide: Option<Q1_14>) -> Wrenched<N> {
        let force = self.twist.apply(wrench.force, self.twisted.force);
        let moment = self.twist.apply(wrench.moment, self.twisted.moment);
        let d = slide.map_or_else(|| length(self.d), |slide| Some(N::word(self.d.saturating_add(slide))));
        Wrenched { force, moment: self.shift(force, moment, d) }
    }

    /// `Rz(theta)`, but only what is live.
    #[inline]
    fn turn(&self, wrench: Wrenched<N>, position: Q1_14) -> Wrenched<N> {
        let ([fx, fy, _], [mx, my, _]) = (self.turned.force, self.turned.moment);
        if !(fx || fy || mx || my) {
            return wrench;
        }
        let [sine, cosine] = match (self.kind, self.constant) {
            (RowKind::Revolute, _) => N::sine_cosine(N::plus_angle(position, self.offset)),
            (RowKind::Prismatic | RowKind::Fixed, Some(constant)) => constant,
            (RowKind::Prismatic | RowKind::Fixed, None) => return wrench,
        };
        let turn = |[x, y, z]: [N; 3], [live_x, live_y, _]: [bool; 3]| {
            [
                if live_x { N::rounded_difference(cosine.times(x), sine.times(y)) } else { x },
                if live_y { N::rounded_sum(sine.times(x), cosine.times(y)) } else { y },
                z,
            ]
        };
        Wrenched {
            force: turn(wrench.force, self.turned.force),
            moment: turn(wrench.moment, self.turned.moment),
        }
    }

    /// The moment about an origin that lies (a, 0, d) further down, but only what is live.
    #[inline]
    fn shift(&self, force: [N; 3], moment: [N; 3], d: Option<N>) -> [N; 3] {
        let ([fx, fy, fz], [mut mx, mut my, mut mz]) = (force, moment);
        let a: Option<N> = length(self.a);
        let [live_x, live_y, live_z] = self.twisted.moment;
        if live_y {
            my = match (d, a) {
                (None, None) => my,
                (Some(d), None) => N::rounded_sum(my.widen(), d.times(fx)),
                (None, Some(a)) => N::rounded_difference(my.widen(), a.times(fz)),
                (Some(d), Some(a)) => N::round(N::minus(N::plus(my.widen(), d.times(fx)), a.times(fz))),
            };
        }
        if let Some(d) = d
            && live_x
        {
            mx = N::rounded_difference(mx.widen(), d.times(fy));
        }
        if let Some(a) = a
            && live_z
        {
            mz = N::rounded_sum(mz.widen(), a.times(fy));
        }
        [mx, my, mz]
    }

    /// The moment about an origin that lies so far along z.
    fn shift_along(&self, force: [N; 3], moment: [N; 3], d: Option<N>) -> [N; 3] {
        Self { a: Q1_14::ZERO, ..*self }.shift(force, moment, d)
    }
}

impl<N: Number> Twist<N> {
    /// `Rx(alpha)`, but only what is live.
    #[inline]
    fn apply(self, [x, y, z]: [N; 3], [_, live_y, live_z]: [bool; 3]) -> [N; 3] {
        let negative = |number: N, live: bool| if live { number.negative() } else { number };
        match self {
            Self::None => [x, y, z],
            Self::Ahead => [x, negative(z, live_y), y],
            Self::Half => [x, negative(y, live_y), negative(z, live_z)],
            Self::Back => [x, z, negative(y, live_z)],
            Self::Other { sine, cosine } => [
                x,
                if live_y { N::rounded_difference(cosine.times(y), sine.times(z)) } else { y },
                if live_z { N::rounded_sum(sine.times(y), cosine.times(z)) } else { z },
            ],
        }
    }
}

/// What must be there before a twist, for these to be there after it.
fn before_twist<N>(twist: Twist<N>, [x, y, z]: [bool; 3]) -> [bool; 3] {
    match twist {
        Twist::None | Twist::Half => [x, y, z],
        Twist::Ahead | Twist::Back => [x, z, y],
        Twist::Other { .. } => [x, y || z, y || z],
    }
}

/// What must be there before a turn about z, for these to be there after it.
fn before_turn([x, y, z]: [bool; 3]) -> [bool; 3] {
    [x || y, x || y, z]
}

/// The contact's wrench, twisted and shifted by joint k's row, rounded once.
fn fold<N: Number>(pose: &Pose, row: &Row) -> Wrenched<N> {
    let (force, moment) = folded(
        pose.normal.map(N::fine),
        pose.position.map(N::fine),
        N::fine_turn(row.alpha),
        (N::fine(row.a), N::fine(row.d)),
    );
    // 14 bits of a word and 28 of the twist; and for the moment 14 more of a length.
    Wrenched { force: force.map(N::settle::<42>), moment: moment.map(N::settle::<56>) }
}

/// The same before rounding. Words of 16 bits give no number above 2^61.
fn folded<N: Copy + Add<Output = N> + Sub<Output = N> + Mul<Output = N> + Neg<Output = N>>(
    [nx, ny, nz]: [N; 3],
    [tx, ty, tz]: [N; 3],
    [sine, cosine, one]: [N; 3],
    (a, d): (N, N),
) -> ([N; 3], [N; 3]) {
    let twist = |[x, y, z]: [N; 3]| [one * x, cosine * y - sine * z, sine * y + cosine * z];
    // The force pushes against the normal.
    let [fx, fy, fz] = twist([-nx, -ny, -nz]);
    // t x f = n x t.
    let [mx, my, mz] = twist([ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx]);
    ([fx, fy, fz], [mx - d * fy, my + d * fx - a * fz, mz + a * fy])
}
