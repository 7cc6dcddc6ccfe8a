//! Why a run ends without the external controller that its skin requires.

use std::fmt::{self, Display, Formatter};
use std::path::PathBuf;

use thiserror::Error;

/// What an external controller lacks that counts as absent. Each says what to do.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum Absence {
    /// Nobody said hello.
    #[error(
        "no external controller said hello on {}{}: start it before the run or within [controller] start_s; \
         docs/how-to/external-controller.md has an example",
        .socket.display(), .others
    )]
    NoHello {
        /// The gateway's socket.
        socket: PathBuf,
        /// What came in its place.
        others: Others,
    },
    /// It said hello, and nothing else that could be used.
    #[error(
        "the external controller on {} said hello and answered no tick in time ({missing} without an answer, {late} \
         answered late, {nonsense} datagrams of nonsense): it must answer each state before the next tick, as in \
         docs/how-to/external-controller.md", .socket.display()
    )]
    NoAnswer {
        /// The gateway's socket.
        socket: PathBuf,
        /// Ticks without an answer.
        missing: u64,
        /// Answers to ticks that had ended.
        late: u64,
        /// Datagrams that were no answers.
        nonsense: u64,
    },
    /// It answered, and ended or fell silent.
    #[error(
        "the external controller on {} answered {answers} ticks and none of the last {ticks}, when the run ended: it \
         must answer until then; see its own messages", .socket.display()
    )]
    Gone {
        /// The gateway's socket.
        socket: PathBuf,
        /// Ticks that it answered.
        answers: u64,
        /// Ticks at the end of the run that it did not.
        ticks: u32,
    },
}

/// Datagrams of programs that said no hello.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Others {
    /// Of senders with an address.
    pub named: u64,
    /// Of senders without one, who cannot be answered.
    pub unnamed: u64,
}

impl Display for Others {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let named = |count| format!("{count} datagrams came that are no hello of this version");
        let unnamed = |count| format!("{count} came from a socket without an address, which must be bound");
        match (self.named, self.unnamed) {
            (0, 0) => Ok(()),
            (count, 0) => write!(f, " ({})", named(count)),
            (0, count) => write!(f, " ({})", unnamed(count)),
            (count, more) => write!(f, " ({}, {})", named(count), unnamed(more)),
        }
    }
}
