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
    requirement(Cell, "OPT-1", "parameters of options that it does not have"),
    requirement(Cell, "OPT-2", "unused contents are ignored"),
    requirement(Cell, "SEND-1", "only the packets of the documents, whole and in order"),
    requirement(Cell, "TIME-1", "clock within 1 %"),
    requirement(Cell, "TIME-2", "answers at once"),
    requirement(Cell, "TIME-3", "order of packets of the same moment"),
    requirement(Cell, "ID-1", "serial number"),
    requirement(Cell, "ID-2", "its node id in all that it sends"),
    requirement(Cell, "ID-3", "node id survives a reset"),
    requirement(Cell, "CLAIM-1", "first packet is a heartbeat with CLAIMING"),
    requirement(Cell, "CLAIM-2", "accepted and ignored packets while it claims"),
    requirement(Cell, "CLAIM-3", "gives way, or stays and answers"),
    requirement(Cell, "CLAIM-4", "silence after it gave way"),
    requirement(Cell, "CLAIM-5", "end of claiming"),
    requirement(Cell, "CLAIM-6", "a settled cell defends its node id"),
    requirement(Cell, "CLAIM-7", "DUPLICATE is set"),
    requirement(Cell, "CLAIM-8", "wires while it claims"),
    requirement(Cell, "BEAT-1", "a heartbeat every 250 ms"),
    requirement(Cell, "BEAT-2", "early heartbeats after joints"),
    requirement(Cell, "BEAT-3", "other heartbeats do not shift regular ones"),
    requirement(Cell, "BEAT-4", "counts of a heartbeat"),
    requirement(Cell, "STATE-1", "ACTIVE"),
    requirement(Cell, "STATE-2", "DUPLICATE and SATURATED in one heartbeat"),
    requirement(Cell, "STATE-3", "the other bits of the state"),
    requirement(Cell, "CMD-1", "halt"),
    requirement(Cell, "CMD-2", "resume"),
    requirement(Cell, "CMD-3", "sync"),
    requirement(Cell, "CMD-4", "report"),
    requirement(Cell, "JOINTS-1", "a repeated epoch is dropped, any other is accepted"),
    requirement(Cell, "JOINTS-2", "another count is dropped"),
    requirement(Cell, "JOINTS-3", "last joints accepted"),
    requirement(Cell, "JOINTS-4", "joints that are too old"),
    requirement(Cell, "JOINTS-5", "joints are counted"),
    requirement(Cell, "JOINTS-6", "the answer to joints"),
    requirement(Cell, "FORCE-1", "Algorithm 1, bit for bit"),
    requirement(Cell, "J-1", "no torque beyond joint k"),
    requirement(Cell, "J-2", "J saturates"),
    requirement(Cell, "J-3", "accuracy of J"),
    requirement(Cell, "TORQUE-1", "torque words, bit for bit"),
    requirement(Cell, "TORQUE-2", "SATURATED"),
    requirement(Cell, "CONF-1", "read"),
    requirement(Cell, "CONF-2", "writes are staged"),
    requirement(Cell, "CONF-3", "unused words are 0"),
    requirement(Cell, "CONF-4", "answers to writes"),
    requirement(Cell, "CONF-5", "a refused write changes nothing"),
    requirement(Cell, "CONF-6", "the reason of a refusal"),
    requirement(Cell, "CONF-7", "commit"),
    requirement(Cell, "CONF-8", "a committed configuration survives a reset"),
    requirement(Cell, "CONF-9", "volatile parameters"),
    requirement(Cell, "CONF-10", "ranges of volatile parameters"),
    requirement(Cell, "CONF-11", "to everyone"),
    requirement(Cell, "CONF-12", "tags"),
    requirement(Cell, "CONF-13", "unknown parameters"),
    requirement(Cell, "COUNT-1", "unusable packets are dropped and counted"),
    requirement(Cell, "COUNT-2", "a refusal is not counted"),
    requirement(Cell, "COUNT-3", "reassembly of segments"),
    requirement(Sensing, "SENSE-1", "pages on report"),
    requirement(Sensing, "SENSE-2", "values of a report"),
    requirement(Sensing, "STIM-1", "stimuli outside test mode"),
    requirement(Sensing, "STIM-2", "a write of the mode forgets stimuli"),
    requirement(Sensing, "STIM-3", "first epoch of a stimulus"),
    requirement(Sensing, "STIM-4", "from the next joints on"),
    requirement(Sensing, "STIM-5", "late stimuli"),
    requirement(Sensing, "STIM-6", "8 pending stimuli"),
    requirement(Sensing, "STIM-7", "order of stimuli"),
    requirement(Sensing, "STIM-8", "stimuli of joints without an answer"),
    requirement(Sensing, "SENSE-3", "ranges of parameters 7 and 8"),
    requirement(Sensing, "SENSE-4", "a switch begins with both pages"),
    requirement(Sensing, "SENSE-5", "continuous mode"),
    requirement(Sensing, "SENSE-6", "early pages after joints"),
    requirement(Sensing, "SENSE-7", "events"),
    requirement(Sensing, "SENSE-8", "the last sent values"),
    requirement(Sensing, "SENSE-9", "turns"),
    requirement(Sensing, "SENSE-10", "pages after heartbeats"),
    requirement(Sensing, "SENSE-11", "halted, unconfigured and claiming cells"),
    requirement(Sensing, "BASE-1", "ranges of parameters 11 and 12, and without a baseline"),
    requirement(Sensing, "BASE-2", "the first tare"),
    requirement(Sensing, "BASE-3", "the zero holds under a touch"),
    requirement(Sensing, "BASE-4", "the zero tracks the reading, and how fast"),
    requirement(Sensing, "BASE-5", "the zero and the temperature"),
    requirement(Sensing, "BASE-6", "tare"),
    requirement(Sensing, "BASE-7", "sensors page 3"),
    requirement(Sensing, "BASE-8", "the subtraction from each word"),
    requirement(Tree, "SUM-1", "the place in the tree of an epoch"),
    requirement(Tree, "SUM-2", "the cell's own word"),
    requirement(Tree, "SUM-3", "the sum"),
    requirement(Tree, "SUM-4", "when sums are sent"),
    requirement(Tree, "SUM-5", "later sums of an epoch"),
    requirement(Tree, "SUM-6", "the end of a contact"),
    requirement(Tree, "SUM-7", "when no sums are sent"),
    requirement(Tree, "LEASE-1", "state before sums"),
    requirement(Tree, "LEASE-2", "a lease continues epoch by epoch"),
    requirement(Tree, "LEASE-3", "the end of a lease"),
    requirement(Tree, "NACK-1", "looking back at an epoch"),
    requirement(Tree, "NACK-2", "not when it was late itself"),
    requirement(Tree, "NACK-3", "nack"),
    requirement(Tree, "NACK-4", "probe"),
    requirement(Tree, "NACK-5", "a parent that does not answer"),
    requirement(Tree, "HELLO-1", "a hello every 250 ms"),
    requirement(Tree, "HELLO-2", "hellos at once"),
    requirement(Tree, "HELLO-3", "ports that lead nowhere"),
    requirement(Tree, "JOIN-1", "looking for a parent"),
    requirement(Tree, "JOIN-2", "grant and refuse"),
    requirement(Tree, "JOIN-3", "a better parent"),
    requirement(Tree, "JOIN-4", "the grant that is accepted"),
    requirement(Tree, "JOIN-5", "roots"),
    requirement(Tree, "JOIN-6", "the tree page"),
    requirement(Tree, "LOSS-1", "a lost parent"),
    requirement(Tree, "LOSS-2", "a hello without a rank"),
    requirement(Tree, "LOSS-3", "leave"),
    requirement(Tree, "LOSS-4", "a lost child"),
    requirement(Tree, "REPAIR-1", "repair"),
    requirement(Tree, "REPAIR-2", "answer to repair"),
    requirement(Tree, "REPAIR-3", "repair goes up"),
    requirement(Tree, "REPAIR-4", "repair goes down"),
    requirement(Tree, "NODE-1", "no packets without a node id"),
    requirement(Tree, "NODE-2", "walks"),
    requirement(Tree, "NODE-3", "a new node id is kept"),
    requirement(Tree, "LINK-1", "links down"),
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
