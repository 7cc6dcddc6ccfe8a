//! The parameters with which a process opens its bus.

use protocol::bus::{Bus, BusOptions, KindChoice};

use super::StopReason;

/// The parameters for opening the bus of a process, kept so that it can be opened again.
#[derive(Clone, Debug)]
pub struct BusPort {
    /// The name of the bus.
    pub name: String,
    /// Requested kind of bus.
    pub choice: KindChoice,
    /// True if wires between cells are simulated on the bus, which must then not be real hardware.
    pub wires: bool,
    /// True if the process opens the bus again after it has closed, false if the process stops.
    pub reconnect: bool,
}

impl BusPort {
    /// Opens the bus.
    ///
    /// # Errors
    /// Returns an error if the bus does not exist, is not accessible, or does not support `options`.
    pub fn open(&self, options: &BusOptions) -> Result<Bus, StopReason> {
        let bus = Bus::open(&self.name, self.choice, options)?;
        if self.wires && bus.kind().is_interface() && !bus.is_virtual()? {
            return Err(StopReason::Real { bus: self.name.clone() });
        }
        Ok(bus)
    }
}
