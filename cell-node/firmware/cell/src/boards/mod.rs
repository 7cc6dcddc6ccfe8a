//! The boards, a file each: `board::Board` by the registers of a microcontroller.

#[cfg(feature = "microbit")]
mod microbit;
#[cfg(feature = "stm32g4")]
mod stm32g4;

#[cfg(feature = "microbit")]
pub use microbit::Chosen;
#[cfg(feature = "stm32g4")]
pub use stm32g4::Chosen;

use core::ptr::read_volatile;

use protocol::factory::{BYTES, ERASED, Factory};

/// The record in its own page of flash. It is erased until whoever makes the cell writes it.
#[used]
#[unsafe(link_section = ".factory")]
static FACTORY: [u8; BYTES] = ERASED;

unsafe extern "C" {
    /// Where the pages for parameters begin: an address, not a value.
    static _store: u32;
}

/// What the factory has written; read from flash, not from what the compiler knows of it.
fn factory() -> Option<Factory> {
    // SAFETY: a static of this very type; it is only read.
    Factory::decode(&unsafe { read_volatile(&raw const FACTORY) })
}

/// The address of the first page for parameters.
fn store() -> usize {
    (&raw const _store).addr()
}
