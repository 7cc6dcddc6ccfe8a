//! The numbered requirements of the cell's documents.

use serde::Serialize;

/// A document with requirements.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
pub enum Document {
    /// The requirements of every cell.
    #[serde(rename = "cell.md")]
    Cell,
    /// Sensor values and stimuli.
    #[serde(rename = "sensing.md")]
    Sensing,
    /// Sums and wires.
    #[serde(rename = "tree.md")]
    Tree,
}

/// A requirement.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
pub struct Requirement {
    /// Its id.
    pub id: &'static str,
    /// The document that contains it.
    pub document: Document,
    /// A short title.
    pub title: &'static str,
}

const fn of(document: Document, id: &'static str, title: &'static str) -> Requirement {
    Requirement { id, document, title }
}

use Document::{Cell, Sensing, Tree};

/// All requirements, in the order of the documents.
pub const REQUIREMENTS: &[Requirement] = &[
    of(Cell, "OPT-1", "parameters of options that it does not have"),
    of(Cell, "OPT-2", "unused contents are ignored"),
    of(Cell, "SEND-1", "only the packets of the documents, whole and in order"),
    of(Cell, "TIME-1", "clock within 1 %"),
    of(Cell, "TIME-2", "answers at once"),
    of(Cell, "TIME-3", "order of packets of the same moment"),
    of(Cell, "ID-1", "serial number"),
    of(Cell, "ID-2", "its node id in all that it sends"),
    of(Cell, "ID-3", "node id survives a reset"),
    of(Cell, "CLAIM-1", "first packet is a heartbeat with CLAIMING"),
    of(Cell, "CLAIM-2", "accepted and ignored packets while it claims"),
    of(Cell, "CLAIM-3", "gives way, or stays and answers"),
    of(Cell, "CLAIM-4", "silence after it gave way"),
    of(Cell, "CLAIM-5", "end of claiming"),
    of(Cell, "CLAIM-6", "a settled cell defends its node id"),
    of(Cell, "CLAIM-7", "DUPLICATE is set"),
    of(Cell, "CLAIM-8", "wires while it claims"),
    of(Cell, "BEAT-1", "a heartbeat every 250 ms"),
    of(Cell, "BEAT-2", "early heartbeats after joints"),
    of(Cell, "BEAT-3", "other heartbeats do not shift regular ones"),
    of(Cell, "BEAT-4", "counts of a heartbeat"),
    of(Cell, "STATE-1", "ACTIVE"),
    of(Cell, "STATE-2", "DUPLICATE and SATURATED in one heartbeat"),
    of(Cell, "STATE-3", "the other bits of the state"),
    of(Cell, "CMD-1", "halt"),
    of(Cell, "CMD-2", "resume"),
    of(Cell, "CMD-3", "sync"),
    of(Cell, "CMD-4", "report"),
    of(Cell, "JOINTS-1", "a repeated epoch is dropped, any other is accepted"),
    of(Cell, "JOINTS-2", "another count is dropped"),
    of(Cell, "JOINTS-3", "last joints accepted"),
    of(Cell, "JOINTS-4", "joints that are too old"),
    of(Cell, "JOINTS-5", "joints are counted"),
    of(Cell, "JOINTS-6", "the answer to joints"),
    of(Cell, "FORCE-1", "Algorithm 1, bit for bit"),
    of(Cell, "J-1", "no torque beyond joint k"),
    of(Cell, "J-2", "J saturates"),
    of(Cell, "J-3", "accuracy of J"),
    of(Cell, "TORQUE-1", "torque words, bit for bit"),
    of(Cell, "TORQUE-2", "SATURATED"),
    of(Cell, "CONF-1", "read"),
    of(Cell, "CONF-2", "writes are staged"),
    of(Cell, "CONF-3", "unused words are 0"),
    of(Cell, "CONF-4", "answers to writes"),
    of(Cell, "CONF-5", "a refused write changes nothing"),
    of(Cell, "CONF-6", "the reason of a refusal"),
    of(Cell, "CONF-7", "commit"),
    of(Cell, "CONF-8", "a committed configuration survives a reset"),
    of(Cell, "CONF-9", "volatile parameters"),
    of(Cell, "CONF-10", "ranges of volatile parameters"),
    of(Cell, "CONF-11", "to everyone"),
    of(Cell, "CONF-12", "tags"),
    of(Cell, "CONF-13", "unknown parameters"),
    of(Cell, "COUNT-1", "unusable packets are dropped and counted"),
    of(Cell, "COUNT-2", "a refusal is not counted"),
    of(Cell, "COUNT-3", "reassembly of segments"),
    of(Sensing, "SENSE-1", "pages on report"),
    of(Sensing, "SENSE-2", "values of a report"),
    of(Sensing, "STIM-1", "stimuli outside test mode"),
    of(Sensing, "STIM-2", "a write of the mode forgets stimuli"),
    of(Sensing, "STIM-3", "first epoch of a stimulus"),
    of(Sensing, "STIM-4", "from the next joints on"),
    of(Sensing, "STIM-5", "late stimuli"),
    of(Sensing, "STIM-6", "8 pending stimuli"),
    of(Sensing, "STIM-7", "order of stimuli"),
    of(Sensing, "STIM-8", "stimuli of joints without an answer"),
    of(Sensing, "SENSE-3", "ranges of parameters 7 and 8"),
    of(Sensing, "SENSE-4", "a switch begins with both pages"),
    of(Sensing, "SENSE-5", "continuous mode"),
    of(Sensing, "SENSE-6", "early pages after joints"),
    of(Sensing, "SENSE-7", "events"),
    of(Sensing, "SENSE-8", "the last sent values"),
    of(Sensing, "SENSE-9", "turns"),
    of(Sensing, "SENSE-10", "pages after heartbeats"),
    of(Sensing, "SENSE-11", "halted, unconfigured and claiming cells"),
    of(Sensing, "BASE-1", "ranges of parameters 11 and 12, and without a baseline"),
    of(Sensing, "BASE-2", "the first tare"),
    of(Sensing, "BASE-3", "the zero holds under a touch"),
    of(Sensing, "BASE-4", "the zero tracks the reading, and how fast"),
    of(Sensing, "BASE-5", "the zero and the temperature"),
    of(Sensing, "BASE-6", "tare"),
    of(Sensing, "BASE-7", "sensors page 3"),
    of(Sensing, "BASE-8", "the subtraction from each word"),
    of(Tree, "SUM-1", "the place in the tree of an epoch"),
    of(Tree, "SUM-2", "the cell's own word"),
    of(Tree, "SUM-3", "the sum"),
    of(Tree, "SUM-4", "when sums are sent"),
    of(Tree, "SUM-5", "later sums of an epoch"),
    of(Tree, "SUM-6", "the end of a contact"),
    of(Tree, "SUM-7", "when no sums are sent"),
    of(Tree, "LEASE-1", "state before sums"),
    of(Tree, "LEASE-2", "a lease continues epoch by epoch"),
    of(Tree, "LEASE-3", "the end of a lease"),
    of(Tree, "NACK-1", "looking back at an epoch"),
    of(Tree, "NACK-2", "not when it was late itself"),
    of(Tree, "NACK-3", "nack"),
    of(Tree, "NACK-4", "probe"),
    of(Tree, "NACK-5", "a parent that does not answer"),
    of(Tree, "HELLO-1", "a hello every 250 ms"),
    of(Tree, "HELLO-2", "hellos at once"),
    of(Tree, "HELLO-3", "ports that lead nowhere"),
    of(Tree, "JOIN-1", "looking for a parent"),
    of(Tree, "JOIN-2", "grant and refuse"),
    of(Tree, "JOIN-3", "a better parent"),
    of(Tree, "JOIN-4", "the grant that is accepted"),
    of(Tree, "JOIN-5", "roots"),
    of(Tree, "JOIN-6", "the tree page"),
    of(Tree, "LOSS-1", "a lost parent"),
    of(Tree, "LOSS-2", "a hello without a rank"),
    of(Tree, "LOSS-3", "leave"),
    of(Tree, "LOSS-4", "a lost child"),
    of(Tree, "REPAIR-1", "repair"),
    of(Tree, "REPAIR-2", "answer to repair"),
    of(Tree, "REPAIR-3", "repair goes up"),
    of(Tree, "REPAIR-4", "repair goes down"),
    of(Tree, "NODE-1", "no packets without a node id"),
    of(Tree, "NODE-2", "walks"),
    of(Tree, "NODE-3", "a new node id is kept"),
    of(Tree, "LINK-1", "links down"),
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
