//! Networks of the cells of a run, as the main thread checks them: it reports unreachable cells, and sends slots to
//! cells.

use std::collections::{BTreeMap, BTreeSet};

use protocol::id::{CellId, Node};
use protocol::message::{Message, Request};
use protocol::packet::WORDS;
use protocol::parameters::{LinksDown, Parameter, ReplyKind as Words, SumSchedule};
use protocol::port::PORTS;
use protocol::skin::{BusWires, Skin, SkinReply};
use protocol::time::{Micros, Span};
use thiserror::Error;

use model::network::check::{self, Difference};
use model::network::tree::{ReportedTree, tree_from_reports};
use model::repeat::RepeatedRequests;

use crate::view::BusView;

/// Interval after which a message is sent again to a cell that does not answer.
const RETRY_INTERVAL: Span = Span::from_millis(200);
/// Time that cells have to find another route before they are reported as unreachable.
const REROUTE_TIMEOUT: Span = Span::from_millis(300);

/// The network of one bus.
#[derive(Debug)]
pub(super) struct Network {
    name: String,
    wires: BusWires,
    slots: SumSchedule,
    period_us: u16,
    /// Cells to which their slots were sent, with the times.
    announced: RepeatedRequests<CellId>,
    /// Ports of each cell whose links must be down, one bit per port.
    ports_down: BTreeMap<CellId, u8>,
    reported_links_down: RepeatedRequests<CellId>,
    /// Cells that send but have no route to a root, with the time at which this began.
    without_route: BTreeMap<CellId, Micros>,
    /// Cells that were reported as unreachable and still have no route, with the time at which this began.
    reported: BTreeMap<CellId, Micros>,
    reported_too_deep: bool,
    /// Longest time for which any cell was unreachable.
    pub(super) longest_unreachable: Span,
    /// Time from the moment when all cells were ready until all had a route.
    pub(super) tree_ready: Option<Span>,
    /// Differences between the tree at the start and its description.
    pub(super) differences: Vec<Difference>,
}

/// The error of a tree that is too deep for the time between two joint broadcasts.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[error(
    "the tree of {bus} is {deepest} wires deep: {slots} slots of slot_us = {slot_us} do not fit into the {period_us} us \
     between two joints messages: set slot_us = {}, or add roots so that no cell is deeper than {}",
    .period_us.checked_div(*.slots).unwrap_or(0),
    .period_us.checked_div(*.slot_us).unwrap_or(0).saturating_sub(1),
    slots = .slots
)]
pub struct TreeTooDeep {
    /// Name of the bus.
    pub bus: String,
    /// Depth of the deepest cell of the tree, in wires from its root.
    pub deepest: u8,
    /// Number of slots for that depth.
    pub slots: u32,
    /// Length of a slot in µs.
    pub slot_us: u32,
    /// Time between joint broadcasts in µs.
    pub period_us: u32,
}

/// Messages that result from a check of a network.
#[derive(Debug, Default, PartialEq)]
pub(super) struct NetworkCheckResult {
    /// Messages that must be sent to cells.
    pub(super) messages: Vec<Message>,
    /// Messages for the user.
    pub(super) notes: Vec<String>,
}

impl Network {
    /// Creates the network of a bus, or `None` if its cells answer with their own torques.
    pub(super) fn for_bus(skin: &Skin, bus: usize) -> Option<Self> {
        let described = skin.buses.get(bus)?;
        let SkinReply::Sum { slot_us, carry } = described.reply else { return None };
        Some(Self {
            name: described.name.clone(),
            wires: skin.wires(bus),
            slots: SumSchedule { slot_us: u16::try_from(slot_us).unwrap_or(u16::MAX), deepest: 0, carry },
            period_us: skin.broadcast_period_us().unwrap_or(u16::MAX),
            announced: RepeatedRequests::new(RETRY_INTERVAL),
            ports_down: BTreeMap::new(),
            reported_links_down: RepeatedRequests::new(RETRY_INTERVAL),
            without_route: BTreeMap::new(),
            reported: BTreeMap::new(),
            reported_too_deep: false,
            longest_unreachable: Span(0),
            tree_ready: None,
            differences: Vec::new(),
        })
    }

    /// Returns the largest depth that has a slot.
    pub(super) const fn max_slot_depth(&self) -> u8 {
        self.slots.deepest
    }

    /// Name of the bus.
    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// Returns the cells that sent but were unreachable at the last check.
    pub(super) fn unreachable_nodes(&self) -> impl Iterator<Item = u8> {
        self.without_route.keys().map(|cell| cell.get())
    }

    fn reported_tree(view: &BusView) -> ReportedTree {
        tree_from_reports(
            view.network.iter().map(|cell| (cell.node, cell.alive && cell.serial.is_some(), cell.tree)),
        )
    }

    /// Returns the number of cells with a route to a root, and true if all cells that send have one and their pages
    /// agree.
    pub(super) fn tree_progress(view: &BusView) -> (usize, bool) {
        let places = Self::reported_tree(view);
        (places.depths.len(), places.unreachable.is_empty() && places.agree)
    }

    /// Returns the differences between the present tree and the description.
    pub(super) fn description_differences(&self, view: &BusView) -> Vec<Difference> {
        check::differences(&self.wires, &view.network)
    }

    /// Adapts the number of slots to the present tree.
    ///
    /// # Errors
    /// Returns [`TreeTooDeep`] if the slots do not fit between two joint broadcasts. The error names values that would
    /// fit.
    pub(super) fn fit_slots(&mut self, view: &BusView) -> Result<(), TreeTooDeep> {
        let deepest = Self::reported_tree(view).max_depth().unwrap_or(0);
        let slots = u32::from(deepest) + 1;
        let (slot_us, period_us) = (u32::from(self.slots.slot_us), u32::from(self.period_us));
        if slots * slot_us > period_us {
            return Err(TreeTooDeep { bus: self.name.clone(), deepest, slots, slot_us, period_us });
        }
        self.slots.deepest = deepest;
        Ok(())
    }

    fn reply_words(&self) -> [i16; WORDS] {
        Words::Sum(self.slots).words()
    }

    fn reply_message(&self, to: Node) -> Message {
        let request = Request::Write { number: Parameter::Reply.number(), words: self.reply_words() };
        Message::Configure { to, tag: self.slots.deepest, request }
    }

    /// Returns the message that sends the depth of the tree to all cells.
    pub(super) fn announce_slots(&mut self, now: Micros) -> Message {
        self.announced.mark_all_sent(now);
        self.reply_message(Node::Everyone)
    }

    /// Returns the ready cells that have not confirmed the slots of the present tree.
    pub(super) fn cells_with_unconfirmed_slots(&self, view: &BusView) -> Vec<CellId> {
        let words = Some(self.reply_words());
        let unconfirmed = view.cells.iter().filter(|cell| cell.ready && cell.reply != words);
        unconfirmed.map(|cell| cell.node).collect()
    }

    /// Returns the messages for cells that have not answered in time.
    pub(super) fn messages_to_repeat(&mut self, now: Micros, view: &BusView) -> Vec<Message> {
        let due = self.announced.due_requests(now, self.cells_with_unconfirmed_slots(view));
        due.into_iter().map(|cell| self.reply_message(Node::Cell(cell))).collect()
    }

    /// Takes the links from one cell to another down, or brings them up again.
    pub(super) fn set_link_down(&mut self, link_down: bool, from: CellId, to: CellId) {
        let ends = (0_u8..)
            .zip(0..PORTS)
            .filter(|&(_, port)| self.wires.other_end(to, port).is_some_and(|(other, _)| other == from));
        let bits = ends.fold(0, |bits, (bit, _)| bits | 1 << bit);
        let deaf = self.ports_down.entry(to).or_default();
        *deaf = if link_down { *deaf | bits } else { *deaf & !bits };
        self.reported_links_down.make_request_due(to);
    }

    /// Returns the links that must be down in one or both directions, each once, with the smaller node id first.
    pub(super) fn links_down(&self) -> BTreeSet<[CellId; 2]> {
        let ports = |(&to, &bits): (&CellId, &u8)| {
            let down = (0..PORTS).filter(move |port| bits >> port & 1 == 1);
            down.filter_map(move |port| self.wires.other_end(to, port)).map(move |(from, _)| (from, to))
        };
        self.ports_down.iter().flat_map(ports).map(|(from, to)| [from.min(to), from.max(to)]).collect()
    }

    /// Returns the messages for cells whose links must go down, or up again.
    fn report_links_down(&mut self, now: Micros, view: &BusView) -> Vec<Message> {
        let requested_ports = |node: &CellId| self.ports_down.get(node).copied();
        let ready = view.cells.iter().filter(|cell| cell.ready);
        let open =
            ready.filter(|cell| requested_ports(&cell.node).is_some_and(|deaf| deaf != cell.ports_down));
        let due = self.reported_links_down.due_requests(now, open.map(|cell| cell.node));
        let message = |cell: CellId| {
            let deaf = requested_ports(&cell)?;
            let request = Request::Write {
                number: Parameter::LinksDown.number(),
                words: LinksDown { ports: deaf }.words(),
            };
            Some(Message::Configure { to: Node::Cell(cell), tag: deaf, request })
        };
        due.into_iter().filter_map(message).collect()
    }

    /// Checks the network while the loop runs.
    pub(super) fn check_running(&mut self, now: Micros, view: &BusView) -> NetworkCheckResult {
        let mut look = NetworkCheckResult::default();
        let places = Self::reported_tree(view);
        if places.max_depth().is_some_and(|deepest| deepest > self.slots.deepest) {
            match self.fit_slots(view) {
                Ok(()) => look.messages.push(self.announce_slots(now)),
                Err(why) if !self.reported_too_deep => {
                    self.reported_too_deep = true;
                    look.notes.push(format!(
                        "{why}; until then, deeper cells send their sums in the wrong \
                                             slot, and these arrive late"
                    ));
                }
                Err(_) => {}
            }
        }
        look.messages.extend(self.messages_to_repeat(now, view));
        look.messages.extend(self.report_links_down(now, view));
        let without: BTreeSet<_> = places.unreachable.into_iter().collect();
        self.without_route.retain(|cell, since| {
            self.longest_unreachable = self.longest_unreachable.max(now.elapsed_since(*since));
            without.contains(cell)
        });
        let mut back = Vec::new();
        self.reported.retain(|cell, since| {
            let has_one = places.depths.contains_key(cell);
            if has_one {
                back.push((*cell, now.elapsed_since(*since)));
            }
            !has_one
        });
        for &cell in &without {
            self.without_route.entry(cell).or_insert(now);
        }
        let if_overdue = |(cell, since): (&CellId, &Micros)| {
            (now.elapsed_since(*since) >= REROUTE_TIMEOUT && !self.reported.contains_key(cell))
                .then_some((*cell, *since))
        };
        let newly_unreachable: Vec<_> = self.without_route.iter().filter_map(if_overdue).collect();
        if let Some(oldest) = newly_unreachable.iter().map(|(_, since)| now.elapsed_since(*since)).max() {
            self.reported.extend(newly_unreachable.iter().copied());
            let cells: Vec<_> = newly_unreachable.into_iter().map(|(cell, _)| cell).collect();
            let (has, their) =
                if cells.len() == 1 { ("has", "its torque") } else { ("have", "their torques") };
            look.notes.push(format!(
                "{} on {} {has} had no route to the gateway for {:.1} s, so no sum contains {their}",
                check::cell_list(&cells),
                self.name,
                oldest.seconds()
            ));
        }
        if let Some(longest) = back.iter().map(|(_, length)| *length).max() {
            let cells: Vec<_> = back.into_iter().map(|(cell, _)| cell).collect();
            let has = if cells.len() == 1 { "has" } else { "have" };
            look.notes.push(format!(
                "{} on {} {has} a route to the gateway again, after {:.1} s",
                check::cell_list(&cells),
                self.name,
                longest.seconds()
            ));
        }
        look
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::view::CellView;
    use model::network::check::ObservedCell;
    use model::table::{ResponseFlags, SWITCH_COUNT};
    use protocol::message::TreePage;
    use protocol::packet::Epoch;

    fn network() -> Network {
        let head = model::testing::ONE_CELL_SKIN_TOML
            .replace("reply = \"torque\"", "reply = \"sum\"\nslot_us = 5000");
        let (head, one) = head.split_at(head.find("[[cell]]").unwrap());
        let cell = |node: u8, root: bool, neighbors: &str| {
            one.replace("node = 1", &format!("node = {node}\nroot = {root}\nneighbors = {neighbors}"))
        };
        let cells =
            [cell(1, true, "[2, 3, 0, 0]"), cell(2, false, "[1, 3, 0, 0]"), cell(3, false, "[1, 2, 0, 0]")];
        let text = format!("{head}{}", cells.concat());
        Network::for_bus(&Skin::parse("skin.toml", &text).unwrap(), 0).unwrap()
    }

    /// Creates a view of cells with these parents and depths; `None` is a dead cell.
    fn view(trees: &[Option<(Option<u8>, u8)>], reply: Option<[i16; WORDS]>) -> BusView {
        let cells = trees.iter().enumerate().map(|(at, tree)| CellView {
            node: CellId::new(i64::try_from(at + 1).unwrap()).unwrap(),
            seen: true,
            dead: tree.is_none(),
            ready: tree.is_some(),
            halted: false,
            unconfigured: false,
            measures: false,
            other_configuration: false,
            last_joints: Epoch(0),
            responded: ResponseFlags::default(),
            reply,
            ports_down: 0,
            unconfirmed_switches: [None; SWITCH_COUNT],
            unclear: false,
        });
        let network = trees.iter().enumerate().map(|(at, tree)| ObservedCell {
            node: CellId::new(i64::try_from(at + 1).unwrap()).unwrap(),
            serial: Some(1),
            configuration: 0,
            heartbeat: None,
            alive: tree.is_some(),
            tree: tree.map(|(parent, depth)| {
                let up = if parent == Some(0) { 4 } else { 0 };
                TreePage { parent, parent_port: up, depth, ..TreePage::default() }
            }),
            ports: None,
        });
        BusView::new(cells.collect(), 0, network.collect())
    }

    #[test]
    fn a_tree_that_grows_deeper_gets_more_slots_as_far_as_they_fit() {
        let mut network = network();
        let flat = [Some((Some(0), 0)), Some((Some(1), 1)), Some((Some(1), 1))];
        network.fit_slots(&view(&flat, None)).unwrap();
        let at = |rounds: u64| Micros(rounds * RETRY_INTERVAL.0);
        let now = at(1);
        let words = Some(network.reply_words());
        assert_eq!(network.check_running(now, &view(&flat, words)), NetworkCheckResult::default());
        let deep = [Some((Some(0), 0)), Some((Some(1), 1)), Some((Some(2), 2))];
        let look = network.check_running(now, &view(&deep, words));
        let everyone = |message: &Message| matches!(message, Message::Configure { to: Node::Everyone, .. });
        assert!(look.messages.iter().all(everyone) && look.messages.len() == 1, "{look:?}");
        assert_eq!(network.max_slot_depth(), 2);
        // A cell that has not answered gets its own message, after an interval.
        assert_eq!(network.check_running(now, &view(&deep, words)), NetworkCheckResult::default());
        let look = network.check_running(at(2), &view(&deep, words));
        assert_eq!(look.messages.len(), 3, "{look:?}");
        let new = Some(network.reply_words());
        assert_eq!(network.check_running(at(3), &view(&deep, new)), NetworkCheckResult::default());
        // A restarted cell has lost its slots.
        let look = network.check_running(at(4), &view(&deep, None));
        assert_eq!(look.messages.len(), 3, "{look:?}");
        // 4 slots of 5 ms are more than 16 ms.
        let deeper = [Some((Some(0), 0)), Some((Some(1), 1)), Some((Some(2), 2)), Some((Some(3), 3))];
        let look = network.check_running(at(4), &view(&deeper, new));
        let [note] = look.notes.as_slice() else { panic!("{look:?}") };
        assert!(note.contains("set slot_us = 4000") && note.contains("deeper than 2"), "{note}");
    }

    #[test]
    fn a_link_down_is_sent_to_its_receiving_end_until_confirmed_and_after_a_restart() {
        let mut network = network();
        let trees = [Some((Some(0), 0)), Some((Some(1), 1)), Some((Some(2), 2))];
        network.fit_slots(&view(&trees, None)).unwrap();
        let words = Some(network.reply_words());
        let cell = |node| CellId::new(node).unwrap();
        let mut now = Micros(0);
        let mut look = |network: &mut Network, deaf| {
            now = now + RETRY_INTERVAL;
            let mut view = view(&trees, words);
            view.cells[1].ports_down = deaf;
            let announced = |message: &Message| {
                let Message::Configure {
                    to: Node::Cell(to),
                    request: Request::Write { number: 9, words },
                    ..
                } = *message
                else {
                    panic!("{message:?}")
                };
                (to.get(), LinksDown::from_words(words).ports)
            };
            network.check_running(now, &view).messages.iter().map(announced).collect::<Vec<_>>()
        };
        network.set_link_down(true, cell(3), cell(2));
        assert_eq!(look(&mut network, 0), [(2, 0b10)]);
        assert_eq!(look(&mut network, 0), [(2, 0b10)], "it did not answer");
        assert_eq!(look(&mut network, 0b10), []);
        network.set_link_down(true, cell(1), cell(2));
        assert_eq!(look(&mut network, 0b10), [(2, 0b11)]);
        network.set_link_down(true, cell(2), cell(1));
        assert_eq!(
            network.links_down().into_iter().collect::<Vec<_>>(),
            [[cell(1), cell(2)], [cell(2), cell(3)]]
        );
        network.set_link_down(false, cell(2), cell(1));
        network.set_link_down(false, cell(3), cell(2));
        assert_eq!(look(&mut network, 0b11), [(2, 0b01)]);
        assert_eq!(look(&mut network, 0b01), []);
        assert_eq!(look(&mut network, 0), [(2, 0b01)], "it restarted");
    }

    #[test]
    fn an_unreachable_cell_is_reported_once_and_when_it_has_a_route_again() {
        let mut network = network();
        let whole = [Some((Some(0), 0)), Some((Some(1), 1)), Some((Some(2), 2))];
        network.fit_slots(&view(&whole, None)).unwrap();
        let words = Some(network.reply_words());
        let mut at = Micros(0);
        let mut look = |network: &mut Network, trees: &[_]| {
            at = at + Span::from_millis(200);
            network.check_running(at, &view(trees, words)).notes
        };
        assert_eq!(look(&mut network, &whole), Vec::<String>::new());
        let link_down = [Some((Some(0), 0)), Some((None, 0)), Some((Some(2), 1))];
        assert_eq!(look(&mut network, &link_down), Vec::<String>::new());
        assert_eq!(look(&mut network, &link_down), Vec::<String>::new());
        assert_eq!(
            look(&mut network, &link_down),
            [
                "cells 2, 3 on vcan0 have had no route to the gateway for 0.4 s, so no sum contains their torques"
            ]
        );
        assert_eq!(look(&mut network, &link_down), Vec::<String>::new());
        assert_eq!(network.unreachable_nodes().collect::<Vec<_>>(), [2, 3]);
        // One cell dies, which is reported elsewhere; the other has a route again.
        let partial = [Some((Some(0), 0)), None, Some((Some(1), 1))];
        assert_eq!(
            look(&mut network, &partial),
            ["cell 3 on vcan0 has a route to the gateway again, after 0.8 s"]
        );
        assert_eq!(network.unreachable_nodes().count(), 0);
        assert_eq!(
            look(&mut network, &whole),
            ["cell 2 on vcan0 has a route to the gateway again, after 1.0 s"]
        );
        assert_eq!(network.longest_unreachable, Span::from_millis(800));
    }
}
