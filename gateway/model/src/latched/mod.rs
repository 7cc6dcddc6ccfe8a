//! The latched state of a bus: the effect of earlier commands that its cells still hold. With it, a reader or a cell
//! that starts in the middle of a recording reaches the same state as one that received all of it.
//!
//! | module | content | used by |
//! |---|---|---|
//! | [`packets`] | the packets that still have an effect, as they were on the bus | recordings, which begin each part with them |
//! | [`state`] | the state before a point of a capture, and the messages that restore it | replays |
//! | [`touched`] | the cells in contact, as far as known | replays |
//!
//! Both follow each cell's contact by [`Contact`](crate::tracker::ContactState) and the owner of each node id by
//! [`Claim`](crate::tracker::AddressClaim), under the same rules of `docs/reference/cell.md`:
//!
//! | message | effect |
//! |---|---|
//! | joints of a new epoch | latches the pending stimuli of this epoch |
//! | joints of the last epoch | none: cells drop them |
//! | a stimulus | is pending until its epoch, or latched at the next joints |
//! | a write of the mode | ends all stimuli; the cell obeys stimuli or measures |
//! | a start, by the owner of the node id | ends all stimuli and switches; the cell obeys stimuli |
//! | a heartbeat of a claimant or an outsider | none: it does not own the node id |
//! | a report of a cell's sensors | sets its contact state, if that is not known otherwise |

pub mod packets;
pub mod state;
pub mod touched;

pub use packets::{LatchedFrame, LatchedPackets};
pub use state::LatchedState;
pub use touched::KnownContacts;
