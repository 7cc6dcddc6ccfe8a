#![doc = include_str!("../README.md")]

pub mod doctor;
pub mod embedded;
pub mod hosts;
pub mod kernel;
pub mod link;
pub mod look;
pub mod namespace;
pub mod netlink;
pub mod plan;
pub mod slcan;
