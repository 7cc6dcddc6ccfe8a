//! The latched state of a bus: what its cells were told and still hold, so that a reader or a cell that begins in the
//! middle of a recording reaches the same state as one that received all of it.
//!
//! | module | what | used by |
//! |---|---|---|
//! | [`packets`] | the packets that still count, as they were on the bus | recordings, which begin each part with them |
//! | [`state`] | the state before a point of a capture, and the messages that restore it | replays |
//! | [`touched`] | the cells that something touches, as far as that is known | replays |
//!
//! Both follow each cell's contact by [`Contact`](crate::tracker::Contact) and the owner of each node id by
//! [`Claim`](crate::tracker::Claim), under the same rules of `docs/reference/cell.md`:
//!
//! | message | what it changes |
//! |---|---|
//! | joints of a new epoch | stimuli that wait for it are latched |
//! | joints of the last epoch | nothing: cells drop them |
//! | a stimulus | waits for its epoch, or is latched at the next joints |
//! | a write of the mode | all stimuli end; the cell obeys or measures |
//! | a start, by the owner of the node id | all stimuli and switches end; the cell obeys |
//! | a heartbeat of a claimant or an outsider | nothing: it does not own the node id |
//! | a report of a cell's sensors | its contact state, while nothing else is known of it |

pub mod packets;
pub mod state;
pub mod touched;

pub use packets::{Latched, Seen};
pub use state::State;
pub use touched::Touched;
