#![doc = include_str!("../README.md")]
#![cfg_attr(not(any(feature = "host", test)), no_std)]

#[cfg(feature = "host")]
pub mod bus;
pub mod can;
pub mod candump;
#[cfg(feature = "host")]
pub mod document;
pub mod factory;
pub mod fixed;
pub mod id;
#[cfg(feature = "host")]
pub mod input;
#[cfg(feature = "host")]
pub mod last_words;
pub mod message;
pub mod packet;
pub mod parameters;
#[cfg(feature = "host")]
pub mod schema;
#[cfg(feature = "host")]
pub mod skin;
pub mod slcan;
#[cfg(feature = "host")]
pub mod stop;
pub mod time;
pub mod touch;
#[cfg(feature = "host")]
pub mod usage;
pub mod wire;
pub mod wire_time;
#[cfg(feature = "host")]
pub mod xml;

#[cfg(test)]
mod tests;
