//! The power state of a cell: off, running or hung.

use std::collections::VecDeque;

use cell_node::node::Node;

/// The power state of a cell. While the cell hangs, its input collects.
#[derive(Debug)]
pub(crate) enum PowerState<W> {
    /// The cell has no power.
    Off,
    /// The cell works normally.
    Runs(Box<Node>),
    /// The cell hangs: it does nothing, and its input waits.
    Hangs(Box<Node>, VecDeque<W>),
}

impl<W> PowerState<W> {
    /// Returns the cell, unless it is off.
    pub(crate) const fn node(&self) -> Option<&Node> {
        match self {
            Self::Runs(node) | Self::Hangs(node, _) => Some(node),
            Self::Off => None,
        }
    }

    /// Returns true if the cell works.
    pub(crate) const fn runs(&self) -> bool {
        matches!(self, Self::Runs(_))
    }

    /// Hangs a working cell.
    pub(crate) fn hang(&mut self) {
        *self = match core::mem::replace(self, Self::Off) {
            Self::Runs(node) => Self::Hangs(node, VecDeque::new()),
            other @ (Self::Off | Self::Hangs(..)) => other,
        };
    }

    /// Makes a hung cell work again, and returns the collected input.
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
