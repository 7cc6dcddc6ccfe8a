//! Evaluation of captures, and what a bus can carry.
//!
//! | module | what |
//! |---|---|
//! | [`stats`] | counts of each bus and each cell |
//! | [`explain`] | where a torque comes from |
//! | [`compare`] | two captures of one skin, side by side |
//! | [`fit`], [`shadow`] | timing of buses: a bench before it is built, a capture on its bus |
//! | [`report`] | pages with figures |
//! | [`dbc`] | packets for other tools |
//! | [`paper`] | figures of the paper |

pub mod compare;
pub mod dbc;
pub mod explain;
pub mod fit;
pub mod paper;
pub mod report;
pub mod shadow;
pub mod stats;
