//! Compares complete rounds with the recording.

use std::collections::BTreeSet;

use protocol::id::CellId;
use protocol::packet::Words;

use super::bus_comparator::{BusComparator, JointsRound, KnownCell, RecordedAndNow};
use super::states::contact::{self, ReplayedContactEnd};
use super::sums::{EpochSums, MAX_ROUNDING_STEPS, OmitReason, SumComparison, compare};
use super::tally::UncomparedReplies;
use super::{Comparator, FirstDifference, ReplyTally};
use crate::replay::difference::{DifferenceKind, ReplyKind, SentValue};

impl Comparator {
    pub(super) fn close_round(&mut self, index: usize) {
        let Self { buses: bus_comparators, tolerance, tally, first, .. } = self;
        let Some(bus_comparator) = bus_comparators.get_mut(index) else { return };
        let Some(round) = bus_comparator.rounds.pop_front() else { return };
        let number = bus_comparator.base;
        bus_comparator.base += 1;
        let Some(tolerance) = tolerance.filter(|_| round.sending.is_announced()) else { return };
        if round.is_first {
            for known_cell in bus_comparator.known.values_mut() {
                known_cell.contact = known_cell.contact.next(contact::RecordedTorque::PassBegins);
            }
        }
        let at = Some((number, round.epoch, round.nanos));
        for (&(cell, what), &pair) in &round.replies {
            if let Some(how) =
                bus_comparator.compare_reply(number, &round, (cell, what), pair, (tally, tolerance))
            {
                tally.count_difference(how, round.sending.is_unsent());
                let said = [pair.recorded, pair.now].map(|words| Some(SentValue::Words(what, words?)));
                first.keep_first_difference(how, bus_comparator.name_and_units(), cell, at, said);
            }
        }
        if !round.sums.recorded.is_empty() || !round.sums.now.is_empty() {
            bus_comparator.compare_sums(number, &round, (tally, tolerance), first);
        }
        bus_comparator.trees.recorded.forget_changes_before(number);
        bus_comparator.trees.now.forget_changes_before(number);
    }
}

impl BusComparator {
    /// Compares a reply to joints with the recorded one. Returns the difference, unless the recording explains it.
    fn compare_reply(
        &mut self,
        number: u64,
        round: &JointsRound,
        (cell, what): (CellId, ReplyKind),
        RecordedAndNow { recorded, now }: RecordedAndNow<Option<Words>>,
        (tally, tolerance): (&mut ReplyTally, u16),
    ) -> Option<DifferenceKind> {
        let (is_last, begins_later) = (self.last_round == Some(number), self.has_earlier_messages());
        let is_torque = what == ReplyKind::Torque;
        let mut known_cell = self.known.get_mut(&cell);
        let contact = known_cell.as_ref().map(|known_cell| known_cell.contact).unwrap_or_default();
        if let (Some(known_cell), Some(recorded), true) = (&mut known_cell, recorded, is_torque) {
            let is_end = recorded.is_zero();
            let input = if is_end { contact::RecordedTorque::End } else { contact::RecordedTorque::Torque };
            known_cell.contact = contact.next(input);
        }
        match (recorded, now) {
            (None, None) => None,
            (Some(recorded), Some(now)) => {
                if let Some(known_cell) = known_cell.filter(|_| is_torque) {
                    known_cell.end = known_cell.end.next(contact::RoundTorques::Both);
                }
                let is_equal = match what {
                    ReplyKind::Torque => tally.compare_torque(&recorded, &now, tolerance),
                    ReplyKind::Sensors(_) => recorded == now,
                };
                tally.equal += u64::from(is_equal);
                (!is_equal).then_some(DifferenceKind::Different)
            }
            (Some(_), None) if !is_torque && self.sends_unrequested_sensors => {
                tally.lacking.sensed_otherwise += 1;
                None
            }
            (Some(_), None) if round.sending.is_unsent() => Some(DifferenceKind::Missing),
            (Some(recorded), None) => {
                let is_end = is_torque && recorded.is_zero();
                // The cell had not received the joints at which the contact ended.
                let was_over = contact.was_over_before_late_end(begins_later, round.may_answer(cell));
                let is_later = |known_cell: &&mut KnownCell| {
                    let was_over = was_over && !known_cell.cell.is_covered_by_counters(round.nanos);
                    is_end && (known_cell.end == ReplayedContactEnd::Earlier || was_over)
                };
                let Some(known_cell) = known_cell.filter(is_later) else {
                    return Some(DifferenceKind::Missing);
                };
                known_cell.end = known_cell.end.next(contact::RoundTorques::LateEnd);
                tally.lacking.said_later += 1;
                None
            }
            // This replay may have requested the report itself.
            (None, Some(now)) => {
                let counts = is_torque
                    && !explain_extra_reply(
                        &mut tally.lacking,
                        known_cell,
                        (cell, round),
                        is_last,
                        now.is_zero(),
                    );
                counts.then_some(DifferenceKind::Extra)
            }
        }
    }

    /// Compares each cell's own contribution to the sums of a round.
    fn compare_sums(
        &mut self,
        number: u64,
        round: &JointsRound,
        (tally, tolerance): (&mut ReplyTally, u16),
        first: &mut FirstDifference,
    ) {
        let then = EpochSums::new(&round.sums.recorded, &self.trees.recorded, number);
        let now = EpochSums::new(&round.sums.now, &self.trees.now, number);
        let cells: BTreeSet<_> = round.sums.recorded.cells().chain(round.sums.now.cells()).collect();
        let is_last = self.last_round == Some(number);
        for cell in cells {
            let known_cell = self.known.get_mut(&cell);
            let lacking = &mut tally.lacking;
            if known_cell.as_ref().is_some_and(|known_cell| known_cell.cell.measured) {
                lacking.measured += u64::from(round.sums.recorded.contains_cell(cell));
                continue;
            }
            let mut outcome = compare(&then, &now, cell, tolerance, self.units.torque_format());
            let is_touched = round.is_touched(cell);
            let is_doubtful = || {
                then.is_contribution_impossible(cell, is_touched, false)
                    || round.sending.is_repeated() && now.is_contribution_impossible(cell, is_touched, true)
            };
            if matches!(outcome, SumComparison::Different | SumComparison::Missing | SumComparison::Extra)
                && is_doubtful()
            {
                outcome = SumComparison::Omitted(OmitReason::NotTaken);
            }
            let owns = [then.own_contribution(cell), now.own_contribution(cell)];
            if let ([Some(then), Some(now)], SumComparison::Equal | SumComparison::Different) =
                (&owns, outcome)
            {
                let max = tally.sum_words.count_step_differences(then.step_differences(now));
                tally.tolerated += u64::from(outcome == SumComparison::Equal && max > MAX_ROUNDING_STEPS);
            }
            let how = match outcome {
                SumComparison::Nothing => continue,
                SumComparison::Equal => {
                    tally.equal += 1;
                    tally.sums += 1;
                    continue;
                }
                SumComparison::Omitted(why) => {
                    *match why {
                        _ if round.sending.is_unsent() => &mut tally.not_requested,
                        OmitReason::Changing => &mut lacking.parent_changing,
                        OmitReason::Unknown => &mut lacking.tree_unknown,
                        OmitReason::NotTaken => &mut lacking.sums_not_taken,
                    } += 1;
                    continue;
                }
                SumComparison::Different => DifferenceKind::Different,
                SumComparison::Missing => DifferenceKind::Missing,
                // The cell had to send again or end its contact then, but missed its slot.
                SumComparison::Extra if self.contributing.contains(&cell) => {
                    lacking.slot_skipped += 1;
                    continue;
                }
                // Only a torque's words show that a contact has ended; a sum does not.
                SumComparison::Extra
                    if explain_extra_reply(lacking, known_cell, (cell, round), is_last, false) =>
                {
                    continue;
                }
                SumComparison::Extra => DifferenceKind::Extra,
            };
            tally.count_difference(how, round.sending.is_unsent());
            let said = owns.map(|own| own.map(SentValue::Sum));
            first.keep_first_difference(
                how,
                self.name_and_units(),
                cell,
                Some((number, round.epoch, round.nanos)),
                said,
            );
        }
        for (cell, count) in round.sums.recorded.contributor_counts() {
            if count > 0 {
                self.contributing.insert(cell);
            } else {
                self.contributing.remove(&cell);
            }
        }
    }

    /// Compares the answers to `configure` with the recorded ones, in order.
    pub(super) fn compare_answers(&mut self, tally: &mut ReplyTally, first: &mut FirstDifference) {
        for (cell, mut answers) in std::mem::take(&mut self.answers) {
            loop {
                let known_cell = self.known.get_mut(&cell);
                let next = answers.recorded.front().map(|(_, tag, _)| *tag);
                if let Some((tag, _)) = answers.now.front().copied().filter(|(tag, _)| Some(*tag) != next)
                    && answers.explain_extra_answer(&mut tally.lacking, known_cell, tag, self.base)
                {
                    answers.now.pop_front();
                    continue;
                }
                let recorded = answers.recorded.pop_front().map(|(_, tag, answer)| (tag, answer));
                let now = answers.now.pop_front();
                let how = match (recorded, now) {
                    (None, None) => break,
                    (Some(recorded), Some(now)) if recorded == now => {
                        tally.equal += 1;
                        continue;
                    }
                    (Some(_), Some(_)) => DifferenceKind::Different,
                    (Some(_), None) => DifferenceKind::Missing,
                    (None, Some(_)) => DifferenceKind::Extra,
                };
                tally.count_difference(how, false);
                let said =
                    [recorded, now].map(|said| said.map(|(tag, answer)| SentValue::Answer(tag, answer)));
                first.keep_first_difference(how, self.name_and_units(), cell, None, said);
            }
        }
    }
}

/// Returns true if the recording explains why it lacks this reply, and counts the reason.
fn explain_extra_reply(
    lacking: &mut UncomparedReplies,
    known_cell: Option<&mut KnownCell>,
    (cell, round): (CellId, &JointsRound),
    is_last: bool,
    is_end: bool,
) -> bool {
    // After an apparent restart, the cell's contact state is unknown: the contact may continue.
    let is_free = round.touched.iter().all(|touched| touched.in_contact(cell) == Some(false));
    let Some(known_cell) = known_cell else {
        // The recording lacks this cell altogether.
        lacking.silent += 1;
        return true;
    };
    let cell = &mut known_cell.cell;
    if cell.measured {
        return true;
    }
    let is_counted = cell.is_covered_by_counters(round.nanos);
    if cell.is_silent_at(round.nanos) {
        lacking.silent += 1;
    } else if is_last && !is_counted {
        lacking.ended += 1;
    } else if !is_free && !is_counted {
        lacking.uncounted += 1;
    } else if cell.untaken > 0 {
        cell.untaken -= 1;
        lacking.untaken += 1;
    } else if cell.unrecorded > 0 {
        cell.unrecorded -= 1;
        lacking.unrecorded += 1;
    } else if is_last {
        lacking.ended += 1;
    } else {
        return false;
    }
    // Counters show how many messages are missing, but not which: the end may have been sent later.
    known_cell.end = known_cell.end.next(contact::RoundTorques::Extra { is_end });
    true
}
