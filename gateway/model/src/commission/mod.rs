//! Writes what a description says into the cells of one bus: what each still needs, and what it was asked last.
//!
//! ```text
//!   message, now ─> handle_message ─┐                  ┌─> poll_transmit ─> message
//!            now ─> handle_time ────┼─ [ Commission ] ─┼─> poll_timeout ──> when to call again
//!                   stop ───────────┘                  └─> progress, report
//! ```
//!
//! A cell is known by its serial number; the number that it has on the bus may be another than the description's.
//! What it computes with changes at its commit, as a whole: the hash in the commit says what must be staged. So a
//! commissioning may end at any moment, of itself or not, and the next one goes on: cells that have the right hash
//! already are left as they are.
//!
//! One listens first, and then asks: what all cells want to be the same of everyone at once, one request at a time;
//! the rest of each cell, some cells at a time. What was not answered is asked again. When all have committed, all is
//! read back and compared, and so is the hash in their heartbeats.

pub mod numbers;
mod outcome;
mod roster;
mod task;

use std::collections::{BTreeMap, HashMap, VecDeque};

use protocol::id::{CellId, Node};
use protocol::message::{Heartbeat, Message, NetworkPage, Request, State};
use protocol::packet::Epoch;
use protocol::parameters::Parameter;
use protocol::skin::Skin;
use protocol::time::{Micros, Span};
use serde::Serialize;

use roster::Roster;
use task::{Stage, Task};

pub use outcome::{Ask, Outcome, Reason, Trouble};
pub use task::Wish;

/// How long a bus is listened to before anything is said: two gateways notice each other in this time.
pub const LISTEN: Span = Span::from_millis(500);
/// How long cells may stay away after the last one showed up.
const SHOWING: Span = Span::from_millis(3_000);
/// Cells that are asked by themselves at the same time.
const WINDOW: usize = 16;
/// How long nobody may answer a request to everyone before it is over, and what remains is asked of each.
const QUIET: Span = Span::from_millis(150);
/// How often everyone is asked the same, when most do not answer.
const CALLS: u8 = 3;
/// From one sync to the next while heartbeats are awaited.
const SYNC: Span = Span::from_millis(300);
/// How often a gateway says that it is there: nobody begins beside it.
const ANNOUNCE: Span = Span::from_millis(250);
/// Set in the tags of requests to everyone.
const EVERYONE: u8 = 0x80;

/// What is done next.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Phase {
    /// Only listening, until then.
    Listen(Micros),
    /// Waiting for cells; since when no further one has shown up.
    Find(Micros),
    /// Parameters and commits.
    Write,
    /// All parameters are read back.
    Read,
    /// Heartbeats are awaited; when the last sync was said.
    Beat(Micros),
    /// Nothing is left to do.
    Over,
}

/// A request to everyone.
#[derive(Clone, Copy, Debug)]
struct Call {
    ask: Ask,
    tag: u8,
    /// Cells that needed it at first.
    needed: usize,
    tries: u8,
    /// When it is over, unless somebody answers before that.
    due: Micros,
}

/// How far it is, for people.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Progress {
    /// What is being done: listening, looking for cells, writing, reading back, waiting for heartbeats.
    pub doing: &'static str,
    /// Cells of the description on this bus.
    pub cells: usize,
    /// Of these, heard.
    pub found: usize,
    /// Of these, finished well.
    pub done: usize,
    /// Of these, given up.
    pub failed: usize,
}

/// What became of one cell.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct CellReport {
    /// Its number in the description.
    pub described: CellId,
    /// Its number on the bus, if it was heard.
    #[serde(rename = "node")]
    pub number: Option<CellId>,
    /// Its serial number.
    pub serial: u32,
    /// What became of it.
    #[serde(flatten)]
    pub outcome: Outcome,
}

/// A cell that the description does not have on this bus.
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
pub struct Stranger {
    /// Its number on the bus.
    #[serde(rename = "node")]
    pub number: CellId,
    /// Its serial number.
    pub serial: u32,
    /// The bus on which the description has it.
    #[serde(rename = "belongs_to", skip_serializing_if = "Option::is_none")]
    pub belongs: Option<String>,
}

/// What became of one bus.
#[derive(Clone, Debug, PartialEq)]
pub struct Report {
    /// The described cells, in the file's order.
    pub cells: Vec<CellReport>,
    /// The others, by number; they were left alone.
    pub strangers: Vec<Stranger>,
    /// Requests to one cell or to everyone.
    pub requests: u64,
    /// Of these, said again because nobody answered.
    pub repeated: u64,
    /// Why the bus was left alone from some moment on.
    pub trouble: Option<Trouble>,
}

/// The commissioning of one bus.
#[derive(Debug)]
pub struct Commission {
    wish: Wish,
    /// Answers that a request to everyone may bring at once.
    room: usize,
    tasks: Vec<Task>,
    by_serial: HashMap<u32, usize>,
    /// Serial numbers of cells on other buses, and their buses.
    elsewhere: BTreeMap<u32, String>,
    roster: Roster,
    phase: Phase,
    calls: VecDeque<Ask>,
    call: Option<Call>,
    /// All requests to everyone so far, with their tags: who is late has answered all the same.
    called: Vec<(Ask, u8)>,
    outbox: VecDeque<Message>,
    announced: Option<Micros>,
    requests: u64,
    repeated: u64,
    trouble: Option<Trouble>,
}

impl Commission {
    /// The commissioning of a skin's bus, which begins now by listening; `room` is how many packets may come at
    /// once without loss.
    #[must_use]
    pub fn new(skin: &Skin, bus: usize, wish: Wish, room: usize, now: Micros) -> Self {
        let tasks: Vec<_> =
            skin.cells_of(bus).map(|cell| Task::new(cell.serial, cell.node, skin.parameters(cell))).collect();
        let by_serial = tasks.iter().enumerate().map(|(place, task)| (task.serial, place)).collect();
        let others = skin.cells.iter().filter(|cell| cell.bus != bus);
        let elsewhere =
            others.filter_map(|cell| Some((cell.serial, skin.buses.get(cell.bus)?.name.clone()))).collect();
        Self {
            wish,
            room,
            tasks,
            by_serial,
            elsewhere,
            roster: Roster::default(),
            phase: Phase::Listen(now + LISTEN),
            calls: VecDeque::new(),
            call: None,
            called: Vec::new(),
            outbox: VecDeque::new(),
            announced: None,
            requests: 0,
            repeated: 0,
            trouble: None,
        }
    }

    /// Whether nothing is left to do.
    #[must_use]
    pub fn is_over(&self) -> bool {
        self.phase == Phase::Over
    }

    /// Whether something may be said on the bus: not while it is only listened to, and not in a dry run.
    #[must_use]
    pub const fn speaks(&self) -> bool {
        !matches!(self.phase, Phase::Listen(_) | Phase::Over) && !self.wish.dry_run
    }

    /// Takes what somebody else said on the bus; [`Commission::handle_time`] says what that leads to.
    pub fn handle_message(&mut self, now: Micros, message: &Message) {
        match *message {
            Message::Joints { .. } | Message::Network { from: Node::Gateway, .. } => self.end(Trouble::Rival),
            Message::Configure { request: Request::Write { number, .. }, .. } if is_stored(number) => {
                self.end(Trouble::Meddler);
            }
            Message::Network {
                from: Node::Cell(number), page: NetworkPage::Heartbeat(heartbeat), ..
            } => {
                self.hear(now, number, &heartbeat);
            }
            Message::Configured { from, tag, answer } => {
                let called = self.called.iter().rev().copied().find(|(_, called)| *called == tag);
                let wish = self.wish;
                let Some(task) = self.holder(from) else { return };
                task.answer(now, tag, answer, called.map(|(ask, _)| ask), wish);
                if let Some(call) = self.call.as_mut().filter(|_| called.is_some()) {
                    call.due = now + QUIET;
                }
            }
            Message::Network { .. }
            | Message::Configure { .. }
            | Message::Halt
            | Message::Sync
            | Message::Resume
            | Message::Report
            | Message::Sum { .. }
            | Message::Torque { .. }
            | Message::Sensors { .. }
            | Message::Stimulus { .. } => {}
        }
    }

    /// The described cell that has a number now.
    fn holder(&mut self, number: CellId) -> Option<&mut Task> {
        let serial = self.roster.holder(number)?;
        let task = self.tasks.get_mut(*self.by_serial.get(&serial)?)?;
        (task.number == Some(number)).then_some(task)
    }

    fn hear(&mut self, now: Micros, number: CellId, heartbeat: &Heartbeat) {
        let before = self.roster.holder(number).filter(|&serial| serial != heartbeat.serial);
        if let Some([one, other]) = self.roster.hear(number, heartbeat) {
            for (serial, other) in [(one, other), (other, one)] {
                self.fail(serial, Reason::Shared { number, other });
            }
            return;
        }
        if self.roster.holder(number) != Some(heartbeat.serial) {
            return; // it claims a number that is taken, and will give way
        }
        if let Some(loser) = before.and_then(|serial| self.task(serial))
            && loser.number == Some(number)
        {
            loser.lose_number(now);
        }
        let wish = self.wish;
        let Some(task) = self.task(heartbeat.serial) else { return };
        let new = task.number.is_none();
        task.hear(now, number, heartbeat, wish);
        if let (true, Phase::Find(since)) = (new, &mut self.phase) {
            *since = now;
        }
    }

    fn task(&mut self, serial: u32) -> Option<&mut Task> {
        self.tasks.get_mut(*self.by_serial.get(&serial)?)
    }

    fn fail(&mut self, serial: u32, reason: Reason) {
        if let Some(task) = self.task(serial) {
            task.fail(reason);
        }
    }

    fn end(&mut self, trouble: Trouble) {
        if self.phase != Phase::Over {
            self.trouble = Some(trouble);
            self.stop();
        }
    }

    /// Ends it now; nothing more is said.
    pub fn stop(&mut self) {
        self.outbox.clear();
        self.give_up(Reason::Stopped, Reason::Stopped);
    }

    /// Gives up all cells that are not done.
    fn give_up(&mut self, unheard: Reason, heard: Reason) {
        for task in self.tasks.iter_mut().filter(|task| !task.is_done()) {
            task.fail(if task.number.is_none() { unheard } else { heard });
        }
        self.phase = Phase::Over;
    }

    /// Takes in that time has passed, and decides what to ask. Harmless when called early.
    pub fn handle_time(&mut self, now: Micros) {
        for place in 0..self.tasks.len() {
            let again = self.tasks.get_mut(place).and_then(|task| Some((task.number, task.time(now)?)));
            if let Some((Some(number), (ask, tag))) = again {
                self.repeated += 1;
                self.request(place, Node::Cell(number), ask, tag);
            }
        }
        // Each turn is a phase that has nothing left to do.
        while let Some(next) = self.turn(now) {
            self.phase = next;
        }
        if self.speaks() && self.announced.is_none_or(|at| now.since(at) >= ANNOUNCE) {
            self.announced = Some(now);
            let heartbeat = Heartbeat { state: State::default().with_joint(0), ..Heartbeat::default() };
            let page = NetworkPage::Heartbeat(heartbeat);
            self.outbox.push_back(Message::Network { from: Node::Gateway, epoch: Epoch(0), page });
        }
    }

    /// Does what there is to do in a phase; returns the next one, when nothing is left.
    fn turn(&mut self, now: Micros) -> Option<Phase> {
        match self.phase {
            Phase::Listen(until) => {
                if now < until {
                    return None;
                }
                if !self.wish.dry_run {
                    // Cells whose heartbeats were not heard.
                    self.outbox.push_back(Message::Sync);
                }
                Some(Phase::Find(now))
            }
            Phase::Find(since) => {
                let all = self.tasks.iter().all(|task| task.stage != Stage::Missing);
                if !all && now.since(since) < SHOWING {
                    return None;
                }
                self.calls = self.common_writes();
                Some(Phase::Write)
            }
            Phase::Write => {
                if self.works(now, |stage| stage == Stage::Write) {
                    return None;
                }
                self.calls = Parameter::STORED.into_iter().map(Ask::Read).collect();
                Some(Phase::Read)
            }
            Phase::Read => {
                if self.works(now, |stage| matches!(stage, Stage::Write | Stage::Read)) {
                    return None;
                }
                if self.any(|stage| matches!(stage, Stage::Beat(_))) {
                    self.outbox.push_back(Message::Sync);
                }
                Some(Phase::Beat(now))
            }
            Phase::Beat(synced) => {
                if self.works(now, |stage| stage != Stage::Missing) {
                    let waits = self.any(|stage| matches!(stage, Stage::Beat(_)));
                    if waits && now.since(synced) >= SYNC {
                        self.outbox.push_back(Message::Sync);
                        self.phase = Phase::Beat(now);
                    }
                    return None;
                }
                self.give_up(Reason::Missing, Reason::Gone);
                Some(Phase::Over)
            }
            Phase::Over => None,
        }
    }

    fn any(&self, is: impl Fn(Stage) -> bool) -> bool {
        self.tasks.iter().any(|task| !task.is_done() && is(task.stage))
    }

    /// Asks what can be asked now, of cells in such stages; whether any is left, or a cell that is about to settle.
    fn works(&mut self, now: Micros, is: impl Fn(Stage) -> bool) -> bool {
        if self.call_everyone(now) {
            return true;
        }
        let mut asked = self.tasks.iter().filter(|task| task.is_asked()).count();
        for place in 0..self.tasks.len() {
            if asked >= WINDOW {
                break;
            }
            let Some(task) = self.tasks.get_mut(place).filter(|task| is(task.stage)) else { continue };
            if let (Some(number), Some((ask, tag))) = (task.number, task.ask(now)) {
                asked += 1;
                self.request(place, Node::Cell(number), ask, tag);
            }
        }
        self.any(is) || self.tasks.iter().any(|task| !task.is_done() && task.unsettled.is_some())
    }

    /// Goes on with requests to everyone; whether one is under way.
    fn call_everyone(&mut self, now: Micros) -> bool {
        loop {
            if let Some(call) = self.call {
                let mut waiting = self.tasks.iter().enumerate().filter(|(_, task)| task.needs(call.ask));
                let first = waiting.next().map(|(place, _)| place);
                if first.is_some() && now < call.due {
                    return true;
                }
                // When most have not heard it, to say it again costs less than to ask each.
                let lost = first.filter(|_| 2 * (waiting.count() + 1) > call.needed && call.tries < CALLS);
                if let Some(place) = lost {
                    self.call = Some(Call { due: now + QUIET, tries: call.tries + 1, ..call });
                    self.repeated += 1;
                    self.request(place, Node::Everyone, call.ask, call.tag);
                    return true;
                }
                self.call = None;
            }
            let Some(ask) = self.calls.pop_front() else { return false };
            let mut needing = self.tasks.iter().enumerate().filter(|(_, task)| task.needs(ask));
            // What one cell needs is asked of that cell.
            let (Some((place, _)), Some(_)) = (needing.next(), needing.next()) else { continue };
            let needed = needing.count() + 2;
            if !self.may_call(ask) {
                continue;
            }
            // There are fewer of them than tags.
            let tag = EVERYONE | self.called.last().map_or(0, |(_, tag)| tag.wrapping_add(1));
            self.called.push((ask, tag));
            self.call = Some(Call { ask, tag, needed, tries: 1, due: now + QUIET });
            self.request(place, Node::Everyone, ask, tag);
        }
    }

    /// Whether everyone may be asked this: all answers must find room, and nothing is written to cells that are
    /// not the description's.
    fn may_call(&self, ask: Ask) -> bool {
        let fits = self.roster.all().count() <= self.room;
        let known = |serial| self.by_serial.get(&serial).and_then(|&place| self.tasks.get(place));
        let ours = |serial| known(serial).is_some_and(|task| !is_failed(task.stage));
        fits && (matches!(ask, Ask::Read(_)) || self.roster.all().all(|(_, serial)| ours(serial)))
    }

    /// Writes that are the same for all cells that need any.
    fn common_writes(&self) -> VecDeque<Ask> {
        let common = |parameter: &Parameter| {
            let mut words = self
                .tasks
                .iter()
                .filter(|task| task.stage == Stage::Write)
                .map(|task| task.words(*parameter));
            let first = words.next();
            words.all(|other| Some(other) == first)
        };
        Parameter::STORED.into_iter().filter(common).map(Ask::Write).collect()
    }

    fn request(&mut self, place: usize, to: Node, ask: Ask, tag: u8) {
        let Some(task) = self.tasks.get(place) else { return };
        let number = ask.parameter().number();
        let request = match ask {
            Ask::Write(parameter) => Request::Write { number, words: task.words(parameter) },
            Ask::Commit => Request::Write { number, words: task.words(Parameter::Commit) },
            Ask::Read(_) => Request::Read { number },
        };
        self.requests += 1;
        self.outbox.push_back(Message::Configure { to, tag, request });
    }

    /// The next message to send.
    pub fn poll_transmit(&mut self) -> Option<Message> {
        self.outbox.pop_front()
    }

    /// When [`Commission::handle_time`] has something to do; `None` when it is over.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Micros> {
        let phase = match self.phase {
            Phase::Listen(until) => return Some(until),
            Phase::Over => return None,
            Phase::Find(since) => Some(since + SHOWING),
            Phase::Beat(synced) => Some(synced + SYNC),
            Phase::Write | Phase::Read => None,
        };
        let call = self.call.map(|call| call.due);
        let announcement = self.announced.map(|at| at + ANNOUNCE);
        let tasks = self.tasks.iter().filter_map(Task::due);
        tasks.chain([phase, call, announcement].into_iter().flatten()).min()
    }

    /// How far it is.
    #[must_use]
    pub fn progress(&self) -> Progress {
        let count = |is: &dyn Fn(&Task) -> bool| self.tasks.iter().filter(|task| is(task)).count();
        let failed = count(&|task| is_failed(task.stage));
        let doing = match self.phase {
            Phase::Listen(_) => "listening",
            Phase::Find(_) => "looking for cells",
            Phase::Write => "writing",
            Phase::Read => "reading back",
            Phase::Beat(_) => "waiting for heartbeats",
            Phase::Over => "done",
        };
        Progress {
            doing,
            cells: self.tasks.len(),
            found: count(&|task| task.number.is_some()),
            done: count(&|task| task.is_done()) - failed,
            failed,
        }
    }

    /// What has become of everybody; of cells that are not done, as if it were stopped now.
    #[must_use]
    pub fn report(&self) -> Report {
        let cell = |task: &Task| CellReport {
            described: task.described,
            serial: task.serial,
            number: task.number,
            outcome: match task.stage {
                Stage::Done(outcome) => outcome,
                Stage::Missing | Stage::Write | Stage::Read | Stage::Beat(_) => {
                    Outcome::Failed(Reason::Stopped)
                }
            },
        };
        let stranger = |(number, serial): (CellId, u32)| Stranger {
            number,
            serial,
            belongs: self.elsewhere.get(&serial).cloned(),
        };
        let unknown = self.roster.all().filter(|(_, serial)| !self.by_serial.contains_key(serial));
        Report {
            cells: self.tasks.iter().map(cell).collect(),
            strangers: unknown.map(stranger).collect(),
            requests: self.requests,
            repeated: self.repeated,
            trouble: self.trouble,
        }
    }
}

const fn is_failed(stage: Stage) -> bool {
    matches!(stage, Stage::Done(Outcome::Failed(_)))
}

/// Whether a write of this number changes what is kept, or is about to be.
fn is_stored(number: u8) -> bool {
    let parameter = Parameter::from_number(number);
    parameter.is_some_and(|it| it == Parameter::Commit || Parameter::STORED.contains(&it))
}
