//! Detects other gateways, and cells that are not in the skin, from their frames.

use std::collections::BTreeMap;

use protocol::id::CellId;
use protocol::message::Heartbeat;
use protocol::time::{Micros, Span};

/// Number of joints from another sender within [`GATEWAY_DETECTION_TIME`] that prove another gateway.
const MIN_GATEWAY_JOINTS: usize = 4;
/// The time window for these joints; the slowest gateway sends fifteen in it.
const GATEWAY_DETECTION_TIME: Span = Span::from_millis(1_000);

/// Senders on the bus that are neither this gateway nor a cell of the skin.
#[derive(Clone, Debug, Default)]
pub(super) struct UnknownSenders {
    /// Nodes that are not in the skin, each with its last heartbeat.
    pub(super) nodes: BTreeMap<CellId, Heartbeat>,
    /// Arrival times of the last joints, newest first.
    joints: [Option<Micros>; MIN_GATEWAY_JOINTS],
}

impl UnknownSenders {
    /// Records joints from another sender. Returns true if these joints prove another gateway.
    pub(super) fn record_joints(&mut self, at: Micros) -> bool {
        self.joints.rotate_right(1);
        if let Some(newest) = self.joints.first_mut() {
            *newest = Some(at);
        }
        self.joints
            .last()
            .copied()
            .flatten()
            .is_some_and(|oldest| at.elapsed_since(oldest) <= GATEWAY_DETECTION_TIME)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_joints_within_a_second_are_of_a_gateway() {
        let of = |every_ms: u64| {
            let mut outsiders = UnknownSenders::default();
            (0..5).map(|at| outsiders.record_joints(Micros(at * every_ms * 1_000))).collect::<Vec<_>>()
        };
        assert_eq!(of(333), [false, false, false, true, true]);
        assert_eq!(of(334), [false; 5]);
    }
}
