//! The gateway's end of the wires to the roots: the end of all routes, and the source of node ids.
//!
//! ```text
//!    message of a root ─> handle_message ────┐             ┌─> poll_transmit ─> message for a root
//!                 now ──> handle_time ───────┼─ [Uplinks] ─┘
//!   node id in use ─────> mark_node_id_used ─┘
//! ```

use std::collections::{BTreeSet, VecDeque};

use protocol::id::CellId;
use protocol::message::VERSION;
use protocol::port::{Hello, NodeIdWalk, PortMessage, TreeRank};
use protocol::time::{Micros, Span};

/// Interval of the hellos that the gateway sends to each root.
const HELLO_INTERVAL: Span = Span::from_millis(250);
/// Time without a hello from a root after which its wire counts as down.
const HELLO_TIMEOUT: Span = Span::from_millis(600);
/// Time after which an unanswered walk counts as lost.
const WALK_TIMEOUT: Span = Span::from_millis(400);
/// Port number of the gateway's side, as sent in hellos.
const GATEWAY_PORT: u8 = 0;

/// The wire from the gateway to one root.
#[derive(Clone, Copy, Debug)]
struct RootWire {
    /// The index of the wire in the description.
    root: usize,
    last_hello: Option<(Hello, Micros)>,
    is_child: bool,
}

/// A walk on its way below one root, which assigns node ids to cells.
#[derive(Clone, Copy, Debug)]
struct ActiveWalk {
    root: usize,
    walk: NodeIdWalk,
    since: Micros,
}

/// The gateway's ends of the wires to all roots of one bus.
#[derive(Debug)]
pub struct Uplinks {
    wires: Vec<RootWire>,
    round: u8,
    used_node_ids: BTreeSet<u8>,
    last_walk_number: u8,
    active_walk: Option<ActiveWalk>,
    /// Earliest time of the next walk. Until then, cells with node ids from a lost walk can claim them.
    next_walk: Micros,
    next_hello: Micros,
    outbox: VecDeque<(usize, PortMessage)>,
}

impl Uplinks {
    /// Creates the wires to this number of roots. The first walk gets the number `walk`, which must differ from the
    /// walk numbers of an earlier gateway.
    #[must_use]
    pub fn new(roots: usize, walk: u8, now: Micros) -> Self {
        let wire = |root| RootWire { root, last_hello: None, is_child: false };
        Self {
            wires: (0..roots).map(wire).collect(),
            round: 1,
            used_node_ids: BTreeSet::new(),
            last_walk_number: walk,
            active_walk: None,
            next_walk: Micros(0),
            next_hello: now,
            outbox: VecDeque::new(),
        }
    }

    /// Marks a node id as used by a cell on the bus.
    pub fn mark_node_id_used(&mut self, cell: CellId) {
        self.used_node_ids.insert(cell.get());
    }

    /// Returns the next message to send, with the index of the root to which it goes.
    pub fn poll_transmit(&mut self) -> Option<(usize, PortMessage)> {
        self.outbox.pop_front()
    }

    /// Returns the time of the next call of [`Uplinks::handle_time`].
    #[must_use]
    pub fn poll_timeout(&self) -> Micros {
        let lost = self.active_walk.map(|walking| walking.since + WALK_TIMEOUT);
        let waits = Some(self.next_walk)
            .filter(|_| self.active_walk.is_none() && self.root_needing_node_ids().is_some());
        [lost, waits].into_iter().flatten().fold(self.next_hello, Micros::min)
    }

    /// Returns true if a root sends its sums to the gateway; otherwise it sends them to another cell.
    #[must_use]
    pub fn is_gateway_child(&self, root: usize) -> bool {
        self.wires.get(root).is_some_and(|wire| wire.is_child)
    }

    /// Handles a message from a root over its wire.
    pub fn handle_message(&mut self, now: Micros, root: usize, message: PortMessage) {
        let rank = TreeRank { round: self.round, depth: 0 };
        let Some(wire) = self.wires.get_mut(root) else { return };
        match message {
            PortMessage::Hello(hello) => {
                let is_new = wire.last_hello.is_none_or(|(_, at)| now.elapsed_since(at) > HELLO_TIMEOUT);
                wire.last_hello = Some((hello, now));
                // Only the root knows whether a grant arrived, and whether one from an earlier gateway is still valid.
                wire.is_child = hello.is_parent;
                if hello.is_parent && hello.rank.is_some_and(|own| own.is_better_than(rank.child_rank())) {
                    self.start_round_after(now, hello.rank.map_or(self.round, |own| own.round));
                } else if is_new || !hello.receives {
                    self.send_hello(now, root);
                }
            }
            PortMessage::Join => self.outbox.push_back((root, PortMessage::Grant(rank))),
            PortMessage::Leave => {
                wire.is_child = false;
                self.outbox.push_back((root, PortMessage::LeaveAck));
            }
            PortMessage::Repair(round) => self.start_round_after(now, round),
            PortMessage::Probe => self.send_hello(now, root),
            PortMessage::Return(walk) => self.end_walk(now, root, walk),
            PortMessage::Grant(_)
            | PortMessage::Refuse
            | PortMessage::LeaveAck
            | PortMessage::State(_)
            | PortMessage::Nack(_)
            | PortMessage::NodeId(_) => {}
        }
        self.start_walk(now);
    }

    /// Starts a round later than `round`, unless a later one has started already.
    fn start_round_after(&mut self, now: Micros, round: u8) {
        if self.round.wrapping_sub(round).cast_signed() <= 0 {
            self.round = round.wrapping_add(1);
        }
        self.send_hellos(now);
    }

    fn send_hello(&mut self, now: Micros, root: usize) {
        let heard = self.wires.get(root).and_then(|wire| wire.last_hello);
        let hello = Hello {
            version: VERSION,
            number: 0,
            port: GATEWAY_PORT,
            receives: heard.is_some_and(|(_, at)| now.elapsed_since(at) <= HELLO_TIMEOUT),
            is_parent: false,
            unnumbered: false,
            rank: Some(TreeRank { round: self.round, depth: 0 }),
        };
        self.outbox.push_back((root, PortMessage::Hello(hello)));
    }

    fn send_hellos(&mut self, now: Micros) {
        for root in 0..self.wires.len() {
            self.send_hello(now, root);
        }
    }

    /// Handles expired timeouts: sends hellos, marks silent roots and gives up lost walks.
    pub fn handle_time(&mut self, now: Micros) {
        if now >= self.next_hello {
            let skipped = now.elapsed_since(self.next_hello).0 / HELLO_INTERVAL.0;
            self.next_hello = self.next_hello + Span((skipped + 1) * HELLO_INTERVAL.0);
            for wire in &mut self.wires {
                wire.is_child &=
                    wire.last_hello.is_some_and(|(_, at)| now.elapsed_since(at) <= HELLO_TIMEOUT);
            }
            self.send_hellos(now);
        }
        if self.active_walk.is_some_and(|walking| now.elapsed_since(walking.since) >= WALK_TIMEOUT) {
            self.active_walk = None;
            self.next_walk = now + WALK_TIMEOUT;
        }
        self.start_walk(now);
    }

    /// Returns the index of a root that has a cell without a node id below it.
    fn root_needing_node_ids(&self) -> Option<usize> {
        let needs =
            |wire: &&RootWire| wire.is_child && wire.last_hello.is_some_and(|(hello, _)| hello.unnumbered);
        self.wires.iter().find(needs).map(|wire| wire.root)
    }

    /// Sends a walk, with the first range of free node ids, to a root that has cells without node ids below it.
    fn start_walk(&mut self, now: Micros) {
        if self.active_walk.is_some() || now < self.next_walk {
            return;
        }
        let Some((root, (first, last))) = self.root_needing_node_ids().zip(self.free_node_id_range()) else {
            return;
        };
        self.last_walk_number = self.last_walk_number.wrapping_add(1);
        let walk = NodeIdWalk { walk: self.last_walk_number, first, last };
        self.active_walk = Some(ActiveWalk { root, walk, since: now });
        self.outbox.push_back((root, PortMessage::NodeId(walk)));
    }

    /// Returns the first and last node id of the first range of free node ids.
    fn free_node_id_range(&self) -> Option<(u8, u8)> {
        let first = (1..=CellId::MAX.get()).find(|number| !self.used_node_ids.contains(number))?;
        let last =
            (first..=CellId::MAX.get()).take_while(|number| !self.used_node_ids.contains(number)).last()?;
        Some((first, last))
    }

    fn end_walk(&mut self, now: Micros, root: usize, remaining: NodeIdWalk) {
        let Some(walking) = self.active_walk.filter(|it| it.root == root && it.walk.walk == remaining.walk)
        else {
            return;
        };
        self.used_node_ids
            .extend(walking.walk.first..remaining.first.min(walking.walk.last.saturating_add(1)));
        self.active_walk = None;
        if remaining.first == walking.walk.first {
            // The root assigned none: it does not know its children yet.
            self.next_walk = now + Span::from_millis(20);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000;

    fn said(uplinks: &mut Uplinks) -> Vec<(usize, PortMessage)> {
        std::iter::from_fn(|| uplinks.poll_transmit()).collect()
    }

    /// Returns a hello of a root with the gateway as its parent.
    fn hello_up(unnumbered: bool) -> PortMessage {
        let rank = Some(TreeRank { round: 1, depth: 1 });
        PortMessage::Hello(Hello {
            version: VERSION,
            number: 1,
            port: 4,
            receives: true,
            is_parent: true,
            unnumbered,
            rank,
        })
    }

    fn hellos(messages: &[(usize, PortMessage)]) -> usize {
        messages.iter().filter(|(_, message)| matches!(message, PortMessage::Hello(_))).count()
    }

    #[test]
    fn hellos_that_were_skipped_are_sent_once_and_the_next_keep_their_times() {
        let mut uplinks = Uplinks::new(2, 0, Micros(10 * MS));
        uplinks.handle_time(Micros(9 * MS));
        assert_eq!(said(&mut uplinks), []);
        for (now, next) in [(10, 260), (260, 510), (1_300, 1_510), (1_510, 1_760)] {
            uplinks.handle_time(Micros(now * MS));
            assert_eq!((hellos(&said(&mut uplinks)), uplinks.poll_timeout()), (2, Micros(next * MS)));
        }
    }

    #[test]
    fn a_root_is_a_child_as_long_as_its_hellos_say_so() {
        let mut uplinks = Uplinks::new(2, 0, Micros(0));
        uplinks.handle_message(Micros(0), 1, hello_up(false));
        assert_eq!([0, 1, 2].map(|root| uplinks.is_gateway_child(root)), [false, true, false]);
        uplinks.handle_time(Micros(600 * MS));
        assert!(uplinks.is_gateway_child(1));
        uplinks.handle_time(Micros(1_000 * MS));
        assert!(!uplinks.is_gateway_child(1), "silent");
        uplinks.handle_message(Micros(1_000 * MS), 1, hello_up(false));
        uplinks.handle_message(Micros(1_000 * MS), 1, PortMessage::Leave);
        assert!(!uplinks.is_gateway_child(1), "left");
    }

    #[test]
    fn a_walk_has_the_first_range_of_free_node_ids() {
        let mut uplinks = Uplinks::new(1, 7, Micros(0));
        for used in [1, 2, 5] {
            uplinks.mark_node_id_used(CellId::new(used).unwrap());
        }
        uplinks.handle_message(Micros(0), 0, hello_up(true));
        let walk = |walk, first, last| PortMessage::NodeId(NodeIdWalk { walk, first, last });
        let walks = |uplinks: &mut Uplinks| {
            let mut messages = said(uplinks);
            messages.retain(|(_, message)| matches!(message, PortMessage::NodeId(_)));
            messages
        };
        assert_eq!(walks(&mut uplinks), [(0, walk(8, 3, 4))]);
        // One of them was assigned.
        uplinks.handle_message(Micros(MS), 0, PortMessage::Return(NodeIdWalk { walk: 8, first: 4, last: 4 }));
        assert_eq!(walks(&mut uplinks), [(0, walk(9, 4, 4))]);
        uplinks.handle_message(
            Micros(2 * MS),
            0,
            PortMessage::Return(NodeIdWalk { walk: 9, first: 5, last: 4 }),
        );
        assert_eq!(walks(&mut uplinks), [(0, walk(10, 6, CellId::MAX.get()))]);
    }

    #[test]
    fn a_repair_starts_a_round_later_than_its_own_but_never_an_earlier_one() {
        let mut uplinks = Uplinks::new(1, 0, Micros(0));
        let mut round_after = |repair| {
            uplinks.handle_message(Micros(0), 0, PortMessage::Repair(repair));
            said(&mut uplinks).into_iter().find_map(|(_, message)| {
                if let PortMessage::Hello(hello) = message { hello.rank.map(|rank| rank.round) } else { None }
            })
        };
        // Rounds are compared modulo 256.
        let rounds =
            [(7, 8), (8, 9), (3, 9), (9, 10), (120, 121), (240, 241), (250, 251), (255, 0), (250, 0)];
        for (repair, round) in rounds {
            assert_eq!(round_after(repair), Some(round), "after a repair of round {repair}");
        }
    }
}
