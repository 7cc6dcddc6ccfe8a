//! Which cell has a node id, and whether a heartbeat is of a cell that has restarted.

use protocol::message::{Heartbeat, State};
use protocol::time::{Micros, Span};

use super::DEAD_AFTER;

/// What a heartbeat of a node id means.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Word {
    /// The first one of the cell that has the id; when it started is not known.
    First,
    /// A further one of the cell that has the id.
    Known,
    /// An old one of that cell, or its last one again: it tells nothing new.
    Overtaken,
    /// The first one since the cell started.
    Started {
        /// Whether the cell, or another one that had the id before, sent something before that.
        again: bool,
    },
    /// Of the sender that had the id before, which goes on: two use it in turn, and what seemed a start was none.
    Shared,
    /// Of another sender, while the cell that has the id is alive: after two used it in turn, or when no cell can have
    /// sent so much since that one was heard.
    Outsider,
    /// Another cell claims the id, and will give up the claim.
    Claimant,
}

/// A counter that falls back by more than this is of a cell that has restarted, not of an overtaken heartbeat.
const OVERTAKES: u16 = 128;

/// More than a cell sends until it is found dead: three packets for each of 500 joints a second are 900.
const AT_MOST: u16 = 2_048;

/// More than a cell sends between two heartbeats.
const LEAP: u16 = 256;

/// A cell whose counter goes on after so long without a heartbeat is not looked for any more.
const GONE_AFTER: Span = Span::from_millis(10_000);

/// So many heartbeats whose counter goes on show a start of which no claim was heard, on an id that two senders used.
const SHOWN_BY: u8 = 3;

/// A cell's heartbeats are a quarter of a second apart. Old ones that are sent again in the order of their counters, by
/// chance, come much sooner.
const PACE: Span = Span::from_millis(100);

/// A cell claims its id for 250 ms or longer; less 10 ms, by which a frame may have been late.
const CLAIM_TAKES: Span = Span::from_millis(240);

/// The address claim of one node id: which cell has it.
///
/// A cell is identified by its serial number. While it claims the id it yields to a cell that has it already, so a
/// claim of a settled cell's id does not change that cell's state.
///
/// A heartbeat is not signed, and old ones may be sent again. So a start is believed at once, and taken back when the
/// counter before it goes on; from then on a start is believed only of an id whose cell is silent.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Claim {
    owner: Option<Life>,
    /// The owner before the last start, or before the first one of several while it may be alive.
    before: Option<Life>,
    /// Of the last owner before it that was another cell.
    previous: Option<Heartbeat>,
    /// Two senders used the id in turn.
    is_contested: bool,
    /// Since then, who may have it when the owner is gone: the last heartbeat of those whose counter goes on, and how many.
    candidate: Option<(Life, u8)>,
}

/// A cell from one start to the next: its last heartbeat.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
struct Life {
    heartbeat: Heartbeat,
    at: Micros,
    /// When it claimed the id, if that was heard.
    claimed: Option<Micros>,
}

impl Life {
    fn is_alive(&self, at: Micros) -> bool {
        at.since(self.at) <= DEAD_AFTER
    }

    /// Whether it may go on; its bus may have been lost.
    fn may_go_on(&self, at: Micros) -> bool {
        at.since(self.at) <= GONE_AFTER
    }

    /// How many packets it has sent since its last heartbeat, if this one can be its next.
    fn sent(&self, at: Micros, heartbeat: &Heartbeat) -> Option<u16> {
        let sent = heartbeat.sent.wrapping_sub(self.heartbeat.sent);
        let is_next = self.heartbeat.serial == heartbeat.serial && self.may_go_on(at);
        (is_next && sent.cast_signed() > 0 && self.has_time_for(at, sent)).then_some(sent)
    }

    /// Whether a cell can have sent so many packets since this one's last heartbeat.
    fn has_time_for(&self, at: Micros, sent: u16) -> bool {
        u64::from(sent) <= u64::from(AT_MOST) * (1 + at.since(self.at).0 / DEAD_AFTER.0)
    }

    /// Whether a heartbeat is an old one of it, or its last one again.
    fn is_past(&self, heartbeat: &Heartbeat) -> bool {
        let back = self.heartbeat.sent.wrapping_sub(heartbeat.sent);
        let is_same = self.heartbeat.serial == heartbeat.serial;
        is_same && (back == 0 || back <= OVERTAKES && heartbeat.sent > 1)
    }

    /// Whether it still claims the id, so that a heartbeat without CLAIMING is not its.
    fn claims_until(&self, at: Micros, heartbeat: &Heartbeat) -> bool {
        let claims = |heartbeat: &Heartbeat| heartbeat.state.has(State::CLAIMING);
        let settles = claims(&self.heartbeat) && !claims(heartbeat);
        settles && self.claimed.is_some_and(|claimed| at.since(claimed) < CLAIM_TAKES)
    }
}

/// Whether it is the first packet of a cell since it started, which is a claim.
fn begins_a_life(heartbeat: &Heartbeat) -> bool {
    heartbeat.state.has(State::CLAIMING) && heartbeat.sent == 0
}

impl Claim {
    /// Takes a heartbeat of this node id, which came at `at`. This is the one place that detects a restart.
    pub fn hear(&mut self, at: Micros, heartbeat: &Heartbeat) -> Word {
        let mut word = self.word(at, heartbeat);
        if word == Word::Outsider && self.takes_over(at, heartbeat) {
            word = Word::Started { again: true };
        }
        if matches!(word, Word::Overtaken | Word::Claimant | Word::Outsider) {
            return word;
        }
        let claims = heartbeat.state.has(State::CLAIMING);
        let claimed = match self.owner {
            Some(owner) if matches!(word, Word::Known) => owner.claimed,
            Some(_) | None => claims.then_some(at),
        };
        let owner = self.owner.replace(Life { heartbeat: *heartbeat, at, claimed });
        self.candidate = None;
        match word {
            Word::Started { .. } => self.before = self.before.filter(|life| life.may_go_on(at)).or(owner),
            Word::Shared => (self.before, self.is_contested) = (None, true),
            Word::First | Word::Known | Word::Overtaken | Word::Outsider | Word::Claimant => {}
        }
        let owner = owner.map(|owner| owner.heartbeat);
        self.previous = owner.filter(|owner| owner.serial != heartbeat.serial).or(self.previous);
        word
    }

    /// Whether a start that was heard may still be taken back.
    pub(super) fn is_in_question(&self, at: Micros) -> bool {
        self.before.is_some_and(|before| before.may_go_on(at))
    }

    /// Whether a counter rather goes on where it was before the last start, by so many packets, than since then, by `sent`.
    fn is_nearer(&self, at: Micros, before: u16, sent: u16) -> bool {
        let is_alive = self.before.is_some_and(|life| life.is_alive(at));
        before < sent && (is_alive || sent > LEAP && before < sent / 8)
    }

    /// Whether an outsider has the id now: the owner is silent, and its claim was heard or its counter goes on.
    fn takes_over(&mut self, at: Micros, heartbeat: &Heartbeat) -> bool {
        let goes_on = |life: &Life| life.sent(at, heartbeat).is_some() && at.since(life.at) >= PACE;
        let before = self.candidate.filter(|(life, _)| goes_on(life));
        let shown = before.map_or(1, |(_, shown)| shown.saturating_add(1));
        self.candidate = Some((Life { heartbeat: *heartbeat, at, claimed: None }, shown));
        let is_gone = self.owner.is_none_or(|owner| !owner.is_alive(at));
        is_gone && (begins_a_life(heartbeat) || shown >= SHOWN_BY)
    }

    fn word(&self, at: Micros, heartbeat: &Heartbeat) -> Word {
        let claims = heartbeat.state.has(State::CLAIMING);
        let Some(owner) = &self.owner else {
            // A cell claims its id for half a second at most.
            return if claims { Word::Started { again: false } } else { Word::First };
        };
        let begins = if self.is_contested { Word::Outsider } else { Word::Started { again: true } };
        let of_before = self.before.and_then(|before| before.sent(at, heartbeat));
        if owner.heartbeat.serial != heartbeat.serial {
            return match (self.is_settled(), claims) {
                (_, true) => Word::Claimant,
                (true, false) if of_before.is_some() => Word::Shared,
                (true, false) => begins,
                // The claimant did not get the id.
                (false, false) => Word::First,
            };
        }
        if begins_a_life(heartbeat) {
            return begins;
        }
        if owner.is_past(heartbeat) {
            return Word::Overtaken;
        }
        // What seemed a start may have been an old one too.
        let was_before = self.before.is_some_and(|before| before.is_alive(at) && before.is_past(heartbeat));
        if was_before && owner.claimed.is_none() {
            return Word::Overtaken;
        }
        let back = owner.heartbeat.sent.wrapping_sub(heartbeat.sent);
        match (owner.sent(at, heartbeat), of_before) {
            // By the counters it can be either's.
            (Some(_), Some(_)) if owner.claims_until(at, heartbeat) => Word::Shared,
            (Some(sent), Some(before)) if owner.claimed.is_none() && self.is_nearer(at, before, sent) => {
                Word::Shared
            }
            (Some(_), _) => Word::Known,
            (None, Some(_)) => Word::Shared,
            // It was away for long, and nothing is known of it.
            (None, None) if back.cast_signed() < 0 && !owner.may_go_on(at) && !self.is_contested => {
                Word::Known
            }
            // No cell that started since then can have sent so much.
            (None, None) if !owner.has_time_for(at, heartbeat.sent) => Word::Outsider,
            (None, None) => begins,
        }
    }

    /// The last heartbeat of the cell that has the id, or is the first one to claim it.
    #[must_use]
    pub fn heartbeat(&self) -> Option<Heartbeat> {
        self.owner.map(|owner| owner.heartbeat)
    }

    /// The serial number of that cell.
    #[must_use]
    pub fn serial(&self) -> Option<u32> {
        self.heartbeat().map(|heartbeat| heartbeat.serial)
    }

    /// The serial number of the cell that had the id before that one, or claimed it.
    #[must_use]
    pub fn previous(&self) -> Option<u32> {
        self.previous.map(|owner| owner.serial)
    }

    /// Whether that cell reports this state.
    #[must_use]
    pub fn says(&self, state: State) -> bool {
        self.owner.is_some_and(|owner| owner.heartbeat.state.has(state))
    }

    /// Whether a cell has the id, and so answers.
    #[must_use]
    pub fn is_settled(&self) -> bool {
        self.owner.is_some() && !self.says(State::CLAIMING)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const AGAIN: Word = Word::Started { again: true };

    /// A heartbeat every 100 ms.
    fn words(said: &[(u32, u16, State)]) -> Vec<Word> {
        words_at(said.iter().zip(0..).map(|(&(serial, sent, state), at)| (at * 100, serial, sent, state)))
    }

    /// At times in ms.
    fn words_at(said: impl IntoIterator<Item = (u64, u32, u16, State)>) -> Vec<Word> {
        let mut claim = Claim::default();
        let hear = |(ms, serial, sent, state)| {
            claim.hear(Micros(ms * 1_000), &Heartbeat { serial, sent, state, ..Heartbeat::default() })
        };
        said.into_iter().map(hear).collect()
    }

    #[test]
    fn two_old_heartbeats_in_order_are_no_life() {
        let heard = [
            (0, 1032),
            (252, 1049),
            (375, 883),  // an old one
            (400, 1049), // another one
            (508, 1066),
            (720, 1049),
            (756, 1083),
            (964, 883),
            (1006, 1100),
        ];
        let words = |more: u16| {
            let of = |&(ms, sent): &(u64, u16)| (ms, 7, sent + more, State::default());
            words_at(heard.iter().map(of))
        };
        let known = Word::Known;
        let (old, outsider) = (Word::Overtaken, Word::Outsider);
        assert_eq!(words(0), [Word::First, known, AGAIN, old, Word::Shared, old, known, outsider, known]);
        // A cell that had started since could not have sent 2883 packets.
        assert_eq!(words(2000), [Word::First, known, outsider, old, known, old, known, outsider, known]);
    }

    #[test]
    fn old_heartbeats_in_order_do_not_take_the_id_of_a_cell_that_hangs() {
        let old = [15_611, 15_860, 15_611, 15_611, 15_727, 15_860, 15_860, 15_611, 15_727, 15_860];
        let burst = old.iter().zip(1_703..).map(|(&sent, ms)| (ms, sent));
        let own = [(0, 15_993), (1, 15_860), (2, 15_993 + 3), (227, 16_010), (686, 16_016), (995, 16_059)];
        let heard = own.into_iter().chain(burst).chain([(1_718, 16_063), (1_975, 16_123)]);
        let words = words_at(heard.map(|(ms, sent)| (ms, 7, sent, State::default())));
        let count = |of: Word| words.iter().filter(|word| **word == of).count();
        assert_eq!((count(Word::First), count(Word::Known), count(Word::Outsider)), (1, 6, 11), "{words:?}");
    }

    #[test]
    fn a_restart_is_a_claim_or_a_counter_that_falls_back() {
        let (claims, settled) = (State::CLAIMING, State::default());
        let life = [(7, 0, claims), (7, 1, settled), (7, 65_535, settled), (7, 2, settled)];
        let started = Word::Started { again: false };
        assert_eq!(words(&life), [started, Word::Known, Word::Overtaken, Word::Known]);
        assert_eq!(words(&[(7, 900, settled), (7, 0, claims)]), [Word::First, AGAIN]);
        assert_eq!(words(&[(7, 900, settled), (7, 1, settled)]), [Word::First, AGAIN], "its claim was lost");
        assert_eq!(words(&[(7, 900, settled), (7, 771, settled)]), [Word::First, AGAIN]);
        assert_eq!(words(&[(7, 900, settled), (7, 772, settled)]), [Word::First, Word::Overtaken]);
        // A cell that wins when two claim at once sends a heartbeat, still claiming.
        assert_eq!(words(&[(7, 0, claims), (7, 1, claims)]), [started, Word::Known]);
    }

    #[test]
    fn a_claimed_id_keeps_its_owner_until_the_claimant_settles() {
        let (claims, settled) = (State::CLAIMING, State::default());
        let said = [(7, 9, settled), (8, 0, claims), (7, 10, settled), (8, 1, settled), (8, 2, settled)];
        assert_eq!(words(&said), [Word::First, Word::Claimant, Word::Known, AGAIN, Word::Known]);
        let said = [(8, 0, claims), (7, 10, settled), (7, 11, settled)];
        assert_eq!(
            words(&said),
            [Word::Started { again: false }, Word::First, Word::Known],
            "it gave up the claim"
        );
    }

    #[test]
    fn two_cells_that_use_one_id_in_turn_do_not_restart_each_time() {
        let settled = State::default();
        let said = [(7, 90, settled), (9, 40, settled), (7, 91, settled), (9, 41, settled), (9, 42, settled)];
        assert_eq!(words(&said), [Word::First, AGAIN, Word::Shared, Word::Outsider, Word::Outsider]);
    }

    #[test]
    fn old_heartbeats_that_are_sent_again_take_a_living_cells_id_once_at_most() {
        let (claims, settled) = (State::CLAIMING, State::default());
        let (shared, outsider, known) = (Word::Shared, Word::Outsider, Word::Known);
        // Its own counter is at 900, an old one at 100.
        let said =
            [(0, 7, 900, settled), (50, 7, 100, settled), (250, 7, 916, settled), (300, 7, 116, settled)];
        assert_eq!(words_at(said), [Word::First, AGAIN, shared, outsider]);
        // Two old ones before its next one, then a start.
        let said = [
            (0, 7, 900, settled),
            (10, 7, 100, settled),
            (200, 7, 116, settled),
            (250, 7, 916, settled),
            (260, 7, 0, claims),
            (490, 7, 1, settled),
            (500, 7, 932, settled),
        ];
        let expected = [Word::First, AGAIN, known, shared, outsider, outsider, known];
        assert_eq!(words_at(said), expected);
        // A claim of a cell that has hardly sent anything: its next heartbeat comes before the claim can end.
        let said = [(0, 7, 9, settled), (60, 7, 0, claims), (250, 7, 12, settled)];
        assert_eq!(words_at(said), [Word::First, AGAIN, shared]);
        // A counter that is ahead.
        let said =
            [(0, 7, 900, settled), (10, 7, 9_000, settled), (250, 7, 916, settled), (260, 7, 9_020, settled)];
        assert_eq!(words_at(said), [Word::First, outsider, known, outsider]);
        // The cell is gone; whoever has its id then is believed.
        let said = [(0, 7, 900, settled), (10, 7, 100, settled), (250, 7, 916, settled), (900, 7, 0, claims)];
        assert_eq!(words_at(said), [Word::First, AGAIN, shared, AGAIN]);
    }

    #[test]
    fn a_cell_whose_bus_was_lost_goes_on_whatever_is_sent_again_meanwhile() {
        let (claims, settled) = (State::CLAIMING, State::default());
        let (shared, outsider, known) = (Word::Shared, Word::Outsider, Word::Known);
        // Its id was contested before the bus was lost, or was not.
        let said = [(0, 7, 916, settled), (10, 7, 100, settled), (250, 7, 932, settled)];
        let meanwhile = [(1_200, 7, 100, settled), (1_250, 7, 116, settled), (1_300, 7, 100, settled)];
        let after = [(1_750, 7, 940, settled), (2_000, 7, 956, settled)];
        let expected = [Word::First, AGAIN, shared, outsider, outsider, outsider, known, known];
        assert_eq!(words_at(said.into_iter().chain(meanwhile).chain(after)), expected);
        let expected = [Word::First, AGAIN, known, Word::Overtaken, shared, known];
        assert_eq!(words_at([said[0]].into_iter().chain(meanwhile).chain(after)), expected);
        // A cell that restarts with a contested id: its claim is heard while it seems alive, or later, or never.
        let starts =
            [(400, 7, 0, claims), (660, 7, 1, settled), (910, 7, 4, settled), (1_160, 7, 8, settled)];
        let expected = [Word::First, AGAIN, shared, outsider, outsider, AGAIN, known];
        assert_eq!(words_at(said.into_iter().chain(starts)), expected);
        let later = [(900, 7, 0, claims), (1_160, 7, 1, settled)];
        assert_eq!(words_at(said.into_iter().chain(later)), [Word::First, AGAIN, shared, AGAIN, known]);
    }

    #[test]
    fn a_quick_restart_is_not_taken_for_an_old_heartbeat() {
        let (claims, settled) = (State::CLAIMING, State::default());
        for sent in [1, 2, 9, 300] {
            let said = [
                (0, 7, sent, settled),
                (100, 7, 0, claims),
                (360, 7, 1, settled),
                (610, 7, sent + 1, settled),
            ];
            assert_eq!(words_at(said), [Word::First, AGAIN, Word::Known, Word::Known], "{sent}");
        }
        // A cell that has been away for long.
        assert_eq!(
            words_at([(0, 7, 900, settled), (60_000, 7, 30_000, settled)]),
            [Word::First, Word::Known]
        );
    }

    #[test]
    fn the_cell_that_had_the_id_before_is_remembered() {
        let mut claim = Claim::default();
        let mut sent = 0;
        let mut hear = |serial, state| {
            claim.hear(Micros(0), &Heartbeat { serial, state, sent, ..Heartbeat::default() });
            sent += 1;
            (claim.serial(), claim.previous(), claim.is_settled())
        };
        let (claims, settled) = (State::CLAIMING, State::default());
        assert_eq!(hear(7, claims), (Some(7), None, false));
        assert_eq!(hear(7, settled), (Some(7), None, true));
        assert_eq!(hear(8, claims), (Some(7), None, true));
        assert_eq!(hear(8, settled), (Some(8), Some(7), true));
        assert_eq!(hear(8, settled), (Some(8), Some(7), true));
        assert_eq!(hear(7, settled), (Some(7), Some(8), true));
    }
}
