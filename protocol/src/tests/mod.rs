//! Tests of the whole crate against documents, golden frames and other programs' values.

mod candump_corpus;
mod document;
mod golden;
mod wire_time;
