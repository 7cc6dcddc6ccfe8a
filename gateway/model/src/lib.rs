//! What is known of cells and buses, and the requests to them. Nothing here opens a file or a socket, or reads a clock.
//!
//! | module | what |
//! |---|---|
//! | [`packets`] | frames into packets and messages |
//! | [`decode`] | classes of frames, as text and JSON |
//! | [`tracker`] | the state of a cell from its packets: identity, restarts, losses |
//! | [`table`] | the state of a live bus: each cell, and sums |
//! | [`latched`] | what the cells of a bus were told and still hold |
//! | [`central`] | torques computed centrally, in double precision |
//! | [`network`] | the tree of cells, compared with the skin |
//! | [`commission`], [`listing`] | which cells are on a bus; node ids and configuration for them |
//! | [`surface`] | the surface that a link's cells lie on, and that laid flat |
//! | [`repeat`] | requests that are repeated until they are confirmed |
//! | [`accelerometer`] | what the accelerometers of cells show while a robot moves |
//! | [`scenario`], [`generate`] | what a run does, and skins made from a recipe |

pub mod accelerometer;
pub mod central;
pub mod commission;
pub mod decode;
pub mod generate;
pub mod latched;
pub mod listing;
pub mod network;
pub mod packets;
pub mod quantiles;
pub mod repeat;
pub mod scenario;
pub mod surface;
pub mod table;
#[doc(hidden)]
pub mod testing;
pub mod tracker;

#[cfg(test)]
mod tests;
