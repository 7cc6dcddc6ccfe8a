//! Models of cells and buses, fed with frames and times, and the requests to cells. This crate opens no files or
//! sockets and reads no clock; its callers do.
//!
//! | module | content |
//! |---|---|
//! | [`decode`] | classes of frames, as text and JSON |
//! | [`tracker`] | the state of a cell from its packets: identity, restarts, losses |
//! | [`table`] | the state of a live bus: each cell, and sums |
//! | [`latched`] | the state that the cells of a bus hold from earlier commands |
//! | [`central`] | torques computed centrally, in double precision |
//! | [`network`] | the tree of cells, compared with the skin |
//! | [`commission`], [`listing`] | discovery of the cells on a bus; their node ids and configuration |
//! | [`surface`] | the surface that a link's cells lie on, and its flat map |
//! | [`repeat`] | requests that are repeated until they are confirmed |
//! | [`accelerometer`] | accelerometer readings of the cells while a robot moves |
//! | [`scenario`], [`generate`] | the course of a run, and skins generated from a recipe |

pub mod accelerometer;
pub mod central;
pub mod commission;
pub mod decode;
pub mod generate;
pub mod latched;
pub mod listing;
pub mod network;
pub mod repeat;
pub mod scenario;
pub mod surface;
pub mod table;
#[doc(hidden)]
pub mod testing;
pub mod tracker;

#[cfg(test)]
mod tests;
