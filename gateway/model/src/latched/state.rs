//! The state of a bus at some point of a capture, and the messages that restore it.
//!
//! ```text
//!   messages up to there ──> apply_message ──> [ LatchedState ] ──> restoring_messages, before the first replayed one
//! ```
//!
//! A torque is a function of the cell's parameters, one joints packet and the stimuli latched at it; and the end of a
//! contact is sent once, by a cell that was in contact at the joints before. So a replay that begins in the middle
//! resends, in this order: the configuration as it was written; resume; the stimuli latched before the last joints; the
//! stimuli pending then; halt, if the cells were halted; the last joints; and all later inputs, as they were sent.

use protocol::fixed::{Q1_14, Q5_10};
use protocol::id::{CellId, Node};
use protocol::message::{
    Joints, Message, NetworkPage, Request, SensorPage, SensorReadings, SkinSensors, StimulusStart,
};
use protocol::packet::Epoch;
use protocol::parameters::Parameter;
use protocol::time::Micros;

use super::touched::KnownContacts;
use crate::tracker::{AddressClaim, ContactState, HeartbeatKind, PerCell};

/// Maximum number of messages since the last joints that are kept for a replay.
const MAX_PENDING_MESSAGES: usize = 16_384;

/// The contact state of one cell, without data for each stimulus.
type CellContactState = ContactState<()>;

/// Resets the contact state to no contact; `obeys` is true for a cell in test mode.
fn reset_contact(contact_state: &mut CellContactState, obeys: bool) {
    contact_state.reset();
    contact_state.set_obeys_stimuli(obeys);
}

/// Returns true if the cell is in contact at the joints of `epoch` and later; `None` if unknown.
fn is_touched_from(contact_state: &CellContactState, epoch: Epoch) -> Option<bool> {
    let touches =
        |(skin, ()): &(SkinSensors, ())| skin.contact != [Q5_10::ZERO; 3] || skin.proximity != Q1_14::ZERO;
    if contact_state.pending_stimuli().is_empty() {
        return contact_state.presumed_skin().map(touches);
    }
    let mut then = contact_state.clone();
    then.latch_due_stimuli(epoch, |()| {});
    then.presumed_skin().map(touches)
}

/// Returns the latched sensors pages that differ from those of a cell that has just started.
fn changed_sensor_pages(contact_state: &CellContactState) -> impl Iterator<Item = SensorPage> {
    let nothing = SensorReadings::default().simulated_pages();
    contact_state.latched_pages().map(|(page, ())| page).filter(move |page| !nothing.contains(page))
}

/// The state of a bus before its last joints.
#[derive(Clone, Debug, Default)]
struct StateBeforeJoints {
    /// Parameter writes in order, without those that later writes replaced.
    writes: Vec<(Node, u8, Message)>,
    halted: bool,
    cells: PerCell<CellContactState>,
}

/// The state of one bus.
#[derive(Clone, Debug, Default)]
pub struct LatchedState {
    before: StateBeforeJoints,
    /// The owners of node ids.
    claims: PerCell<AddressClaim>,
    /// The last joints with their epoch. The contact state before them decides whether a cell was in contact at them.
    joints: Option<(Epoch, Joints)>,
    /// Messages since the last joints, in the order in which they were sent.
    messages_since: Vec<Message>,
}

impl StateBeforeJoints {
    /// Applies a message that was sent after the joints with the epoch `last`.
    fn apply_after_joints(&mut self, message: &Message, last: Option<Epoch>) {
        if let Message::Halt | Message::Resume = message {
            self.halted = *message == Message::Halt;
        } else if let Message::Stimulus { to, from, page } = *message {
            self.cells.addressed_mut(to).iter_mut().for_each(|cell| cell.add_stimulus(from, page, (), last));
        } else if let Message::Configure { to, request: Request::Write { number, words }, .. } = *message {
            self.record_write(to, number, *message);
            if number == Parameter::Mode.number() {
                self.cells
                    .addressed_mut(to)
                    .iter_mut()
                    .for_each(|cell| reset_contact(cell, words.first() == Some(&1)));
            }
        }
    }

    /// Resets the contact state of a restarted cell, and drops its writes of volatile parameters.
    fn start_again(&mut self, cell: Node) {
        self.cells.addressed_mut(cell).iter_mut().for_each(|cell| reset_contact(cell, true));
        self.writes.retain(|(to, number, _)| *to != cell || !is_volatile(*number));
    }

    /// Keeps a parameter write. It replaces an earlier write of the same parameter to the same cells, unless a commit
    /// has activated the earlier one. So memory grows only with the number of commits.
    fn record_write(&mut self, to: Node, number: u8, message: Message) {
        let commit = Parameter::Commit.number();
        let since_commit =
            self.writes.iter().rposition(|(_, number, _)| *number == commit).map_or(0, |at| at + 1);
        let stale = |(at, write): (usize, &(Node, u8, Message))| {
            let over = write.0 == to && write.1 == number && number != commit;
            (over && (at >= since_commit || is_volatile(number))).then_some(at)
        };
        if let Some(at) = self.writes.iter().enumerate().find_map(stale) {
            self.writes.remove(at);
        }
        self.writes.push((to, number, message));
    }
}

fn is_volatile(number: u8) -> bool {
    Parameter::from_number(number).is_some_and(Parameter::is_volatile)
}

impl LatchedState {
    /// Applies the next message of the bus.
    pub fn apply_message(&mut self, message: &Message) {
        if let Message::Joints { epoch, joints } = *message {
            // Cells drop joints of the last epoch.
            if self.joints.is_none_or(|(last, _)| last != epoch) {
                self.fold_pending_messages();
                self.joints = Some((epoch, joints));
            }
        } else if let Message::Halt
        | Message::Resume
        | Message::Stimulus { .. }
        | Message::Configure { request: Request::Write { .. }, .. } = message
        {
            if self.messages_since.len() == MAX_PENDING_MESSAGES {
                self.fold_pending_messages();
            }
            self.messages_since.push(*message);
        } else if let Message::Sensors { from, epoch, page } = *message {
            // The cell's own report counts if its contact state is not known otherwise.
            let cell = self.before.cells.get_mut(from).filter(|cell| cell.pending_stimuli().is_empty());
            if let Some(cell) = cell.filter(|_| self.joints.is_none_or(|(last, _)| last == epoch)) {
                cell.apply_reported_page(page, ());
            }
        } else if let Message::Network { from, page: NetworkPage::Heartbeat(heartbeat), .. } = message {
            // Use the order of the capture: its times may be wrong.
            let hear = |claim: &mut AddressClaim| claim.receive(Micros(0), heartbeat);
            let started = |claim: &mut AddressClaim| matches!(hear(claim), HeartbeatKind::Started { .. });
            if self.claims.addressed_mut(*from).iter_mut().any(started) {
                self.start_again(*from);
            }
        }
    }

    fn start_again(&mut self, cell: Node) {
        self.before.start_again(cell);
        let is_forgotten = |message: &Message| {
            let feels = matches!(message, Message::Stimulus { to, .. } if *to == cell);
            let switched = matches!(message, Message::Configure { to, request: Request::Write { number, .. }, .. } if *to == cell && is_volatile(*number));
            feels || switched
        };
        self.messages_since.retain(|message| !is_forgotten(message));
    }

    /// Moves the messages since the last joints into the state before them, as new joints follow.
    fn fold_pending_messages(&mut self) {
        let last = self.joints.map(|(epoch, _)| epoch);
        if let Some(epoch) = last {
            self.before.cells.iter_mut().for_each(|(_, cell)| cell.latch_due_stimuli(epoch, |()| {}));
        }
        for message in self.messages_since.drain(..) {
            self.before.apply_after_joints(&message, last);
        }
    }

    /// Returns the owner of a node id.
    #[must_use]
    pub fn node_id_claim(&self, cell: CellId) -> Option<&AddressClaim> {
        self.claims.get(cell)
    }

    /// Returns the epoch of the last joints.
    #[must_use]
    pub fn last_epoch(&self) -> Option<Epoch> {
        self.joints.map(|(epoch, _)| epoch)
    }

    /// Returns the cells that are in contact since the last joints, by the messages before these joints.
    #[must_use]
    pub fn cells_in_contact(&self) -> KnownContacts {
        let mut touched = KnownContacts::default();
        let Some((epoch, _)) = self.joints else { return touched };
        for (cell, contact_state) in self.before.cells.iter() {
            if let Some(is_touched) = is_touched_from(contact_state, epoch) {
                touched.insert(cell, is_touched);
            }
        }
        touched
    }

    /// Returns true if a cell in its state after a start needs no messages to reach this state.
    #[must_use]
    pub fn is_start_state(&self) -> bool {
        let StateBeforeJoints { writes, halted, cells } = &self.before;
        let contact = cells.iter().any(|(_, cell)| {
            changed_sensor_pages(cell).next().is_some() || !cell.pending_stimuli().is_empty()
        });
        !contact && writes.is_empty() && !halted && self.joints.is_none() && self.messages_since.is_empty()
    }

    /// Returns true if a message commits parameters, so that cells use new ones.
    #[must_use]
    pub fn has_commit(&self) -> bool {
        let commit = Parameter::Commit.number();
        let commits = |message: &Message| matches!(message, Message::Configure { request: Request::Write { number, .. }, .. } if *number == commit);
        self.before.writes.iter().any(|(_, _, message)| commits(message))
            || self.messages_since.iter().any(commits)
    }

    /// Returns the messages that bring `cells` into this state. On a bus without joints so far, `next` are the joints
    /// that will follow: they let the cells forget the epoch of an earlier gateway.
    #[must_use]
    pub fn restoring_messages(
        &self,
        cells: impl Fn(CellId) -> bool,
        next: Option<(Epoch, Joints)>,
    ) -> Vec<Message> {
        let StateBeforeJoints { writes, halted, cells: contact_states } = &self.before;
        // Links can be down only in test mode, and the mode may have been written again since.
        let links_down = |write: &&(Node, u8, Message)| write.1 == Parameter::LinksDown.number();
        let (links_down_writes, others): (Vec<_>, Vec<_>) = writes.iter().partition(links_down);
        let mut messages: Vec<_> =
            others.iter().chain(&links_down_writes).map(|(_, _, message)| *message).collect();
        messages.push(Message::Resume);
        let known: Vec<_> = contact_states.iter().filter(|(cell, _)| cells(*cell)).collect();
        let stimulus = |cell, from, page| Message::Stimulus { to: Node::Cell(cell), from, page };
        let contact: Vec<_> = known
            .iter()
            .flat_map(|(cell, contact_state)| {
                changed_sensor_pages(contact_state).map(|page| stimulus(*cell, StimulusStart::Next, page))
            })
            .collect();
        let pending = known.iter().flat_map(|(cell, it)| {
            it.pending_stimuli().iter().map(|&(from, page, ())| stimulus(*cell, from, page))
        });
        let pending: Vec<_> = pending.collect();
        let steps_before = |steps: u8, (epoch, joints): (Epoch, Joints)| Message::Joints {
            epoch: epoch.advanced_by(0_u8.wrapping_sub(steps)),
            joints,
        };
        let last = self.joints.or_else(|| next.map(|(epoch, joints)| (epoch.advanced_by(u8::MAX), joints)));
        if let Some(last) = last.filter(|_| !contact.is_empty() || !pending.is_empty()) {
            // A cell drops joints of its last epoch, so the joints that matter must not be the first ones.
            messages.push(steps_before(2, last));
            messages.extend(contact);
            messages.push(steps_before(1, last));
        } else {
            messages.extend(contact);
        }
        messages.extend(pending);
        if *halted {
            messages.push(Message::Halt);
        }
        messages.extend(last.map(|last| steps_before(0, last)));
        messages.extend(&self.messages_since);
        messages
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::message::{Heartbeat, State as Flags};

    fn press(newtons: f64) -> SensorPage {
        SensorPage::Skin(SkinSensors { contact: [Q5_10::nearest(newtons); 3], ..SkinSensors::default() })
    }

    fn cell(node: i64) -> CellId {
        CellId::new(node).unwrap()
    }

    fn to(node: i64, from: StimulusStart, newtons: f64) -> Message {
        Message::Stimulus { to: Node::Cell(cell(node)), from, page: press(newtons) }
    }

    fn joints(epoch: u8) -> Message {
        Message::Joints { epoch: Epoch(epoch), joints: Joints::default() }
    }

    fn mode(to: Node, words: i16) -> Message {
        let request = Request::Write {
            number: Parameter::Mode.number(),
            words: protocol::packet::padded_words([words]),
        };
        Message::Configure { to, tag: 0, request }
    }

    fn restored(messages: &[Message]) -> Vec<Message> {
        let mut state = LatchedState::default();
        for message in messages {
            state.apply_message(message);
        }
        state.restoring_messages(|_| true, None)
    }

    #[test]
    fn latched_waiting_and_later_stimuli_are_distinguished() {
        let at = |epoch| StimulusStart::Epoch(Epoch(epoch));
        let said = [
            joints(10),
            to(1, at(11), 1.0),
            joints(11),
            to(1, at(13), 2.0),
            joints(12),
            to(2, StimulusStart::Next, 3.0),
        ];
        let expected = [
            Message::Resume,
            joints(10),
            to(1, StimulusStart::Next, 1.0),
            joints(11),
            to(1, at(13), 2.0),
            joints(12),
            to(2, StimulusStart::Next, 3.0),
        ];
        assert_eq!(restored(&said), expected);
    }

    #[test]
    fn a_late_stimulus_waits_for_the_next_joints() {
        let late = to(1, StimulusStart::Epoch(Epoch(11)), 1.0);
        assert_eq!(restored(&[joints(11), late]), [Message::Resume, joints(11), late]);
        let next = to(1, StimulusStart::Next, 1.0);
        let expected = [Message::Resume, joints(10), joints(11), next, joints(12)];
        assert_eq!(restored(&[joints(11), late, joints(12)]), expected);
    }

    #[test]
    fn halted_cells_are_halted_before_the_last_joints_or_after_them_as_it_was() {
        let said =
            [Message::Halt, joints(1), Message::Resume, joints(2), Message::Halt, joints(3), Message::Resume];
        assert_eq!(restored(&said[..2]), [Message::Resume, Message::Halt, joints(1)]);
        assert_eq!(restored(&said[..4]), [Message::Resume, joints(2)]);
        assert_eq!(restored(&said[..5]), [Message::Resume, joints(2), Message::Halt]);
        assert_eq!(restored(&said), [Message::Resume, Message::Halt, joints(3), Message::Resume]);
    }

    #[test]
    fn a_released_restarted_or_measuring_cell_is_not_in_contact() {
        let heartbeat = Heartbeat { state: Flags::CLAIMING_NODE_ID, ..Heartbeat::default() };
        let page = NetworkPage::Heartbeat(heartbeat);
        let restarted = Message::Network { from: Node::Cell(cell(1)), epoch: Epoch(0), page };
        for end in [to(1, StimulusStart::Next, 0.0), restarted] {
            let said = [to(1, StimulusStart::Next, 1.0), joints(1), end, joints(2), joints(3)];
            assert_eq!(restored(&said), [Message::Resume, joints(3)]);
        }
        let measure = mode(Node::Everyone, 0);
        let said = [
            to(1, StimulusStart::Next, 1.0),
            joints(1),
            measure,
            to(1, StimulusStart::Next, 1.0),
            joints(2),
            joints(3),
        ];
        assert_eq!(restored(&said), [measure, Message::Resume, joints(3)]);
    }

    #[test]
    fn parameters_are_written_again_as_far_as_they_still_count() {
        let write = |number, word| Message::Configure {
            to: Node::Everyone,
            tag: 0,
            request: Request::Write { number, words: [word, 0, 0, 0, 0, 0] },
        };
        let said =
            [write(1, 1), write(1, 2), write(127, 9), write(1, 3), mode(Node::Everyone, 1), write(127, 9)];
        let again = [&said[..], &[mode(Node::Everyone, 1), write(1, 4), joints(1)]].concat();
        let expected = [
            write(1, 2),
            write(127, 9),
            write(1, 3),
            write(127, 9),
            mode(Node::Everyone, 1),
            write(1, 4),
            Message::Resume,
            joints(1),
        ];
        assert_eq!(restored(&again), expected);
    }

    #[test]
    fn what_was_switched_last_is_switched_again_and_links_down_come_after_the_mode() {
        let write = |to, number, word| Message::Configure {
            to,
            tag: 0,
            request: Request::Write { number, words: [word, 9, 0, 0, 0, 0] },
        };
        let (all, one) = (Node::Everyone, Node::Cell(cell(1)));
        let said = [
            write(all, 6, 1),
            write(all, 7, 2),
            write(one, 7, 1),
            write(one, 9, 2),
            write(all, 127, 9),
            write(all, 6, 0),
            mode(all, 1),
            joints(1),
        ];
        let commit = write(all, 127, 9);
        let expected = [
            write(all, 7, 2),
            write(one, 7, 1),
            commit,
            write(all, 6, 0),
            mode(all, 1),
            write(one, 9, 2),
            Message::Resume,
            joints(1),
        ];
        assert_eq!(restored(&said), expected);
        let page =
            NetworkPage::Heartbeat(Heartbeat { state: Flags::CLAIMING_NODE_ID, ..Heartbeat::default() });
        let restarted = Message::Network { from: one, epoch: Epoch(0), page };
        let expected = [write(all, 7, 2), commit, write(all, 6, 0), mode(all, 1), Message::Resume, joints(1)];
        assert_eq!(restored(&[&said[..], &[restarted]].concat()), expected);
        assert_eq!(restored(&[&said[..7], &[restarted, joints(1)]].concat()), expected);
    }

    #[test]
    fn a_cells_own_report_counts_until_a_stimulus() {
        let says =
            |newtons, epoch| Message::Sensors { from: cell(1), epoch: Epoch(epoch), page: press(newtons) };
        let said = [joints(1), says(5.0, 0), says(1.0, 1), says(2.0, 1)];
        let expected = [Message::Resume, joints(255), to(1, StimulusStart::Next, 1.0), joints(0), joints(1)];
        assert_eq!(restored(&said), expected);
    }

    #[test]
    fn a_bus_without_joints_makes_cells_drop_another_epoch() {
        let state = LatchedState::default();
        assert!(state.is_start_state());
        let next = Some((Epoch(0), Joints::default()));
        assert_eq!(state.restoring_messages(|_| true, next), [Message::Resume, joints(255)]);
    }

    #[test]
    fn only_cells_that_are_there_are_pressed() {
        let mut state = LatchedState::default();
        state.apply_message(&Message::Stimulus {
            to: Node::Everyone,
            from: StimulusStart::Next,
            page: press(1.0),
        });
        state.apply_message(&joints(1));
        let messages = state.restoring_messages(|it| it.get() == 7, None);
        assert_eq!(
            messages,
            [Message::Resume, joints(255), joints(0), to(7, StimulusStart::Next, 1.0), joints(1)]
        );
    }

    #[test]
    fn a_claim_of_a_taken_node_id_changes_nothing() {
        let says = |serial, sent, state| {
            let page = NetworkPage::Heartbeat(Heartbeat { serial, sent, state, ..Heartbeat::default() });
            Message::Network { from: Node::Cell(cell(1)), epoch: Epoch(0), page }
        };
        let (owner, claim) = (says(7, 40, Flags::CONFIGURED), says(9, 0, Flags::CLAIMING_NODE_ID));
        let write = |number| Message::Configure {
            to: Node::Cell(cell(1)),
            tag: 0,
            request: Request::Write { number, words: [1; 6] },
        };
        let said = [
            owner,
            write(7),
            to(1, StimulusStart::Next, 1.0),
            joints(1),
            joints(2),
            to(1, StimulusStart::Next, 2.0),
            write(8),
        ];
        let whole = restored(&said);
        for at in 1..=said.len() {
            let (before, after) = said.split_at(at);
            assert_eq!(restored(&[before, &[claim], after].concat()), whole, "a claim after {at} messages");
        }
    }
}
