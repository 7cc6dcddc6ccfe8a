//! Tests of the whole crate.

mod external_python;
mod scenarios;
