//! Finds the cells that a sum contains, and delivers the sum to its receivers.

use std::collections::BTreeSet;

use cell_node::sum::SumWords;
use protocol::can::Format;
use protocol::fixed::Q7_8;
use protocol::id::CellId;
use protocol::message::Message;
use protocol::packet::{self, Epoch, Length};
use protocol::parameters::MAX_JOINTS;

use super::place::Inlet;
use super::{Event, PortEnd, Wiring};

impl Wiring {
    /// Handles a sum of a cell: finds the cells in it, and its receivers.
    pub(super) fn handle_sum(&mut self, cell: usize, from: CellId, epoch: Epoch, words: SumWords) {
        let cells = self.decode(cell, epoch, words);
        let said = &mut self.cells[cell].said;
        // A cell that hung continues with sums from long before.
        if said.len() > 64 {
            said.retain(|of, _| Epoch(*of).epochs_since(epoch) >= -48);
        }
        said.entry(epoch.0).or_default().push((words, cells));
        let frame = Message::Sum {
            from,
            epoch,
            torque: packet::Words::new(Length::Six, words.torque.map(Q7_8::to_bits)),
            count: words.count,
        };
        let frame = frame.encode();
        let frame = frame.frames(Format::Fd).next().expect("one frame");
        let neighbours: BTreeSet<usize> = self.cells[cell]
            .wires
            .iter()
            .filter_map(|end| match end {
                Some(PortEnd::Cell(other, _)) => Some(*other),
                Some(PortEnd::Gateway(_)) | None => None,
            })
            .collect();
        for other in neighbours {
            let node = self.cells[other].life.node();
            if node.is_some_and(|node| node.received_ids().any(|id| id == frame_id(from))) {
                let at = self.arrival(Some(other));
                self.agenda.enter(at, Event::Deliver(other, Inlet::Frame(frame)));
            }
        }
        let root = self.roots.iter().position(|&root| root == cell);
        if root.is_some_and(|root| self.uplinks.is_gateway_child(root)) && self.epoch == Some(epoch) {
            let best = self.root_sums.entry(cell).or_insert((words, cells));
            if words.count >= best.0.count {
                *best = (words, cells);
            }
            if let Some(took) = self.took.last_mut() {
                took.frames += 1;
                took.cells = 0;
                for (root, (_, cells)) in &self.root_sums {
                    assert_eq!(
                        took.cells & cells,
                        0,
                        "root {root} counts cells of another one in {epoch:?}: {:?}; {}",
                        self.root_sums,
                        self.routes()
                    );
                    took.cells |= cells;
                }
            }
        }
    }

    /// Returns the cells in a sum: it may contain the sender's own torque, and sums of the sender's neighbours.
    fn decode(&self, cell: usize, epoch: Epoch, words: SumWords) -> u128 {
        let place = &self.cells[cell];
        let mut heard: Vec<Vec<(SumWords, u128)>> = Vec::new();
        let mut seen = BTreeSet::new();
        for end in place.wires.iter().flatten() {
            if let PortEnd::Cell(other, _) = end
                && seen.insert(*other)
                && let Some(said) = self.cells[*other].said.get(&epoch.0)
            {
                heard.push(said.clone());
            }
        }
        let expected = words.torque.map(|word| i32::from(word.to_bits()));
        let mut found = None;
        for own in [1_u32, 0] {
            let sum = if own == 1 { place.own } else { [0; MAX_JOINTS] };
            choose(&heard, sum, own, u128::from(own) << cell, (&expected, words.count.into()), &mut found);
        }
        // The end of a contact: its own torque is zeros, and there is no other torque.
        if words.is_lease_end() {
            return 0;
        }
        let cells = found.unwrap_or_else(|| panic!("cell {cell} says {words:?} in {epoch:?}, of {heard:?}"));
        assert_ne!(
            cells,
            TWICE,
            "cell {cell} counts a cell twice in {epoch:?} at {:?}: {words:?} of {heard:?}; {}",
            self.agenda.now,
            self.routes()
        );
        cells
    }
}

/// The result for a sum that contains a cell twice.
const TWICE: u128 = u128::MAX;

fn frame_id(from: CellId) -> protocol::id::Id {
    protocol::id::Id::new(protocol::id::Kind::Sum, protocol::id::Node::Cell(from))
}

/// Tries every choice of at most one sum of each neighbour, and stores the cells of the choice that fits.
fn choose(
    heard: &[Vec<(SumWords, u128)>],
    sum: [i32; MAX_JOINTS],
    count: u32,
    cells: u128,
    expected: (&[i32; MAX_JOINTS], u32),
    found: &mut Option<u128>,
) {
    if count == expected.1 && sum == *expected.0 && found.is_none_or(|before| before == TWICE) {
        *found = Some(cells);
    }
    let Some((first, rest)) = heard.split_first() else { return };
    if count > expected.1 {
        return;
    }
    for (words, of) in first {
        let mut with = sum;
        for (sum, word) in with.iter_mut().zip(words.torque) {
            *sum += i32::from(word.to_bits());
        }
        // All bits are set if a cell is in the sum twice.
        let both = if cells & of == 0 { cells | of } else { TWICE };
        choose(rest, with, count + u32::from(words.count), both, expected, found);
    }
    choose(rest, sum, count, cells, expected, found);
}
