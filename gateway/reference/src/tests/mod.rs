//! Tests of the whole crate.

mod arithmetic;
mod vectors;
