//! Tests of the whole crate.

mod orphans;
mod summary_keys;
