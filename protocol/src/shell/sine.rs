//! The polynomials with which cells compute sines. They decide about the last bits of torques.

use std::fmt::{self, Display, Formatter};
use std::str::FromStr;

/// The polynomials with which the cells of a build compute sines.
///
/// The gateway records it with a run, and starts cells with the same polynomials for a replay, which then returns the
/// recorded words bit for bit.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum SineMethod {
    /// Short polynomials for the distance from the nearest quarter turn.
    #[default]
    Eighths,
    /// One polynomial of seventh order for a quarter turn, as in builds of before December 2026.
    SeventhOrder,
}

impl SineMethod {
    /// All methods, the present one first.
    pub const ALL: [Self; 2] = [Self::Eighths, Self::SeventhOrder];

    /// Returns the other method.
    #[must_use]
    pub const fn other(self) -> Self {
        match self {
            Self::Eighths => Self::SeventhOrder,
            Self::SeventhOrder => Self::Eighths,
        }
    }

    /// Returns the name in recordings and on command lines.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Eighths => "eighths",
            Self::SeventhOrder => "seventh-order",
        }
    }
}

impl Display for SineMethod {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The error for a name that no [`SineMethod`] has.
#[derive(Clone, Debug, Eq, PartialEq, thiserror::Error)]
#[error("unknown sine method {0:?}: it must be eighths or seventh-order")]
pub struct UnknownSineMethod(String);

impl FromStr for SineMethod {
    type Err = UnknownSineMethod;

    fn from_str(name: &str) -> Result<Self, UnknownSineMethod> {
        Self::ALL.into_iter().find(|it| it.name() == name).ok_or_else(|| UnknownSineMethod(name.to_owned()))
    }
}
