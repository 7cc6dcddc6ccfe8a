//! The way up: whom a cell joins, follows, leaves, and lets in.

use protocol::time::{Micros, Span};
use protocol::wire::{Label, PortMessage};

use super::{ALL, JOIN_PATIENCE, Lost, Network, Parent, SEEK};

impl Network {
    /// A port that is nearer than the parent is asked, when nothing is lost by moving.
    pub(super) fn improve(&mut self, now: Micros, port: usize, parent: Parent) {
        let label = self.ports.get(port).and_then(|port| port.label(now));
        let nearer = label.is_some_and(|label| label.is_better_than(parent.label));
        if nearer && !self.busy && self.joining.is_none() {
            self.joining = Some((port, now));
            self.say(port, PortMessage::Join);
        }
    }

    /// The parent's label is this: those below hear it when that is news.
    pub(super) fn follow(&mut self, now: Micros, port: usize, label: Label) {
        let news = self.parent.is_none_or(|parent| parent.label != label);
        self.parent = Some(Parent { port, label });
        if news {
            self.best = Some(label.below());
            self.tree_changed = true;
            self.hello_to_all(now);
        }
    }

    /// A cell asks to send its sums here.
    pub(super) fn let_in(&mut self, now: Micros, port: usize) {
        let label = self.parent.filter(|parent| parent.port != port).map(|parent| parent.label.below());
        let number = self.number_at(port);
        match label {
            Some(label) => {
                // Two wires may lead to the same cell, whose sums come by one of them.
                for (other, there) in self.ports.iter_mut().enumerate() {
                    if other == port {
                        there.adopt(now);
                    } else if number.is_some() && there.number() == number {
                        there.disown();
                    }
                }
                self.tree_changed = true;
                self.say(port, PortMessage::Grant(label));
            }
            None => self.say(port, PortMessage::Refuse),
        }
    }

    fn is_good(&self, label: Label) -> bool {
        self.best.is_none_or(|best| label.is_better_than(best))
    }

    /// A cell lets this one in.
    pub(super) fn join(&mut self, now: Micros, port: usize, label: Label) {
        if self.up() == Some(port) {
            return;
        }
        let moves = self.parent.is_none_or(|parent| !self.busy && label.is_better_than(parent.label));
        if !moves || !self.is_good(label) {
            return self.say(port, PortMessage::Leave);
        }
        if let Some(before) = self.parent {
            self.left = Some((before.port, false));
            self.say(before.port, PortMessage::Leave);
        }
        self.joining = None;
        self.orphan = None;
        self.seek = None;
        self.changes = self.changes.wrapping_add(1);
        self.follow(now, port, label);
    }

    /// The parent does not take this cell's sums any more: another way has to be found.
    pub fn lose_parent(&mut self, now: Micros, how: Lost) {
        let Some(parent) = self.parent.take() else { return };
        self.tree_changed = true;
        self.orphan = Some((now, false));
        self.left = Some((parent.port, how == Lost::Done));
        self.say(parent.port, PortMessage::Leave);
        self.distrust(now, parent.port);
        self.search(now);
    }

    pub(super) fn distrust(&mut self, now: Micros, port: usize) {
        self.ports.get_mut(port).into_iter().for_each(|port| port.distrust(now));
    }

    /// Asks the nearest port that is good enough, or for a new round where none is.
    pub(super) fn search(&mut self, now: Micros) {
        if self.parent.is_some() {
            return;
        }
        if self.orphan.is_none() {
            self.orphan = Some((now, false));
        }
        if let Some((asked, at)) = self.joining {
            if now.since(at) < JOIN_PATIENCE {
                return;
            }
            self.joining = None;
            self.distrust(now, asked);
        }
        let labelled = || self.ports.iter().enumerate().filter_map(|(port, it)| Some((port, it.label(now)?)));
        let good = labelled().filter(|(_, label)| self.is_good(*label));
        let nearest =
            good.reduce(|nearest, next| if next.1.is_better_than(nearest.1) { next } else { nearest });
        if let Some((port, _)) = nearest {
            self.joining = Some((port, now));
            return self.say(port, PortMessage::Join);
        }
        // Who never had a way has nothing to compare: the first hello with a label is good enough.
        let Some(best) = self.best else { return };
        let (at, wait) = self.seek.unwrap_or((now, SEEK.0));
        if now >= at {
            self.seek = Some((now + wait, Span(wait.0 * 2).min(SEEK.1)));
            for port in 0..ALL {
                if self.ports.get(port).is_some_and(|port| port.label(now).is_some()) {
                    self.say(port, PortMessage::Seek(best.round));
                }
            }
        }
    }

    /// Somebody needs a round later than this one.
    pub(super) fn pass_on(&mut self, now: Micros, port: usize, round: u8) {
        let Some(parent) = self.parent.filter(|parent| parent.port != port) else { return };
        if parent.label.round.wrapping_sub(round).cast_signed() > 0 {
            return self.hello(now, port);
        }
        if self.passed_on.is_some_and(|(of, at)| of == round && now.since(at) < SEEK.0) {
            return;
        }
        self.passed_on = Some((round, now));
        self.say(parent.port, PortMessage::Seek(round));
    }
}
