//! Reads and writes the files of the bench: captures in both formats, recordings of runs, and files that are replaced
//! atomically.
//!
//! | module | what |
//! |---|---|
//! | [`capture`] | reading and writing captures: candump text and MCAP, whole or in parts |
//! | [`columns`] | folders of NumPy files, one for each column of a table |
//! | [`container`] | the checked reader of MCAP records |
//! | [`recording`] | recordings of a run: their files, parts, names, and recovery |
//! | [`ros2`] | the ROS 2 messages in them, in CDR |
//! | [`files`] | files that are replaced atomically, and logs that grow |
//! | [`order`] | merging of buses by the times of their frames |

pub mod capture;
pub mod columns;
pub mod container;
pub mod files;
mod note;
pub mod order;
pub mod recording;
pub mod ros2;

#[cfg(test)]
mod tests;
