//! Numbers for cells that have none: a walk over the tree gives them away, depth first.

use protocol::time::Micros;
use protocol::wire::{PORTS, PortMessage, Walk};

use super::Network;
use super::port::Port;

/// A walk that gives numbers, while it is with this cell and those below it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Walking {
    walk: Walk,
    /// The port that has it now.
    at: usize,
}

impl Network {
    pub(super) fn is_unnumbered(&self) -> bool {
        self.number == 0 || self.ports.iter().any(Port::is_unnumbered)
    }

    /// Numbers are given away: this cell takes the first if it has none, and then each child's turn comes.
    pub(super) fn begin_walk(&mut self, now: Micros, mut walk: Walk) {
        if self.last_walk.replace(walk.walk) == Some(walk.walk) {
            return;
        }
        if self.number == 0 && walk.first <= walk.last {
            self.number = walk.first;
            self.given = Some(walk.first);
            walk.first += 1;
            self.hello_to_all(now);
        }
        self.walk_from(0, walk);
    }

    pub(super) fn go_on_walking(&mut self, port: usize, walk: Walk) {
        if self.walking.is_some_and(|walking| walking.at == port && walking.walk.walk == walk.walk) {
            self.walk_from(port + 1, walk);
        }
    }

    fn walk_from(&mut self, first: usize, walk: Walk) {
        let wants = |port: &usize| self.ports.get(*port).is_some_and(Port::is_unnumbered);
        let next = (first..PORTS).find(wants).filter(|_| walk.first <= walk.last);
        self.walking = next.map(|at| Walking { walk, at });
        match (next, self.up()) {
            (Some(port), _) => self.say(port, PortMessage::Number(walk)),
            (None, Some(up)) => self.say(up, PortMessage::Return(walk)),
            (None, None) => {}
        }
    }

    pub(super) fn tell_unnumbered(&mut self, now: Micros) {
        let unnumbered = self.is_unnumbered();
        if core::mem::replace(&mut self.was_unnumbered, unnumbered) != unnumbered
            && let Some(up) = self.up()
        {
            self.hello(now, up);
        }
    }
}
