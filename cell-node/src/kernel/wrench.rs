//! The wrench kernel: the contact, carried down the chain.
//!
//! Eq. 8 is a scalar triple product, and a contact on a link is a constant wrench in that link's frame:
//! the force f and its moment m = t x f about the frame's origin. From frame l to frame l-1, whose
//! transform is `Rz(theta_l) Tz(d_l) Tx(a_l) Rx(alpha_l)`, the wrench goes in three steps:
//!
//! ```text
//! twist   f, m by Rx(alpha_l)
//! shift   m_x -= d f_y     m_y += d f_x - a f_z     m_z += a f_y
//!         J_l = m_z
//! turn    f, m by Rz(theta_l)
//! ```
//!
//! The turn leaves m_z alone, so J_l can be read before it, and the base's own angle theta_1 is never
//! needed. Twist and shift of joint k are constant too and are folded into the six stored words. What
//! nobody reads further down the chain is not computed: [`Live`] says what is, worked out once.

use core::ops::{Add, Mul, Neg, Sub};

use protocol::fixed::Q1_14;
use protocol::parameters::{MAX_JOINTS, Parameters, Pose, Row};

use super::{Kernel, Scalar, Twist, angle, length};

/// The wrench kernel, of one cell.
///
/// For a UR5 and a cell on its last link: 40 multiplications, 24 additions or subtractions, 5 sines and
/// 5 cosines. Over 300 poses of a UR5 the torques err by 1.2e-4 Nm in the mean and 1.5e-3 Nm at most.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wrench<S = Q1_14> {
    /// The joint that moves the cell; 0 when there is none.
    joint: usize,
    /// The contact's wrench, twisted and shifted by joint k's row: what the turn by theta_k takes.
    contact: Wrenched<S>,
    /// How to get from the turn of joint l+1 to that of joint l; those below k are in use.
    links: [Link<S>; MAX_JOINTS - 1],
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

    /// The same of both.
    fn each(self, before: impl Fn([bool; 3]) -> [bool; 3]) -> Self {
        Self { force: before(self.force), moment: before(self.moment) }
    }
}

/// The steps from the frame of joint l to that of joint l-1, beginning with the turn by theta_(l+1).
#[derive(Clone, Copy, Debug, PartialEq)]
struct Link<S> {
    /// What the turn computes.
    turned: Live,
    /// theta_offset of joint l+1.
    offset: Q1_14,
    /// What the twist computes.
    twisted: Live,
    twist: Twist<S>,
    a: Option<S>,
    d: Option<S>,
}

impl<S: Scalar> Kernel<S> for Wrench<S> {
    fn new(parameters: &Parameters) -> Self {
        let chain = parameters.chain();
        let nothing = Wrenched { force: [S::zero(); 3], moment: [S::zero(); 3] };
        let contact = chain.last().map_or(nothing, |last| fold(&parameters.pose, last));
        let mut read = Live::NOTHING; // by the links further down: nothing below joint 1
        let links = core::array::from_fn(|index| {
            let [row, above] = [index, index + 1].map(|row| parameters.rows.get(row).copied());
            let link;
            (link, read) = Link::new(&row.unwrap_or_default(), above.unwrap_or_default().theta_offset, read);
            link
        });
        Self { joint: chain.len(), contact, links }
    }

    fn jacobian(&self, joints: &[Q1_14; MAX_JOINTS]) -> [S; MAX_JOINTS] {
        let mut jacobian = [S::zero(); MAX_JOINTS];
        let mut wrench = self.contact;
        let Some((last, rest)) = jacobian.get_mut(..self.joint).and_then(<[S]>::split_last_mut) else {
            return jacobian;
        };
        [_, _, *last] = wrench.moment;
        let above = joints.get(1..self.joint).unwrap_or_default();
        for ((row, link), &position) in rest.iter_mut().zip(&self.links).zip(above).rev() {
            wrench = link.carry(wrench, position);
            [_, _, *row] = wrench.moment;
        }
        jacobian
    }
}

impl<S: Scalar> Link<S> {
    /// The link below the turn of the joint `above`, when the turn after it reads `read`; and what it
    /// reads itself.
    fn new(row: &Row, offset: Q1_14, read: Live) -> (Self, Live) {
        let twist = Twist::new(row.alpha);
        let (a, d) = (length(row.a), length(row.d));

        // Backwards: the shift, whose m_z is J.
        let ([fx, fy, fz], [mx, my, _]) = (read.force, read.moment);
        let twisted = Live {
            force: [
                fx || (my && d.is_some()),
                fy || (mx && d.is_some()) || a.is_some(),
                fz || (my && a.is_some()),
            ],
            moment: [mx, my, true],
        };
        let turned = twisted.each(|live| before_twist(twist, live));
        (Self { turned, offset, twisted, twist, a, d }, turned.each(before_turn))
    }

    #[inline]
    fn carry(&self, wrench: Wrenched<S>, position: Q1_14) -> Wrenched<S> {
        let Wrenched { force, moment } = self.turn(wrench, position);
        let force = self.twist.apply(force, self.twisted.force);
        let moment = self.twist.apply(moment, self.twisted.moment);
        Wrenched { force, moment: self.shift(force, moment) }
    }

    /// `Rz(theta)`, but only what is live.
    #[inline]
    fn turn(&self, wrench: Wrenched<S>, position: Q1_14) -> Wrenched<S> {
        let ([fx, fy, _], [mx, my, _]) = (self.turned.force, self.turned.moment);
        if !(fx || fy || mx || my) {
            return wrench;
        }
        let angle = angle::<S>(position, self.offset);
        let (sine, cosine) = (S::sine(angle), S::cosine(angle));
        let turn = |[x, y, z]: [S; 3], [live_x, live_y, _]: [bool; 3]| {
            [
                if live_x { S::round(S::minus(cosine.times(x), sine.times(y))) } else { x },
                if live_y { S::round(S::plus(sine.times(x), cosine.times(y))) } else { y },
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
    fn shift(&self, [fx, fy, fz]: [S; 3], [mut mx, mut my, mut mz]: [S; 3]) -> [S; 3] {
        let [live_x, live_y, _] = self.twisted.moment;
        if live_y {
            my = match (self.d, self.a) {
                (None, None) => my,
                (Some(d), None) => S::round(S::plus(my.widen(), d.times(fx))),
                (None, Some(a)) => S::round(S::minus(my.widen(), a.times(fz))),
                (Some(d), Some(a)) => S::round(S::minus(S::plus(my.widen(), d.times(fx)), a.times(fz))),
            };
        }
        if let Some(d) = self.d
            && live_x
        {
            mx = S::round(S::minus(mx.widen(), d.times(fy)));
        }
        if let Some(a) = self.a {
            mz = S::round(S::plus(mz.widen(), a.times(fy)));
        }
        [mx, my, mz]
    }
}

impl<S: Scalar> Twist<S> {
    /// `Rx(alpha)`, but only what is live.
    #[inline]
    fn apply(self, [x, y, z]: [S; 3], [_, live_y, live_z]: [bool; 3]) -> [S; 3] {
        let negative = |number: S, live: bool| if live { number.negative() } else { number };
        match self {
            Self::None => [x, y, z],
            Self::Ahead => [x, negative(z, live_y), y],
            Self::Half => [x, negative(y, live_y), negative(z, live_z)],
            Self::Back => [x, z, negative(y, live_z)],
            Self::Other { sine, cosine } => [
                x,
                if live_y { S::round(S::minus(cosine.times(y), sine.times(z))) } else { y },
                if live_z { S::round(S::plus(sine.times(y), cosine.times(z))) } else { z },
            ],
        }
    }
}

/// What must be there before a twist, for these to be there after it.
fn before_twist<S>(twist: Twist<S>, [x, y, z]: [bool; 3]) -> [bool; 3] {
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
fn fold<S: Scalar>(pose: &Pose, row: &Row) -> Wrenched<S> {
    let (force, moment) = folded(
        pose.normal.map(S::fine),
        pose.position.map(S::fine),
        S::fine_turn(row.alpha),
        (S::fine(row.a), S::fine(row.d)),
    );
    // 14 bits of a word and 28 of the twist; and for the moment 14 more of a length.
    Wrenched { force: force.map(S::settle::<42>), moment: moment.map(S::settle::<56>) }
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
