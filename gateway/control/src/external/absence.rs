//! The reasons for which an external controller, which the skin requires, counts as absent at the end of a run.

use std::fmt::{self, Display, Formatter};
use std::path::PathBuf;

use thiserror::Error;

/// The reason for which an external controller counts as absent. The message also says what to do.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum ControllerAbsence {
    /// No program sent a hello.
    #[error(
        "no external controller sent a hello on {}{}: start it before the run or within [controller] start_s; \
         docs/how-to/external-controller.md has an example",
        .socket.display(), .others
    )]
    NoHello {
        /// Path of the gateway's socket.
        socket: PathBuf,
        /// Datagrams that arrived from other programs instead.
        others: OtherDatagrams,
    },
    /// A program sent a hello, but no answer in time.
    #[error(
        "the external controller on {} sent a hello but answered no tick in time ({missing} without an answer, {late} \
         answered late, {nonsense} invalid datagrams): it must answer each state before the next tick, as in \
         docs/how-to/external-controller.md", .socket.display()
    )]
    NoAnswer {
        /// Path of the gateway's socket.
        socket: PathBuf,
        /// Number of ticks without an answer.
        missing: u64,
        /// Number of answers that arrived after their tick had ended.
        late: u64,
        /// Number of invalid datagrams.
        nonsense: u64,
    },
    /// The program answered at first, and then ended or fell silent.
    #[error(
        "the external controller on {} answered {answers} ticks, but none of the last {ticks} before the run ended: it \
         must answer until the end; see its own messages", .socket.display()
    )]
    Gone {
        /// Path of the gateway's socket.
        socket: PathBuf,
        /// Number of answered ticks.
        answers: u64,
        /// Number of consecutive unanswered ticks at the end of the run.
        ticks: u32,
    },
}

/// Datagrams of programs that have not sent a hello.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct OtherDatagrams {
    /// Number of datagrams from senders whose sockets have an address.
    pub named: u64,
    /// Number of datagrams from senders whose sockets have no address, so that they cannot be answered.
    pub unnamed: u64,
}

impl Display for OtherDatagrams {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let datagrams = |count| format!("{count} datagram{}", if count == 1 { "" } else { "s" });
        let named = |count| format!("{} received, but none is a hello of this version", datagrams(count));
        let unnamed = |count| {
            format!("{} received from a socket without an address: bind the socket", datagrams(count))
        };
        match (self.named, self.unnamed) {
            (0, 0) => Ok(()),
            (count, 0) => write!(f, " ({})", named(count)),
            (0, count) => write!(f, " ({})", unnamed(count)),
            (count, more) => write!(f, " ({}, {})", named(count), unnamed(more)),
        }
    }
}
