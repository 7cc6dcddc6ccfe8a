//! The commands as processes: what they print, write and refuse.

mod columns;
mod commands;
mod compare;
mod convert;
mod fit;
mod fits;
mod foreign;
mod inspect;
mod memory;
mod mutations;
mod recorded;
mod recordings;
mod recover;
mod report;
mod shadow;
mod shell;
mod stops;
mod torques;
