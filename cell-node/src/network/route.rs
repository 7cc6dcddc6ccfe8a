//! The route to the root: how a cell joins, follows and leaves a parent, and accepts joins of children.

use protocol::port::{PortMessage, TreeRank, UPLINK};
use protocol::time::{Micros, Span};

use super::port::Port;
use super::{
    FormerParent, JOIN_TIMEOUT, MIN_AND_MAX_REPAIR_INTERVAL, Network, PORT_COUNT_WITH_UPLINK, Parent,
    ParentLossReason,
};

impl Network {
    /// Returns true if the cell can change its parent without losing sums: none are sent, or the parent is unreachable.
    const fn may_change_parent(&self) -> bool {
        !self.busy || self.parent_unreachable
    }

    /// Sends a join to a port whose depth is less than the parent's, if the change loses no sums.
    pub(super) fn join_better_parent(&mut self, now: Micros, port: usize, parent: Parent) {
        let rank = self.ports.get(port).and_then(|port| port.rank(now));
        let nearer = rank.is_some_and(|rank| rank.is_better_than(parent.rank));
        if nearer && self.may_change_parent() && self.joining.is_none() {
            self.joining = Some((port, now));
            self.send(port, PortMessage::Join);
        }
    }

    /// Sets the parent and its rank. The cell announces a new depth on all ports, but a new round only to children and
    /// unreachable cells, so that a round costs one message per cell instead of one per port.
    pub(super) fn set_parent(&mut self, now: Micros, port: usize, rank: TreeRank) {
        let before = self.parent.replace(Parent { port, rank });
        if before == self.parent {
            return;
        }
        let own = rank.child_rank();
        self.best = Some(own);
        self.parent_unreachable = false;
        let offered = self.announced.replace(own);
        let is_as_deep = offered.is_some_and(|offered| offered.depth == own.depth);
        self.tree_changed |= !is_as_deep || before.is_none_or(|before| before.port != port);
        if !is_as_deep && !self.busy {
            return self.send_hellos(now);
        }
        for port in (0..PORT_COUNT_WITH_UPLINK).filter(|_| offered != Some(own)) {
            if self.ports.get(port).is_some_and(|port| port.must_announce_round(now)) {
                self.send_hello(now, port);
            }
        }
    }

    /// Handles a join, in which the cell at a port requests to become a child.
    pub(super) fn handle_join(&mut self, now: Micros, port: usize) {
        let Some(rank) = self.rank().filter(|_| self.parent_port() != Some(port)) else {
            return self.send(port, PortMessage::Refuse);
        };
        let number = self.node_id_at(port);
        // Two wires may lead to the same cell, whose sums use one of them.
        for (other, there) in self.ports.iter_mut().enumerate() {
            if other == port {
                there.child = Some(now);
            } else if number.is_some() && there.node_id() == number {
                there.child = None;
            }
        }
        self.tree_changed = true;
        self.send(port, PortMessage::Grant(rank));
    }

    fn is_better_than_best(&self, rank: TreeRank) -> bool {
        self.best.is_none_or(|best| rank.is_better_than(best))
    }

    /// Handles a grant, with which the cell at a port becomes the parent.
    pub(super) fn handle_grant(&mut self, now: Micros, port: usize, rank: TreeRank) {
        if self.parent_port() == Some(port) {
            return;
        }
        let moves =
            self.parent.is_none_or(|parent| self.may_change_parent() && rank.is_better_than(parent.rank));
        if !moves || !self.is_better_than_best(rank) {
            return self.send(port, PortMessage::Leave);
        }
        if let Some(before) = self.parent {
            self.former_parent = Some(FormerParent::new(before.port, false, now));
            self.send(before.port, PortMessage::Leave);
        }
        self.joining = None;
        self.repair = None;
        self.changes = self.changes.wrapping_add(1);
        self.set_parent(now, port, rank);
        if port == UPLINK {
            // The gateway's side accepts sums from then on.
            self.send_hello(now, port);
        }
    }

    /// Handles the loss of the parent, and searches for another route.
    pub(crate) fn handle_parent_loss(&mut self, now: Micros, how: ParentLossReason) {
        let Some(parent) = self.parent.take() else { return };
        self.tree_changed = true;
        self.parent_unreachable = false;
        self.former_parent = Some(FormerParent::new(parent.port, how == ParentLossReason::Done, now));
        self.send(parent.port, PortMessage::Leave);
        self.distrust_port(now, parent.port);
        self.search_parent(now);
    }

    pub(super) fn distrust_port(&mut self, now: Micros, port: usize) {
        self.ports.get_mut(port).into_iter().for_each(|port| port.distrusted = Some(now));
    }

    /// Sends a join to the port with the best rank, if it is better than any rank that this cell has had. Otherwise
    /// starts a local repair.
    pub(super) fn search_parent(&mut self, now: Micros) {
        if self.parent.is_some() {
            return;
        }
        if let Some((requested, at)) = self.joining {
            if now.elapsed_since(at) < JOIN_TIMEOUT {
                return;
            }
            self.joining = None;
            self.distrust_port(now, requested);
        }
        let ranked = || self.ports.iter().enumerate().filter_map(|(port, it)| Some((port, it.rank(now)?)));
        let good = ranked().filter(|(_, rank)| self.is_better_than_best(*rank));
        let nearest =
            good.reduce(|nearest, next| if next.1.is_better_than(nearest.1) { next } else { nearest });
        if let Some((port, _)) = nearest {
            self.joining = Some((port, now));
            return self.send(port, PortMessage::Join);
        }
        // A cell that never had a rank accepts any rank, so it waits for the first hello with one.
        let Some(best) = self.best else { return };
        let (at, wait) = self.repair.unwrap_or((now, MIN_AND_MAX_REPAIR_INTERVAL.0));
        if now >= at {
            self.repair = Some((now + wait, Span(wait.0 * 2).min(MIN_AND_MAX_REPAIR_INTERVAL.1)));
            // If no other port leads to the gateway, or the first repair found no route, it may be through a
            // child or a former parent.
            let is_first = wait == MIN_AND_MAX_REPAIR_INTERVAL.0;
            let leads = self.ports.iter().any(|port| port.rank(now).is_some());
            self.request_later_round(now, best.round, None, !(leads && is_first));
        }
    }

    /// Requests a round later than `round`: on the ports that lead to the gateway, or on all working ports if `all` is
    /// true. The port `but` is excluded.
    fn request_later_round(&mut self, now: Micros, round: u8, but: Option<usize>, all: bool) {
        for port in (0..PORT_COUNT_WITH_UPLINK).filter(|port| Some(*port) != but) {
            let leads = |port: &Port| port.rank(now).is_some() || (all && port.is_working(now));
            if self.ports.get(port).is_some_and(leads) {
                self.send(port, PortMessage::Repair(round));
            }
        }
    }

    /// Handles a repair, with which a neighbour requests a round later than `round`. The request of a child is
    /// forwarded to the parent. The request of the parent is forwarded to all other ports, because another route may
    /// exist there.
    pub(super) fn forward_repair(&mut self, now: Micros, port: usize, round: u8) {
        let Some(parent) = self.parent else { return };
        if parent.rank.round.wrapping_sub(round).cast_signed() > 0 {
            return self.send_hello(now, port);
        }
        self.ports.get_mut(port).into_iter().for_each(|port| port.round_requested = true);
        let is_deserted = parent.port == port;
        self.parent_unreachable |= is_deserted;
        // A repair that went to the parent only does not count for a deserted cell: the parent may have two
        // wires to this cell, and repair on both.
        let again = |(of, everywhere, at)| {
            of == round
                && now.elapsed_since(at) < MIN_AND_MAX_REPAIR_INTERVAL.0
                && (everywhere || !is_deserted)
        };
        if self.forwarded_repair.is_some_and(again) {
            return;
        }
        self.forwarded_repair = Some((round, is_deserted, now));
        if is_deserted {
            self.request_later_round(now, round, Some(port), true);
        } else {
            self.send(parent.port, PortMessage::Repair(round));
        }
    }
}
