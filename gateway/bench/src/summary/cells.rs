//! Due and received replies of each cell, and of all cells of a bus.

use std::collections::BTreeMap;

use model::table::{CellState, Replies, TorqueErrors};
use protocol::skin::{self, Skin};
use serde::Serialize;

/// Replies of cells that answer with their own torques. They add up: due = in time + late + missing; missing = too late
/// + skipped + not heard + lost + refused + in doubt + unknown.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct RepliesSummary {
    /// Number of epochs that cells had to answer, added up over the cells.
    pub due: u64,
    /// Replies before the next broadcast.
    pub in_time: u64,
    /// Replies after the next broadcast.
    pub late: u64,
    /// Replies that arrived and were dropped because their epoch was long over.
    pub too_late: u64,
    /// Replies that the cell skipped because it processed the joints more than one period late.
    pub skipped: u64,
    /// Replies missing because the cell did not receive the joints.
    pub not_heard: u64,
    /// Replies that the cell sent and that were lost or damaged on the way.
    pub lost: u64,
    /// Replies that the transmit queue of a timed bus refused.
    pub refused: u64,
    /// Missing replies of cells that were dead or restarted, or whose bus was lost.
    pub in_doubt: u64,
    /// Missing replies without a known reason.
    pub unknown: u64,
    /// Torques that were not due: ends of contacts, and those in the next two fields.
    pub unasked: u64,
    /// Torques of cells whose contact state was unknown.
    pub contact_unknown: u64,
    /// Torques other than zero of cells that were known not to be in contact.
    pub unexpected: u64,
}

impl RepliesSummary {
    /// Adds the replies of a cell, and attributes missing ones to reasons as far as these are known.
    pub(super) fn add_replies_of(&mut self, cell: &CellState) {
        let Replies { due, in_time, late, missing, in_doubt, unasked, contact_unknown, unexpected, too_late } =
            cell.replies;
        let mut rest = missing.saturating_sub(in_doubt);
        let mut explain = |count: u64| {
            let explained = rest.min(count);
            rest -= explained;
            explained
        };
        let (skipped, not_heard) = cell.unanswered_joint_counts().unwrap_or((0, 0));
        self.due += due;
        self.in_time += in_time;
        self.late += late;
        self.too_late += explain(too_late);
        self.skipped += explain(skipped);
        self.not_heard += explain(not_heard);
        self.lost += explain(cell.uplink().lost + cell.uplink().rejected);
        self.in_doubt += in_doubt;
        self.unknown += rest;
        self.unasked += unasked;
        self.contact_unknown += contact_unknown;
        self.unexpected += unexpected;
    }

    /// Returns the numbers of missing replies by reason; unknown reasons are last.
    #[must_use]
    pub const fn missing_replies_by_reason(&self) -> [(&'static str, u64); 7] {
        [
            ("too_late", self.too_late),
            ("skipped", self.skipped),
            ("not_heard", self.not_heard),
            ("lost", self.lost),
            ("refused", self.refused),
            ("in_doubt", self.in_doubt),
            ("unknown", self.unknown),
        ]
    }
}

/// Summary of one cell.
#[derive(Clone, Debug, Default, Serialize)]
pub struct CellSummary {
    /// Node id of the cell.
    pub node: u8,
    /// Name of its bus.
    pub bus: String,
    /// Mode of the cell by its last heartbeat, `test` or `measure`; `None` if no heartbeat was received.
    pub mode: Option<&'static str>,
    /// Number of replies due.
    pub due: u64,
    /// Number of replies before the next broadcast.
    pub in_time: u64,
    /// Number of replies after the next broadcast.
    pub late: u64,
    /// Number of missing replies by reason, without zeros.
    pub missing: BTreeMap<&'static str, u64>,
    /// Number of torques that were not due, because the cell's contact state was unknown.
    pub contact_unknown: u64,
    /// Errors of the cell's torques against the central ones, in the joints that move the cell.
    pub error: TorqueErrors,
    /// Largest number of equal words in succession, by kind, while the cell should have sent changing ones. Kinds
    /// without such a succession are absent.
    pub stuck: BTreeMap<&'static str, u64>,
    /// Number of restarts.
    pub restarts: u32,
}

impl CellSummary {
    /// Creates the summary of a cell of the skin. `known` is the table entry of the cell, or `None` if its bus was not
    /// opened.
    #[must_use]
    pub fn new(skin: &Skin, described: &skin::Cell, known: Option<&CellState>) -> Self {
        let mut replies = RepliesSummary::default();
        known.into_iter().for_each(|cell| replies.add_replies_of(cell));
        let mode =
            known.and_then(CellState::is_measuring).map(|measures| if measures { "measure" } else { "test" });
        Self {
            node: described.node.get(),
            bus: skin.buses.get(described.bus).map_or_else(String::new, |bus| bus.name.clone()),
            mode,
            due: replies.due,
            in_time: replies.in_time,
            late: replies.late,
            missing: replies
                .missing_replies_by_reason()
                .into_iter()
                .filter(|(_, count)| *count > 0)
                .collect(),
            contact_unknown: replies.contact_unknown,
            error: known.map(CellState::errors).unwrap_or_default(),
            stuck: known.into_iter().flat_map(CellState::stuck_word_runs).collect(),
            restarts: known.map_or(0, |cell| cell.uplink().restarts),
        }
    }

    /// Returns true if the cell measures, so that stimuli do not touch it.
    #[must_use]
    pub fn is_measuring(&self) -> bool {
        self.mode == Some("measure")
    }
}
