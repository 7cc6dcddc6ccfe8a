//! The bus of the cell under test, as the checks see it: real, or in virtual time.

use protocol::can::{Format, Frame};
use protocol::time::{Micros, Span};
use thiserror::Error;

/// A frame seen on the bus.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct ObservedFrame {
    /// The time at which the frame was on the bus, on the clock of [`TestBus::now`].
    pub at: Micros,
    /// The frame.
    pub frame: Frame,
    /// True if the bench sent the frame.
    pub own: bool,
}

/// A bus with the cell under test.
pub trait TestBus {
    /// Returns the present time of the bus's clock.
    fn now(&self) -> Micros;

    /// Returns true if frames of this format can be sent, also if the cell uses the other format.
    fn supports_format(&self, format: Format) -> bool;

    /// Sends frames, in order. [`TestBus::receive`] returns each one, marked as own, once it was on the bus.
    ///
    /// # Errors
    /// Returns [`StopReason`] if the bus does not accept the frames, or if the test is interrupted.
    fn send(&mut self, frames: &[Frame]) -> Result<(), StopReason>;

    /// Returns the next frame, or `None` if no frame arrives until then.
    ///
    /// # Errors
    /// Returns [`StopReason`] if the bus is gone, or if the test is interrupted.
    fn receive(&mut self, until: Micros) -> Result<Option<ObservedFrame>, StopReason>;

    /// Returns the maximum lateness of the bench itself since the last call, so that it does not count against the
    /// cell.
    fn bench_lateness(&mut self) -> Span;

    /// Ignores signals from now on, so that the cell can be restored.
    fn ignore_signals(&mut self);

    /// Returns true if the cell can be switched off and on.
    fn can_restart(&self) -> bool;

    /// Begins to switch the cell off and on.
    ///
    /// # Errors
    /// Returns [`StopReason`] if the restart cannot begin.
    fn begin_restart(&mut self) -> Result<(), StopReason>;

    /// Returns true while the restart is in progress.
    ///
    /// # Errors
    /// Returns [`StopReason`] if the restart failed.
    fn is_restarting(&mut self) -> Result<bool, StopReason>;
}

/// The reason why a test ends early.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
pub enum StopReason {
    /// A signal arrived.
    #[error("interrupted")]
    Interrupted,
    /// The bus cannot be used any more.
    #[error("{0}")]
    Bus(String),
    /// The cell has stopped sending.
    #[error("the cell stopped sending: no frame arrived from it for 3 s")]
    Silent,
    /// Another program commands cells on this bus.
    #[error("another program sent frame {0} to the cells: stop the gateway on this bus")]
    Gateway(String),
    /// The command of a restart failed.
    #[error("{0}")]
    Restart(String),
    /// The time limit is reached.
    #[error("the test reached its time limit")]
    Time,
}
