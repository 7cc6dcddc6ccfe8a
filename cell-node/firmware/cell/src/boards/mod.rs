//! The boards, one file each. A board implements `board::Board` with the registers of a microcontroller.

#[cfg(feature = "microbit")]
mod microbit;
#[cfg(feature = "stm32g4")]
mod stm32g4;

#[cfg(feature = "microbit")]
pub use microbit::SelectedBoard;
#[cfg(feature = "stm32g4")]
pub use stm32g4::SelectedBoard;

use core::ptr::read_volatile;

use protocol::factory::{ERASED_RECORD, FactoryRecord, RECORD_BYTES};

/// The factory record, in a flash page of its own. The page is erased until the manufacturer writes it.
#[used]
#[unsafe(link_section = ".factory")]
static FACTORY: [u8; RECORD_BYTES] = ERASED_RECORD;

unsafe extern "C" {
    /// The start of the pages for parameters; only its address is meaningful.
    static _store: u32;
}

/// Reads the factory record from flash. The volatile read keeps the compiler from using the initial value.
fn factory() -> Option<FactoryRecord> {
    // SAFETY: a static of this type, which is only read.
    FactoryRecord::decode(&unsafe { read_volatile(&raw const FACTORY) })
}

/// Returns the address of the first page for parameters.
fn store() -> usize {
    (&raw const _store).addr()
}
