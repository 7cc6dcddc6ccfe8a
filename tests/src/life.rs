//! Whether a cell is off, works or hangs.

use std::collections::VecDeque;

use cell_node::node::Node;

/// How a cell is; while it hangs, what comes in gathers.
#[derive(Debug)]
pub(crate) enum Life<W> {
    /// Without power.
    Off,
    /// As it should be.
    Runs(Box<Node>),
    /// It does nothing.
    Hangs(Box<Node>, VecDeque<W>),
}

impl<W> Life<W> {
    /// The cell, unless it is off.
    pub(crate) const fn node(&self) -> Option<&Node> {
        match self {
            Self::Runs(node) | Self::Hangs(node, _) => Some(node),
            Self::Off => None,
        }
    }

    /// Whether it works.
    pub(crate) const fn runs(&self) -> bool {
        matches!(self, Self::Runs(_))
    }

    /// It hangs, if it worked.
    pub(crate) fn hang(&mut self) {
        *self = match core::mem::replace(self, Self::Off) {
            Self::Runs(node) => Self::Hangs(node, VecDeque::new()),
            other @ (Self::Off | Self::Hangs(..)) => other,
        };
    }

    /// It works again, if it hung: what has gathered.
    pub(crate) fn go_on(&mut self) -> Option<VecDeque<W>> {
        match core::mem::replace(self, Self::Off) {
            Self::Hangs(node, waiting) => {
                *self = Self::Runs(node);
                Some(waiting)
            }
            other @ (Self::Off | Self::Runs(_)) => {
                *self = other;
                None
            }
        }
    }
}
