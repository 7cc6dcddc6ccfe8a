//! The commissioning of one cell: its stage, the parameters that it still needs, and its pending request.

use protocol::id::CellId;
use protocol::message::{Answer, Heartbeat, State, VERSION};
use protocol::packet::WORDS;
use protocol::parameters::{Abilities, Parameter, Parameters};
use protocol::time::{Micros, Span};

use super::outcome::{FailureReason, Outcome, RequestStep};
use crate::repeat::{RetryAction, RetryLimits, RetryState};

/// Retry limit and timeout of a request to one cell.
const REQUEST_RETRY_LIMITS: RetryLimits = RetryLimits {
    first_timeout: Span::from_millis(100),
    max_timeout: Span::from_millis(800),
    max_transmissions: 6,
};
/// Retry limit and timeouts of a commit request; longer than [`REQUEST_RETRY_LIMITS`], because the cell writes its
/// flash.
const COMMIT_RETRY_LIMITS: RetryLimits =
    RetryLimits { first_timeout: Span::from_millis(400), ..REQUEST_RETRY_LIMITS };
/// Maximum number of times that the writing of a cell starts over after the cell restarted meanwhile.
const MAX_WRITE_RESTARTS: u8 = 6;
/// Maximum time for a cell to hold a node id after it started or lost its node id.
pub(super) const NODE_ID_SETTLE_TIMEOUT: Span = Span::from_millis(3_000);
/// Time to wait for a heartbeat with the expected hash, after all parameters were read back.
const HEARTBEAT_TIMEOUT: Span = Span::from_millis(2_000);

/// The stage of a cell's commissioning.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Stage {
    /// The cell has not sent a heartbeat yet.
    Missing,
    /// The abilities of the cell are being read.
    QueryAbilities,
    /// The cell needs parameters, and then a commit.
    Write,
    /// The cell has committed, or had the expected hash; its parameters are being read back and compared.
    Read,
    /// Waiting for a heartbeat with the expected hash; holds the start of the wait.
    AwaitHeartbeat(Micros),
    /// The commissioning of the cell has finished, with this result.
    Done(Outcome),
}

/// A request to the cell that has not been answered yet.
#[derive(Clone, Copy, Debug)]
struct PendingRequest {
    step: RequestStep,
    tag: u8,
    attempt: RetryState,
}

/// The commissioning of one described cell.
#[derive(Debug)]
pub(super) struct Task {
    /// Serial number, which identifies the cell.
    pub(super) serial: u32,
    /// Node id of the cell in the description.
    pub(super) described: CellId,
    /// Node id of the cell on the bus; `None` until it is known.
    pub(super) number: Option<CellId>,
    /// The present stage of the cell.
    pub(super) stage: Stage,
    target: Parameters,
    hash: u16,
    /// True if this commissioning has changed the configuration of the cell; in a dry run, if it would change it.
    touched: bool,
    /// Bit i is set if stored parameter i is staged in the cell, or was read back with the expected value.
    written: u64,
    read: u64,
    pending: Option<PendingRequest>,
    tag: u8,
    rounds: u8,
    /// The node id that the cell had before its present one.
    previous_number: Option<CellId>,
    /// The time since when the cell cannot receive requests, because it claims a node id or has lost it; `None` if it
    /// can.
    pub(super) unsettled: Option<Micros>,
    reported_hash: u16,
}

/// Options of a commissioning: what it may write, and what it checks.
#[derive(Clone, Copy, Debug, Default)]
pub struct CommissionOptions {
    /// True to send no writes.
    pub dry_run: bool,
    /// True to read back also the cells that already have the expected hash.
    pub verify: bool,
}

const fn bit_mask(place: usize) -> u64 {
    1 << place
}

impl Task {
    pub(super) fn new(serial: u32, described: CellId, target: Parameters) -> Self {
        Self {
            serial,
            described,
            number: None,
            stage: Stage::Missing,
            target,
            hash: target.hash(),
            touched: false,
            written: 0,
            read: 0,
            pending: None,
            tag: 0,
            rounds: 0,
            previous_number: None,
            unsettled: None,
            reported_hash: 0,
        }
    }

    /// Returns the words that a parameter of the cell should have.
    pub(super) fn words(&self, parameter: Parameter) -> [i16; WORDS] {
        if parameter == Parameter::Commit {
            return protocol::packet::padded_words([self.hash.cast_signed()]);
        }
        self.target.words(parameter)
    }

    /// Returns the parameters that the skin's configuration of the cell has.
    pub(super) fn stored_parameters(&self) -> impl Iterator<Item = Parameter> + use<> {
        Parameter::stored_for_rows(self.target.all_rows().len())
    }

    /// Returns the bit of a parameter in `written`; zero if the cell's configuration lacks the parameter.
    fn parameter_bit(&self, parameter: Parameter) -> u64 {
        self.stored_parameters().position(|stored| stored == parameter).map_or(0, bit_mask)
    }

    fn first_missing_parameter(&self, mask: u64) -> Option<Parameter> {
        self.stored_parameters()
            .enumerate()
            .find(|(place, _)| mask & bit_mask(*place) == 0)
            .map(|(_, parameter)| parameter)
    }

    pub(super) const fn is_done(&self) -> bool {
        matches!(self.stage, Stage::Done(_))
    }

    pub(super) const fn has_pending_request(&self) -> bool {
        self.pending.is_some()
    }

    /// Returns true if the cell still needs this step of a broadcast request.
    pub(super) fn needs_step(&self, step: RequestStep) -> bool {
        let of_step = self.parameter_bit(step.parameter());
        let missing = |mask| of_step != 0 && mask & of_step == 0;
        let can = self.number.is_some() && self.unsettled.is_none() && self.pending.is_none();
        can && match step {
            RequestStep::Write(_) => self.stage == Stage::Write && missing(self.written),
            RequestStep::Read(_) => self.stage == Stage::Read && missing(self.read),
            RequestStep::Commit => false,
        }
    }

    /// Records a heartbeat that arrived under a node id.
    pub(super) fn handle_heartbeat(
        &mut self,
        now: Micros,
        number: CellId,
        heartbeat: &Heartbeat,
        wish: CommissionOptions,
    ) {
        if let Some(old) = self.number.filter(|&old| old != number) {
            // One change is a cell with a new node id; a change back means two cells.
            if self.previous_number == Some(number) {
                return self.fail(FailureReason::Twins(old.min(number), old.max(number)));
            }
            self.previous_number = Some(old);
            self.reset_after_restart();
        }
        self.number = Some(number);
        self.reported_hash = heartbeat.configuration;
        let version = heartbeat.state.version();
        if version != u16::from(VERSION) {
            return self.fail(FailureReason::Version { got: version });
        }
        if heartbeat.state.has(State::CLAIMING_NODE_ID) {
            self.unsettled = Some(now);
            return self.reset_after_restart();
        }
        self.unsettled = None;
        match self.stage {
            Stage::Missing => self.choose_stage(wish),
            Stage::AwaitHeartbeat(_) if self.reported_hash == self.hash => self.mark_done(),
            Stage::QueryAbilities
            | Stage::Write
            | Stage::Read
            | Stage::AwaitHeartbeat(_)
            | Stage::Done(_) => {}
        }
    }

    /// Handles a restart or a new node id: the staged parameters are lost, and the flash content is known only once the
    /// cell has settled.
    fn reset_after_restart(&mut self) {
        self.pending = None;
        (self.written, self.read) = (0, 0);
        if matches!(self.stage, Stage::QueryAbilities | Stage::Write | Stage::Read | Stage::AwaitHeartbeat(_))
        {
            self.stage = Stage::Missing;
        }
    }

    /// Chooses the stage of a cell that has settled.
    fn choose_stage(&mut self, wish: CommissionOptions) {
        let has_it = self.reported_hash == self.hash;
        self.stage = match (has_it, wish.dry_run, wish.verify || self.touched) {
            (true, _, true) => Stage::Read,
            (true, _, false) => Stage::Done(Outcome::AlreadySo),
            // A configuration that needs only the default abilities requires no query.
            (false, ..) if Abilities::default().first_missing(&self.target).is_some() => {
                Stage::QueryAbilities
            }
            (false, true, _) => Stage::Done(Outcome::WouldWrite),
            (false, false, _) => Stage::Write,
        };
    }

    /// Records that another cell now holds the node id of this cell.
    pub(super) fn lose_node_id(&mut self, now: Micros) {
        self.number = None;
        self.unsettled.get_or_insert(now);
        self.reset_after_restart();
    }

    pub(super) fn fail(&mut self, reason: FailureReason) {
        if !matches!(self.stage, Stage::Done(Outcome::Failed(_))) {
            self.pending = None;
            self.stage = Stage::Done(Outcome::Failed(reason));
        }
    }

    fn mark_done(&mut self) {
        self.stage = Stage::Done(if self.touched { Outcome::Written } else { Outcome::Verified });
    }

    /// Starts the next request of the cell and returns it with its tag; returns `None` if a request is pending.
    pub(super) fn next_request(&mut self, now: Micros) -> Option<(RequestStep, u8)> {
        if self.pending.is_some() || self.unsettled.is_some() || self.number.is_none() {
            return None;
        }
        let step = match self.stage {
            Stage::QueryAbilities => RequestStep::Read(Parameter::Identity),
            Stage::Write => {
                self.first_missing_parameter(self.written).map_or(RequestStep::Commit, RequestStep::Write)
            }
            Stage::Read => RequestStep::Read(self.first_missing_parameter(self.read)?),
            Stage::Missing | Stage::AwaitHeartbeat(_) | Stage::Done(_) => return None,
        };
        // The upper half of the tags is reserved for broadcast requests.
        self.tag = self.tag.wrapping_add(1) & 0x7F;
        // A commit may take effect without an answer.
        self.touched |= step == RequestStep::Commit;
        let attempt = RetryState::new(
            now,
            if step == RequestStep::Commit { COMMIT_RETRY_LIMITS } else { REQUEST_RETRY_LIMITS },
        );
        self.pending = Some(PendingRequest { step, tag: self.tag, attempt });
        Some((step, self.tag))
    }

    /// Handles timeouts: repeats the request, and fails at the retry limit or if the cell does not settle.
    pub(super) fn handle_timeout(&mut self, now: Micros) -> Option<(RequestStep, u8)> {
        if self.unsettled.is_some_and(|since| now.elapsed_since(since) >= NODE_ID_SETTLE_TIMEOUT)
            && !self.is_done()
        {
            self.fail(FailureReason::Gone);
        }
        if let Stage::AwaitHeartbeat(since) = self.stage
            && now.elapsed_since(since) >= HEARTBEAT_TIMEOUT
        {
            self.fail(FailureReason::Hash { target: self.hash, got: self.reported_hash });
        }
        let PendingRequest { step, tag, attempt } = self.pending.as_mut()?;
        let (step, tag, tries) = (*step, *tag, attempt.transmissions());
        match attempt.handle_timeout(now) {
            RetryAction::Wait => None,
            RetryAction::Resend => Some((step, tag)),
            RetryAction::GiveUp => {
                self.fail(FailureReason::Silent { step, tries });
                None
            }
        }
    }

    /// Returns the time of the next call of [`Task::handle_timeout`]; `None` if no timeout is running.
    pub(super) fn next_timeout(&self) -> Option<Micros> {
        let settled = self.unsettled.filter(|_| !self.is_done()).map(|since| since + NODE_ID_SETTLE_TIMEOUT);
        let beat = if let Stage::AwaitHeartbeat(since) = self.stage {
            Some(since + HEARTBEAT_TIMEOUT)
        } else {
            None
        };
        [self.pending.map(|pending| pending.attempt.next_timeout()), settled, beat]
            .into_iter()
            .flatten()
            .min()
    }

    /// Handles an answer of the cell to the pending request, or to the broadcast request `call` with this tag.
    pub(super) fn handle_answer(
        &mut self,
        now: Micros,
        tag: u8,
        answer: Answer,
        call: Option<RequestStep>,
        wish: CommissionOptions,
    ) {
        let own = self.pending.filter(|pending| pending.tag == tag).map(|pending| pending.step);
        let called = call.filter(|&step| self.needs_step(step));
        let Some(step) = own.or(called) else { return };
        let parameter = step.parameter();
        let is_write = !matches!(step, RequestStep::Read(_));
        match answer {
            Answer::Refused { number, reason } if number == parameter.number() => {
                self.pending = None;
                if step == RequestStep::Commit && reason == Answer::REFUSED_WRONG_HASH {
                    // The cell restarted in between, without a heartbeat that arrived.
                    return self.restart_writing(FailureReason::Refused { step, code: reason });
                }
                self.fail(FailureReason::Refused { step, code: reason });
            }
            Answer::Value { number, written, words }
                if number == parameter.number() && written == is_write =>
            {
                self.pending = None;
                if self.stage == Stage::QueryAbilities {
                    let [.., abilities] = words;
                    return match (Abilities::from_word(abilities).first_missing(&self.target), wish.dry_run) {
                        (Some(ability), _) => self.fail(FailureReason::Cannot(ability)),
                        (None, true) => self.stage = Stage::Done(Outcome::WouldWrite),
                        (None, false) => self.stage = Stage::Write,
                    };
                }
                let target = self.words(parameter);
                if words == target {
                    return self.confirm_step(now, step);
                }
                let differs = FailureReason::Differs { step, target, got: words };
                if is_write {
                    self.fail(differs);
                } else if wish.dry_run {
                    self.stage = Stage::Done(Outcome::WouldWrite);
                } else {
                    self.restart_writing(differs);
                }
            }
            // The answer belongs to an earlier request with this tag.
            Answer::Value { .. } | Answer::Refused { .. } => {}
        }
    }

    fn confirm_step(&mut self, now: Micros, step: RequestStep) {
        let bit = self.parameter_bit(step.parameter());
        match step {
            RequestStep::Write(_) => self.written |= bit,
            RequestStep::Commit => (self.stage, self.read) = (Stage::Read, 0),
            RequestStep::Read(_) => {
                self.read |= bit;
                if self.first_missing_parameter(self.read).is_none() {
                    self.stage = Stage::AwaitHeartbeat(now);
                    // A heartbeat may have brought the right hash meanwhile.
                    if self.reported_hash == self.hash {
                        self.mark_done();
                    }
                }
            }
        }
    }

    /// Starts the writing of the cell over; fails with `why` after the maximum number of rounds.
    fn restart_writing(&mut self, why: FailureReason) {
        self.rounds += 1;
        if self.rounds > MAX_WRITE_RESTARTS {
            return self.fail(why);
        }
        (self.written, self.read, self.stage) = (0, 0, Stage::Write);
    }
}
