#![doc = include_str!("../README.md")]

pub mod bus_model;
pub mod capture;
pub mod central;
pub mod commission;
pub mod container;
pub mod controller;
pub mod cycle;
pub mod dbc;
pub mod decode;
pub mod experiment;
pub mod explain;
pub mod external;
pub mod files;
pub mod fit;
pub mod generate;
pub mod listing;
pub mod motion;
pub mod network;
pub mod order;
pub mod paper;
pub mod quantiles;
pub mod record;
pub mod replay;
pub mod report;
pub mod robot;
pub mod ros2;
pub mod run;
pub mod scenario;
pub mod shadow;
pub mod signals;
mod stimuli;
pub mod summary;
pub mod table;
#[cfg(test)]
mod testing;
