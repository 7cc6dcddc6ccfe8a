//! What is known of cells and buses, and what is asked of them. Nothing here opens a file or a socket, or looks at a clock.
//!
//! | module | what |
//! |---|---|
//! | [`decode`] | frames into packets, and packets into words |
//! | [`tracker`] | what is known of a cell by what it says: who it is, whether it started again, what is lost |
//! | [`table`] | what a live bus has said: each cell, and sums |
//! | [`central`] | torques computed centrally, in double precision |
//! | [`network`] | the tree of cells, and whether it is as the skin says |
//! | [`commission`], [`listing`] | who is there, and giving it its number and configuration |
//! | [`repeat`] | requests that are repeated until they are confirmed |
//! | [`scenario`], [`generate`] | what a run does, and skins made from a recipe |

pub mod central;
pub mod commission;
pub mod decode;
pub mod generate;
pub mod listing;
pub mod network;
pub mod quantiles;
pub mod repeat;
pub mod scenario;
pub mod table;
#[doc(hidden)]
pub mod testing;
pub mod tracker;
