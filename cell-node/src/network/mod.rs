//! How cells that are wired to each other become a tree, and stay one.
//!
//! ```text
//!   message of a port ─> handle ─────┐             ┌─> poll_transmit ─> message for a port
//!                now ──> handle_time ┼─ [Network] ─┼─> up, children ──> whose sums are whose
//!   no sum was taken ──> lose_parent ┘             └─> given ─────────> a node id for this cell
//! ```
//!
//! A cell with a route to the root announces it in its hellos, with a [`Rank`]: its depth, and the round (version) of
//! the tree. A cell without a parent sends a join to the nearest port whose rank is better than every rank that it had
//! itself, and the neighbour answers with a grant. A cell's rank only improves, and a parent's is better than its
//! child's: so the tree has no loops, whatever is lost or late. While no sums are sent, a cell moves to a port that is
//! nearer than its parent, so that the tree does not stay deeper than necessary. Where no rank is good enough, the cell
//! starts a local repair: it requests a new round, which is forwarded to the root and spreads from there as better
//! ranks for all.

mod node_ids;
mod port;
mod route;

use heapless::Deque;
use protocol::id::CellId;
use protocol::message::{PortState, VERSION};
use protocol::packet::Epoch;
use protocol::port::{Hello, PORTS, PortMessage, Rank, UPLINK};
use protocol::time::{Micros, Span};

use crate::phase;
use node_ids::NodeIds;
use port::Port;

/// From one hello to the next.
const HELLO: Span = Span::from_millis(250);
/// How long a cell waits for a grant before it tries another port.
const JOIN_TIMEOUT: Span = Span::from_millis(5);
/// From one local repair to the next: the first interval, and the maximum.
const REPAIR: (Span, Span) = (Span::from_millis(20), Span::from_millis(320));
/// From one leave to the gateway's side to the next, until it acknowledges; it takes sums until then.
const AGAIN: Span = Span::from_millis(20);
/// Ports, and a root's wire to the gateway's side.
const ALL: usize = PORTS + 1;
/// Outgoing messages, which a shell takes after every call.
const OUTBOX: usize = 32;

/// How a parent was lost, and so whether it may still take a sum.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(crate) enum Lost {
    /// It did not take the last sums, or refuses this child: it takes no more.
    Done,
    /// The link is down in one direction, or the parent is unreachable itself: it may take sums until it acknowledges
    /// the leave.
    Unsure,
}

/// The neighbour that takes this cell's sums.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
struct Parent {
    port: usize,
    rank: Rank,
}

/// A parent that was left.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
struct FormerParent {
    port: usize,
    /// It acknowledged: it takes no sum any more.
    heard: bool,
    since: Micros,
    /// When the leave is resent.
    again: Micros,
}

impl FormerParent {
    const fn new(port: usize, heard: bool, now: Micros) -> Self {
        Self { port, heard, since: now, again: Self::next(port, now) }
    }

    const fn next(port: usize, now: Micros) -> Micros {
        Micros(now.0 + if port == UPLINK { AGAIN.0 } else { HELLO.0 })
    }
}

/// A cell's part of the network.
#[derive(Debug, Default)]
pub(crate) struct Network {
    wired: u8,
    /// Ports whose input is ignored (bit mask).
    pub(crate) deaf: u8,
    node_ids: NodeIds,
    ports: [Port; ALL],
    parent: Option<Parent>,
    /// The best rank that this cell ever had: only better ones are followed.
    best: Option<Rank>,
    /// The rank that was announced last, if any.
    offered: Option<Rank>,
    joining: Option<(usize, Micros)>,
    /// Sums are being sent: a parent is not left without need.
    pub(crate) busy: bool,
    /// The parent itself is unreachable.
    deserted: bool,
    /// When the next local repair is due, and the interval after that.
    repair: Option<(Micros, Span)>,
    /// The last repair that was forwarded: its round, whether to all ports or to the parent only, and when.
    passed_on: Option<(u8, bool, Micros)>,
    /// The parent that was left last.
    former_parent: Option<FormerParent>,
    reported: Option<[PortState; PORTS]>,
    /// How often the parent changed.
    pub(crate) changes: u16,
    /// The place in the tree has changed since this was read last.
    pub(crate) tree_changed: bool,
    next_hello: Micros,
    outbox: Deque<(usize, PortMessage), OUTBOX>,
}

impl Network {
    /// A cell that is not wired.
    pub(crate) fn new(now: Micros) -> Self {
        Self { next_hello: now, ..Self::default() }
    }

    /// Wires are at the ports `wired`; hellos of many cells are spread by serial number.
    pub(crate) fn wire(&mut self, wired: u8, number: Option<CellId>, serial: u32) {
        (self.wired, self.node_ids.own) = (wired, number);
        self.next_hello = self.next_hello + phase::by_serial(HELLO, serial);
    }

    /// Returns true if it is wired at all.
    pub(crate) const fn exists(&self) -> bool {
        self.wired != 0
    }

    /// Returns true if a port receives: it is wired, and its link is not down.
    pub(crate) const fn hears(&self, port: usize) -> bool {
        self.wired & !self.deaf & 1 << port != 0
    }

    /// The port that leads to the parent.
    pub(crate) fn up(&self) -> Option<usize> {
        self.parent.map(|parent| parent.port)
    }

    /// Wires to the root of the tree; 0 is a root.
    pub(crate) fn depth(&self) -> Option<u8> {
        self.parent.map(|parent| parent.rank.depth)
    }

    /// The rank that it announces to those below it.
    fn rank(&self) -> Option<Rank> {
        self.parent.map(|parent| parent.rank.below())
    }

    /// The round of its rank.
    pub(crate) fn round(&self) -> u8 {
        self.best.map_or(0, |rank| rank.round)
    }

    /// The parent's node id: 0 for the gateway's side.
    pub(crate) fn parent_node(&self) -> Option<u8> {
        match self.up()? {
            UPLINK => Some(0),
            port => self.number_at(port).map(CellId::get),
        }
    }

    /// The node id of the cell at a port.
    pub(crate) fn number_at(&self, port: usize) -> Option<CellId> {
        self.ports.get(port)?.number()
    }

    /// Returns true if the cell at a port is a child.
    pub(crate) fn is_child(&self, port: usize) -> bool {
        self.ports.get(port).is_some_and(Port::is_child)
    }

    /// The port of the child with this node id.
    pub(crate) fn child_with(&self, number: CellId) -> Option<usize> {
        (0..PORTS).find(|&port| self.is_child(port) && self.number_at(port) == Some(number))
    }

    /// Whether the former parent has acknowledged the leave, or there is none: then it takes no sum any more.
    pub(crate) fn is_released(&self) -> bool {
        self.former_parent.is_none_or(|former_parent| former_parent.heard)
    }

    /// The cell was silent for an epoch: a former parent takes no sum any more. The gateway's side needs longer,
    /// because it goes by the messages of the wire.
    pub(crate) fn forget_former_parent(&mut self, now: Micros) {
        self.former_parent
            .take_if(|former_parent| former_parent.port != UPLINK || now.since(former_parent.since) >= HELLO);
    }

    /// Bit p: the cell at port p is a child.
    pub(crate) fn children(&self) -> u8 {
        self.bits(Port::is_child)
    }

    /// Bit p: port p works in both directions.
    pub(crate) fn working(&self, now: Micros) -> u8 {
        self.bits(|port| port.works(now))
    }

    fn bits(&self, target: impl Fn(&Port) -> bool) -> u8 {
        let bit = |(place, port): (usize, &Port)| u8::from(target(port)) << place;
        self.ports.iter().take(PORTS).enumerate().map(bit).sum()
    }

    /// What each port leads to.
    pub(crate) fn port_states(&self, now: Micros) -> [PortState; PORTS] {
        core::array::from_fn(|port| self.ports.get(port).map(|port| port.state(now)).unwrap_or_default())
    }

    /// Returns true if what the ports lead to has changed since the last call.
    pub(crate) fn ports_changed(&mut self, now: Micros) -> bool {
        let states = self.port_states(now);
        self.reported.replace(states) != Some(states)
    }

    /// A node id that a walk assigned to this cell, once.
    pub(crate) const fn given(&mut self) -> Option<CellId> {
        self.node_ids.given.take()
    }

    /// The next message for a port.
    pub(crate) fn poll_transmit(&mut self) -> Option<(usize, PortMessage)> {
        self.outbox.pop_front()
    }

    /// When [`Network::handle_time`] has something to do.
    pub(crate) fn poll_timeout(&self) -> Micros {
        if !self.exists() {
            return Micros(u64::MAX);
        }
        let join = self.joining.map(|(_, requested)| requested + JOIN_TIMEOUT);
        let repair = self.repair.map(|(at, _)| at).filter(|_| self.joining.is_none());
        let silent = self.parent.and_then(|parent| self.ports.get(parent.port)?.silent_at());
        let leave = self.to_be_reported().map(|former_parent| former_parent.again);
        [join, repair, silent, leave].into_iter().flatten().fold(self.next_hello, Micros::min)
    }

    /// Sends a message to the cell at a port.
    pub(crate) fn say(&mut self, port: usize, message: PortMessage) {
        if self.wired >> port & 1 != 0 {
            // A shell takes messages after every call; for what does not fit, the next hello stands in.
            let _ = self.outbox.push_back((port, message));
        }
    }

    fn hello(&mut self, now: Micros, port: usize) {
        let hears = self.ports.get(port).is_some_and(|port| port.hello(now).is_some());
        let hello = Hello {
            version: VERSION,
            number: self.node_ids.own.map_or(0, CellId::get),
            port: port.to_le_bytes()[0],
            hears,
            up: self.up() == Some(port),
            unnumbered: self.is_unnumbered(),
            rank: self.rank(),
        };
        if hello.rank.is_some() {
            self.ports.get_mut(port).into_iter().for_each(|port| port.sought = false);
        }
        self.say(port, PortMessage::Hello(hello));
    }

    fn hello_to_all(&mut self, now: Micros) {
        self.offered = self.rank();
        for port in 0..ALL {
            self.hello(now, port);
        }
    }

    /// Takes a message of a port that receives, except those about sums: `State` and `Nack`.
    pub(crate) fn handle(&mut self, now: Micros, port: usize, message: PortMessage) {
        match message {
            PortMessage::Hello(hello) => self.take_hello(now, port, hello),
            PortMessage::Join => self.let_in(now, port),
            PortMessage::Grant(rank) => self.join(now, port, rank),
            PortMessage::Refuse if self.up() == Some(port) => self.lose_parent(now, Lost::Done),
            PortMessage::Refuse if self.joining.is_some_and(|(requested, _)| requested == port) => {
                self.distrust(now, port);
                self.joining = None;
                self.search(now);
            }
            PortMessage::Leave => {
                self.ports.get_mut(port).into_iter().for_each(|port| port.child = None);
                self.say(port, PortMessage::LeaveAck);
            }
            PortMessage::LeaveAck => self
                .former_parent
                .iter_mut()
                .for_each(|former_parent| former_parent.heard |= former_parent.port == port),
            PortMessage::Repair(round) => self.pass_on(now, port, round),
            PortMessage::Probe => self.hello(now, port),
            PortMessage::NodeId(walk) if self.up() == Some(port) => self.begin_walk(now, walk),
            PortMessage::Return(walk) => self.go_on_walking(port, walk),
            PortMessage::Refuse | PortMessage::NodeId(_) | PortMessage::State(_) | PortMessage::Nack(_) => {}
        }
        self.tell_unnumbered(now);
    }

    fn take_hello(&mut self, now: Micros, port: usize, hello: Hello) {
        let Some(there) = self.ports.get_mut(port) else { return };
        let number = there.number();
        let restarted = there.take(now, hello);
        let is_child = there.is_child();
        self.tree_changed |=
            there.number() != number && (is_child || self.parent.is_some_and(|it| it.port == port));
        if hello.version != VERSION {
            return;
        }
        if restarted || !hello.hears {
            self.hello(now, port);
        }
        if hello.up && !is_child {
            self.say(port, PortMessage::Refuse);
        }
        match self.parent {
            Some(parent) if parent.port == port => match hello.rank {
                _ if !hello.hears => self.lose_parent(now, Lost::Unsure),
                // It is as near as it was, or nearer, or of a later round.
                Some(rank) if !parent.rank.is_better_than(rank) => self.follow(now, port, rank),
                // The parent is unreachable and repairs its route: this cell helps, and its sums are NACKed meanwhile.
                None => self.pass_on(now, port, parent.rank.round),
                // It restarted.
                Some(_) => self.lose_parent(now, Lost::Unsure),
            },
            Some(parent) => self.improve(now, port, parent),
            None => self.search(now),
        }
    }

    /// Sends the hellos that are due by then: while the cell is awake anyway, it need not wake for them.
    pub(crate) fn hello_by(&mut self, now: Micros, until: Micros) {
        if self.exists() && until >= self.next_hello {
            self.next_hello = phase::next(self.next_hello, HELLO, now);
            let before = self.children();
            self.ports.iter_mut().for_each(|port| port.pass(now));
            self.tree_changed |= before != self.children();
            self.hello_to_all(now);
        }
    }

    /// A former parent that has not acknowledged the leave.
    fn to_be_reported(&self) -> Option<FormerParent> {
        self.former_parent
            .filter(|former_parent| !former_parent.heard && self.up() != Some(former_parent.port))
    }

    /// Takes in that time has passed. Harmless when called early.
    pub(crate) fn handle_time(&mut self, now: Micros) {
        if !self.exists() {
            return;
        }
        self.hello_by(now, now);
        if let Some(former_parent) = self.to_be_reported().filter(|former_parent| now >= former_parent.again)
        {
            self.former_parent =
                Some(FormerParent { again: FormerParent::next(former_parent.port, now), ..former_parent });
            self.say(former_parent.port, PortMessage::Leave);
        }
        let silent = |parent: &Parent| self.ports.get(parent.port).is_none_or(|it| it.hello(now).is_none());
        if self.parent.as_ref().is_some_and(silent) {
            if self.up() == Some(UPLINK) {
                // The gateway's side may notice it later, and takes sums until then.
                self.joining = Some((UPLINK, now + HELLO));
            }
            self.lose_parent(now, Lost::Unsure);
        }
        if self.parent.is_none() {
            self.search(now);
        } else {
            self.joining.take_if(|(_, requested)| now.since(*requested) >= JOIN_TIMEOUT);
        }
        self.tell_unnumbered(now);
    }

    /// Announces to the parent that the sums from this epoch on are for it.
    pub(crate) fn state(&mut self, epoch: Epoch) {
        if let Some(up) = self.up().filter(|up| *up != UPLINK) {
            self.say(up, PortMessage::State(epoch));
        }
    }
}

#[cfg(test)]
mod tests;
