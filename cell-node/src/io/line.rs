//! Where the bus of a process comes from.

use std::time::Duration;

use protocol::bus::{Bus, BusError, BusKind, Choice, Options};

use super::Stopped;

/// From one attempt to open a bus that is away to the next.
const AGAIN: Duration = Duration::from_millis(100);

/// A bus that can be opened, and opened again.
#[derive(Clone, Debug)]
pub struct Line {
    /// Its name.
    pub name: String,
    /// What kind of bus it shall be.
    pub choice: Choice,
    /// Whether wires between cells are simulated on it, which no real bus may carry.
    pub wires: bool,
    /// Whether to open it again when it is gone, instead of stopping.
    pub reconnect: bool,
}

impl Line {
    /// Opens it.
    ///
    /// # Errors
    /// When it cannot be used as it is asked for.
    pub fn open(&self, options: &Options) -> Result<Bus, Stopped> {
        let bus = Bus::open(&self.name, self.choice, options)?;
        if self.wires && bus.kind() == BusKind::SocketCan && !bus.is_virtual()? {
            return Err(Stopped::Real { bus: self.name.clone() });
        }
        Ok(bus)
    }

    /// Opens it as soon as it is there.
    ///
    /// # Errors
    /// When it cannot be used as it is asked for, and waiting would not help.
    pub fn open_again(&self, options: &Options) -> Result<Bus, Stopped> {
        loop {
            std::thread::sleep(AGAIN);
            match self.open(options) {
                Err(Stopped::Bus(error)) if error.may_open_later() => {}
                opened => return opened,
            }
        }
    }

    /// Whether this is a reason to open it again.
    pub(super) const fn is_gone(&self, error: &BusError) -> bool {
        self.reconnect && error.is_closed()
    }
}
