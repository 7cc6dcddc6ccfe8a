//! Files: captures in every format, recordings, and how files appear whole.
//!
//! | module | what |
//! |---|---|
//! | [`capture`] | captures read and written: candump text and MCAP, in one piece or in parts |
//! | [`container`] | the checked reader of MCAP records |
//! | [`recording`] | recordings of a run: their files, parts, names, and recovery |
//! | [`ros2`] | the ROS 2 messages in them, in CDR |
//! | [`files`] | files that appear whole, and logs that grow |
//! | [`order`] | frames in the order of their times |

pub mod capture;
pub mod container;
pub mod files;
mod note;
pub mod order;
pub mod recording;
pub mod ros2;

#[cfg(test)]
mod tests;
