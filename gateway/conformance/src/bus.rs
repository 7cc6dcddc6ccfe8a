//! The bus that the cell is on, as the checks see it: in virtual time or real.

use protocol::can::{Format, Frame};
use protocol::time::{Micros, Span};
use thiserror::Error;

/// A frame that was on the bus.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Seen {
    /// When, on the clock of [`Bus::now`].
    pub at: Micros,
    /// The frame.
    pub frame: Frame,
    /// Whether the bench sent it.
    pub own: bool,
}

/// A bus with the cell on it.
pub trait Bus {
    /// The time.
    fn now(&self) -> Micros;

    /// Whether frames of this format can be sent, whatever format the cell's are.
    fn carries(&self, format: Format) -> bool;

    /// Sends frames, in order. Each comes back by [`Bus::receive`], marked as own, when it was on the bus.
    ///
    /// # Errors
    /// When the bus does not take them, or the test is interrupted.
    fn send(&mut self, frames: &[Frame]) -> Result<(), Stop>;

    /// The next frame, if there is one until then.
    ///
    /// # Errors
    /// When the bus is gone, or the test is interrupted.
    fn receive(&mut self, until: Micros) -> Result<Option<Seen>, Stop>;

    /// By how much the bench itself was late at most since this was called last: it is not the cell's fault.
    fn lateness(&mut self) -> Span;

    /// From now on no signal interrupts: the cell is put back.
    fn finish(&mut self);

    /// Whether the cell can be switched off and on.
    fn can_restart(&self) -> bool;

    /// Begins to switch the cell off and on.
    ///
    /// # Errors
    /// When it cannot be done.
    fn begin_restart(&mut self) -> Result<(), Stop>;

    /// Whether that is still being done.
    ///
    /// # Errors
    /// When it failed.
    fn is_restarting(&mut self) -> Result<bool, Stop>;
}

/// Why a test ends before its end.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
pub enum Stop {
    /// A signal came.
    #[error("interrupted")]
    Interrupted,
    /// The bus cannot be used any more.
    #[error("{0}")]
    Bus(String),
    /// The cell sends nothing any more.
    #[error("the cell fell silent: nothing came for 3 s")]
    Silent,
    /// Somebody else commands cells.
    #[error("{0} was sent by somebody else: stop the gateway that is on this bus")]
    Gateway(String),
    /// The command of a restart failed.
    #[error("{0}")]
    Restart(String),
    /// The time is over.
    #[error("the time was over")]
    Time,
}
