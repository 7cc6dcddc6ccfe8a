//! The bus that a process opens.

use protocol::bus::{Bus, KindChoice, BusOptions};

use super::StopReason;

/// The parameters for opening a bus, also repeatedly.
#[derive(Clone, Debug)]
pub struct BusPort {
    /// The name of the bus.
    pub name: String,
    /// The requested kind of bus.
    pub choice: KindChoice,
    /// True if wires between cells are simulated on the bus, which must then not be real hardware.
    pub wires: bool,
    /// True to open the bus again after it has closed, instead of stopping.
    pub reconnect: bool,
}

impl BusPort {
    /// Opens the bus.
    ///
    /// # Errors
    /// Returns an error if the bus cannot be used as requested.
    pub fn open(&self, options: &BusOptions) -> Result<Bus, StopReason> {
        let bus = Bus::open(&self.name, self.choice, options)?;
        if self.wires && bus.kind().is_interface() && !bus.is_virtual()? {
            return Err(StopReason::Real { bus: self.name.clone() });
        }
        Ok(bus)
    }
}
