//! The interface between the firmware of a cell and a board.

use cell_node::node::Node;
use protocol::can::Frame;
use protocol::factory::FactoryRecord;
use protocol::time::{Micros, Span};

use crate::store::Flash;

/// A microcontroller with a bus, a clock, flash and a watchdog.
pub trait Board {
    /// The flash for parameters.
    type Flash: Flash;

    /// Returns the factory record; `None` if it is blank. The firmware calls this once, at the start.
    fn factory(&mut self) -> Option<FactoryRecord>;

    /// Opens the bus. No frames are received before.
    fn open(&mut self, factory: &FactoryRecord);

    /// Returns the time since the start, which never decreases. The firmware calls this at least once a second.
    fn now(&mut self) -> Micros;

    /// Returns the next received frame and its time of arrival; `None` if no frame is pending.
    fn receive(&mut self) -> Option<(Frame, Micros)>;

    /// Passes a frame to the CAN controller. Waits while the controller has no room. A frame that cannot be sent is
    /// lost.
    fn send(&mut self, frame: &Frame);

    /// Sets the receive filters to the identifiers that the cell receives in its present state. A board may pass other
    /// frames too, because the node ignores them.
    fn filter(&mut self, node: &Node, factory: &FactoryRecord) {
        let _ = (node, factory);
    }

    /// Sleeps until the time `due` or until a frame arrives, but at most [`MAX_SLEEP`]. May return early.
    fn sleep_until(&mut self, due: Micros);

    /// Stops forever, until another program is loaded into the microcontroller.
    fn idle(&mut self) -> ! {
        loop {
            self.feed();
            let now = self.now();
            self.sleep_until(now + Span(MAX_SLEEP));
        }
    }

    /// Feeds the watchdog, which must reset the processor if it is not fed for 2 s.
    fn feed(&mut self);

    /// Returns the flash for parameters.
    fn flash(&mut self) -> &mut Self::Flash;

    /// Reads the flash image of this cell from a copy outside the microcontroller, which takes precedence over flash.
    /// Returns the number of bytes written to `into`; `None` without such a copy. Only an emulator has a copy, because
    /// the emulated flash does not persist.
    fn load_external(&mut self, into: &mut [u8]) -> Option<usize> {
        let _ = into;
        None
    }

    /// Writes an image, which flash already holds, to the copy outside the microcontroller. Returns true on success.
    fn store_external(&mut self, image: &[u8]) -> bool {
        let _ = image;
        true
    }
}

/// Maximum duration of a sleep in µs. It is short enough to feed the watchdog in time, and to detect every wrap of the
/// clock's counter.
pub const MAX_SLEEP: u64 = 500_000;

/// A clock that does not wrap, from a 32-bit counter with 1 MHz.
#[derive(Debug, Default)]
pub struct Clock {
    wraps: u64,
    last: u32,
}

impl Clock {
    /// Returns the time for the present counter value. It must be called at least every 71 minutes, the period of the
    /// counter.
    pub fn at(&mut self, counter: u32) -> Micros {
        if counter < self.last {
            self.wraps += 1 << 32;
        }
        self.last = counter;
        Micros(self.wraps | u64::from(counter))
    }

    /// Returns the time at which the counter had this value. It must be less than 71 minutes before `now`.
    #[must_use]
    pub fn time_of(now: Micros, counter: u32) -> Micros {
        Micros(now.0 - u64::from(counter_value(now).wrapping_sub(counter)))
    }
}

/// Returns the counter value at a time: the lower 32 bits.
#[must_use]
pub const fn counter_value(at: Micros) -> u32 {
    let [a, b, c, d, ..] = at.0.to_le_bytes();
    u32::from_le_bytes([a, b, c, d])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_clock_goes_on_when_its_counter_wraps() {
        let mut clock = Clock::default();
        let times = [5, u32::MAX, 3, 4, u32::MAX - 1, 0].map(|counter| clock.at(counter).0);
        let wrap = 1 << 32;
        assert_eq!(times, [5, wrap - 1, wrap + 3, wrap + 4, 2 * wrap - 2, 2 * wrap]);
        assert_eq!(Clock::time_of(Micros(wrap + 3), u32::MAX), Micros(wrap - 1));
        assert_eq!(Clock::time_of(Micros(wrap + 3), 3), Micros(wrap + 3));
    }
}
