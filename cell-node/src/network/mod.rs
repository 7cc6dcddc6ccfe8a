//! The formation and repair of the tree of wired cells.
//!
//! ```text
//!   message of a port ─> handle_message ─────┐             ┌─> poll_transmit ───────────> message for a port
//!                now ──> handle_timeout ─────┼─ [Network] ─┼─> parent_port, child_mask ─> whose sums are whose
//!   no sum was taken ──> handle_parent_loss ─┘             └─> take_assigned_id ────────> a node id for this cell
//! ```
//!
//! A cell with a route to the root announces it in its hellos with a [`TreeRank`]: its depth, and the round
//! (version) of the tree. A cell without a parent sends a join to the nearest port whose rank is better than
//! any rank it had itself, and the neighbour answers with a grant. A cell's rank only improves, and a
//! parent's is better than its child's, so the tree has no loops, even if messages are lost or late. While no
//! sums are sent, a cell moves to a port that is nearer than its parent, so that the tree does not stay
//! deeper than necessary. If no rank is good enough, the cell starts a local repair: it requests a new round,
//! which is forwarded to the root and spreads from there as better ranks for all.

mod node_ids;
mod port;
mod route;

use heapless::Deque;
use protocol::id::CellId;
use protocol::message::{PortState, VERSION};
use protocol::packet::Epoch;
use protocol::port::{Hello, PORTS, PortMessage, TreeRank, UPLINK};
use protocol::time::{Micros, Span};

use crate::phase;
use node_ids::NodeIdState;
use port::Port;

const HELLO_INTERVAL: Span = Span::from_millis(250);
/// Maximum time to wait for the answer to a join before another port is tried.
const JOIN_TIMEOUT: Span = Span::from_millis(5);
/// Intervals between local repairs: the first, and the maximum.
const MIN_AND_MAX_REPAIR_INTERVAL: (Span, Span) = (Span::from_millis(20), Span::from_millis(320));
/// Interval at which a leave to the gateway's side is repeated until it is acknowledged. The gateway's side accepts
/// sums until then.
const LEAVE_INTERVAL: Span = Span::from_millis(20);
/// Number of ports, including a root's wire to the gateway's side.
const PORT_COUNT_WITH_UPLINK: usize = PORTS + 1;
/// Capacity for outgoing messages. The caller collects them after every call.
const OUTBOX_CAPACITY: usize = 32;

/// The reason for the loss of a parent. It determines whether the parent may still accept sums of this cell.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(crate) enum ParentLossReason {
    /// The parent did not accept the last sums, or rejects this cell as its child. It accepts no more sums.
    Done,
    /// The link fails in one direction, or the parent itself is unreachable. The parent may accept sums until it
    /// acknowledges the leave.
    Unsure,
}

/// The neighbour to which this cell sends its sums.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
struct Parent {
    port: usize,
    rank: TreeRank,
}

/// A neighbour that was the parent until this cell left it.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
struct FormerParent {
    port: usize,
    /// True if the former parent has acknowledged the leave, after which it accepts no more sums.
    acknowledged: bool,
    since: Micros,
    /// The time at which the leave is repeated.
    resend_at: Micros,
}

impl FormerParent {
    const fn new(port: usize, heard: bool, now: Micros) -> Self {
        Self { port, acknowledged: heard, since: now, resend_at: Self::next_resend_time(port, now) }
    }

    const fn next_resend_time(port: usize, now: Micros) -> Micros {
        Micros(now.0 + if port == UPLINK { LEAVE_INTERVAL.0 } else { HELLO_INTERVAL.0 })
    }
}

/// The part of a cell that forms the tree with its neighbours.
#[derive(Debug, Default)]
pub(crate) struct Network {
    wired: u8,
    /// Ports whose messages are ignored; bit p stands for port p.
    pub(crate) ignored_ports: u8,
    node_ids: NodeIdState,
    ports: [Port; PORT_COUNT_WITH_UPLINK],
    parent: Option<Parent>,
    /// The best rank that this cell has ever had. It accepts a parent only with a better rank.
    best: Option<TreeRank>,
    /// The rank that this cell announced last.
    announced: Option<TreeRank>,
    joining: Option<(usize, Micros)>,
    /// True while sums are sent. The cell then keeps its parent unless it loses it.
    pub(crate) busy: bool,
    /// True if the parent has announced that it is itself unreachable.
    parent_unreachable: bool,
    /// The time of the next local repair, and the interval until the one after it.
    repair: Option<(Micros, Span)>,
    /// The last repair that was forwarded: its round, true if it went to all ports instead of the parent only, and the
    /// time.
    forwarded_repair: Option<(u8, bool, Micros)>,
    /// The parent that this cell left last, until it can accept no more sums.
    former_parent: Option<FormerParent>,
    reported: Option<[PortState; PORTS]>,
    /// Number of times that the parent has changed.
    pub(crate) changes: u16,
    /// True if parent, depth, round or children have changed since this flag was read.
    pub(crate) tree_changed: bool,
    next_hello: Micros,
    outbox: Deque<(usize, PortMessage), OUTBOX_CAPACITY>,
}

impl Network {
    /// Creates the network part of a cell without wires.
    pub(crate) fn new(now: Micros) -> Self {
        Self { next_hello: now, ..Self::default() }
    }

    /// Sets the ports that have wires. The serial number spreads the hellos of many cells over time.
    pub(crate) fn set_wired_ports(&mut self, wired: u8, number: Option<CellId>, serial: u32) {
        (self.wired, self.node_ids.own) = (wired, number);
        self.next_hello = self.next_hello + phase::send_offset_by_serial(HELLO_INTERVAL, serial);
    }

    /// Returns true if the cell has wires.
    pub(crate) const fn has_wires(&self) -> bool {
        self.wired != 0
    }

    /// Returns true if a port has a wire and its messages are not ignored.
    pub(crate) const fn is_receiving_port(&self, port: usize) -> bool {
        self.wired & !self.ignored_ports & 1 << port != 0
    }

    /// Returns the port that leads to the parent; `None` without a parent.
    pub(crate) fn parent_port(&self) -> Option<usize> {
        self.parent.map(|parent| parent.port)
    }

    /// Returns the number of wires to the root of the tree, 0 for a root; `None` without a parent.
    pub(crate) fn depth(&self) -> Option<u8> {
        self.parent.map(|parent| parent.rank.depth)
    }

    /// Returns the rank that this cell announces to cells below it.
    fn rank(&self) -> Option<TreeRank> {
        self.parent.map(|parent| parent.rank.child_rank())
    }

    /// Returns the round of the cell's rank.
    pub(crate) fn rank_round(&self) -> u8 {
        self.best.map_or(0, |rank| rank.round)
    }

    /// Returns the parent's node id, 0 for the gateway's side; `None` without a parent.
    pub(crate) fn parent_node_id(&self) -> Option<u8> {
        match self.parent_port()? {
            UPLINK => Some(0),
            port => self.node_id_at(port).map(CellId::get),
        }
    }

    /// Returns the node id of the cell at a port; `None` if it is unknown.
    pub(crate) fn node_id_at(&self, port: usize) -> Option<CellId> {
        self.ports.get(port)?.node_id()
    }

    /// Returns true if the cell at a port is a child.
    pub(crate) fn is_child(&self, port: usize) -> bool {
        self.ports.get(port).is_some_and(Port::is_child)
    }

    /// Returns the port of the child with this node id.
    pub(crate) fn child_port_of(&self, number: CellId) -> Option<usize> {
        (0..PORTS).find(|&port| self.is_child(port) && self.node_id_at(port) == Some(number))
    }

    /// Returns true if no former parent can accept sums of this cell any more: there is none, or it has acknowledged
    /// the leave.
    pub(crate) fn is_former_parent_released(&self) -> bool {
        self.former_parent.is_none_or(|former_parent| former_parent.acknowledged)
    }

    /// Forgets the former parent after an epoch in which this cell sent no sum, because a cell then accepts no more
    /// sums. The gateway's side is forgotten only one hello interval after it was left.
    pub(crate) fn forget_former_parent(&mut self, now: Micros) {
        self.former_parent.take_if(|former_parent| {
            former_parent.port != UPLINK || now.elapsed_since(former_parent.since) >= HELLO_INTERVAL
        });
    }

    /// Returns a mask of the children: bit p is set if the cell at port p is a child.
    pub(crate) fn child_mask(&self) -> u8 {
        self.port_mask(Port::is_child)
    }

    /// Returns a mask of the working ports: bit p is set if port p works in both directions.
    pub(crate) fn working_port_mask(&self, now: Micros) -> u8 {
        self.port_mask(|port| port.is_working(now))
    }

    fn port_mask(&self, target: impl Fn(&Port) -> bool) -> u8 {
        let bit = |(place, port): (usize, &Port)| u8::from(target(port)) << place;
        self.ports.iter().take(PORTS).enumerate().map(bit).sum()
    }

    /// Returns the state of each port for network page 4.
    pub(crate) fn port_states(&self, now: Micros) -> [PortState; PORTS] {
        core::array::from_fn(|port| self.ports.get(port).map(|port| port.state(now)).unwrap_or_default())
    }

    /// Returns true if the state of any port has changed since the last call.
    pub(crate) fn poll_ports_changed(&mut self, now: Micros) -> bool {
        let states = self.port_states(now);
        self.reported.replace(states) != Some(states)
    }

    /// Returns the node id that a walk has assigned to this cell, once; `None` afterwards.
    pub(crate) const fn take_assigned_id(&mut self) -> Option<CellId> {
        self.node_ids.given.take()
    }

    /// Returns the next message to send, and its port.
    pub(crate) fn poll_transmit(&mut self) -> Option<(usize, PortMessage)> {
        self.outbox.pop_front()
    }

    /// Returns the time at which [`Network::handle_timeout`] must be called next.
    pub(crate) fn poll_timeout(&self) -> Micros {
        if !self.has_wires() {
            return Micros(u64::MAX);
        }
        let join = self.joining.map(|(_, requested)| requested + JOIN_TIMEOUT);
        let repair = self.repair.map(|(at, _)| at).filter(|_| self.joining.is_none());
        let silent = self.parent.and_then(|parent| self.ports.get(parent.port)?.disconnect_time());
        let leave = self.unacknowledged_former_parent().map(|former_parent| former_parent.resend_at);
        [join, repair, silent, leave].into_iter().flatten().fold(self.next_hello, Micros::min)
    }

    /// Queues a message for the cell at a port.
    pub(crate) fn send(&mut self, port: usize, message: PortMessage) {
        if self.wired >> port & 1 != 0 {
            // The shell collects messages after every call; the next hello makes up for one that does not
            // fit.
            let _ = self.outbox.push_back((port, message));
        }
    }

    fn send_hello(&mut self, now: Micros, port: usize) {
        let hears = self.ports.get(port).is_some_and(|port| port.recent_hello(now).is_some());
        let hello = Hello {
            version: VERSION,
            number: self.node_ids.own.map_or(0, CellId::get),
            port: port.to_le_bytes()[0],
            receives: hears,
            is_parent: self.parent_port() == Some(port),
            unnumbered: self.lacks_node_ids(),
            rank: self.rank(),
        };
        if hello.rank.is_some() {
            self.ports.get_mut(port).into_iter().for_each(|port| port.round_requested = false);
        }
        self.send(port, PortMessage::Hello(hello));
    }

    fn send_hellos(&mut self, now: Micros) {
        self.announced = self.rank();
        for port in 0..PORT_COUNT_WITH_UPLINK {
            self.send_hello(now, port);
        }
    }

    /// Handles a message that arrived at a port, except the messages `State` and `Nack` about sums.
    pub(crate) fn handle_message(&mut self, now: Micros, port: usize, message: PortMessage) {
        match message {
            PortMessage::Hello(hello) => self.handle_hello(now, port, hello),
            PortMessage::Join => self.handle_join(now, port),
            PortMessage::Grant(rank) => self.handle_grant(now, port, rank),
            PortMessage::Refuse if self.parent_port() == Some(port) => {
                self.handle_parent_loss(now, ParentLossReason::Done)
            }
            PortMessage::Refuse if self.joining.is_some_and(|(requested, _)| requested == port) => {
                self.distrust_port(now, port);
                self.joining = None;
                self.search_parent(now);
            }
            PortMessage::Leave => {
                self.ports.get_mut(port).into_iter().for_each(|port| port.child = None);
                self.send(port, PortMessage::LeaveAck);
            }
            PortMessage::LeaveAck => self
                .former_parent
                .iter_mut()
                .for_each(|former_parent| former_parent.acknowledged |= former_parent.port == port),
            PortMessage::Repair(round) => self.forward_repair(now, port, round),
            PortMessage::Probe => self.send_hello(now, port),
            PortMessage::NodeId(walk) if self.parent_port() == Some(port) => self.begin_walk(now, walk),
            PortMessage::Return(walk) => self.continue_walk(port, walk),
            PortMessage::Refuse | PortMessage::NodeId(_) | PortMessage::State(_) | PortMessage::Nack(_) => {}
        }
        self.report_missing_node_ids(now);
    }

    fn handle_hello(&mut self, now: Micros, port: usize, hello: Hello) {
        let Some(there) = self.ports.get_mut(port) else { return };
        let number = there.node_id();
        let restarted = there.record_hello(now, hello);
        let is_child = there.is_child();
        self.tree_changed |=
            there.node_id() != number && (is_child || self.parent.is_some_and(|it| it.port == port));
        if hello.version != VERSION {
            return;
        }
        if restarted || !hello.receives {
            self.send_hello(now, port);
        }
        if hello.is_parent && !is_child {
            self.send(port, PortMessage::Refuse);
        }
        match self.parent {
            Some(parent) if parent.port == port => match hello.rank {
                _ if !hello.receives => self.handle_parent_loss(now, ParentLossReason::Unsure),
                // The parent is as near as before, nearer, or of a later round.
                Some(rank) if !parent.rank.is_better_than(rank) => self.set_parent(now, port, rank),
                // The parent is unreachable and repairs its route. This cell helps, and its sums are NACKed
                // meanwhile.
                None => self.forward_repair(now, port, parent.rank.round),
                // The parent restarted.
                Some(_) => self.handle_parent_loss(now, ParentLossReason::Unsure),
            },
            Some(parent) => self.join_better_parent(now, port, parent),
            None => self.search_parent(now),
        }
    }

    /// Sends now the hellos that would be due by the time `until`, so that the cell need not wake up for them.
    pub(crate) fn send_hellos_due_by(&mut self, now: Micros, until: Micros) {
        if self.has_wires() && until >= self.next_hello {
            self.next_hello = phase::next_send_time(self.next_hello, HELLO_INTERVAL, now);
            let before = self.child_mask();
            self.ports.iter_mut().for_each(|port| port.remove_silent_child(now));
            self.tree_changed |= before != self.child_mask();
            self.send_hellos(now);
        }
    }

    /// Returns the former parent if it has not acknowledged the leave.
    fn unacknowledged_former_parent(&self) -> Option<FormerParent> {
        self.former_parent.filter(|former_parent| {
            !former_parent.acknowledged && self.parent_port() != Some(former_parent.port)
        })
    }

    /// Handles timers that are due at `now`. Does nothing if called early.
    pub(crate) fn handle_timeout(&mut self, now: Micros) {
        if !self.has_wires() {
            return;
        }
        self.send_hellos_due_by(now, now);
        if let Some(former_parent) =
            self.unacknowledged_former_parent().filter(|former_parent| now >= former_parent.resend_at)
        {
            self.former_parent = Some(FormerParent {
                resend_at: FormerParent::next_resend_time(former_parent.port, now),
                ..former_parent
            });
            self.send(former_parent.port, PortMessage::Leave);
        }
        let silent =
            |parent: &Parent| self.ports.get(parent.port).is_none_or(|it| it.recent_hello(now).is_none());
        if self.parent.as_ref().is_some_and(silent) {
            if self.parent_port() == Some(UPLINK) {
                // The gateway's side may notice it later, and accepts sums until then.
                self.joining = Some((UPLINK, now + HELLO_INTERVAL));
            }
            self.handle_parent_loss(now, ParentLossReason::Unsure);
        }
        if self.parent.is_none() {
            self.search_parent(now);
        } else {
            self.joining.take_if(|(_, requested)| now.elapsed_since(*requested) >= JOIN_TIMEOUT);
        }
        self.report_missing_node_ids(now);
    }

    /// Announces to the parent that it is to receive the sums from this epoch on.
    pub(crate) fn announce_sums_to_parent(&mut self, epoch: Epoch) {
        if let Some(up) = self.parent_port().filter(|up| *up != UPLINK) {
            self.send(up, PortMessage::State(epoch));
        }
    }
}

#[cfg(test)]
mod tests;
