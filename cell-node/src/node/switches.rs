//! What is switched at run time and not kept: parameters 6 to 9.

use protocol::message::Answer;
use protocol::packet::WORDS;
use protocol::parameters::{Cuts, Events, Parameter, Reply, Sensing};

/// The switches of one cell.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Switches {
    /// What it answers joints with.
    pub(super) reply: Reply,
    /// When it sends what it measures.
    pub(super) sensing: Sensing,
    /// Which changes are events.
    pub(super) events: Events,
    /// Which ports hear nothing.
    pub(super) cuts: Cuts,
}

impl Switches {
    /// The words of a switch; `None` for parameters that are none.
    pub(super) const fn read(&self, parameter: Parameter) -> Option<[i16; WORDS]> {
        match parameter {
            Parameter::Reply => Some(self.reply.words()),
            Parameter::Sensing => Some(self.sensing.words()),
            Parameter::Events => Some(self.events.words()),
            Parameter::Cuts => Some(self.cuts.words()),
            Parameter::Identity
            | Parameter::Mount
            | Parameter::Pose
            | Parameter::Contact
            | Parameter::Timing
            | Parameter::Mode
            | Parameter::Row(_)
            | Parameter::Commit => None,
        }
    }

    /// Sets a switch at once, and gives the answer; `None` for parameters that are none. Ports are cut in test
    /// mode only.
    pub(super) fn write(
        &mut self,
        parameter: Parameter,
        words: [i16; WORDS],
        test_mode: bool,
    ) -> Option<Answer> {
        let mut next = *self;
        let set = match parameter {
            Parameter::Reply => Reply::from_words(words).map(|reply| next.reply = reply),
            Parameter::Sensing => Sensing::from_words(words).map(|sensing| next.sensing = sensing),
            Parameter::Events => Events::from_words(words).map(|events| next.events = events),
            Parameter::Cuts => test_mode.then(|| next.cuts = Cuts::from_words(words)),
            Parameter::Identity
            | Parameter::Mount
            | Parameter::Pose
            | Parameter::Contact
            | Parameter::Timing
            | Parameter::Mode
            | Parameter::Row(_)
            | Parameter::Commit => return None,
        };
        *self = next;
        let number = parameter.number();
        Some(match set {
            Some(()) => Answer::Value { number, written: true, words },
            None => Answer::Refused { number, reason: Answer::CANNOT_BE },
        })
    }
}
