//! Assignment of node ids to cells without one, in a depth-first walk over the tree.

use protocol::id::CellId;
use protocol::port::{NodeIdWalk, PORTS, PortMessage};
use protocol::time::Micros;

use super::Network;
use super::port::Port;

/// The cell's node id, and the state of an assignment walk in the part of the tree below it.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct NodeIdState {
    /// The cell's node id, if it has one.
    pub(super) own: Option<CellId>,
    /// The node id that a walk has assigned to this cell and that has not been read yet.
    pub(super) given: Option<CellId>,
    /// The walk in progress below this cell, and the port of the child that it is at.
    walking: Option<(NodeIdWalk, usize)>,
    last_walk: Option<u8>,
    was_unnumbered: bool,
}

impl Network {
    pub(super) fn lacks_node_ids(&self) -> bool {
        self.node_ids.own.is_none() || self.ports.iter().any(Port::lacks_node_ids)
    }

    /// Starts a walk at this cell: the cell takes the first free node id if it has none. The walk then visits each
    /// child in turn.
    pub(super) fn begin_walk(&mut self, now: Micros, mut walk: NodeIdWalk) {
        if self.node_ids.last_walk.replace(walk.walk) == Some(walk.walk) {
            return;
        }
        if self.node_ids.own.is_none()
            && walk.first <= walk.last
            && let Ok(number) = CellId::new(walk.first.into())
        {
            self.node_ids.own = Some(number);
            self.node_ids.given = Some(number);
            walk.first += 1;
            self.send_hellos(now);
        }
        self.walk_from(0, walk);
    }

    pub(super) fn continue_walk(&mut self, port: usize, walk: NodeIdWalk) {
        if self.node_ids.walking.is_some_and(|(of, at)| at == port && of.walk == walk.walk) {
            self.walk_from(port + 1, walk);
        }
    }

    fn walk_from(&mut self, first: usize, walk: NodeIdWalk) {
        let wants = |port: &usize| self.ports.get(*port).is_some_and(Port::lacks_node_ids);
        let next = (first..PORTS).find(wants).filter(|_| walk.first <= walk.last);
        self.node_ids.walking = next.map(|at| (walk, at));
        match (next, self.parent_port()) {
            (Some(port), _) => self.send(port, PortMessage::NodeId(walk)),
            (None, Some(up)) => self.send(up, PortMessage::Return(walk)),
            (None, None) => {}
        }
    }

    pub(super) fn report_missing_node_ids(&mut self, now: Micros) {
        let unnumbered = self.lacks_node_ids();
        if core::mem::replace(&mut self.node_ids.was_unnumbered, unnumbered) != unnumbered
            && let Some(up) = self.parent_port()
        {
            self.send_hello(now, up);
        }
    }
}
