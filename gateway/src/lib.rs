//! To be written.

pub mod central;
pub mod controller;
pub mod robot;
#[cfg(test)]
mod testing;
