//! The process environment: input files, command lines, the arithmetic of a build's cells, requests to stop, and the reason
//! of an exit.

pub mod input;
pub mod last_words;
pub mod sine;
pub mod stop;
pub mod usage;
