//! Replies due and come: of each cell, and of a bus' cells together.

use std::collections::BTreeMap;

use model::table::{Cell, Errors, Replies};
use protocol::skin::{self, Skin};
use serde::Serialize;

/// Replies: due = in time + late + missing; missing = too late + skipped + not heard + lost + in doubt + unknown.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct RepliesSummary {
    /// Epochs that cells had to answer.
    pub due: u64,
    /// Answered before the next broadcast.
    pub in_time: u64,
    /// Answered after it.
    pub late: u64,
    /// Dropped, because they came when their epoch was long over.
    pub too_late: u64,
    /// Skipped by the cell, because the joints were older than a period when it took them.
    pub skipped: u64,
    /// Not heard by the cell.
    pub not_heard: u64,
    /// Sent by the cell and lost or damaged on the way.
    pub lost: u64,
    /// Of cells that were dead or restarted, or whose bus was lost.
    pub in_doubt: u64,
    /// Missing, for no known reason.
    pub unknown: u64,
    /// Torques that were not due: ends of contacts, and the next two.
    pub unasked: u64,
    /// Of these, torques of cells whose contact was not known.
    pub contact_unknown: u64,
    /// Of these, torques other than zero of cells whose contact was known.
    pub unexpected: u64,
}

impl RepliesSummary {
    /// Adds those of a cell, and explains its missing ones as far as reasons are known.
    pub(super) fn add(&mut self, cell: &Cell) {
        let Replies { due, in_time, late, missing, in_doubt, unasked, contact_unknown, unexpected, too_late } =
            cell.replies;
        let mut rest = missing.saturating_sub(in_doubt);
        let mut explain = |count: u64| {
            let explained = rest.min(count);
            rest -= explained;
            explained
        };
        let (skipped, not_heard) = cell.unanswered().unwrap_or((0, 0));
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

    /// The missing ones by reason, those without a known reason last.
    #[must_use]
    pub const fn missing(&self) -> [(&'static str, u64); 6] {
        [
            ("too_late", self.too_late),
            ("skipped", self.skipped),
            ("not_heard", self.not_heard),
            ("lost", self.lost),
            ("in_doubt", self.in_doubt),
            ("unknown", self.unknown),
        ]
    }
}

/// One cell.
#[derive(Clone, Debug, Default, Serialize)]
pub struct CellSummary {
    /// Its node id.
    pub node: u8,
    /// Its bus.
    pub bus: String,
    /// `test` or `measure`, by its last heartbeat; none when it was never heard.
    pub mode: Option<&'static str>,
    /// Replies that were due.
    pub due: u64,
    /// Those that came before the next broadcast.
    pub in_time: u64,
    /// Those that came after it.
    pub late: u64,
    /// Those that did not come, by reason; zeros are left out.
    pub missing: BTreeMap<&'static str, u64>,
    /// Torques that were not due because its contact was not known.
    pub contact_unknown: u64,
    /// Its torques against the central ones, in the joints that move it.
    pub error: Errors,
    /// Equal words in a row, the most of each kind, while it should have sent others; kinds without any are left out.
    pub stuck: BTreeMap<&'static str, u64>,
    /// How often it restarted.
    pub restarts: u32,
}

impl CellSummary {
    /// A cell of a skin; `known` is what is known of it, if its bus was opened.
    #[must_use]
    pub fn new(skin: &Skin, described: &skin::Cell, known: Option<&Cell>) -> Self {
        let mut replies = RepliesSummary::default();
        known.into_iter().for_each(|cell| replies.add(cell));
        let mode = known.and_then(Cell::measures).map(|measures| if measures { "measure" } else { "test" });
        Self {
            node: described.node.get(),
            bus: skin.buses.get(described.bus).map_or_else(String::new, |bus| bus.name.clone()),
            mode,
            due: replies.due,
            in_time: replies.in_time,
            late: replies.late,
            missing: replies.missing().into_iter().filter(|(_, count)| *count > 0).collect(),
            contact_unknown: replies.contact_unknown,
            error: known.map(Cell::errors).unwrap_or_default(),
            stuck: known.into_iter().flat_map(Cell::stuck).collect(),
            restarts: known.map_or(0, |cell| cell.uplink().restarts),
        }
    }

    /// Whether stimuli do not touch it.
    #[must_use]
    pub fn measures(&self) -> bool {
        self.mode == Some("measure")
    }
}
