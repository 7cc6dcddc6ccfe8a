//! Tests of the whole crate with ready-made scenarios and with an external program.

mod external_python;
mod scenarios;
