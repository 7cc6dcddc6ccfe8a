//! The result of a replay: the figures of the table at its end, and of `--summary`.
//!
//! The keys of the JSON are the names of the fields here; `docs/how-to/replay.md` explains them.

use std::collections::BTreeMap;

use serde::Serialize;

use super::comparator::{Lacking, Tally};
use super::difference::Difference;
use super::player::BusLinkTally;
use crate::summary::{CellError, cells_in_error, many};
use model::quantiles::Quantiles;

/// A whole replay.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// The capture's file.
    pub file: String,
    /// How long frames were sent, in s.
    pub duration_s: f64,
    /// Whether it was ended by a signal.
    pub interrupted: bool,
    /// Frames that the buses took.
    pub sent: u64,
    /// Frames that they did not take, because they stayed full.
    pub refused: u64,
    /// Frames that they did not take, because they were down.
    pub lost: u64,
    /// Frames that were not to be sent, by reason.
    pub skipped: BTreeMap<&'static str, u64>,
    /// Frames that were sent at once, because newer ones had been sent before them.
    pub sent_at_once: u64,
    /// Each bus.
    pub buses: Vec<BusSummary>,
    /// How late frames were sent; none of a replay without times, nor of lockstep.
    pub late_us: Option<Quantiles>,
    /// How late the same machine wakes a thread when nothing else runs.
    pub idle_late_us: Option<Quantiles>,
    /// How long before its time a frame was waited for by spinning, in µs.
    pub spin_us: f64,
    /// Whether the machine granted SCHED_FIFO.
    pub fifo: bool,
    /// Whether it locked the memory.
    pub memory_locked: bool,
    /// With lockstep, the cells that did not answer.
    pub lockstep: Option<Lockstep>,
    /// With a comparison, its result.
    pub expect: Option<Expect>,
    /// Errors by which processes of cells ended.
    pub cell_errors: Vec<CellError>,
    /// Why it did not come to its end, if it did not.
    pub failure: Option<String>,
}

/// One bus.
#[derive(Clone, Debug, Serialize)]
pub struct BusSummary {
    /// Its name in the capture.
    pub capture: String,
    /// Its name now.
    pub name: String,
    /// What carries its frames.
    pub kind: String,
    /// Its frames.
    #[serde(flatten)]
    pub frames: BusLinkTally,
    /// Replies that came faster than they were read.
    pub unheard: u64,
}

/// The outcome of lockstep.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Lockstep {
    /// Cells that did not answer in time, as text.
    pub silent_cells: Vec<String>,
    /// Joints that were resent, because a cell was too late for them.
    pub retried: u64,
}

/// How replies compare with recorded ones.
#[derive(Clone, Debug, Serialize)]
pub struct Expect {
    /// By how many steps torques may differ.
    pub tolerance: u16,
    /// The counts.
    #[serde(flatten)]
    pub tally: Tally,
    /// Joints that the cells processed too late, by their own counters: replies to them are missing.
    pub joints_skipped: u64,
    /// Frames that the recorder reported as lost: inputs among them cannot be sent.
    pub recording_dropped: u64,
    /// Cells whose configuration in the recording is not known, and was not compared.
    pub unchecked_cells: u64,
    /// The first reply that is not as it was recorded.
    pub first: Option<Difference>,
}

impl Lacking {
    /// The reasons that occurred, with their counts, as text.
    #[must_use]
    pub fn reasons(&self) -> Vec<(&'static str, u64)> {
        nonzero([
            ("the cell was silent", self.silent),
            ("the cell had not taken the joints", self.untaken),
            ("the reply was not recorded", self.unrecorded),
            ("the recording ended", self.ended),
            ("the end of a contact was sent later", self.said_later),
            ("no counters tell whether the cell took the joints", self.uncounted),
            ("the joints were not recorded", self.joints_unrecorded),
            ("the joints came before the replayed part", self.joints_earlier),
            ("the configure came before the replayed part", self.requested_earlier),
            ("the cell measured", self.measured),
            ("unrequested sensors were sent at other joints", self.sensed_otherwise),
            ("the cell did not come to its slot", self.slot_skipped),
            ("a cell was changing its parent", self.parent_changing),
            ("a cell had not reported where its sums go", self.tree_unknown),
            ("a sum lacked one of its children's", self.sums_not_taken),
        ])
    }
}

/// The counts that are not 0, with what they count.
fn nonzero<const N: usize>(counts: [(&'static str, u64); N]) -> Vec<(&'static str, u64)> {
    counts.into_iter().filter(|(_, count)| *count > 0).collect()
}

impl Summary {
    /// Why it is no success, in one line; none when it is. Reasons of cells' errors are not repeated unless it was `quiet`.
    #[must_use]
    pub fn verdict(&self, quiet: bool) -> Option<String> {
        if let Some(failure) = &self.failure {
            return Some(failure.clone());
        }
        let mut wrong: Vec<_> = cells_in_error(&self.cell_errors, quiet).into_iter().collect();
        if let Some(expect) = self.expect.as_ref().filter(|expect| !expect.tally.is_good()) {
            let Tally { different, missing, extra, not_requested, .. } = expect.tally;
            let counts = nonzero([
                ("different", different),
                ("missing", missing),
                ("extra", extra),
                ("not asked for", not_requested),
            ]);
            let counts: Vec<_> = counts.iter().map(|(what, count)| format!("{count} {what}")).collect();
            if !counts.is_empty() {
                let by = expect.tally.torque_words.max;
                let by = if by > expect.tolerance.into() {
                    format!(", torque words by up to {by} steps (--tolerance {})", expect.tolerance)
                } else {
                    String::new()
                };
                wrong.push(format!("replies are not as they were recorded: {}{by}", counts.join(", ")));
            }
            if expect.tally.lacks_the_tree() {
                wrong.push(
                    "no sum could be compared: cells have not reported where their sums go, then or now"
                        .to_owned(),
                );
            }
            if expect.joints_skipped > 0 && self.lockstep.is_none() {
                wrong.push(format!(
                    "cells came too late for joints {}: --lockstep waits for them",
                    many(expect.joints_skipped, "time", "times")
                ));
            }
        }
        if let Some(lockstep) = self.lockstep.as_ref().filter(|lockstep| !lockstep.silent_cells.is_empty()) {
            wrong.push(format!("cells did not answer: {}", lockstep.silent_cells.join(", ")));
        }
        if self.lost > 0 {
            let were = if self.lost == 1 { "was" } else { "were" };
            let frames = many(self.lost, "frame", "frames");
            wrong.push(format!("{frames} {were} lost while a bus was down"));
        }
        if self.refused > 0 {
            let were = if self.refused == 1 { "was" } else { "were" };
            let frames = many(self.refused, "frame", "frames");
            wrong.push(format!("{frames} {were} refused: a bus stayed full"));
        }
        (!wrong.is_empty()).then(|| wrong.join("; "))
    }

    /// Returns the result in one line, and whether all is well: everything was sent, compared and equal.
    #[must_use]
    pub fn first_line(&self) -> (bool, String) {
        let until = if self.interrupted { " until it was interrupted" } else { "" };
        let sent = format!("{} sent", many(self.sent, "frame", "frames"));
        match (self.verdict(true), &self.expect) {
            (Some(why), _) => (false, format!("look at: {why}")),
            (None, None) => {
                (false, format!("all sent{until}: {sent}; no reply was compared, which --expect does"))
            }
            (None, Some(expect)) if expect.tally.equal == 0 => {
                (false, format!("look at: no reply was compared, {sent}"))
            }
            (None, Some(expect)) => {
                let equal = format!("{} as recorded", many(expect.tally.equal, "reply", "replies"));
                let lacking = expect.tally.lacking.reasons().iter().map(|(_, count)| count).sum::<u64>();
                let unread = self.buses.iter().map(|bus| bus.unheard).sum();
                let unchecked = [
                    (lacking, many(lacking, "reply not compared", "replies not compared")),
                    (unread, many(unread, "reply not read in time", "replies not read in time")),
                    (
                        expect.recording_dropped,
                        many(
                            expect.recording_dropped,
                            "frame not in the recording",
                            "frames not in the recording",
                        ),
                    ),
                    (
                        expect.unchecked_cells,
                        many(expect.unchecked_cells, "configuration not known", "configurations not known"),
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

    /// A replay of 100 frames whose 40 replies are as recorded.
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
            expect: Some(Expect {
                tolerance: 0,
                tally: Tally { equal: 40, ..Tally::default() },
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
        let line = |change: fn(&mut Summary, &mut Expect)| {
            let mut summary = well();
            let mut expect = summary.expect.take().unwrap();
            change(&mut summary, &mut expect);
            summary.expect = Some(expect);
            summary.first_line()
        };
        assert_eq!(line(|_, _| {}), (true, "all well: 100 frames sent, 40 replies as recorded".to_owned()));
        let interrupted = line(|it, _| it.interrupted = true);
        assert!(interrupted.0 && interrupted.1.starts_with("all well until it was interrupted: "));
        for (change, begin) in [
            (
                (|_, expect| expect.tally.lacking.ended = 1) as fn(&mut Summary, &mut Expect),
                "no difference: 100 frames sent, 40 replies as recorded, 1 reply not compared",
            ),
            (|_, expect| expect.recording_dropped = 2, "no difference: "),
            (|_, expect| expect.unchecked_cells = 1, "no difference: "),
            (|_, expect| expect.tally.equal = 0, "look at: no reply was compared"),
            (
                |_, expect| expect.tally.different = 3,
                "look at: replies are not as they were recorded: 3 different",
            ),
            (|it, _| it.refused = 1, "look at: 1 frame was refused"),
            (|it, _| it.failure = Some("no bus".to_owned()), "look at: no bus"),
        ] {
            let (is_well, text) = line(change);
            assert!(!is_well && text.starts_with(begin), "{text}");
        }
        let sent = Summary { expect: None, ..well() }.first_line();
        assert_eq!(
            sent,
            (false, "all sent: 100 frames sent; no reply was compared, which --expect does".to_owned())
        );
    }

    #[test]
    fn every_reason_has_a_text() {
        let all = Lacking {
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
        assert_eq!(all.reasons().len(), size_of::<Lacking>() / size_of::<u64>());
    }
}
