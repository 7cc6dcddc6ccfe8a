#![doc = include_str!("../README.md")]
#![cfg_attr(not(feature = "std"), no_std)]

pub mod baseline;
pub mod contact;
pub mod flash;
pub mod identity;
#[cfg(feature = "host")]
pub mod io;
pub mod kernel;
mod network;
pub mod node;
mod phase;
pub mod sine;
pub mod sum;

// The oracle of the tests is shared with benchmarks and examples, which refer to the crate by name.
#[cfg(test)]
extern crate self as cell_node;

#[cfg(test)]
mod tests;
