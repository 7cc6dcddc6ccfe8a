//! Where the bus of a process comes from.

use protocol::bus::{Bus, BusKind, Choice, Options};

use super::Stopped;

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
    /// When it cannot be used as requested.
    pub fn open(&self, options: &Options) -> Result<Bus, Stopped> {
        let bus = Bus::open(&self.name, self.choice, options)?;
        if self.wires && bus.kind() == BusKind::SocketCan && !bus.is_virtual()? {
            return Err(Stopped::Real { bus: self.name.clone() });
        }
        Ok(bus)
    }
}
