//! Writes a skin's description into the cells of one bus, as a state machine without I/O.
//!
//! ```text
//!   message, now ─> handle_message ─┐                  ┌─> poll_transmit ─> message
//!            now ─> handle_time ────┼─ [ Commission ] ─┼─> poll_timeout ──> when to call again
//!                   stop ───────────┘                  └─> progress, report
//! ```
//!
//! A cell is identified by its serial number; its node id on the bus may differ from the description's. Its
//! configuration changes atomically, at its commit: the commit contains the hash of the parameters that must be staged.
//! So a commissioning may stop at any moment, and the next one continues: cells with the right hash are skipped.
//!
//! The gateway first listens, then sends requests. Parameters that all cells share are broadcast, one request at a
//! time; the rest goes to each cell, several cells at a time. Unanswered requests are repeated. When all cells
//! have committed, all parameters are read back and compared, and so is the hash in the heartbeats.

mod address_table;
pub mod node_ids;
mod outcome;
mod report;
mod task;

use std::collections::{BTreeMap, HashMap, VecDeque};

use protocol::id::{CellId, Node};
use protocol::message::{Heartbeat, Message, NetworkPage, Request, State};
use protocol::packet::Epoch;
use protocol::parameters::{MAX_ROWS, Parameter};
use protocol::skin::Skin;
use protocol::time::{Micros, Span};

use address_table::AddressTable;
use task::{Stage, Task};

use crate::repeat::{RetryAction, RetryLimits, RetryState};
pub use outcome::{AbortReason, FailureReason, Outcome, RequestStep};
pub use report::{CellReport, Progress, Report, UnknownNode};
pub use task::CommissionOptions;

/// Duration of listening before the first request: long enough for two gateways to receive each other's heartbeats.
pub const LISTEN_TIME: Span = Span::from_millis(500);
/// Time after which no further cells are expected, counted from the appearance of the last one.
const DISCOVERY_TIMEOUT: Span = Span::from_millis(3_000);
/// Maximum number of cells that have a pending request addressed to them alone.
const MAX_PENDING_CELLS: usize = 16;
/// Retry limits of a broadcast request while most cells do not answer. If no cell answers within this time, each
/// remaining cell gets a request of its own.
const BROADCAST_RETRY_LIMITS: RetryLimits =
    RetryLimits { first_timeout: BROADCAST_TIMEOUT, max_timeout: BROADCAST_TIMEOUT, max_transmissions: 3 };
const BROADCAST_TIMEOUT: Span = Span::from_millis(150);
/// Interval of syncs while waiting for heartbeats.
const SYNC_INTERVAL: Span = Span::from_millis(300);
/// Interval of this gateway's heartbeats, by which other gateways detect it.
const HEARTBEAT_INTERVAL: Span = Span::from_millis(250);
/// The bit that marks the tags of broadcast requests.
const BROADCAST_TAG: u8 = 0x80;

/// The phases of a commissioning, in order.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Phase {
    /// Listening without sending, until this time.
    Listen(Micros),
    /// Waiting for cells to appear; holds the time when the last one appeared.
    Discover(Micros),
    /// Writing parameters to cells, and committing them.
    Write,
    /// Reading back all parameters from cells.
    Read,
    /// Waiting for heartbeats with the expected hash; holds the time of the last sync.
    AwaitHeartbeats(Micros),
    /// Finished: nothing is sent any more.
    Over,
}

/// A broadcast request and the state of its retries.
#[derive(Clone, Copy, Debug)]
struct Broadcast {
    step: RequestStep,
    tag: u8,
    /// Number of cells that needed the request when it was first sent.
    needed: usize,
    /// Retry state of the request. An answer from any cell restarts the timeout.
    attempt: RetryState,
}

/// The commissioning of one bus.
#[derive(Debug)]
pub struct Commission {
    wish: CommissionOptions,
    /// Maximum number of answers to one broadcast request that the receive buffer can hold.
    max_answers: usize,
    tasks: Vec<Task>,
    by_serial: HashMap<u32, usize>,
    /// Serial numbers of the cells that the description has on other buses, with the names of these buses.
    elsewhere: BTreeMap<u32, String>,
    address_table: AddressTable,
    phase: Phase,
    pending_broadcasts: VecDeque<RequestStep>,
    broadcast: Option<Broadcast>,
    /// All broadcast requests so far, each with its tag; late answers to earlier ones still count.
    sent_broadcasts: Vec<(RequestStep, u8)>,
    outbox: VecDeque<Message>,
    announced: Option<Micros>,
    requests: u64,
    repeated: u64,
    trouble: Option<AbortReason>,
}

impl Commission {
    /// Starts the commissioning of one bus of a skin; it listens first. `room` is the number of packets that the
    /// receive buffer can hold without loss.
    #[must_use]
    pub fn new(skin: &Skin, bus: usize, wish: CommissionOptions, room: usize, now: Micros) -> Self {
        let tasks: Vec<_> = skin
            .cells_on_bus(bus)
            .map(|cell| Task::new(cell.serial, cell.node, skin.parameters(cell)))
            .collect();
        let by_serial = tasks.iter().enumerate().map(|(place, task)| (task.serial, place)).collect();
        let others = skin.cells.iter().filter(|cell| cell.bus != bus);
        let elsewhere =
            others.filter_map(|cell| Some((cell.serial, skin.buses.get(cell.bus)?.name.clone()))).collect();
        Self {
            wish,
            max_answers: room,
            tasks,
            by_serial,
            elsewhere,
            address_table: AddressTable::default(),
            phase: Phase::Listen(now + LISTEN_TIME),
            pending_broadcasts: VecDeque::new(),
            broadcast: None,
            sent_broadcasts: Vec::new(),
            outbox: VecDeque::new(),
            announced: None,
            requests: 0,
            repeated: 0,
            trouble: None,
        }
    }

    /// Returns true when the commissioning is finished.
    #[must_use]
    pub fn is_over(&self) -> bool {
        self.phase == Phase::Over
    }

    /// Returns true if the commissioning may send on the bus: not while it listens, and not in a dry run.
    #[must_use]
    pub const fn may_send(&self) -> bool {
        !matches!(self.phase, Phase::Listen(_) | Phase::Over) && !self.wish.dry_run
    }

    /// Records a message from another sender on the bus. Replies are sent by [`Commission::handle_time`], not here.
    pub fn handle_message(&mut self, now: Micros, message: &Message) {
        if let Message::Joints { .. } | Message::Network { from: Node::Gateway, .. } = message {
            self.abort(AbortReason::OtherGateway);
        } else if let Message::Configure { request: Request::Write { number, .. }, .. } = *message
            && is_stored(number)
        {
            self.abort(AbortReason::OtherWriter);
        } else if let Message::Network {
            from: Node::Cell(node),
            page: NetworkPage::Heartbeat(heartbeat),
            ..
        } = *message
        {
            self.handle_heartbeat(now, node, &heartbeat);
        } else if let Message::Configured { from, tag, answer } = *message {
            let called = self.sent_broadcasts.iter().rev().copied().find(|(_, called)| *called == tag);
            let wish = self.wish;
            let Some(task) = self.task_of_node(from) else { return };
            task.handle_answer(now, tag, answer, called.map(|(step, _)| step), wish);
            if let Some(call) = self.broadcast.as_mut().filter(|_| called.is_some()) {
                call.attempt.extend_timeout(now);
            }
        }
    }

    /// Returns the task of the described cell that holds a node id now.
    fn task_of_node(&mut self, number: CellId) -> Option<&mut Task> {
        let serial = self.address_table.owner_serial(number)?;
        let task = self.tasks.get_mut(*self.by_serial.get(&serial)?)?;
        (task.number == Some(number)).then_some(task)
    }

    fn handle_heartbeat(&mut self, now: Micros, number: CellId, heartbeat: &Heartbeat) {
        let before = self.address_table.owner_serial(number).filter(|&serial| serial != heartbeat.serial);
        if let Some([one, other]) = self.address_table.receive_heartbeat(now, number, heartbeat) {
            for (serial, other) in [(one, other), (other, one)] {
                self.fail_cell(serial, FailureReason::Shared { number, other });
            }
            return;
        }
        if self.address_table.owner_serial(number) != Some(heartbeat.serial) {
            return; // an address claim for a taken node id, which will be given up
        }
        if let Some(loser) = before.and_then(|serial| self.task_for_serial(serial))
            && loser.number == Some(number)
        {
            loser.lose_node_id(now);
        }
        let wish = self.wish;
        let Some(task) = self.task_for_serial(heartbeat.serial) else { return };
        let new = task.number.is_none();
        task.handle_heartbeat(now, number, heartbeat, wish);
        if let (true, Phase::Discover(since)) = (new, &mut self.phase) {
            *since = now;
        }
    }

    fn task_for_serial(&mut self, serial: u32) -> Option<&mut Task> {
        self.tasks.get_mut(*self.by_serial.get(&serial)?)
    }

    fn fail_cell(&mut self, serial: u32, reason: FailureReason) {
        if let Some(task) = self.task_for_serial(serial) {
            task.fail(reason);
        }
    }

    fn abort(&mut self, trouble: AbortReason) {
        if self.phase != Phase::Over {
            self.trouble = Some(trouble);
            self.stop();
        }
    }

    /// Stops the commissioning now, and discards the messages that have not been sent.
    pub fn stop(&mut self) {
        self.outbox.clear();
        self.fail_open_tasks(FailureReason::Stopped, FailureReason::Stopped);
    }

    /// Fails all cells that are not done: with the reason `unheard` if a cell sent no heartbeat, else with `heard`.
    fn fail_open_tasks(&mut self, unheard: FailureReason, heard: FailureReason) {
        for task in self.tasks.iter_mut().filter(|task| !task.is_done()) {
            task.fail(if task.number.is_none() { unheard } else { heard });
        }
        self.phase = Phase::Over;
    }

    /// Handles expired timeouts, and queues the messages to send. A call before any timeout has no effect.
    pub fn handle_time(&mut self, now: Micros) {
        for place in 0..self.tasks.len() {
            let again =
                self.tasks.get_mut(place).and_then(|task| Some((task.number, task.handle_timeout(now)?)));
            if let Some((Some(node), (step, tag))) = again {
                self.repeated += 1;
                self.queue_request(place, Node::Cell(node), step, tag);
            }
        }
        // Advance through all phases that are complete.
        while let Some(next) = self.run_phase(now) {
            self.phase = next;
        }
        if self.may_send() && self.announced.is_none_or(|at| now.elapsed_since(at) >= HEARTBEAT_INTERVAL) {
            self.announced = Some(now);
            let heartbeat = Heartbeat { state: State::default().with_joint(0), ..Heartbeat::default() };
            let page = NetworkPage::Heartbeat(heartbeat);
            self.outbox.push_back(Message::Network { from: Node::Gateway, epoch: Epoch(0), page });
        }
    }

    /// Does the work of the current phase. Returns the next phase if the current one is complete.
    fn run_phase(&mut self, now: Micros) -> Option<Phase> {
        match self.phase {
            Phase::Listen(until) => {
                if now < until {
                    return None;
                }
                if !self.wish.dry_run {
                    // Requests heartbeats from cells that have not sent one yet.
                    self.outbox.push_back(Message::Sync);
                }
                Some(Phase::Discover(now))
            }
            Phase::Discover(since) => {
                let all = self.tasks.iter().all(|task| task.stage != Stage::Missing);
                if !all && now.elapsed_since(since) < DISCOVERY_TIMEOUT {
                    return None;
                }
                self.pending_broadcasts = self.common_writes();
                Some(Phase::Write)
            }
            Phase::Write => {
                if self.send_requests(now, |stage| matches!(stage, Stage::QueryAbilities | Stage::Write)) {
                    return None;
                }
                self.pending_broadcasts = self.stored_parameters().map(RequestStep::Read).collect();
                Some(Phase::Read)
            }
            Phase::Read => {
                if self.send_requests(now, |stage| {
                    matches!(stage, Stage::QueryAbilities | Stage::Write | Stage::Read)
                }) {
                    return None;
                }
                if self.any_open_task_in(|stage| matches!(stage, Stage::AwaitHeartbeat(_))) {
                    self.outbox.push_back(Message::Sync);
                }
                Some(Phase::AwaitHeartbeats(now))
            }
            Phase::AwaitHeartbeats(synced) => {
                if self.send_requests(now, |stage| stage != Stage::Missing) {
                    let waits = self.any_open_task_in(|stage| matches!(stage, Stage::AwaitHeartbeat(_)));
                    if waits && now.elapsed_since(synced) >= SYNC_INTERVAL {
                        self.outbox.push_back(Message::Sync);
                        self.phase = Phase::AwaitHeartbeats(now);
                    }
                    return None;
                }
                self.fail_open_tasks(FailureReason::Missing, FailureReason::Gone);
                Some(Phase::Over)
            }
            Phase::Over => None,
        }
    }

    fn any_open_task_in(&self, is: impl Fn(Stage) -> bool) -> bool {
        self.tasks.iter().any(|task| !task.is_done() && is(task.stage))
    }

    /// Queues the requests that are possible now for the cells whose stage satisfies `is`. Returns true if any such
    /// cell remains, or if a cell is still claiming its node id.
    fn send_requests(&mut self, now: Micros, is: impl Fn(Stage) -> bool) -> bool {
        if self.send_broadcasts(now) {
            return true;
        }
        let mut pending = self.tasks.iter().filter(|task| task.has_pending_request()).count();
        for place in 0..self.tasks.len() {
            if pending >= MAX_PENDING_CELLS {
                break;
            }
            let Some(task) = self.tasks.get_mut(place).filter(|task| is(task.stage)) else { continue };
            if let (Some(node), Some((step, tag))) = (task.number, task.next_request(now)) {
                pending += 1;
                self.queue_request(place, Node::Cell(node), step, tag);
            }
        }
        self.any_open_task_in(is) || self.tasks.iter().any(|task| !task.is_done() && task.unsettled.is_some())
    }

    /// Sends or repeats broadcast requests. Returns true if one is pending.
    fn send_broadcasts(&mut self, now: Micros) -> bool {
        loop {
            if let Some(call) = &mut self.broadcast {
                let mut waiting =
                    self.tasks.iter().enumerate().filter(|(_, task)| task.needs_step(call.step));
                let first = waiting.next().map(|(place, _)| place);
                // If most cells did not answer, a repeated broadcast costs less than a request to each.
                match first.map(|place| (place, call.attempt.handle_timeout(now))) {
                    Some((_, RetryAction::Wait)) => return true,
                    Some((place, RetryAction::Resend)) if 2 * (waiting.count() + 1) > call.needed => {
                        let Broadcast { step, tag, .. } = *call;
                        self.repeated += 1;
                        self.queue_request(place, Node::Everyone, step, tag);
                        return true;
                    }
                    Some((_, RetryAction::Resend | RetryAction::GiveUp)) | None => self.broadcast = None,
                }
            }
            let Some(step) = self.pending_broadcasts.pop_front() else { return false };
            let mut needing = self.tasks.iter().enumerate().filter(|(_, task)| task.needs_step(step));
            // A write that only one cell needs goes to that cell alone.
            let (Some((place, _)), Some(_)) = (needing.next(), needing.next()) else { continue };
            let needed = needing.count() + 2;
            if !self.may_broadcast(step) {
                continue;
            }
            // There are fewer broadcast requests than tags.
            let tag = BROADCAST_TAG | self.sent_broadcasts.last().map_or(0, |(_, tag)| tag.wrapping_add(1));
            self.sent_broadcasts.push((step, tag));
            self.broadcast =
                Some(Broadcast { step, tag, needed, attempt: RetryState::new(now, BROADCAST_RETRY_LIMITS) });
            self.queue_request(place, Node::Everyone, step, tag);
        }
    }

    /// Returns true if this request may be broadcast: the receive buffer must hold all answers, and a write must not
    /// reach cells outside the description.
    fn may_broadcast(&self, step: RequestStep) -> bool {
        let fits = self.address_table.owners().count() <= self.max_answers;
        let known = |serial| self.by_serial.get(&serial).and_then(|&place| self.tasks.get(place));
        let ours = |serial| known(serial).is_some_and(|task| !is_failed(task.stage));
        fits && (matches!(step, RequestStep::Read(_))
            || self.address_table.owners().all(|(_, serial)| ours(serial)))
    }

    /// Returns the writes that are the same for all cells that need them.
    fn common_writes(&self) -> VecDeque<RequestStep> {
        let common = |parameter: &Parameter| {
            let mut words = self
                .tasks
                .iter()
                .filter(|task| matches!(task.stage, Stage::QueryAbilities | Stage::Write))
                .map(|task| task.words(*parameter));
            let first = words.next();
            words.all(|other| Some(other) == first)
        };
        self.stored_parameters().filter(common).map(RequestStep::Write).collect()
    }

    /// Returns the parameters of the cell with the largest number of parameters.
    fn stored_parameters(&self) -> impl Iterator<Item = Parameter> + use<> {
        let longest =
            self.tasks.iter().map(|task| task.stored_parameters().count()).max().unwrap_or_default();
        Parameter::stored_for_rows(MAX_ROWS).take(longest)
    }

    fn queue_request(&mut self, place: usize, to: Node, step: RequestStep, tag: u8) {
        let Some(task) = self.tasks.get(place) else { return };
        let number = step.parameter().number();
        let request = match step {
            RequestStep::Write(parameter) => Request::Write { number, words: task.words(parameter) },
            RequestStep::Commit => Request::Write { number, words: task.words(Parameter::Commit) },
            RequestStep::Read(_) => Request::Read { number },
        };
        self.requests += 1;
        self.outbox.push_back(Message::Configure { to, tag, request });
    }

    /// Returns the next message to send.
    pub fn poll_transmit(&mut self) -> Option<Message> {
        self.outbox.pop_front()
    }

    /// Returns the time of the next call of [`Commission::handle_time`]; `None` when finished.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Micros> {
        let phase = match self.phase {
            Phase::Listen(until) => return Some(until),
            Phase::Over => return None,
            Phase::Discover(since) => Some(since + DISCOVERY_TIMEOUT),
            Phase::AwaitHeartbeats(synced) => Some(synced + SYNC_INTERVAL),
            Phase::Write | Phase::Read => None,
        };
        let call = self.broadcast.map(|call| call.attempt.next_timeout());
        let announcement = self.announced.map(|at| at + HEARTBEAT_INTERVAL);
        let tasks = self.tasks.iter().filter_map(Task::next_timeout);
        tasks.chain([phase, call, announcement].into_iter().flatten()).min()
    }
}

const fn is_failed(stage: Stage) -> bool {
    matches!(stage, Stage::Done(Outcome::Failed(_)))
}

/// Returns true if a write of the parameter with this number changes stored or staged parameters.
fn is_stored(number: u8) -> bool {
    let parameter = Parameter::from_number(number);
    parameter.is_some_and(|it| it == Parameter::Commit || it.is_stored())
}

#[cfg(test)]
mod tests;
