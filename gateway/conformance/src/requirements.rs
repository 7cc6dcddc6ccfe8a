//! The numbered requirements of the cell's documents.

use serde::Serialize;

/// A document with requirements.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
pub enum Document {
    /// The requirements of every cell.
    #[serde(rename = "cell.md")]
    Cell,
    /// The requirements on sensor values and stimuli.
    #[serde(rename = "sensing.md")]
    Sensing,
    /// The requirements on sums and wires.
    #[serde(rename = "tree.md")]
    Tree,
}

/// A numbered requirement of a document.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
pub struct Requirement {
    /// The id, such as `CONF-7`.
    pub id: &'static str,
    /// The document that contains it.
    pub document: Document,
    /// A short title.
    pub title: &'static str,
}

const fn requirement(document: Document, id: &'static str, title: &'static str) -> Requirement {
    Requirement { id, document, title }
}

use Document::{Cell, Sensing, Tree};

/// All requirements, in the order of the documents.
pub const REQUIREMENTS: &[Requirement] = &[
    requirement(Cell, "OPT-1", "parameters of options that the cell lacks"),
    requirement(Cell, "OPT-2", "unused words, bytes and bits are ignored"),
    requirement(Cell, "SEND-1", "the cell sends only valid, complete packets"),
    requirement(Cell, "TIME-1", "the clock is accurate to 1 %"),
    requirement(Cell, "TIME-2", "answers are sent in time"),
    requirement(Cell, "TIME-3", "order of packets that are sent together"),
    requirement(Cell, "ID-1", "the serial number is unique and never changes"),
    requirement(Cell, "ID-2", "the cell uses only its own node id"),
    requirement(Cell, "ID-3", "the node id survives a reset"),
    requirement(Cell, "CLAIM-1", "the first packet is a heartbeat with CLAIMING"),
    requirement(Cell, "CLAIM-2", "packets that a claiming cell accepts and ignores"),
    requirement(Cell, "CLAIM-3", "a claiming cell gives way, or stays and answers"),
    requirement(Cell, "CLAIM-4", "a cell that gave way is silent"),
    requirement(Cell, "CLAIM-5", "time at which claiming ends"),
    requirement(Cell, "CLAIM-6", "a settled cell defends its node id"),
    requirement(Cell, "CLAIM-7", "DUPLICATE is set after a conflict of node ids"),
    requirement(Cell, "CLAIM-8", "wires of a claiming cell"),
    requirement(Cell, "BEAT-1", "a heartbeat every 250 ms"),
    requirement(Cell, "BEAT-2", "early heartbeats after joints messages"),
    requirement(Cell, "BEAT-3", "other heartbeats do not shift regular ones"),
    requirement(Cell, "BEAT-4", "counters in a heartbeat"),
    requirement(Cell, "STATE-1", "the bit ACTIVE"),
    requirement(Cell, "STATE-2", "DUPLICATE and SATURATED are sent in one heartbeat"),
    requirement(Cell, "STATE-3", "the other bits of the state"),
    requirement(Cell, "CMD-1", "the command halt"),
    requirement(Cell, "CMD-2", "the command resume"),
    requirement(Cell, "CMD-3", "the command sync"),
    requirement(Cell, "CMD-4", "the command report"),
    requirement(Cell, "JOINTS-1", "joints messages with a repeated epoch are dropped, all others accepted"),
    requirement(Cell, "JOINTS-2", "joints messages with a wrong count are dropped"),
    requirement(Cell, "JOINTS-3", "the epoch of the last accepted joints message"),
    requirement(Cell, "JOINTS-4", "joints messages that are too old are skipped"),
    requirement(Cell, "JOINTS-5", "joints messages are counted"),
    requirement(Cell, "JOINTS-6", "the answer to a joints message"),
    requirement(Cell, "FORCE-1", "the force of Algorithm 1, bit for bit"),
    requirement(Cell, "J-1", "torques beyond the joint of the cell are 0"),
    requirement(Cell, "J-2", "the Jacobian J saturates"),
    requirement(Cell, "J-3", "accuracy of the Jacobian J"),
    requirement(Cell, "TORQUE-1", "torque words, bit for bit"),
    requirement(Cell, "TORQUE-2", "saturated torque words set SATURATED"),
    requirement(Cell, "CONF-1", "reads of parameters"),
    requirement(Cell, "CONF-2", "writes are staged"),
    requirement(Cell, "CONF-3", "unused words are stored as 0"),
    requirement(Cell, "CONF-4", "answers to writes"),
    requirement(Cell, "CONF-5", "a refused write changes nothing"),
    requirement(Cell, "CONF-6", "the reason for a refusal"),
    requirement(Cell, "CONF-7", "commit of a configuration"),
    requirement(Cell, "CONF-8", "a committed configuration survives a reset"),
    requirement(Cell, "CONF-9", "volatile parameters are not stored"),
    requirement(Cell, "CONF-10", "ranges of volatile parameters"),
    requirement(Cell, "CONF-11", "requests to everyone"),
    requirement(Cell, "CONF-12", "answers contain the tag of the request"),
    requirement(Cell, "CONF-13", "unknown parameters are refused"),
    requirement(Cell, "COUNT-1", "unusable packets are dropped and counted"),
    requirement(Cell, "COUNT-2", "a refusal is not counted"),
    requirement(Cell, "COUNT-3", "reassembly of segments"),
    requirement(Sensing, "SENSE-1", "sensors pages in a report"),
    requirement(Sensing, "SENSE-2", "sensor values in a report"),
    requirement(Sensing, "STIM-1", "stimuli outside test mode"),
    requirement(Sensing, "STIM-2", "a write of the mode clears stimuli"),
    requirement(Sensing, "STIM-3", "first epoch of a stimulus"),
    requirement(Sensing, "STIM-4", "stimuli for the next joints message"),
    requirement(Sensing, "STIM-5", "late stimuli"),
    requirement(Sensing, "STIM-6", "at most 8 pending stimuli"),
    requirement(Sensing, "STIM-7", "order of stimuli"),
    requirement(Sensing, "STIM-8", "joints messages without an answer latch stimuli too"),
    requirement(Sensing, "SENSE-3", "ranges of parameters 7 and 8"),
    requirement(Sensing, "SENSE-4", "a switch of the mode sends both pages"),
    requirement(Sensing, "SENSE-5", "sensors pages in continuous mode"),
    requirement(Sensing, "SENSE-6", "early sensors pages after joints messages"),
    requirement(Sensing, "SENSE-7", "sensors pages on events"),
    requirement(Sensing, "SENSE-8", "changes are measured from the last sent values"),
    requirement(Sensing, "SENSE-9", "turns (changes of the touch state)"),
    requirement(Sensing, "SENSE-10", "sensors pages after heartbeats"),
    requirement(Sensing, "SENSE-11", "sensor values of halted, unconfigured and claiming cells"),
    requirement(Sensing, "BASE-1", "ranges of parameters 11 and 12"),
    requirement(Sensing, "BASE-2", "the first tare"),
    requirement(Sensing, "BASE-3", "the zero does not move during a touch"),
    requirement(Sensing, "BASE-4", "the zero tracks the reading at a limited rate"),
    requirement(Sensing, "BASE-5", "the zero follows the temperature"),
    requirement(Sensing, "BASE-6", "tare requests"),
    requirement(Sensing, "BASE-7", "times of sensors page 3"),
    requirement(Sensing, "BASE-8", "the zero is subtracted from each contact word"),
    requirement(Tree, "SUM-1", "the place in the tree during an epoch"),
    requirement(Tree, "SUM-2", "the cell's own torque words"),
    requirement(Tree, "SUM-3", "words and count of a sum"),
    requirement(Tree, "SUM-4", "when sums are sent"),
    requirement(Tree, "SUM-5", "later sums of an epoch"),
    requirement(Tree, "SUM-6", "the sum at the end of a contact"),
    requirement(Tree, "SUM-7", "when no sums are sent"),
    requirement(Tree, "LEASE-1", "a state message precedes sums"),
    requirement(Tree, "LEASE-2", "a lease continues from epoch to epoch"),
    requirement(Tree, "LEASE-3", "the end of a lease"),
    requirement(Tree, "NACK-1", "when an epoch is checked for missing sums"),
    requirement(Tree, "NACK-2", "no check after the cell itself was late"),
    requirement(Tree, "NACK-3", "nack messages"),
    requirement(Tree, "NACK-4", "probe messages"),
    requirement(Tree, "NACK-5", "a parent that does not answer"),
    requirement(Tree, "HELLO-1", "a hello every 250 ms"),
    requirement(Tree, "HELLO-2", "hellos that are sent at once"),
    requirement(Tree, "HELLO-3", "ports without a neighbor"),
    requirement(Tree, "JOIN-1", "search for a parent"),
    requirement(Tree, "JOIN-2", "grant and refuse messages"),
    requirement(Tree, "JOIN-3", "change to a better parent"),
    requirement(Tree, "JOIN-4", "which grants are accepted"),
    requirement(Tree, "JOIN-5", "roots and the gateway's side"),
    requirement(Tree, "JOIN-6", "times of the tree page"),
    requirement(Tree, "LOSS-1", "a lost parent"),
    requirement(Tree, "LOSS-2", "a hello without a rank"),
    requirement(Tree, "LOSS-3", "leave messages"),
    requirement(Tree, "LOSS-4", "a lost child"),
    requirement(Tree, "REPAIR-1", "repair messages"),
    requirement(Tree, "REPAIR-2", "the answer to repair messages"),
    requirement(Tree, "REPAIR-3", "repair messages are forwarded to the parent"),
    requirement(Tree, "REPAIR-4", "repair messages from the parent are forwarded"),
    requirement(Tree, "NODE-1", "no packets without a node id"),
    requirement(Tree, "NODE-2", "walks that assign node ids"),
    requirement(Tree, "NODE-3", "a new node id is kept"),
    requirement(Tree, "LINK-1", "links that are taken down"),
];

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the ids of a document, in its order.
    fn ids(text: &str) -> Vec<&str> {
        text.lines().filter_map(|line| Some(line.strip_prefix("- **")?.split_once("**")?.0)).collect()
    }

    #[test]
    fn every_requirement_of_the_documents_is_here_and_no_other() {
        let documents = [
            (Cell, include_str!("../../../docs/reference/cell.md")),
            (Sensing, include_str!("../../../docs/reference/sensing.md")),
            (Tree, include_str!("../../../docs/reference/tree.md")),
        ];
        for (document, text) in documents {
            let here = REQUIREMENTS.iter().filter(|it| it.document == document).map(|it| it.id);
            let (mut here, mut there): (Vec<_>, _) = (here.collect(), ids(text));
            here.sort_unstable();
            there.sort_unstable();
            assert_eq!(here, there, "{document:?}");
            assert!(there.len() > 15, "{document:?}");
        }
    }
}
