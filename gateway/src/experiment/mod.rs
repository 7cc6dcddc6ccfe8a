//! The paper's experiments.

pub mod arithmetic;
pub mod central;
pub mod distributed;
pub mod line;
pub mod paper;
pub mod samples;
pub mod sums;
pub mod ticks;
pub mod tree;
