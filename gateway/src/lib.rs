//! To be written.

pub mod central;
pub mod controller;
pub mod robot;
pub mod scenario;
#[cfg(test)]
mod testing;
