//! Tests of the whole crate against its documents, golden frames and the values of other programs.

mod candump_corpus;
mod document;
mod golden;
mod wire_time;
