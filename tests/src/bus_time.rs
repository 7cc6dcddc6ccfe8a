//! A second program for a bus that takes time. It computes the starts and ends of transmissions from requests, without
//! `bus_model` and without the bit counts of `protocol::wire_time`, and compares the record of a server with them.
//!
//! ```text
//!   requests ──> a list for each node ──> the lowest arbitration bits of all eligible frames ──> transmissions
//!                                                                                                    ║ equal
//!   record of a server ──> requests, damaged bits                                    transmissions ══╝
//! ```
//!
//! The notation of frames and of bit rates, and the reading of packets, are those of `protocol`.

#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

mod record;
#[cfg(test)]
mod tests;
mod wire;

use std::collections::BTreeMap;

use protocol::can::Frame;
use protocol::wire_time::BitRates;

pub use record::{EpochFigures, RecordFigures, SentFrame, check_record};
pub use wire::WireFrame;

/// A request of a node to send a frame.
#[derive(Clone, Copy, Debug)]
pub struct FrameRequest {
    /// Time of the request in ns.
    pub at: u64,
    /// Number of the node.
    pub node: u16,
    /// The frame.
    pub frame: Frame,
}

/// The transmit queues of all nodes.
#[derive(Clone, Copy, Debug)]
pub struct NodeQueues {
    /// True if only the oldest frame of a node takes part in arbitration, false if all do.
    pub is_fifo: bool,
    /// Maximum number of frames in a queue, including the one on the wire.
    pub depth: usize,
}

impl NodeQueues {
    /// Returns the frames of a node's list that take part in arbitration.
    fn eligible<'a>(&self, list: &'a [usize]) -> &'a [usize] {
        if self.is_fifo { &list[..list.len().min(1)] } else { list }
    }
}

/// A transmission of a frame, complete or damaged.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct SentOnBus {
    /// Index of the request.
    pub request: usize,
    /// Start of the first bit in ns.
    pub start: u64,
    /// End of the intermission in ns.
    pub end: u64,
    /// True if the frame was damaged.
    pub is_damaged: bool,
}

/// The results of requests in order of time.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct BusResult {
    /// Indices of the requests that a full queue refused.
    pub refused: Vec<usize>,
    /// All transmissions in order.
    pub sent: Vec<SentOnBus>,
}

/// Computes the transmissions of requests in order of time, until all are sent. For each transmission in its order,
/// `damaged_bits` has the number of bits up to and including the first damaged one, or `None`.
///
/// # Panics
/// If a request is for an error frame, or later than the next one.
#[must_use]
pub fn transmit(
    rates: BitRates,
    queues: NodeQueues,
    requests: &[FrameRequest],
    damaged_bits: &[Option<u32>],
) -> BusResult {
    let frames: Vec<_> = requests.iter().map(|it| WireFrame::new(&it.frame)).collect();
    let mut result = BusResult::default();
    let mut lists = BTreeMap::<u16, Vec<usize>>::new();
    let (mut next, mut free_at) = (0, 0);
    loop {
        if lists.values().all(Vec::is_empty) {
            let Some(request) = requests.get(next) else { return result };
            free_at = request.at.max(free_at);
        }
        let mut join = |lists: &mut BTreeMap<u16, Vec<usize>>, is_early: &dyn Fn(u64) -> bool| {
            while let Some(request) = requests.get(next).filter(|it| is_early(it.at)) {
                let list = lists.entry(request.node).or_default();
                if list.len() < queues.depth {
                    list.push(next)
                } else {
                    result.refused.push(next)
                }
                next += 1;
            }
        };
        join(&mut lists, &|at| at <= free_at);
        let eligible = lists.values().flat_map(|list| queues.eligible(list));
        let (_, request) = eligible.map(|&it| (frames[it].arbitration_bits(), it)).min().unwrap();
        let damaged_bit = damaged_bits.get(result.sent.len()).copied().flatten();
        let end = free_at + frames[request].nanoseconds(rates, damaged_bit);
        // Until its end, the frame has its place in the queue.
        join(&mut lists, &|at| at < end);
        if damaged_bit.is_none() {
            lists.get_mut(&requests[request].node).unwrap().retain(|&it| it != request);
        }
        result.sent.push(SentOnBus { request, start: free_at, end, is_damaged: damaged_bit.is_some() });
        free_at = end;
    }
}
