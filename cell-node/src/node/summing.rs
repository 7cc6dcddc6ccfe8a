//! The cell in a network: whose sums are whose, and when they are said.

use protocol::id::CellId;
use protocol::message::{Message, NetworkPage, Ports, State, Tree};
use protocol::packet::Epoch;
use protocol::time::{Micros, Span};
use protocol::wire::{PORTS, PortMessage, UPLINK};

use super::{Claim, Node, Storing, TREE, first_word};
use crate::contact::Torque;
use crate::network::Lost;
use crate::sum::{Begin, Check, Words};

/// So many more epochs in a row without an answer are borne each time that a parent that was lost that way says that it
/// was there and heard.
const PATIENT: u16 = 2 * FORGETS;
/// So many at most.
const PATIENCE: u16 = 12 * FORGETS;
/// One less after so many epochs with a sum of the parent.
const FORGETS: u16 = 16;
/// After so many epochs in a row in which nothing was amiss, a cell is woken by its children and not by joints.
pub(super) const STEADY: u8 = 8;

impl Node {
    /// Takes what came in through a port `age` ago.
    pub fn handle_port(&mut self, now: Micros, age: Span, port: usize, message: PortMessage) {
        if !self.network.hears(port) {
            return;
        }
        self.sums.heard_after(age);
        self.network.set_busy(self.sums.is_busy());
        if self.network.up() == Some(port) && matches!(message, PortMessage::Hello(_)) {
            (self.asks_parent, self.unanswered) = (false, 0);
            self.sums.release();
        }
        match message {
            PortMessage::State(epoch) if self.network.is_child(port) => {
                self.sums.state(now, port, epoch);
            }
            PortMessage::Missed(epoch) if self.network.up() == Some(port) => self.was_missed(epoch),
            PortMessage::State(_) | PortMessage::Missed(_) => {}
            PortMessage::Left => {
                if self.suspected.take_if(|suspected| *suspected == port).is_some() {
                    self.patience = (self.patience + PATIENT).min(PATIENCE);
                }
                self.network.handle(now, port, message);
            }
            PortMessage::Hello(_)
            | PortMessage::Join
            | PortMessage::Grant(_)
            | PortMessage::Refuse
            | PortMessage::Leave
            | PortMessage::Seek(_)
            | PortMessage::Number(_)
            | PortMessage::Return(_)
            | PortMessage::Ask => self.network.handle(now, port, message),
        }
        self.after_network(now);
    }

    /// Takes in what the network has come to.
    pub(super) fn after_network(&mut self, now: Micros) {
        if !self.network.exists() {
            return;
        }
        if let Some(cell) = self.network.given().and_then(|number| CellId::new(number.into()).ok()) {
            self.identity.cell = Some(cell);
            self.claim = Claim::Unsaid;
            self.next_heartbeat = first_word(self.identity, now);
            self.storing = Some(Storing::Number);
            self.hears_changed = true;
        }
        for port in (0..PORTS).filter(|&port| !self.network.is_child(port)) {
            self.sums.disown(port);
        }
        if core::mem::replace(&mut self.changes, self.network.changes()) != self.network.changes() {
            (self.asks_parent, self.unanswered) = (false, 0);
            self.sums.break_off();
            // What was said in this epoch may have been taken by the parent before.
            self.sums.fall_silent();
        }
        if self.network.up().is_none() {
            self.sums.fall_silent();
        }
        self.tell_tree |= self.network.tree_changed();
        self.tell_tree(now);
        self.listen();
    }

    /// Says where it is in the tree, if that is news; while everything changes, not every change.
    pub(super) fn tell_tree(&mut self, now: Micros) {
        let may = self.network.exists() && self.claim == Claim::Settled;
        if may && self.tell_tree && now >= self.next_tree {
            self.tell_tree = false;
            self.next_tree = now + TREE;
            self.push_tree(now);
        }
    }

    /// Hears the sums of the parent and of the children.
    fn listen(&mut self) {
        let mut wanted = [None; PORTS];
        for (port, wanted) in wanted.iter_mut().enumerate() {
            let is_ours = self.network.is_child(port) || self.network.up() == Some(port);
            let number = self.network.number_at(port).filter(|_| is_ours && self.sums.is_on());
            *wanted = number.and_then(|number| CellId::new(number.into()).ok());
        }
        if core::mem::replace(&mut self.heard_sums, wanted) != wanted {
            self.hears_changed = true;
        }
    }

    /// The tree as it is for the sums of an epoch whose joints stood on the bus at a time.
    fn freeze(&mut self, epoch: Epoch, at: Micros, period: Span) -> Begin {
        self.said_before = self.sums.said().is_some_and(|(of, _)| of.next() == epoch);
        let up = self.network.up();
        // A parent that was left and may not know it takes no sum from who was silent for an epoch.
        if !self.said_before {
            self.network.forget_left(at);
        }
        let number = up.and_then(|up| CellId::new(self.network.number_at(up)?.into()).ok());
        self.parent = up.map(|up| (up, number));
        self.heard_parent = false;
        Begin {
            epoch,
            at,
            period,
            depth: self.network.depth(),
            speaks: up.is_some() && self.network.is_let_go(),
            children: self.network.children(),
        }
    }

    /// New joints, which stood on the bus `age` ago.
    pub(super) fn begin_sum(
        &mut self,
        now: Micros,
        age: Span,
        (epoch, period): (Epoch, Span),
        own: Option<Torque>,
    ) {
        let begin = self.freeze(epoch, now - age, period);
        self.sums.begin(&begin, own.map(|torque| torque.exact()).as_ref());
        // What waited aside is no sign of a late machine.
        if !self.waits_for_children {
            self.sums.heard_after(age);
        }
        if self.asks_parent {
            // Without an answer the parent is lost in this epoch, and what was not said is free for another.
            if self.unanswered >= self.borne() {
                self.sums.hold();
            }
            self.ask_parent();
        }
        self.handle_sums(now);
    }

    /// A neighbour's sum.
    pub(super) fn take_sum(&mut self, now: Micros, age: Span, from: CellId, (epoch, words): (Epoch, Words)) {
        if let Some((port, Some(parent))) = self.parent
            && parent == from
        {
            // A late sum of an earlier epoch is a sign of life too.
            self.heard_parent |= self.network.hears(port);
        } else if let Some(port) = self.network.child_with(from.get())
            && self.network.hears(port)
        {
            // Unlike a parent's, a child's is heard as it comes.
            self.sums.heard_after(age);
            self.sums.take(now, port, epoch, words);
            self.handle_sums(now);
        }
    }

    /// Says what is due, and looks who is missing.
    pub(super) fn handle_sums(&mut self, now: Micros) {
        let Some(from) = self.identity.cell else { return };
        if let Some((epoch, words, anew)) = self.sums.say(now) {
            if anew {
                self.network.state(epoch);
            }
            let saturated = words.torque.iter().any(|word| word.is_saturated());
            self.flags = self.flags.with(State::SATURATED, self.flags.has(State::SATURATED) || saturated);
            self.push(Message::Sum { from, epoch, torque: words.torque, count: words.count });
        }
        match self.sums.check(now) {
            Check::NotYet => return,
            Check::Now => {
                self.judge(now);
                if self.asks_parent {
                    self.ask_parent();
                }
            }
            Check::Late => {}
        }
        if core::mem::replace(&mut self.asked, false) {
            self.push_heartbeat();
        }
    }

    /// Looks whose sums did not come in this epoch, once.
    pub(super) fn judge(&mut self, now: Micros) {
        let Some((epoch, missed)) = self.sums.judge() else { return };
        for port in (0..PORTS).filter(|port| missed >> port & 1 == 1) {
            self.network.say(port, PortMessage::Missed(epoch));
        }
        let said = self.sums.said().is_some_and(|(of, _)| of == epoch);
        if self.asks_parent {
            self.unanswered += 1;
            if self.unanswered > self.borne() {
                // Of who was silent all this epoch it takes no more.
                self.lose_parent(now, if said { Lost::Unsure } else { Lost::Done });
            }
        } else if self.heard_parent {
            self.patience = self.patience.saturating_sub(1);
        } else {
            self.asks_parent = said && self.parent.is_some_and(|(port, _)| port != UPLINK);
        }
        let well = said && missed == 0 && !self.asks_parent && self.sums.awaits_children();
        self.steady = if well { (self.steady + 1).min(STEADY) } else { 0 };
    }

    /// The parent says that it did not take a sum: it has to be told anew whom they are for, and asked whether it hears
    /// this cell at all.
    fn was_missed(&mut self, epoch: Epoch) {
        self.sums.break_off();
        let said = self.sums.said().is_some_and(|(of, _)| of == epoch);
        let before = self.sums.epoch().is_some_and(|present| epoch.next() == present);
        if (self.sums.epoch() == Some(epoch) && said) || (before && self.said_before) {
            // It was thought to be taken.
            self.asks_parent = true;
            self.ask_parent();
        }
    }

    /// Epochs in a row without an answer that are borne.
    const fn borne(&self) -> u16 {
        self.patience.div_ceil(FORGETS)
    }

    /// Asks the parent whether it is there; it is looked for the answer before the next joints.
    fn ask_parent(&mut self) {
        self.network.ask_parent();
        self.sums.watch();
    }

    /// The parent is lost that did not answer.
    fn lose_parent(&mut self, now: Micros, how: Lost) {
        (self.asks_parent, self.unanswered) = (false, 0);
        self.suspected = self.network.up();
        self.sums.fall_silent();
        self.network.lose_parent(now, how);
        self.after_network(now);
    }

    pub(super) fn push_tree(&mut self, now: Micros) {
        self.told_round = self.network.round();
        self.push_network(NetworkPage::Tree(Tree {
            parent: self.network.parent_number(),
            up: self.network.up().map_or(0, |up| up.to_le_bytes()[0]),
            depth: self.network.depth().unwrap_or(0),
            round: self.told_round,
            children: self.network.children(),
            works: self.network.working(now),
            sent: self.sums.sent,
            taken: self.sums.taken,
            dropped: self.sums.dropped,
        }));
    }

    pub(super) fn push_ports(&mut self, now: Micros) {
        let ports = self.network.port_states(now);
        self.push_network(NetworkPage::Ports(Ports { ports, changes: self.network.changes() }));
    }
}
