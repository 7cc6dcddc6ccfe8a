//! The state of one port.

use protocol::id::CellId;
use protocol::message::{PortState, VERSION};
use protocol::port::{Hello, Rank};
use protocol::time::{Micros, Span};

/// Time without a hello after which the port counts as disconnected: two hellos and some jitter.
pub(super) const HELLO_TIMEOUT: Span = Span::from_millis(600);
/// Time after its grant in which a child must name this cell as its parent in its hellos.
const GRANT_TIMEOUT: Span = Span::from_millis(300);

/// A port.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Port {
    /// The last hello, and its time.
    last_hello: Option<(Hello, Micros)>,
    /// The time at which the cell there became a child.
    pub(super) child: Option<Micros>,
    /// Set when the cell there was lost as parent: only later hellos count again.
    pub(super) distrusted: Option<Micros>,
    /// True if the cell there requested a later round and has not received a rank since.
    pub(super) round_requested: bool,
}

impl Port {
    /// Records a hello. Returns true if it is the first after a silence.
    pub(super) fn record_hello(&mut self, now: Micros, hello: Hello) -> bool {
        let restarted = self.hello(now).is_none();
        self.last_hello = Some((hello, now));
        // The child has had time to learn of the grant but names another parent.
        let forgot = !hello.is_parent && self.child.is_some_and(|since| now.elapsed_since(since) > GRANT_TIMEOUT);
        if forgot {
            self.child = None;
        }
        restarted
    }

    /// Returns the last hello, unless it is too old.
    pub(super) fn hello(&self, now: Micros) -> Option<&Hello> {
        self.last_hello.as_ref().filter(|(_, at)| now.elapsed_since(*at) <= HELLO_TIMEOUT).map(|(hello, _)| hello)
    }

    /// Returns true if the port works in both directions, and the other end uses this version.
    pub(super) fn works(&self, now: Micros) -> bool {
        self.hello(now).is_some_and(|hello| hello.receives && hello.version == VERSION)
    }

    /// Returns the rank of the cell at the other end, if sums could be sent to it.
    pub(super) fn rank(&self, now: Micros) -> Option<Rank> {
        let at = self.last_hello.map(|(_, at)| at)?;
        let trusted = self.distrusted.is_none_or(|since| at > since);
        self.hello(now).filter(|_| trusted && self.works(now) && self.child.is_none()).and_then(|it| it.rank)
    }

    /// Returns the node id of the cell at the other end, if it has one.
    pub(super) fn number(&self) -> Option<CellId> {
        CellId::new(self.last_hello?.0.number.into()).ok()
    }

    /// Returns true if the cell there is a child without a node id, or has such a cell below it.
    pub(super) fn is_unnumbered(&self) -> bool {
        self.child.is_some() && self.last_hello.is_some_and(|(hello, _)| hello.unnumbered)
    }

    /// Returns true if a later round must be announced there at once: to a child or an unreachable cell.
    pub(super) fn needs_round(&self, now: Micros) -> bool {
        self.child.is_some() || self.round_requested || self.hello(now).is_some_and(|hello| hello.rank.is_none())
    }

    pub(super) const fn is_child(&self) -> bool {
        self.child.is_some()
    }

    /// Handles the passage of time: a silent child is no longer a child.
    pub(super) fn expire(&mut self, now: Micros) {
        if self.hello(now).is_none() {
            self.child = None;
        }
    }

    /// Returns the time at which the port counts as disconnected without a further hello.
    pub(super) fn silent_at(&self) -> Option<Micros> {
        self.last_hello.map(|(_, at)| at + HELLO_TIMEOUT + Span(1))
    }

    /// Returns the state for reports.
    pub(super) fn state(&self, now: Micros) -> PortState {
        let Some(hello) = self.hello(now) else { return PortState::default() };
        PortState {
            number: hello.number,
            port: hello.port,
            receives: true,
            works: hello.receives,
            other_version: hello.version != VERSION,
        }
    }
}
