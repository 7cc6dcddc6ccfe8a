//! Tests that involve several modules of the crate.

mod captures;
