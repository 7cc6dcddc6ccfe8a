//! Evaluation of captures, and the capacity of buses.
//!
//! | module | content |
//! |---|---|
//! | [`stats`] | counts per bus and per cell |
//! | [`explain`] | the derivation of a torque |
//! | [`columns`] | a capture as NumPy files |
//! | [`compare`] | two captures of one skin, side by side |
//! | [`fit`], [`shadow`] | timing of buses: a bench before it is built, a capture on its bus |
//! | [`report`] | HTML pages with figures |
//! | [`dbc`] | a CAN database (DBC) of the packets for other tools |
//! | [`paper`] | figures of the paper |

pub mod columns;
pub mod compare;
pub mod dbc;
pub mod explain;
pub mod fit;
pub mod paper;
pub mod report;
pub mod shadow;
pub mod stats;
