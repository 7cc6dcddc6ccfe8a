//! The wire format: frames, identifiers, packets, messages and their timing. Cells, firmware and gateway share these
//! modules, so all except [`schema`] need neither an operating system nor a heap.

pub mod can;
pub mod candump;
pub mod factory;
pub mod fixed;
pub mod id;
pub mod message;
pub mod packet;
pub mod parameters;
pub mod port;
#[cfg(feature = "host")]
pub mod schema;
pub mod slcan;
pub mod time;
pub mod touch;
pub mod wire_time;
