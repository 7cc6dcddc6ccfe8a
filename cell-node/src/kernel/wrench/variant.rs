//! The choice between the variants of the kernel: in Rust or in assembly, and with the sine of this or of earlier builds.

#[cfg(feature = "earlier-sine")]
use protocol::sine::SineMethod;

use super::{Scalar, Wrench};

impl<S: Scalar> Wrench<S> {
    /// Returns true if J is computed in assembly, which has the same words.
    #[cfg(feature = "oracle")]
    #[must_use]
    pub const fn is_in_assembly(&self) -> bool {
        #[cfg(armv6m)]
        return self.program.is_prepared();
        #[cfg(not(armv6m))]
        false
    }

    /// Computes J with the code in Rust from now on, for comparison.
    #[cfg(feature = "oracle")]
    pub const fn use_rust_code(&mut self) {
        #[cfg(armv6m)]
        {
            self.program = super::cortex_m0::Program::NONE;
        }
    }

    /// Computes J with the sine of another build from now on.
    #[cfg(feature = "earlier-sine")]
    pub const fn set_sine(&mut self, sine: SineMethod) {
        self.sine = sine;
    }
}
