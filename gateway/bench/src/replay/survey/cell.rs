//! Survey of one cell: its configuration where the replayed part begins, its silences, and what its counters account for.

use model::tracker::{CellTracker, HeartbeatKind, UplinkAccount};
use protocol::message::{Answer, Heartbeat, Message, NetworkPage, ReceivedCounts, State as Flags};
use protocol::parameters::Parameter;
use protocol::time::Micros;

use super::{
    ABSENCE_TIMEOUT_NS, CellBeforeCapture, InitialValue, JointsBroadcast, MAX_CELL_START_NS,
    MAX_COUNTER_DELAY_BROADCASTS, MessageContext, ReplayPartPosition,
};

/// Survey of one cell.
#[derive(Clone, Debug)]
pub struct SurveyedCell {
    /// Hash of the cell's configuration where the replayed part begins, if known.
    pub hash: InitialValue<u16>,
    /// Hash in the last heartbeat before the cell's answer to a commit: of the former or of the new configuration.
    unconfirmed_hash: Option<u16>,
    /// True if the cell measured in the replayed part, so that its torques cannot be reproduced.
    pub measured: bool,
    /// Times of the cell's first and last message in ns since 1970.
    pub active: (u64, u64),
    /// Starts and ends of the cell's long silences in ns since 1970.
    pub silences: Vec<(u64, u64)>,
    /// Number of packets that the cell sent but the capture lacks.
    pub unrecorded: u64,
    /// Number of joint broadcasts that the cell missed or processed too late.
    pub untaken: u64,
    /// Time ranges in ns since 1970 in which the cell's counters account for all joints: start exclusive, end
    /// inclusive.
    pub(super) accounted: Vec<(u64, u64)>,
    /// True if the capture contains counters that account for any joints. Otherwise each missing message is a
    /// difference.
    pub(super) is_accounted: bool,
    tracked: CellTracker,
    /// Start of the cell's present claim of its node id in ns since 1970. A cell claims its id after each start.
    claims: Option<u64>,
    /// Time in ns since 1970 at which the cell's bus was lost; `None` once the cell sends again.
    pub(super) away: Option<u64>,
    /// Counters of the cell's last report, the number of joint broadcasts before it, and the time of the last of them
    /// in ns since 1970.
    report: Option<(ReceivedCounts, u64, u64)>,
}

impl SurveyedCell {
    pub(super) fn new(nanos: u64, before: Option<&CellBeforeCapture>) -> Self {
        // A cell that sent just before the capture was present when it began.
        let is_present = |last: &u64| nanos <= last.saturating_add(ABSENCE_TIMEOUT_NS);
        let first = before.map(|before| before.last_seen).filter(is_present);
        let mut tracked = before.map(|before| before.tracked.clone()).unwrap_or_default();
        // It is not known that messages of the cell between the two times are lost.
        tracked.account = UplinkAccount::default();
        Self {
            hash: before.map_or(InitialValue::No, |before| before.hash),
            unconfirmed_hash: None,
            measured: before.is_some_and(|before| before.measures),
            active: (first.map_or(nanos, |heard| heard.min(nanos)), nanos),
            silences: Vec::new(),
            unrecorded: 0,
            untaken: 0,
            accounted: Vec::new(),
            is_accounted: false,
            tracked,
            claims: None,
            report: None,
            away: None,
        }
    }

    pub(super) fn mark_seen(&mut self, nanos: u64) {
        let last = self.active.1;
        if nanos > last.saturating_add(ABSENCE_TIMEOUT_NS) {
            self.silences.push((last, nanos));
        }
        self.active.1 = last.max(nanos);
        if let Some(away) = self.away.take() {
            self.silences.push((away, nanos));
        }
    }

    /// Ends the survey of the cell at the end of the capture, `nanos` in ns since 1970.
    pub(super) fn finish(&mut self, nanos: u64) {
        self.accept_unconfirmed_hash();
        self.unrecorded = self.tracked.account.uplink().lost;
        if let Some(away) = self.away {
            self.silences.push((away, u64::MAX));
        }
        let from = self.claims.unwrap_or(self.active.1);
        if nanos > from.saturating_add(ABSENCE_TIMEOUT_NS) || self.claims.is_some() {
            self.silences.push((from, u64::MAX));
        }
    }

    /// Forgets the hash: the cell was told to commit before the replayed part.
    pub(super) const fn forget_hash(&mut self) {
        (self.hash, self.unconfirmed_hash) = (InitialValue::No, None);
    }

    /// Takes the hash in the last heartbeat, if the answer to the commit before it is not in the capture.
    pub(super) fn accept_unconfirmed_hash(&mut self) {
        if let (InitialValue::No, Some(hash)) = (self.hash, self.unconfirmed_hash.take()) {
            self.hash = InitialValue::Value(hash);
        }
    }

    /// Handles a message that the cell sent.
    pub(super) fn add_message(&mut self, message: &Message, context: &MessageContext<'_>) {
        let &MessageContext { nanos, place, is_committing, joints } = context;
        let word = self.tracked.record_packet(Micros(nanos / 1_000), message, None).word;
        if let Message::Network { page: NetworkPage::Heartbeat(heartbeat), .. } = message {
            match word {
                Some(HeartbeatKind::Claimant | HeartbeatKind::Outsider | HeartbeatKind::Overtaken) | None => {
                    return;
                }
                // A restart sets the counters to 0. They then count joints from before this heartbeat.
                Some(HeartbeatKind::Started { .. }) => {
                    let last = joints.back().map(|last| (last.number, last.nanos)).unwrap_or_default();
                    let may_count =
                        |joints: &&JointsBroadcast| nanos <= joints.nanos.saturating_add(MAX_CELL_START_NS);
                    let early = joints.iter().rev().take_while(may_count).count() as u64;
                    self.report = Some((ReceivedCounts::default(), last.0.saturating_sub(early), last.1));
                }
                Some(HeartbeatKind::First | HeartbeatKind::Continued | HeartbeatKind::Shared) => {}
            }
            self.add_heartbeat(heartbeat, context);
        } else if let Message::Network { page: NetworkPage::Received(heard), epoch, .. } = *message {
            // The page carries the epoch of the last joints that its counters include.
            let at = joints.iter().rev().find(|joints| joints.epoch == epoch);
            self.add_counters(heard, at.map(|joints| (joints.number, joints.nanos)));
        } else if let Message::Configured { answer: Answer::Value { number, written: true, .. }, .. } =
            *message
            && number == Parameter::Commit.number()
        {
            // The cell was configured again before its first heartbeat, so its former configuration is unknown.
            self.hash = match self.hash {
                _ if place == ReplayPartPosition::Before || is_committing => InitialValue::No,
                InitialValue::No => InitialValue::TooLate,
                known @ (InitialValue::TooLate | InitialValue::Value(_)) => known,
            };
            self.unconfirmed_hash = None;
        }
    }

    fn add_heartbeat(&mut self, heartbeat: &Heartbeat, context: &MessageContext<'_>) {
        let &MessageContext { nanos, place, is_committing, .. } = context;
        // A cell that claims its node id answers nothing.
        if heartbeat.state.has(Flags::CLAIMING_NODE_ID) {
            self.claims.get_or_insert(nanos);
            return;
        }
        if let Some(since) = self.claims.take() {
            self.silences.push((since, nanos));
        }
        if is_committing {
            self.unconfirmed_hash = Some(heartbeat.configuration);
        } else if place == ReplayPartPosition::Before || self.hash == InitialValue::No {
            self.hash = InitialValue::Value(heartbeat.configuration);
        }
        self.measured |= place == ReplayPartPosition::In && !heartbeat.state.has(Flags::TEST_MODE);
    }

    /// Handles a report of counters. `at` is the number and time of the last joints that they cover; it is `None` if
    /// those joints came before the capture, so that it is unknown which joints the counters cover.
    pub(super) fn add_counters(&mut self, heard: ReceivedCounts, at: Option<(u64, u64)>) {
        let Some((joints, last)) = at else { return };
        if let Some((before, joints_before, from)) = self.report {
            let taken = heard.joints.wrapping_sub(before.joints);
            let repeated = heard.joints_repeated.wrapping_sub(before.joints_repeated);
            let known = u64::from(taken) + u64::from(repeated);
            let between = joints.saturating_sub(joints_before);
            // A cell cannot receive more joints than were broadcast since its start, so it had not restarted.
            if known <= between + MAX_COUNTER_DELAY_BROADCASTS as u64 {
                self.untaken += between.saturating_sub(known);
                match self.accounted.last_mut() {
                    Some((_, until)) if *until == from => *until = last,
                    _ => self.accounted.push((from, last)),
                }
            }
        }
        self.report = Some((heard, joints, last));
    }

    /// Returns true if counters account for the joints at this time, in ns since 1970, because the cell reported them
    /// before and after it. Also returns true if the capture contains no counters that account for any joints: they
    /// then explain no deviation.
    #[must_use]
    pub fn is_covered_by_counters(&self, nanos: u64) -> bool {
        !self.is_accounted || self.accounted.iter().any(|&(from, until)| from < nanos && nanos <= until)
    }

    /// Returns true if the cell was in a long silence at `nanos`, in ns since 1970.
    #[must_use]
    pub fn is_silent_at(&self, nanos: u64) -> bool {
        nanos < self.active.0 || self.silences.iter().any(|&(from, to)| (from..to).contains(&nanos))
    }
}
