//! What a board has to offer.

use cell_node::node::Node;
use protocol::can::Frame;
use protocol::factory::Factory;
use protocol::time::{Micros, Span};

use crate::store::Flash;

/// A microcontroller with a bus, a clock, flash and a watchdog.
pub trait Board {
    /// Its flash for parameters.
    type Flash: Flash;

    /// What it knows from the factory; `None` where nobody has written that. Asked once, at the start.
    fn factory(&mut self) -> Option<Factory>;

    /// Opens the bus; nothing is received before.
    fn open(&mut self, factory: &Factory);

    /// The time since the start, in µs. Never goes back, and is asked for at least once a second.
    fn now(&mut self) -> Micros;

    /// The next frame that came, and when it did; at most once it returns `None`, [`Board::sleep_until`] waits.
    fn receive(&mut self) -> Option<(Frame, Micros)>;

    /// Gives a frame to the CAN controller; waits while that has no room. What cannot be sent is lost.
    fn send(&mut self, frame: &Frame);

    /// Sets the receive filters to what the cell receives now. Frames that pass although they need not do no harm.
    fn filter(&mut self, node: &Node, factory: &Factory) {
        let _ = (node, factory);
    }

    /// Sleeps until then, or until something comes; may return earlier. At most [`LONGEST_SLEEP`].
    fn sleep_until(&mut self, due: Micros);

    /// Nothing more to do, until somebody loads another program.
    fn rest(&mut self) -> ! {
        loop {
            self.feed();
            let now = self.now();
            self.sleep_until(now + Span(LONGEST_SLEEP));
        }
    }

    /// Tells the watchdog that the loop turns; it must bite after 2 s without.
    fn feed(&mut self);

    /// Its flash for parameters.
    fn flash(&mut self) -> &mut Self::Flash;

    /// What another keeper has of this cell's parameters, which goes before what flash holds: its bytes in `into`,
    /// and how many there are. Boards have none; an emulator does, because its flash ends with it.
    fn kept_elsewhere(&mut self, into: &mut [u8]) -> Option<usize> {
        let _ = into;
        None
    }

    /// Gives the image that flash holds now to that keeper; whether it has it.
    fn keep_elsewhere(&mut self, image: &[u8]) -> bool {
        let _ = image;
        true
    }
}

/// The longest sleep, in µs: the watchdog is fed after it, and the clock does not miss a wrap of its counter.
pub const LONGEST_SLEEP: u64 = 500_000;

/// A counter of 32 bits and 1 MHz as a clock that does not wrap.
#[derive(Debug, Default)]
pub struct Clock {
    wraps: u64,
    last: u32,
}

impl Clock {
    /// The time when the counter has this value; call it at least once in 71 minutes.
    pub fn at(&mut self, counter: u32) -> Micros {
        if counter < self.last {
            self.wraps += 1 << 32;
        }
        self.last = counter;
        Micros(self.wraps | u64::from(counter))
    }

    /// The time when the counter had this value, less than 71 minutes before `now`.
    #[must_use]
    pub fn before(now: Micros, counter: u32) -> Micros {
        Micros(now.0 - u64::from(low(now).wrapping_sub(counter)))
    }
}

/// The counter's value at a time.
#[must_use]
pub const fn low(at: Micros) -> u32 {
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
        assert_eq!(Clock::before(Micros(wrap + 3), u32::MAX), Micros(wrap - 1));
        assert_eq!(Clock::before(Micros(wrap + 3), 3), Micros(wrap + 3));
    }
}
