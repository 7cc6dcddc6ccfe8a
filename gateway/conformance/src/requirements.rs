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
    requirement(Cell, "OPT-1", "parameters of options that the cell lacks hold only 0"),
    requirement(Cell, "OPT-2", "the cell ignores unused words, bytes and bits"),
    requirement(Cell, "SEND-1", "the cell sends only valid, complete packets"),
    requirement(Cell, "TIME-1", "the clock is accurate to 1 %"),
    requirement(Cell, "TIME-2", "the cell answers in time"),
    requirement(Cell, "TIME-3", "packets due at the same time leave in a fixed order"),
    requirement(Cell, "ID-1", "the serial number is unique and never changes"),
    requirement(Cell, "ID-2", "the cell uses only its own node id"),
    requirement(Cell, "ID-3", "the node id survives a reset"),
    requirement(Cell, "CLAIM-1", "the first packet is a heartbeat with CLAIMING"),
    requirement(Cell, "CLAIM-2", "a claiming cell accepts some packets and ignores others"),
    requirement(Cell, "CLAIM-3", "a claiming cell gives way, or stays and answers"),
    requirement(Cell, "CLAIM-4", "a cell that gave way is silent"),
    requirement(Cell, "CLAIM-5", "claiming ends at the right time"),
    requirement(Cell, "CLAIM-6", "a settled cell defends its node id"),
    requirement(Cell, "CLAIM-7", "DUPLICATE is set after a conflict of node ids"),
    requirement(Cell, "CLAIM-8", "a claiming cell uses its wires, but sends no sums"),
    requirement(Cell, "BEAT-1", "the cell sends a heartbeat every 250 ms"),
    requirement(Cell, "BEAT-2", "a heartbeat may follow a joints message early"),
    requirement(Cell, "BEAT-3", "other heartbeats do not shift regular ones"),
    requirement(Cell, "BEAT-4", "heartbeats have correct counters 'sent' and 'refused'"),
    requirement(Cell, "STATE-1", "the bit ACTIVE tells whether the cell is in contact"),
    requirement(Cell, "STATE-2", "DUPLICATE and SATURATED are sent in one heartbeat"),
    requirement(Cell, "STATE-3", "the other state bits are correct in each heartbeat"),
    requirement(Cell, "CMD-1", "a halted cell sends no torques and no sums"),
    requirement(Cell, "CMD-2", "a resume ends the halted state"),
    requirement(Cell, "CMD-3", "the cell answers a sync with a heartbeat"),
    requirement(Cell, "CMD-4", "the cell answers a report with all its pages"),
    requirement(Cell, "JOINTS-1", "joints messages with a repeated epoch are dropped, all others accepted"),
    requirement(Cell, "JOINTS-2", "joints messages with a wrong count are dropped"),
    requirement(Cell, "JOINTS-3", "later packets have the epoch of the last accepted joints"),
    requirement(Cell, "JOINTS-4", "joints messages that are too old are skipped"),
    requirement(Cell, "JOINTS-5", "joints messages are counted"),
    requirement(Cell, "JOINTS-6", "the cell answers joints messages while in contact"),
    requirement(Cell, "FORCE-1", "the force of Algorithm 1 is correct, bit for bit"),
    requirement(Cell, "J-1", "torques beyond the joint of the cell are 0"),
    requirement(Cell, "J-2", "the Jacobian J saturates"),
    requirement(Cell, "J-3", "the Jacobian J is accurate"),
    requirement(Cell, "TORQUE-1", "torque words are correct, bit for bit"),
    requirement(Cell, "TORQUE-2", "saturated torque words set SATURATED"),
    requirement(Cell, "CONF-1", "a read returns the value in use"),
    requirement(Cell, "CONF-2", "a write changes only the staged copy, until a commit"),
    requirement(Cell, "CONF-3", "unused words are stored as 0"),
    requirement(Cell, "CONF-4", "the answer to a write repeats the written words"),
    requirement(Cell, "CONF-5", "a refused write changes nothing"),
    requirement(Cell, "CONF-6", "a refusal gives the right reason"),
    requirement(Cell, "CONF-7", "a commit with the right hash puts the writes into effect"),
    requirement(Cell, "CONF-8", "a committed configuration survives a reset"),
    requirement(Cell, "CONF-9", "volatile parameters are not stored"),
    requirement(Cell, "CONF-10", "volatile parameters accept only values in range"),
    requirement(Cell, "CONF-11", "the cell obeys requests that are sent to everyone"),
    requirement(Cell, "CONF-12", "answers contain the tag of the request"),
    requirement(Cell, "CONF-13", "unknown parameters are refused"),
    requirement(Cell, "COUNT-1", "unusable packets are dropped and counted"),
    requirement(Cell, "COUNT-2", "a refusal is not counted"),
    requirement(Cell, "COUNT-3", "segments are joined to packets"),
    requirement(Sensing, "SENSE-1", "a report contains all sensors pages"),
    requirement(Sensing, "SENSE-2", "a report contains the latched sensor values"),
    requirement(Sensing, "STIM-1", "stimuli outside test mode are refused and counted"),
    requirement(Sensing, "STIM-2", "a write of the mode clears stimuli"),
    requirement(Sensing, "STIM-3", "a stimulus takes effect at its first epoch"),
    requirement(Sensing, "STIM-4", "a stimulus can take effect at the next joints message"),
    requirement(Sensing, "STIM-5", "a late stimulus takes effect at the next joints message"),
    requirement(Sensing, "STIM-6", "the cell keeps up to 8 pending stimuli"),
    requirement(Sensing, "STIM-7", "stimuli take effect in the order of their arrival"),
    requirement(Sensing, "STIM-8", "joints messages without an answer latch stimuli too"),
    requirement(Sensing, "SENSE-3", "parameters 7 and 8 accept only values in range"),
    requirement(Sensing, "SENSE-4", "a switch of the mode sends both pages"),
    requirement(Sensing, "SENSE-5", "sensors pages come at the set rate in continuous mode"),
    requirement(Sensing, "SENSE-6", "a sensors page may follow a joints message early"),
    requirement(Sensing, "SENSE-7", "sensors pages are sent when sensor values change"),
    requirement(Sensing, "SENSE-8", "changes are measured from the last sent values"),
    requirement(Sensing, "SENSE-9", "when a touch counts as started or ended"),
    requirement(Sensing, "SENSE-10", "sensors pages follow heartbeats in event mode"),
    requirement(Sensing, "SENSE-11", "halted and unconfigured cells go on sending sensor values"),
    requirement(Sensing, "BASE-1", "parameters 11 and 12 accept only values in range"),
    requirement(Sensing, "BASE-2", "the first tare sets the zero, up to its limit"),
    requirement(Sensing, "BASE-3", "the zero does not move during a touch"),
    requirement(Sensing, "BASE-4", "the zero tracks the reading at a limited rate"),
    requirement(Sensing, "BASE-5", "the zero follows the temperature"),
    requirement(Sensing, "BASE-6", "the cell obeys or refuses requests to tare"),
    requirement(Sensing, "BASE-7", "sensors page 3 is sent when it is due"),
    requirement(Sensing, "BASE-8", "the zero is subtracted from each contact word"),
    requirement(Tree, "SUM-1", "parent and children stay the same during an epoch"),
    requirement(Tree, "SUM-2", "the cell's own torque in a sum is correct"),
    requirement(Tree, "SUM-3", "a sum adds the torques and counts of the children"),
    requirement(Tree, "SUM-4", "a sum is sent in the slot of the cell's depth"),
    requirement(Tree, "SUM-5", "late contributions are sent in the next slot"),
    requirement(Tree, "SUM-6", "an empty sum follows the end of a contact"),
    requirement(Tree, "SUM-7", "an unreachable cell sends no sums"),
    requirement(Tree, "LEASE-1", "a state message precedes sums"),
    requirement(Tree, "LEASE-2", "a lease continues from epoch to epoch"),
    requirement(Tree, "LEASE-3", "a lease ends with an empty sum, leave or nack"),
    requirement(Tree, "NACK-1", "each epoch is checked once for missing sums"),
    requirement(Tree, "NACK-2", "a cell that was late skips the check for missing sums"),
    requirement(Tree, "NACK-3", "a child with a lease that sent nothing gets a nack"),
    requirement(Tree, "NACK-4", "a cell probes a parent that may have lost its sum"),
    requirement(Tree, "NACK-5", "a parent that does not answer a probe is lost"),
    requirement(Tree, "HELLO-1", "the cell sends a hello on each port every 250 ms"),
    requirement(Tree, "HELLO-2", "some changes cause a hello at once"),
    requirement(Tree, "HELLO-3", "a port that is silent for 600 ms counts as unconnected"),
    requirement(Tree, "JOIN-1", "a cell without a parent asks its neighbors to join"),
    requirement(Tree, "JOIN-2", "a cell grants or refuses a request to join"),
    requirement(Tree, "JOIN-3", "a cell joins a better parent while it sends no sums"),
    requirement(Tree, "JOIN-4", "a cell accepts only grants that it asked for"),
    requirement(Tree, "JOIN-5", "a root that joins the gateway sends it a hello at once"),
    requirement(Tree, "JOIN-6", "the tree page is sent when the tree changes"),
    requirement(Tree, "LOSS-1", "when a parent counts as lost"),
    requirement(Tree, "LOSS-2", "a hello without a rank asks for repair"),
    requirement(Tree, "LOSS-3", "a lost parent gets a leave message"),
    requirement(Tree, "LOSS-4", "when a child counts as lost"),
    requirement(Tree, "REPAIR-1", "a cell that finds no parent sends repair messages"),
    requirement(Tree, "REPAIR-2", "a cell with a later round answers repair messages"),
    requirement(Tree, "REPAIR-3", "repair messages are forwarded to the parent"),
    requirement(Tree, "REPAIR-4", "repair messages from the parent are forwarded"),
    requirement(Tree, "NODE-1", "a cell without a node id sends no packets"),
    requirement(Tree, "NODE-2", "walks over the wires assign node ids"),
    requirement(Tree, "NODE-3", "a new node id is kept"),
    requirement(Tree, "LINK-1", "the cell does not use links that are taken down"),
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
