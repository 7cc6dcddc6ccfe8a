//! Result of a replay: the figures of the final table and of `--summary`.
//!
//! The JSON keys are the field names; `docs/how-to/replay.md` explains them.

use std::collections::BTreeMap;

use serde::Serialize;

use super::comparator::{ReplyTally, UncomparedReplies};
use super::difference::Difference;
use super::player::BusTally;
use crate::summary::{CellError, cells_in_error, count_noun};
use protocol::quantiles::Quantiles;

/// Summary of a replay.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Path of the capture.
    pub file: String,
    /// Time in s during which frames were sent.
    pub duration_s: f64,
    /// True if a signal ended the replay.
    pub interrupted: bool,
    /// Number of frames that the buses accepted.
    pub sent: u64,
    /// Number of frames refused because a bus stayed full.
    pub refused: u64,
    /// Number of frames refused because a bus was down.
    pub lost: u64,
    /// Number of frames that were not sent, by reason.
    pub skipped: BTreeMap<&'static str, u64>,
    /// Number of frames that were sent at once because newer frames had been sent before them.
    pub sent_at_once: u64,
    /// Summary of each bus.
    pub buses: Vec<BusSummary>,
    /// Lateness of the frames in µs; `None` at full pace and in lockstep.
    pub late_us: Option<Quantiles>,
    /// Lateness of the wake-ups of the idle machine in µs.
    pub idle_late_us: Option<Quantiles>,
    /// Time in µs before a frame is due during which the thread spins.
    pub spin_us: f64,
    /// True if the machine granted SCHED_FIFO.
    pub fifo: bool,
    /// True if the memory was locked.
    pub memory_locked: bool,
    /// Result of lockstep, if used.
    pub lockstep: Option<LockstepResult>,
    /// Result of the comparison, if any.
    pub expect: Option<ReplyComparison>,
    /// Errors that ended processes of cells.
    pub cell_errors: Vec<CellError>,
    /// Error that ended the replay early, if any.
    pub failure: Option<String>,
}

/// Summary of one bus.
#[derive(Clone, Debug, Serialize)]
pub struct BusSummary {
    /// Name in the capture.
    pub capture: String,
    /// Name of the bus in this replay.
    pub name: String,
    /// Transport of the frames.
    pub kind: String,
    /// Counts of sent and refused frames.
    #[serde(flatten)]
    pub frames: BusTally,
    /// Number of replies lost because they arrived faster than this program read them.
    pub unheard: u64,
}

/// Result of lockstep.
#[derive(Clone, Debug, Default, Serialize)]
pub struct LockstepResult {
    /// Cells that did not answer in time, as text.
    pub silent_cells: Vec<String>,
    /// Number of joints that were resent because a cell processed them too late to answer.
    pub retried: u64,
}

/// Result of the comparison with recorded replies.
#[derive(Clone, Debug, Serialize)]
pub struct ReplyComparison {
    /// Tolerance of torques in steps.
    pub tolerance: u16,
    /// Counts of the comparison.
    #[serde(flatten)]
    pub tally: ReplyTally,
    /// Number of joints that cells processed too late to reply, by their own counters.
    pub joints_skipped: u64,
    /// Number of frames that the recorder reported as lost. Inputs among them cannot be sent.
    pub recording_dropped: u64,
    /// Number of cells whose recorded configuration is unknown and was not compared.
    pub unchecked_cells: u64,
    /// First reply that differs from the recorded one.
    pub first: Option<Difference>,
}

impl UncomparedReplies {
    /// Returns the reasons why replies lack a recorded counterpart, with their counts, without zeros.
    #[must_use]
    pub fn reason_counts(&self) -> Vec<(&'static str, u64)> {
        nonzero_counts([
            ("the cell was silent", self.silent),
            ("the cell had not received the joints message", self.untaken),
            ("the reply was not recorded", self.unrecorded),
            ("the recording ended", self.ended),
            ("the end of a contact was sent later", self.said_later),
            ("no counters show whether the cell received the joints message", self.uncounted),
            ("the joints message was not recorded", self.joints_unrecorded),
            ("the joints message came before the replayed part", self.joints_earlier),
            ("the configure command came before the replayed part", self.requested_earlier),
            ("the cell used its own sensors", self.measured),
            ("unrequested sensor pages were sent after other joints messages", self.sensed_otherwise),
            ("the cell missed its slot", self.slot_skipped),
            ("a cell was changing its parent", self.parent_changing),
            ("a cell had not reported its parent", self.tree_unknown),
            ("a sum did not contain the sum of a child", self.sums_not_taken),
        ])
    }
}

/// Returns the counts other than 0.
fn nonzero_counts<const N: usize>(counts: [(&'static str, u64); N]) -> Vec<(&'static str, u64)> {
    counts.into_iter().filter(|(_, count)| *count > 0).collect()
}

impl Summary {
    /// Returns true if torques of cells differ from the recorded ones.
    pub(super) fn has_other_torque_words(&self) -> bool {
        let tally = self.expect.as_ref().map(|expect| &expect.tally);
        !self.interrupted && tally.is_some_and(|tally| tally.different > 0 && tally.torque_words.max > 0)
    }

    /// Returns true if fewer replies differ from the recorded ones than in another replay of the same capture. A replay
    /// that did not reach its end has not compared all of them, and counts as no better.
    pub(super) fn differs_less_than(&self, other: &Self) -> bool {
        let different = |it: &Self| it.expect.as_ref().map_or(u64::MAX, |expect| expect.tally.different);
        !self.interrupted && self.failure.is_none() && different(self) < different(other)
    }

    /// Returns the reason why the replay failed, in one line, or `None` for success. Reasons that processes gave for
    /// errors of cells are repeated only if `quiet`, because they have been printed otherwise.
    #[must_use]
    pub fn failure_reason(&self, quiet: bool) -> Option<String> {
        if let Some(failure) = &self.failure {
            return Some(failure.clone());
        }
        let mut wrong: Vec<_> = cells_in_error(&self.cell_errors, quiet).into_iter().collect();
        let compares_nothing =
            |expect: &ReplyComparison| expect.tally.equal == 0 && expect.tally.has_only_equal_replies();
        if self.expect.as_ref().is_some_and(compares_nothing) && !self.interrupted {
            wrong.push("no reply was compared: replay a part in which cells answer".to_owned());
        }
        if let Some(expect) = self.expect.as_ref().filter(|expect| !expect.tally.has_only_equal_replies()) {
            let ReplyTally { different, missing, extra, not_requested, .. } = expect.tally;
            let counts = nonzero_counts([
                ("different", different),
                ("missing", missing),
                ("extra", extra),
                ("not requested", not_requested),
            ]);
            let counts: Vec<_> = counts.iter().map(|(what, count)| format!("{count} {what}")).collect();
            if !counts.is_empty() {
                let by = expect.tally.torque_words.max;
                let by = if by > expect.tolerance.into() {
                    format!(", torque words differ by up to {by} steps (--tolerance {})", expect.tolerance)
                } else {
                    String::new()
                };
                wrong.push(format!("replies differ from the recorded ones: {}{by}", counts.join(", ")));
            }
            if expect.tally.lacks_known_trees() {
                wrong.push(
                    "no sum could be compared: cells did not report their parents in the recording or in this replay"
                        .to_owned(),
                );
            }
            if expect.joints_skipped > 0 && self.lockstep.is_none() {
                wrong.push(format!(
                    "cells skipped joints messages {} because they received them too late: use --lockstep to wait for \
                     the cells",
                    count_noun(expect.joints_skipped, "time", "times")
                ));
            }
        }
        if let Some(lockstep) = self.lockstep.as_ref().filter(|lockstep| !lockstep.silent_cells.is_empty()) {
            wrong.push(format!("cells did not answer: {}", lockstep.silent_cells.join(", ")));
        }
        if self.lost > 0 {
            let were = if self.lost == 1 { "was" } else { "were" };
            let frames = count_noun(self.lost, "frame", "frames");
            wrong.push(format!("{frames} {were} lost while a bus was down"));
        }
        if self.refused > 0 {
            let were = if self.refused == 1 { "was" } else { "were" };
            let frames = count_noun(self.refused, "frame", "frames");
            wrong.push(format!("{frames} {were} refused: a bus stayed full"));
        }
        (!wrong.is_empty()).then(|| wrong.join("; "))
    }

    /// Returns the result in one line, and true if everything was sent, everything was compared, and all replies are
    /// equal.
    #[must_use]
    pub fn result_line(&self) -> (bool, String) {
        let until = if self.interrupted { " until the replay was interrupted" } else { "" };
        let sent = format!("{} sent", count_noun(self.sent, "frame", "frames"));
        match (self.failure_reason(true), &self.expect) {
            (Some(why), _) => (false, format!("problems: {why}")),
            (None, None) => (false, format!("all sent{until}: {sent}; use --expect to compare the replies")),
            (None, Some(expect)) if expect.tally.equal == 0 => {
                (false, format!("problems: no reply was compared, {sent}"))
            }
            (None, Some(expect)) => {
                let equal = format!("{} as recorded", count_noun(expect.tally.equal, "reply", "replies"));
                let lacking =
                    expect.tally.lacking.reason_counts().iter().map(|(_, count)| count).sum::<u64>();
                let unread = self.buses.iter().map(|bus| bus.unheard).sum();
                let unchecked = [
                    (lacking, count_noun(lacking, "reply not compared", "replies not compared")),
                    (unread, count_noun(unread, "reply not read in time", "replies not read in time")),
                    (
                        expect.recording_dropped,
                        count_noun(
                            expect.recording_dropped,
                            "frame not in the recording",
                            "frames not in the recording",
                        ),
                    ),
                    (
                        expect.unchecked_cells,
                        count_noun(expect.unchecked_cells, "configuration unknown", "configurations unknown"),
                    ),
                ];
                let unchecked = unchecked.into_iter().filter(|(count, _)| *count > 0).map(|(_, text)| text);
                let unchecked: Vec<_> = unchecked.collect();
                if unchecked.is_empty() {
                    return (true, format!("all well{until}: {sent}, {equal}"));
                }
                (false, format!("no difference{until}: {sent}, {equal}, {}", unchecked.join(", ")))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Builds the summary of a replay of 100 frames whose 40 replies are as recorded.
    fn well() -> Summary {
        Summary {
            file: "run.log".to_owned(),
            duration_s: 1.0,
            interrupted: false,
            sent: 100,
            refused: 0,
            lost: 0,
            skipped: BTreeMap::new(),
            sent_at_once: 0,
            buses: Vec::new(),
            late_us: None,
            idle_late_us: None,
            spin_us: 0.0,
            fifo: true,
            memory_locked: true,
            lockstep: None,
            expect: Some(ReplyComparison {
                tolerance: 0,
                tally: ReplyTally { equal: 40, ..ReplyTally::default() },
                joints_skipped: 0,
                recording_dropped: 0,
                unchecked_cells: 0,
                first: None,
            }),
            cell_errors: Vec::new(),
            failure: None,
        }
    }

    #[test]
    fn the_first_line_is_well_only_if_everything_was_compared() {
        let line = |change: fn(&mut Summary, &mut ReplyComparison)| {
            let mut summary = well();
            let mut expect = summary.expect.take().unwrap();
            change(&mut summary, &mut expect);
            summary.expect = Some(expect);
            summary.result_line()
        };
        assert_eq!(line(|_, _| {}), (true, "all well: 100 frames sent, 40 replies as recorded".to_owned()));
        let interrupted = line(|it, _| it.interrupted = true);
        assert!(interrupted.0 && interrupted.1.starts_with("all well until the replay was interrupted: "));
        for (change, begin) in [
            (
                (|_, expect| expect.tally.lacking.ended = 1) as fn(&mut Summary, &mut ReplyComparison),
                "no difference: 100 frames sent, 40 replies as recorded, 1 reply not compared",
            ),
            (|_, expect| expect.recording_dropped = 2, "no difference: "),
            (|_, expect| expect.unchecked_cells = 1, "no difference: "),
            (|_, expect| expect.tally.equal = 0, "problems: no reply was compared: "),
            (
                |_, expect| expect.tally.different = 3,
                "problems: replies differ from the recorded ones: 3 different",
            ),
            (|it, _| it.refused = 1, "problems: 1 frame was refused"),
            (|it, _| it.failure = Some("no bus".to_owned()), "problems: no bus"),
        ] {
            let (is_well, text) = line(change);
            assert!(!is_well && text.starts_with(begin), "{text}");
        }
        let sent = Summary { expect: None, ..well() }.result_line();
        assert_eq!(
            sent,
            (false, "all sent: 100 frames sent; use --expect to compare the replies".to_owned())
        );
    }

    #[test]
    fn every_reason_has_a_text() {
        let all = UncomparedReplies {
            silent: 1,
            untaken: 1,
            unrecorded: 1,
            ended: 1,
            said_later: 1,
            uncounted: 1,
            joints_unrecorded: 1,
            joints_earlier: 1,
            requested_earlier: 1,
            measured: 1,
            sensed_otherwise: 1,
            slot_skipped: 1,
            parent_changing: 1,
            tree_unknown: 1,
            sums_not_taken: 1,
        };
        assert_eq!(all.reason_counts().len(), size_of::<UncomparedReplies>() / size_of::<u64>());
    }
}
