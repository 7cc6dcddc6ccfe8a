//! The state of one port.

use protocol::id::CellId;
use protocol::message::{PortState, VERSION};
use protocol::port::{Hello, Rank};
use protocol::time::{Micros, Span};

/// After so long without a hello a port leads nowhere: two hellos and some jitter.
pub(super) const SILENT: Span = Span::from_millis(600);
/// So long after its grant a child names this cell as its parent in its hellos.
const KNOWS: Span = Span::from_millis(300);

/// One port.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Port {
    /// The last hello, and when it came.
    heard: Option<(Hello, Micros)>,
    /// Since when the cell there is a child of this one.
    pub(super) child: Option<Micros>,
    /// It was a parent and was lost: only later hellos count again.
    pub(super) distrusted: Option<Micros>,
    /// The cell there requested a later round, and no rank was announced to it since.
    pub(super) sought: bool,
}

impl Port {
    /// Takes a hello; whether it is the first one after a silence.
    pub(super) fn take(&mut self, now: Micros, hello: Hello) -> bool {
        let restarted = self.hello(now).is_none();
        self.heard = Some((hello, now));
        // It had time to learn of the grant and names another parent: it is a child no longer.
        let forgot = !hello.up && self.child.is_some_and(|since| now.since(since) > KNOWS);
        if forgot {
            self.child = None;
        }
        restarted
    }

    /// The last hello, unless it is long ago.
    pub(super) fn hello(&self, now: Micros) -> Option<&Hello> {
        self.heard.as_ref().filter(|(_, at)| now.since(*at) <= SILENT).map(|(hello, _)| hello)
    }

    /// Returns true if it works in both directions, and the other end uses this version.
    pub(super) fn works(&self, now: Micros) -> bool {
        self.hello(now).is_some_and(|hello| hello.hears && hello.version == VERSION)
    }

    /// How far the cell at the other end is, if sums could go there.
    pub(super) fn rank(&self, now: Micros) -> Option<Rank> {
        let at = self.heard.map(|(_, at)| at)?;
        let trusted = self.distrusted.is_none_or(|since| at > since);
        self.hello(now).filter(|_| trusted && self.works(now) && self.child.is_none()).and_then(|it| it.rank)
    }

    /// The node id of the cell at the other end, if it has one.
    pub(super) fn number(&self) -> Option<CellId> {
        CellId::new(self.heard?.0.number.into()).ok()
    }

    /// Whether a cell without a node id is there or below.
    pub(super) fn is_unnumbered(&self) -> bool {
        self.child.is_some() && self.heard.is_some_and(|(hello, _)| hello.unnumbered)
    }

    /// Returns true if a later round has to be announced there at once: to a child, and to a cell that is
    /// unreachable.
    pub(super) fn needs_round(&self, now: Micros) -> bool {
        self.child.is_some() || self.sought || self.hello(now).is_some_and(|hello| hello.rank.is_none())
    }

    pub(super) const fn is_child(&self) -> bool {
        self.child.is_some()
    }

    /// Time has passed: a silent child is no child any more.
    pub(super) fn pass(&mut self, now: Micros) {
        if self.hello(now).is_none() {
            self.child = None;
        }
    }

    /// When it falls silent, if nothing more comes.
    pub(super) fn silent_at(&self) -> Option<Micros> {
        self.heard.map(|(_, at)| at + SILENT + Span(1))
    }

    /// As it is reported.
    pub(super) fn state(&self, now: Micros) -> PortState {
        let Some(hello) = self.hello(now) else { return PortState::default() };
        PortState {
            number: hello.number,
            port: hello.port,
            hears: true,
            works: hello.hears,
            other_version: hello.version != VERSION,
        }
    }
}
