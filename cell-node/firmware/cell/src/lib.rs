//! A skin cell as firmware for microcontrollers: the main loop around the core of `cell-node`, and the boards.
//!
//! | module | content |
//! |---|---|
//! | [`board`] | the interface to a board |
//! | [`run`] | the cell's loop |
//! | `place` | construction of the node in a static |
//! | [`store`] | parameters in two pages of flash, safe against a loss of power |
//! | [`slcan`] | a board without a CAN controller: frames as lines over a serial line |
//! | `boards` | the boards: a file each |

#![cfg_attr(not(test), no_std)]

pub mod board;
#[cfg(target_os = "none")]
pub mod boards;
#[cfg(target_os = "none")]
pub mod place;
pub mod run;
pub mod slcan;
pub mod store;
