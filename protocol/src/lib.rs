#![doc = include_str!("../README.md")]
#![cfg_attr(not(any(feature = "host", test)), no_std)]

pub mod can;
pub mod candump;
pub mod fixed;
pub mod id;
pub mod message;
pub mod packet;
pub mod parameters;
pub mod time;
