//! Tests of the whole crate.

mod docs;
