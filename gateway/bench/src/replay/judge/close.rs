//! Compares what has come with what was recorded, when all of it has come.

use std::collections::BTreeSet;

use protocol::packet::WORDS;

use super::lane::{Excuse, Fate, Pair, Round, excuse_extra};
use super::sums::{Outcome, Side, Why, compare};
use super::{Judge, Tally};
use crate::replay::difference::{How, Said, What};

impl Judge {
    pub(super) fn close_round(&mut self, index: usize) {
        let Some(lane) = self.lanes.get_mut(index) else { return };
        let Some(round) = lane.rounds.pop_front() else { return };
        let number = lane.base;
        lane.base += 1;
        if !self.expects || round.fate == Fate::Waiting {
            return;
        }
        let (is_last, begins_later) = (lane.last_round == Some(number), lane.begins_later());
        let at = Some((number, round.epoch, round.nanos));
        if round.is_first {
            lane.excuses.values_mut().for_each(|excuse| excuse.speaks = None);
        }
        for ((cell, what), &Pair { recorded, now }) in &round.replies {
            let (cell, what) = (*cell, *what);
            let Some(lane) = self.lanes.get_mut(index) else { return };
            let mut excuse = lane.excuses.get_mut(&cell);
            let spoke = excuse.as_ref().and_then(|excuse| excuse.speaks);
            if let (Some(excuse), Some(recorded), What::Torque) = (&mut excuse, recorded, what) {
                excuse.speaks = Some(recorded != [0; WORDS]);
            }
            let said = Said::Words { what, recorded, now };
            let how = match (recorded, now) {
                (None, None) => continue,
                (Some(recorded), Some(now)) => {
                    if let (Some(excuse), What::Torque) = (excuse, what) {
                        excuse.ended_earlier = false;
                    }
                    if recorded == now {
                        self.tally.equal += 1;
                        continue;
                    }
                    self.tally.different += 1;
                    How::Different
                }
                (Some(_), None) if what != What::Torque && lane.senses => {
                    self.tally.lacking.sensed_otherwise += 1;
                    continue;
                }
                (Some(_), None) if round.fate == Fate::Unsent => {
                    self.tally.not_asked += 1;
                    How::Missing
                }
                (Some(recorded), None) => {
                    let is_end = what == What::Torque && recorded == [0; WORDS];
                    // What was over before, by what was sent, or began before the part: the cell had not taken the
                    // joints at which it ended.
                    let was_over = match spoke {
                        Some(spoke) => spoke && !round.may_answer(cell),
                        None => begins_later,
                    };
                    let is_later = |excuse: &&mut Excuse| {
                        let was_over = was_over && !excuse.cell.is_counted_at(round.nanos);
                        is_end && (excuse.ended_earlier || was_over)
                    };
                    if let Some(excuse) = excuse.filter(is_later) {
                        excuse.ended_earlier = false;
                        self.tally.lacking.said_later += 1;
                        continue;
                    }
                    self.tally.missing += 1;
                    How::Missing
                }
                // Reports may be asked for by this replay.
                (None, Some(_)) if what != What::Torque => continue,
                (None, Some(now)) => {
                    if excuse_extra(&mut self.tally.lacking, excuse, (cell, &round), is_last, now) {
                        continue;
                    }
                    self.tally.extra += 1;
                    How::Extra
                }
            };
            self.note(index, how, cell, at, said);
        }
        if !round.sums.recorded.is_empty() || !round.sums.now.is_empty() {
            self.close_sums(index, number, &round);
        }
        if let Some(lane) = self.lanes.get_mut(index) {
            lane.trees.recorded.forget_before(number);
            lane.trees.now.forget_before(number);
        }
    }

    /// Compares what each cell itself put into its sums of a round.
    fn close_sums(&mut self, index: usize, number: u64, round: &Round) {
        let Some(lane) = self.lanes.get_mut(index) else { return };
        let then = Side::new(&round.sums.recorded, &lane.trees.recorded, number);
        let now = Side::new(&round.sums.now, &lane.trees.now, number);
        let cells: BTreeSet<_> = round.sums.recorded.cells().chain(round.sums.now.cells()).collect();
        let is_last = lane.last_round == Some(number);
        let mut notes = Vec::new();
        for cell in cells {
            let excuse = lane.excuses.get_mut(&cell);
            let Tally { different, missing, extra, not_asked, lacking, .. } = &mut self.tally;
            if excuse.as_ref().is_some_and(|excuse| excuse.cell.measured) {
                lacking.measured += u64::from(round.sums.recorded.has(cell));
                continue;
            }
            let mut outcome = compare(&then, &now, cell);
            let is_touched = round.is_touched(cell);
            let is_doubtful = || {
                then.is_doubtful(cell, is_touched, false)
                    || round.asked > 1 && now.is_doubtful(cell, is_touched, true)
            };
            if matches!(outcome, Outcome::Different | Outcome::Missing | Outcome::Extra) && is_doubtful() {
                outcome = Outcome::LeftOut(Why::NotTaken);
            }
            let (count, how) = match outcome {
                Outcome::Nothing => continue,
                Outcome::Equal => {
                    self.tally.equal += 1;
                    self.tally.sums += 1;
                    continue;
                }
                Outcome::Missing if round.fate == Fate::Unsent => (not_asked, How::Missing),
                Outcome::LeftOut(_) if round.fate == Fate::Unsent => {
                    *not_asked += 1;
                    continue;
                }
                Outcome::LeftOut(why) => {
                    *match why {
                        Why::Changing => &mut lacking.parent_changing,
                        Why::Unknown => &mut lacking.tree_unknown,
                        Why::NotTaken => &mut lacking.sums_not_taken,
                    } += 1;
                    continue;
                }
                Outcome::Different => (different, How::Different),
                Outcome::Missing => (missing, How::Missing),
                // It had to go on then, or to say the end: it did not come to its slot in time.
                Outcome::Extra if lane.speaking.contains(&cell) => {
                    lacking.slot_missed += 1;
                    continue;
                }
                // The words only say whether a contact has ended, which a sum does not tell.
                Outcome::Extra if excuse_extra(lacking, excuse, (cell, round), is_last, [1; WORDS]) => {
                    continue;
                }
                Outcome::Extra => (extra, How::Extra),
            };
            *count += 1;
            notes.push((how, cell, Said::Sums { recorded: then.own(cell), now: now.own(cell) }));
        }
        for (cell, count) in round.sums.recorded.counts() {
            if count > 0 {
                lane.speaking.insert(cell);
            } else {
                lane.speaking.remove(&cell);
            }
        }
        for (how, cell, said) in notes {
            self.note(index, how, cell, Some((number, round.epoch, round.nanos)), said);
        }
    }

    /// Compares the answers to `configure`, in their order.
    pub(super) fn close_answers(&mut self, index: usize) {
        let Some(lane) = self.lanes.get_mut(index) else { return };
        let (rounds, mut differences) = (lane.base, Vec::new());
        for (cell, mut answers) in std::mem::take(&mut lane.answers) {
            loop {
                let excuse = lane.excuses.get_mut(&cell);
                let next = answers.recorded.front().map(|(_, tag, _)| *tag);
                if let Some((tag, _)) = answers.now.front().copied().filter(|(tag, _)| Some(*tag) != next)
                    && answers.excuse_extra(&mut self.tally.lacking, excuse, tag, rounds)
                {
                    answers.now.pop_front();
                    continue;
                }
                let recorded = answers.recorded.pop_front().map(|(_, tag, answer)| (tag, answer));
                let now = answers.now.pop_front();
                let (count, how) = match (recorded, now) {
                    (None, None) => break,
                    (Some(recorded), Some(now)) if recorded == now => {
                        self.tally.equal += 1;
                        continue;
                    }
                    (Some(_), Some(_)) => (&mut self.tally.different, How::Different),
                    (Some(_), None) => (&mut self.tally.missing, How::Missing),
                    (None, Some(_)) => (&mut self.tally.extra, How::Extra),
                };
                *count += 1;
                differences.push((how, cell, Said::Answers { recorded, now }));
            }
        }
        for (how, cell, said) in differences {
            self.note(index, how, cell, None, said);
        }
    }
}
