//! What holds on a bus at some point of a capture, and the messages that bring it about again.
//!
//! ```text
//!   messages up to there ──> take ──> [ State ] ──> restoring ──> messages before the first replayed one
//! ```
//!
//! A torque is a function of the cell's parameters, one joints packet and the stimuli latched at it. So a replay that
//! begins in the middle says first, in this order: the configuration as it was written; resume; the stimuli in force;
//! the last joints, so that their epoch and who was in contact are as they were; halt, if that was in force; and the
//! stimuli that still waited for their epoch.

use std::collections::VecDeque;

use protocol::fixed::Q3_12;
use protocol::id::{CellId, Node};
use protocol::message::{
    From, Joints, Message, NetworkPage, Request, SensorPage, SkinSensors, State as Flags,
};
use protocol::packet::Epoch;
use protocol::parameters::Parameter;

/// Stimuli that a cell lets wait.
const PENDING: usize = 8;

/// What one cell feels, by the protocol's rules.
#[derive(Clone, Debug, Default)]
struct Feeling {
    /// In force, once something has been said of it.
    skin: Option<SkinSensors>,
    acceleration: Option<[Q3_12; 3]>,
    pending: VecDeque<(From, SensorPage)>,
    /// It was told to measure: then it refuses stimuli.
    measures: bool,
}

impl Feeling {
    fn push(&mut self, from: From, page: SensorPage, last: Option<Epoch>) {
        if self.measures || self.pending.len() == PENDING {
            return;
        }
        let late = matches!((from, last), (From::Epoch(first), Some(last)) if last.since(first) >= 0);
        self.pending.push_back((if late { From::Next } else { from }, page));
    }

    fn latch(&mut self, epoch: Epoch) {
        for _ in 0..self.pending.len() {
            let Some((from, page)) = self.pending.pop_front() else { break };
            match from {
                From::Epoch(first) if epoch.since(first) < 0 => self.pending.push_back((from, page)),
                From::Epoch(_) | From::Next => self.feel(page),
            }
        }
    }

    const fn feel(&mut self, page: SensorPage) {
        match page {
            SensorPage::Skin(skin) => self.skin = Some(skin),
            SensorPage::Acceleration(acceleration) => self.acceleration = Some(acceleration),
        }
    }

    /// What the cell itself says that it feels, when nothing else is known of it.
    fn learn(&mut self, page: SensorPage) {
        let unknown = match page {
            SensorPage::Skin(_) => self.skin.is_none(),
            SensorPage::Acceleration(_) => self.acceleration.is_none(),
        };
        if unknown && self.pending.is_empty() {
            self.feel(page);
        }
    }

    /// Nothing, in either mode.
    fn clear(&mut self, measures: bool) {
        *self = Self { measures, ..Self::default() };
    }

    /// The pages in force.
    fn pages(&self) -> impl Iterator<Item = SensorPage> + use<> {
        let skin = self.skin.filter(|skin| *skin != SkinSensors::default()).map(SensorPage::Skin);
        let acceleration = self.acceleration.filter(|xyz| *xyz != [Q3_12::ZERO; 3]);
        skin.into_iter().chain(acceleration.map(SensorPage::Acceleration))
    }
}

/// What holds on one bus.
#[derive(Clone, Debug)]
pub struct State {
    /// Parameters that were written, in order, without those that were written over.
    writes: Vec<(Node, u8, Message)>,
    halted: bool,
    joints: Option<(Epoch, Joints)>,
    /// By the cell's place.
    cells: Vec<Feeling>,
}

impl Default for State {
    fn default() -> Self {
        let cells = vec![Feeling::default(); CellId::COUNT];
        Self { writes: Vec::new(), halted: false, joints: None, cells }
    }
}

impl State {
    /// Takes in the bus' next message.
    pub fn take(&mut self, message: &Message) {
        match *message {
            Message::Halt => self.halted = true,
            Message::Resume => self.halted = false,
            Message::Joints { epoch, joints } => {
                self.joints = Some((epoch, joints));
                for cell in &mut self.cells {
                    cell.latch(epoch);
                }
            }
            Message::Stimulus { to, from, page } => {
                let last = self.joints.map(|(epoch, _)| epoch);
                self.each(to, |cell| cell.push(from, page, last));
            }
            Message::Configure { to, request: Request::Write { number, words }, .. } => {
                self.write(to, number, *message);
                if number == Parameter::Mode.number() {
                    self.each(to, |cell| cell.clear(words.first() != Some(&1)));
                }
            }
            Message::Sensors { from, epoch, page } => {
                if self.joints.is_none_or(|(last, _)| last == epoch) {
                    self.each(Node::Cell(from), |cell| cell.learn(page));
                }
            }
            // A cell that has started anew has forgotten what it felt.
            Message::Network { from, page: NetworkPage::Heartbeat(heartbeat), .. }
                if heartbeat.state.has(Flags::CLAIMING) =>
            {
                self.each(from, |cell| cell.clear(false));
            }
            Message::Configure { .. }
            | Message::Network { .. }
            | Message::Sync
            | Message::Report
            | Message::Sum { .. }
            | Message::Torque { .. }
            | Message::Configured { .. } => {}
        }
    }

    fn each(&mut self, to: Node, mut act: impl FnMut(&mut Feeling)) {
        for (cell, feeling) in CellId::all().zip(&mut self.cells) {
            if to.names(cell) {
                act(feeling);
            }
        }
    }

    /// Keeps a write. One of the same parameter to the same cells is written over, unless a commit since then has
    /// taken it into use; so what is kept grows with the commits, and with nothing else.
    fn write(&mut self, to: Node, number: u8, message: Message) {
        let commit = Parameter::Commit.number();
        let since_commit =
            self.writes.iter().rposition(|(_, number, _)| *number == commit).map_or(0, |at| at + 1);
        let stale = |(at, write): (usize, &(Node, u8, Message))| {
            let over = write.0 == to && write.1 == number && number != commit;
            let volatile = number == Parameter::Mode.number();
            (over && (at >= since_commit || volatile)).then_some(at)
        };
        if let Some(at) = self.writes.iter().enumerate().find_map(stale) {
            self.writes.remove(at);
        }
        self.writes.push((to, number, message));
    }

    /// Whether a cell that has just started is in this state already.
    #[must_use]
    pub fn is_fresh(&self) -> bool {
        let felt = self.cells.iter().any(|cell| cell.pages().next().is_some() || !cell.pending.is_empty());
        !felt && self.writes.is_empty() && !self.halted && self.joints.is_none()
    }

    /// Whether new parameters were taken into use.
    #[must_use]
    pub fn configures(&self) -> bool {
        self.writes.iter().any(|(_, number, _)| *number == Parameter::Commit.number())
    }

    /// What has to be said so that `cells` are in this state; `next` are the joints that come first then, for a bus
    /// that has had none yet: the cells then forget the epoch of whoever spoke to them before.
    #[must_use]
    pub fn restoring(&self, cells: impl Fn(CellId) -> bool, next: Option<(Epoch, Joints)>) -> Vec<Message> {
        let mut messages: Vec<_> = self.writes.iter().map(|(_, _, message)| *message).collect();
        messages.push(Message::Resume);
        let known: Vec<_> = CellId::all().zip(&self.cells).filter(|(cell, _)| cells(*cell)).collect();
        let stimulus = |cell, from, page| Message::Stimulus { to: Node::Cell(cell), from, page };
        let felt: Vec<_> = known
            .iter()
            .flat_map(|(cell, feeling)| feeling.pages().map(|page| stimulus(*cell, From::Next, page)))
            .collect();
        let before = |(epoch, joints): (Epoch, Joints)| (epoch.plus(u8::MAX), joints);
        if let Some((epoch, joints)) = self.joints.or_else(|| next.map(before)) {
            if !felt.is_empty() {
                // Joints of the cells' last epoch would be dropped, and with them the stimuli would wait.
                let (epoch, joints) = before((epoch, joints));
                messages.push(Message::Joints { epoch, joints });
            }
            messages.extend(felt);
            messages.push(Message::Joints { epoch, joints });
        } else {
            messages.extend(felt);
        }
        if self.halted {
            messages.push(Message::Halt);
        }
        for (cell, feeling) in known {
            messages.extend(feeling.pending.iter().map(|&(from, page)| stimulus(cell, from, page)));
        }
        messages
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::fixed::Q5_10;
    use protocol::message::Heartbeat;

    fn press(newtons: f64) -> SensorPage {
        SensorPage::Skin(SkinSensors { contact: [Q5_10::nearest(newtons); 3], ..SkinSensors::default() })
    }

    fn cell(number: i64) -> CellId {
        CellId::new(number).unwrap()
    }

    fn to(number: i64, from: From, newtons: f64) -> Message {
        Message::Stimulus { to: Node::Cell(cell(number)), from, page: press(newtons) }
    }

    fn joints(epoch: u8) -> Message {
        Message::Joints { epoch: Epoch(epoch), joints: Joints::default() }
    }

    fn mode(to: Node, words: i16) -> Message {
        let request = Request::Write { number: Parameter::Mode.number(), words: [words, 0, 0, 0, 0, 0] };
        Message::Configure { to, tag: 0, request }
    }

    fn restored(messages: &[Message]) -> Vec<Message> {
        let mut state = State::default();
        for message in messages {
            state.take(message);
        }
        state.restoring(|_| true, None)
    }

    #[test]
    fn what_is_in_force_and_what_waits_are_told_apart() {
        let next = From::Epoch;
        let said = [
            joints(10),
            to(1, next(Epoch(11)), 1.0),
            to(1, next(Epoch(13)), 2.0),
            joints(11),
            to(2, From::Next, 3.0),
        ];
        let expected = [
            Message::Resume,
            joints(10),
            to(1, From::Next, 1.0),
            joints(11),
            to(1, next(Epoch(13)), 2.0),
            to(2, From::Next, 3.0),
        ];
        assert_eq!(restored(&said), expected);
    }

    #[test]
    fn a_late_stimulus_waits_for_the_next_joints() {
        let said = [joints(11), to(1, From::Epoch(Epoch(11)), 1.0)];
        assert_eq!(restored(&said), [Message::Resume, joints(11), to(1, From::Next, 1.0)]);
    }

    #[test]
    fn halted_cells_have_felt_and_are_halted_again_before_what_waits() {
        let said = [to(1, From::Next, 1.0), joints(1), Message::Halt, to(1, From::Next, 2.0)];
        let expected = [
            Message::Resume,
            joints(0),
            to(1, From::Next, 1.0),
            joints(1),
            Message::Halt,
            to(1, From::Next, 2.0),
        ];
        assert_eq!(restored(&said), expected);
        let resumed = [&said[..], &[Message::Resume]].concat();
        assert!(!restored(&resumed).contains(&Message::Halt));
    }

    #[test]
    fn who_has_let_go_started_anew_or_measures_feels_nothing() {
        let heartbeat = Heartbeat { state: Flags::CLAIMING, ..Heartbeat::default() };
        let page = NetworkPage::Heartbeat(heartbeat);
        let anew = Message::Network { from: Node::Cell(cell(1)), epoch: Epoch(0), page };
        for end in [to(1, From::Next, 0.0), anew] {
            let said = [to(1, From::Next, 1.0), joints(1), end, joints(2)];
            assert_eq!(restored(&said), [Message::Resume, joints(2)]);
        }
        let measure = mode(Node::Everyone, 0);
        let said = [to(1, From::Next, 1.0), joints(1), measure, to(1, From::Next, 1.0), joints(2)];
        assert_eq!(restored(&said), [measure, Message::Resume, joints(2)]);
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
        let again = [&said[..], &[mode(Node::Everyone, 1), write(1, 4)]].concat();
        let expected = [
            write(1, 2),
            write(127, 9),
            write(1, 3),
            write(127, 9),
            mode(Node::Everyone, 1),
            write(1, 4),
            Message::Resume,
        ];
        assert_eq!(restored(&again), expected);
    }

    #[test]
    fn what_a_cell_says_of_itself_counts_until_somebody_presses_it() {
        let says =
            |newtons, epoch| Message::Sensors { from: cell(1), epoch: Epoch(epoch), page: press(newtons) };
        let said = [joints(1), says(5.0, 0), says(1.0, 1), says(2.0, 1)];
        assert_eq!(restored(&said), [Message::Resume, joints(0), to(1, From::Next, 1.0), joints(1)]);
    }

    #[test]
    fn a_bus_without_joints_makes_cells_forget_another_epoch() {
        let state = State::default();
        assert!(state.is_fresh());
        let next = Some((Epoch(0), Joints::default()));
        assert_eq!(state.restoring(|_| true, next), [Message::Resume, joints(255)]);
    }

    #[test]
    fn only_cells_that_are_there_are_pressed() {
        let mut state = State::default();
        state.take(&Message::Stimulus { to: Node::Everyone, from: From::Next, page: press(1.0) });
        state.take(&joints(1));
        let messages = state.restoring(|it| it.get() == 7, None);
        assert_eq!(messages, [Message::Resume, joints(0), to(7, From::Next, 1.0), joints(1)]);
    }
}
