#![doc = include_str!("../README.md")]
#![cfg_attr(not(any(feature = "host", test)), no_std)]

#[cfg(feature = "host")]
pub mod bus;
#[cfg(feature = "host")]
pub mod packets;
#[cfg(feature = "host")]
pub mod quantiles;
#[cfg(feature = "host")]
mod shell;
#[cfg(feature = "host")]
mod skin_file;
mod wire;

#[cfg(feature = "host")]
pub use shell::{input, last_words, sine, stop, usage};
#[cfg(feature = "host")]
pub use skin_file::{document, skin, xml};
#[cfg(feature = "host")]
pub use wire::schema;
pub use wire::{
    can, candump, factory, fixed, id, message, packet, parameters, port, slcan, time, touch, wire_time,
};

#[cfg(test)]
mod tests;
