//! To be written.

pub mod central;
pub mod controller;
pub mod cycle;
pub mod generate;
pub mod robot;
pub mod table;
pub mod scenario;
#[cfg(test)]
mod testing;
