//! The process environment: input files, command lines, requests to stop, and the reason of an exit.

pub mod input;
pub mod last_words;
pub mod stop;
pub mod usage;
