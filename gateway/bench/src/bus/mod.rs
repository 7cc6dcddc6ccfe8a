//! Buses as a live bench uses them: opened or served, received from, sent on.
//!
//! | module | what |
//! |---|---|
//! | [`follow`] | the one way to follow a bus: waits, receives, counts, reopens, keeps the wires to roots |
//! | [`listen`] | an open bus on which others send: frames, decoded |
//! | [`link`] | one bus of a run, shared by its receiver and its senders, and opened again after a loss |
//! | [`roots`] | the gateway's ends of the wires to the roots of a tree, and the frames that it receives |
//! | [`served`] | embedded buses that are served from here |
//! | [`realtime`] | clocks, deadlines and the privileges of threads |

pub mod follow;
pub mod link;
pub mod listen;
pub mod realtime;
pub mod roots;
pub mod served;
