//! Tests of chains: hand-written URDF files, random ones, and those of other authors.

#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

mod common;
mod examples;
mod foreign;
mod not_quite_xml;
mod random;
mod reading;
mod refusals;
mod rows;
mod written;
mod written_urdf;
