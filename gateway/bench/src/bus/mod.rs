//! Buses of a live bench: opened or served, received from, sent on.
//!
//! | module | what |
//! |---|---|
//! | [`figures`] | figures of a timed bus, from its server |
//! | [`follow`] | follows a bus: waits, receives, counts losses, reopens, keeps the wires to the roots |
//! | [`listen`] | receives and decodes frames of an open bus |
//! | [`link`] | one bus of a run, shared by its receiver and its senders, and reopened after a loss |
//! | [`roots`] | the gateway's ends of the wires to the roots of a tree, and its receive filters |
//! | [`served`] | embedded buses served by this process |
//! | [`realtime`] | clocks, deadlines and thread privileges |

pub mod figures;
pub mod follow;
pub mod link;
pub mod listen;
pub mod realtime;
pub mod roots;
pub mod served;
pub mod time;
