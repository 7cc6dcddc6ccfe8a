//! Tests of the whole crate.

mod bars;
