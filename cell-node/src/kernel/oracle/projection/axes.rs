//! The axes of a frame in base coordinates: which components are known for all joint positions, and how the axes are
//! rotated.
//!
//! The first two components of an axis are alike: both depend on the joints, except in vertical axes and in those of
//! the base. An axis is therefore characterised by its third component, [`Axis`]. Two axes that are rotated together
//! are characterised by the combination of both, [`RotationProducts`].

use crate::kernel::{Number, Twist};

/// The components of an axis or another vector, in base coordinates.
pub(super) type Vector<N> = [N; 3];

/// The components of an axis that are known for all joint positions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Axis {
    /// The axis is (0, 0, 1).
    Up,
    /// The axis is (0, 0, -1).
    Down,
    /// The third component is 0.
    Level,
    /// No component is known.
    Any,
}

/// The products needed to rotate two axes a and b to `c a + s b` and `c b - s a`, with cosine c and sine s.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum RotationProducts {
    /// No products: a and b are the first two axes of the base.
    Base,
    /// Axis b is (0, 0, 1).
    Up,
    /// Axis b is (0, 0, -1).
    Down,
    /// The third components of a and b are 0.
    Level,
    /// The third component of a is 0.
    Second,
    /// The third component of b is 0.
    First,
    /// All components of a and b need products.
    Both,
}

/// The known components of the axes x, y and z of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct AxisFrame {
    known: [Axis; 3],
    /// True if x and y are the axes of the base.
    base: bool,
}

impl AxisFrame {
    pub(super) const BASE: Self = Self { known: [Axis::Level, Axis::Level, Axis::Up], base: true };

    /// Returns the known components of the z axis.
    pub(super) fn z_axis(self) -> Axis {
        let [.., z] = self.known;
        z
    }

    /// Returns the products needed to rotate x and y by a turn about z.
    pub(super) fn z_rotation_products(self) -> RotationProducts {
        let [x, y, _] = self.known;
        if self.base { RotationProducts::Base } else { RotationProducts::new(x, y) }
    }

    /// Returns the frame after a turn about z and a twist about the new x axis, and the products needed for the twist.
    pub(super) fn after_twist<N>(self, twist: Twist<N>) -> (Self, RotationProducts) {
        let (x, v) = self.z_rotation_products().rotated_axes();
        let z = self.z_axis();
        let mix = RotationProducts::new(v, z);
        let (y, z) = match twist {
            Twist::None => (v, z),
            Twist::Ahead => (z, v.opposite()),
            Twist::Half => (v.opposite(), z.opposite()),
            Twist::Back => (z.opposite(), v),
            Twist::Other { .. } => mix.rotated_axes(),
        };
        (Self { known: [x, y, z], base: false }, mix)
    }
}

impl Axis {
    pub(super) fn is_vertical(self) -> bool {
        matches!(self, Self::Up | Self::Down)
    }

    /// Returns the known components of the opposite axis.
    fn opposite(self) -> Self {
        match self {
            Self::Up => Self::Down,
            Self::Down => Self::Up,
            Self::Level | Self::Any => self,
        }
    }
}

impl RotationProducts {
    fn new(a: Axis, b: Axis) -> Self {
        match (a, b) {
            (Axis::Level, Axis::Up) => Self::Up,
            (Axis::Level, Axis::Down) => Self::Down,
            (Axis::Level, Axis::Level) => Self::Level,
            (Axis::Level, Axis::Any) => Self::Second,
            (Axis::Any, Axis::Level) => Self::First,
            // The first axis of a pair is never upright.
            (Axis::Up | Axis::Down | Axis::Any, _) => Self::Both,
        }
    }

    /// Returns the known components of both rotated axes.
    fn rotated_axes(self) -> (Axis, Axis) {
        match self {
            Self::Base | Self::Level => (Axis::Level, Axis::Level),
            Self::Up | Self::Down | Self::First | Self::Second | Self::Both => (Axis::Any, Axis::Any),
        }
    }
}

/// The products needed to transform a vector from a frame to the base.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct BaseTransform {
    pub(super) level: HorizontalTerms,
    pub(super) height: VerticalTerms,
}

/// The axes that contribute to the first two components of the transformed vector.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum HorizontalTerms {
    Xy,
    Xz,
    All,
}

/// The axes that contribute to the third component of the transformed vector.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum VerticalTerms {
    /// The component is not needed.
    Nothing,
    /// Only the y axis, which is vertical, so no product is needed.
    Y,
    MinusY,
    Z,
    MinusZ,
    Xy,
    Xz,
    Yz,
    All,
}

impl BaseTransform {
    /// Creates the transform from a frame with these known components. `upright` is true if the third component is not
    /// needed.
    pub(super) fn new(AxisFrame { known, .. }: AxisFrame, upright: bool) -> Self {
        let [_, y, z] = known;
        let level = if y.is_vertical() {
            HorizontalTerms::Xz
        } else if z.is_vertical() {
            HorizontalTerms::Xy
        } else {
            HorizontalTerms::All
        };
        let height = match known {
            _ if upright => VerticalTerms::Nothing,
            [_, Axis::Up, _] => VerticalTerms::Y,
            [_, Axis::Down, _] => VerticalTerms::MinusY,
            [_, _, Axis::Up] => VerticalTerms::Z,
            [_, _, Axis::Down] => VerticalTerms::MinusZ,
            [Axis::Level, _, _] => VerticalTerms::Yz,
            [_, Axis::Level, _] => VerticalTerms::Xz,
            [_, _, Axis::Level] => VerticalTerms::Xy,
            _ => VerticalTerms::All,
        };
        Self { level, height }
    }
}

/// A rotation, given by its sine and cosine.
///
/// Axes have length 1 except for rounding and the error of the sine. No component can therefore leave the range of a
/// word, and no saturation is needed: see [`super::range`].
#[derive(Clone, Copy)]
pub(super) struct Rotation<N>(pub(super) [N; 2]);

impl<N: Number> Rotation<N> {
    /// Returns `c a + s b`, with cosine c and sine s.
    #[inline(always)]
    pub(super) fn rotated_first_axis(
        self,
        mix: RotationProducts,
        &[a0, a1, a2]: &Vector<N>,
        &[b0, b1, b2]: &Vector<N>,
    ) -> Vector<N> {
        let Self([sine, cosine]) = self;
        match mix {
            RotationProducts::Base => [cosine, sine, N::zero()],
            RotationProducts::Up => [rounded_product(cosine, a0), rounded_product(cosine, a1), sine],
            RotationProducts::Down => {
                [rounded_product(cosine, a0), rounded_product(cosine, a1), sine.bounded_negative()]
            }
            RotationProducts::Level => {
                [self.cosine_a_plus_sine_b(a0, b0), self.cosine_a_plus_sine_b(a1, b1), N::zero()]
            }
            RotationProducts::Second => [
                self.cosine_a_plus_sine_b(a0, b0),
                self.cosine_a_plus_sine_b(a1, b1),
                rounded_product(sine, b2),
            ],
            RotationProducts::First => [
                self.cosine_a_plus_sine_b(a0, b0),
                self.cosine_a_plus_sine_b(a1, b1),
                rounded_product(cosine, a2),
            ],
            RotationProducts::Both => [
                self.cosine_a_plus_sine_b(a0, b0),
                self.cosine_a_plus_sine_b(a1, b1),
                self.cosine_a_plus_sine_b(a2, b2),
            ],
        }
    }

    /// Replaces a by `c a + s b`, and b by `c b - s a`, with cosine c and sine s.
    #[inline(always)]
    pub(super) fn rotate_both_axes(
        self,
        mix: RotationProducts,
        [a0, a1, a2]: &mut Vector<N>,
        [b0, b1, b2]: &mut Vector<N>,
    ) {
        let Self([sine, cosine]) = self;
        let turn = |a: &mut N, b: &mut N| {
            (*a, *b) = (self.cosine_a_plus_sine_b(*a, *b), self.cosine_b_minus_sine_a(*b, *a))
        };
        // The cases in which the component of b or of a is zero.
        let first = |a: &mut N, b: &mut N| {
            (*a, *b) = (rounded_product(cosine, *a), rounded_product(sine.bounded_negative(), *a))
        };
        let second =
            |a: &mut N, b: &mut N| (*a, *b) = (rounded_product(sine, *b), rounded_product(cosine, *b));
        match mix {
            RotationProducts::Base => {
                (*a0, *a1) = (cosine, sine);
                (*b0, *b1) = (sine.bounded_negative(), cosine);
            }
            RotationProducts::Up | RotationProducts::Down => {
                first(a0, b0);
                first(a1, b1);
                (*a2, *b2) = if mix == RotationProducts::Up {
                    (sine, cosine)
                } else {
                    (sine.bounded_negative(), cosine.bounded_negative())
                };
            }
            RotationProducts::Level
            | RotationProducts::Second
            | RotationProducts::First
            | RotationProducts::Both => {
                turn(a0, b0);
                turn(a1, b1);
                match mix {
                    RotationProducts::Second => second(a2, b2),
                    RotationProducts::First => first(a2, b2),
                    RotationProducts::Both => turn(a2, b2),
                    RotationProducts::Base
                    | RotationProducts::Up
                    | RotationProducts::Down
                    | RotationProducts::Level => {}
                }
            }
        }
    }

    fn cosine_a_plus_sine_b(self, a: N, b: N) -> N {
        let Self([sine, cosine]) = self;
        N::round_bounded(N::bounded_plus(cosine.times(a), sine.times(b)))
    }

    fn cosine_b_minus_sine_a(self, b: N, a: N) -> N {
        let Self([sine, cosine]) = self;
        N::round_bounded(N::bounded_minus(cosine.times(b), sine.times(a)))
    }
}

fn rounded_product<N: Number>(factor: N, number: N) -> N {
    N::round_bounded(factor.times(number))
}

/// Negates an axis.
#[inline(always)]
pub(super) fn negate_axis<N: Number>([x, y, z]: &mut Vector<N>) {
    (*x, *y, *z) = (x.bounded_negative(), y.bounded_negative(), z.bounded_negative());
}
