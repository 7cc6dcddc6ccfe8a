//! Tests of the whole crate.

mod captures;
