//! The turn of a wrench about the axis of a joint, and the sine that it takes.

use protocol::fixed::Q1_14;

use super::{PerComponent, due};
use crate::kernel::Number;
use crate::kernel::rounding::Rounding;

/// A sine and cosine for the angles of joints.
pub(super) trait SineFunction {
    /// Returns sine and cosine of an angle in quarter turns.
    fn sine_cosine<N: Number>(angle: Q1_14) -> [N; 2];
}

/// The sine of cells.
pub(super) enum CellSine {}

impl SineFunction for CellSine {
    #[inline(always)]
    fn sine_cosine<N: Number>(angle: Q1_14) -> [N; 2] {
        N::sine_cosine(angle)
    }
}

/// The sine of cells of earlier builds.
#[cfg(feature = "earlier-sine")]
pub(super) enum SeventhOrderSine {}

#[cfg(feature = "earlier-sine")]
impl SineFunction for SeventhOrderSine {
    #[inline(always)]
    fn sine_cosine<N: Number>(angle: Q1_14) -> [N; 2] {
        N::seventh_order_sine_cosine(angle)
    }
}

/// A rotation `Rz`, given by its sine and cosine.
pub(super) struct Rotation<N>([N; 2]);

impl<N: Number> Rotation<N> {
    #[inline(always)]
    pub(super) const fn new(sine_cosine: [N; 2]) -> Self {
        Self(sine_cosine)
    }

    #[inline(always)]
    fn rotated_x<R: Rounding>(&self, x: N, y: N) -> N {
        let Self([sine, cosine]) = self;
        R::rounded_difference(cosine.times(x), sine.times(y))
    }

    #[inline(always)]
    fn rotated_y<R: Rounding>(&self, x: N, y: N) -> N {
        let Self([sine, cosine]) = self;
        R::rounded_sum(sine.times(x), cosine.times(y))
    }

    #[inline(always)]
    pub(super) fn rotate_all_components<R: Rounding>(
        &self,
        PerComponent { force: [fx, fy, _], moment: [mx, my, _] }: &mut PerComponent<N>,
    ) {
        (*fx, *fy) = (self.rotated_x::<R>(*fx, *fy), self.rotated_y::<R>(*fx, *fy));
        (*mx, *my) = (self.rotated_x::<R>(*mx, *my), self.rotated_y::<R>(*mx, *my));
    }

    /// Computes only the results of the turn whose bits are set in `due`.
    #[inline(always)]
    pub(super) fn rotate_due_components<R: Rounding>(&self, wrench: &mut PerComponent<N>, due: u32) {
        let PerComponent { force: [fx, fy, _], moment: [mx, my, _] } = *wrench;
        let PerComponent { force: [new_fx, new_fy, _], moment: [new_mx, new_my, _] } = wrench;
        if due & due::NEEDS_TURNED_FX != 0 {
            *new_fx = self.rotated_x::<R>(fx, fy);
        }
        if due & due::NEEDS_TURNED_FY != 0 {
            *new_fy = self.rotated_y::<R>(fx, fy);
        }
        if due & due::NEEDS_TURNED_MX != 0 {
            *new_mx = self.rotated_x::<R>(mx, my);
        }
        if due & due::NEEDS_TURNED_MY != 0 {
            *new_my = self.rotated_y::<R>(mx, my);
        }
    }
}
