//! The state of one port, and of the cell at its other end.

use protocol::id::CellId;
use protocol::message::{PortState, VERSION};
use protocol::port::{Hello, TreeRank};
use protocol::time::{Micros, Span};

/// Time without a hello after which a port counts as disconnected: two hello intervals and some jitter.
pub(super) const HELLO_TIMEOUT: Span = Span::from_millis(600);
/// Time after a grant within which the new child must name this cell as its parent in a hello.
const GRANT_TIMEOUT: Span = Span::from_millis(300);

/// The state of a port.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Port {
    /// The last hello received at this port, and its time of arrival.
    last_hello: Option<(Hello, Micros)>,
    /// The time at which the cell at the other end became a child; `None` if it is not a child.
    pub(super) child: Option<Micros>,
    /// Time at which the cell at the other end was lost as a parent. Only hellos after it are used.
    pub(super) distrusted: Option<Micros>,
    /// True if the cell at the other end has requested a later round, and no rank has been sent to it since.
    pub(super) round_requested: bool,
}

impl Port {
    /// Records a hello. Returns true if no hello arrived shortly before it.
    pub(super) fn record_hello(&mut self, now: Micros, hello: Hello) -> bool {
        let restarted = self.recent_hello(now).is_none();
        self.last_hello = Some((hello, now));
        // The child has had time to learn of the grant but names another parent.
        let forgot =
            !hello.is_parent && self.child.is_some_and(|since| now.elapsed_since(since) > GRANT_TIMEOUT);
        if forgot {
            self.child = None;
        }
        restarted
    }

    /// Returns the last hello, unless it is so old that the port counts as disconnected.
    pub(super) fn recent_hello(&self, now: Micros) -> Option<&Hello> {
        self.last_hello
            .as_ref()
            .filter(|(_, at)| now.elapsed_since(*at) <= HELLO_TIMEOUT)
            .map(|(hello, _)| hello)
    }

    /// Returns true if the port works in both directions, and the cell at the other end uses the same protocol version.
    pub(super) fn is_working(&self, now: Micros) -> bool {
        self.recent_hello(now).is_some_and(|hello| hello.receives && hello.version == VERSION)
    }

    /// Returns the rank of the cell at the other end; `None` if that cell cannot be a parent.
    pub(super) fn rank(&self, now: Micros) -> Option<TreeRank> {
        let at = self.last_hello.map(|(_, at)| at)?;
        let trusted = self.distrusted.is_none_or(|since| at > since);
        self.recent_hello(now)
            .filter(|_| trusted && self.is_working(now) && self.child.is_none())
            .and_then(|it| it.rank)
    }

    /// Returns the node id of the cell at the other end; `None` if it is unknown.
    pub(super) fn node_id(&self) -> Option<CellId> {
        CellId::new(self.last_hello?.0.number.into()).ok()
    }

    /// Returns true if the cell at the other end is a child that has no node id, or has a cell without one below it.
    pub(super) fn lacks_node_ids(&self) -> bool {
        self.child.is_some() && self.last_hello.is_some_and(|(hello, _)| hello.unnumbered)
    }

    /// Returns true if a new round must be announced at this port at once, because a child or an unreachable cell is
    /// there.
    pub(super) fn must_announce_round(&self, now: Micros) -> bool {
        self.child.is_some()
            || self.round_requested
            || self.recent_hello(now).is_some_and(|hello| hello.rank.is_none())
    }

    pub(super) const fn is_child(&self) -> bool {
        self.child.is_some()
    }

    /// Ends the role of the other end as a child if its hellos have stopped.
    pub(super) fn remove_silent_child(&mut self, now: Micros) {
        if self.recent_hello(now).is_none() {
            self.child = None;
        }
    }

    /// Returns the time at which the port will count as disconnected if no further hello arrives.
    pub(super) fn disconnect_time(&self) -> Option<Micros> {
        self.last_hello.map(|(_, at)| at + HELLO_TIMEOUT + Span(1))
    }

    /// Returns the state of the port for network page 4.
    pub(super) fn state(&self, now: Micros) -> PortState {
        let Some(hello) = self.recent_hello(now) else { return PortState::default() };
        PortState {
            number: hello.number,
            port: hello.port,
            receives: true,
            works: hello.receives,
            other_version: hello.version != VERSION,
        }
    }
}
