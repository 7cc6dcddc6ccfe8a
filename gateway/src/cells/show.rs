//! The list of cells as a table and as JSON.

use std::collections::BTreeMap;
use std::fmt::Display;

use bench::cells::CellWatch;
use comfy_table::{CellAlignment, ContentArrangement, Table, presets};
use model::listing::ListedCell;
use protocol::can::Format;
use protocol::id::CellId;
use protocol::message::{Heartbeat, PortState, ReceivedCounts, RejectedCounts, State, TreePage};
use protocol::skin::Skin;
use protocol::time::Micros;
use rustix::termios::tcgetwinsize;
use serde::Serialize;

use crate::print::{abbreviate_names, drop_empty_columns, readable_width, space_separated};

/// A bus as a skin describes it, for comparison with the cells found.
pub(super) struct DescribedBus {
    file: String,
    pub(super) format: Format,
    /// Node ids and configuration hashes of the cells, by serial number.
    cells: BTreeMap<u32, (CellId, u16)>,
}

/// A column: its header, and the text of a cell if it has reported the value.
type Column = (&'static str, fn(&DisplayedCell) -> Option<String>);

const COLUMNS: [Column; 10] = [
    ("cell", |it| optional_text(Some(it.node))),
    ("serial", |it| optional_text(it.serial)),
    ("state", DisplayedCell::state),
    ("joint", |it| optional_text(it.joint)),
    ("parent", |it| it.tree.as_ref().map(DisplayedTree::parent_text)),
    ("depth", |it| optional_text(it.tree.as_ref()?.depth)),
    ("ports", |it| {
        it.ports.as_ref().map(|ports| space_separated(ports.iter().map(DisplayedPort::neighbour_text)))
    }),
    ("hash", |it| it.hash.clone()),
    ("skin", |it| it.skin.clone()),
    ("age", |it| Some(format!("{:.2}", it.age_s))),
];

/// Columns that are shown on wide terminals only.
const COUNTER_COLUMNS: [Column; 9] = [
    ("sent", |it| optional_text(it.sent)),
    ("refused", |it| optional_text(it.refused)),
    ("joints", |it| optional_text(it.heard.map(|it| it.joints))),
    ("late", |it| optional_text(it.heard.map(|it| it.joints_late))),
    ("torques", |it| optional_text(it.heard.map(|it| it.torques))),
    ("stimuli", |it| optional_text(it.heard.map(|it| it.stimuli))),
    ("sums", |it| optional_text(it.tree.as_ref().map(|it| it.sums_sent))),
    ("taken", |it| optional_text(it.tree.as_ref().map(|it| it.sums_taken))),
    ("dropped", |it| optional_text(it.tree.as_ref().map(|it| it.sums_dropped))),
];

/// Columns with text instead of numbers.
const TEXT_COLUMNS: [&str; 3] = ["state", "ports", "skin"];

fn optional_text(value: Option<impl Display>) -> Option<String> {
    value.map(|value| value.to_string())
}

/// A bus with the cells that send on it, as printed.
#[derive(Serialize)]
pub(super) struct CellList<'a> {
    bus: &'a str,
    kind: String,
    gateway_heard: bool,
    cells: Vec<DisplayedCell>,
    /// Node ids of the skin's cells that are missing on the bus.
    #[serde(skip_serializing_if = "Option::is_none")]
    missing: Option<Vec<u8>>,
    #[serde(skip)]
    file: &'a str,
}

impl<'a> CellList<'a> {
    /// Collects the cells of the bus, and compares them with those of a skin, if given.
    pub(super) fn from_watch(watch: &'a CellWatch, known: Option<&'a DescribedBus>) -> Self {
        let (bus, listing, now) = (watch.bus(), watch.listing(), watch.now());
        let missing = |known: &DescribedBus| {
            let silent = known.cells.iter().filter(|(serial, _)| listing.node_id(**serial).is_none());
            silent.map(|(_, (cell, _))| cell.get()).collect()
        };
        Self {
            bus: bus.name(),
            kind: bus.kind().to_string(),
            gateway_heard: listing.has_gateway(),
            cells: listing
                .cells()
                .map(|(node, cell)| DisplayedCell::from_listed(node, cell, known, now))
                .collect(),
            missing: known.map(missing),
            file: known.map_or("", |known| &known.file),
        }
    }

    /// Formats a table with one line per cell, and the anomalies below. The counters are left out if the terminal is
    /// too narrow.
    pub(super) fn table(&self) -> String {
        let whole = self.lines(COLUMNS.into_iter().chain(COUNTER_COLUMNS));
        let text = match readable_width(Table::new().width()) {
            Some(wide) if width(&whole) > usize::from(wide) => self.lines(COLUMNS),
            _ => whole,
        };
        text + &self.format_totals()
    }

    /// Formats one line per cell, without empty columns.
    fn lines(&self, columns: impl IntoIterator<Item = Column>) -> String {
        let (heads, lines) = drop_empty_columns(columns, &self.cells, "-");
        let mut table = Table::new();
        table.load_style(presets::NOTHING).set_content_arrangement(ContentArrangement::Disabled);
        table.set_header(&heads).add_rows(lines);
        for (column, head) in table.column_iter_mut().zip(&heads) {
            column.set_padding((0, 1));
            if !TEXT_COLUMNS.contains(head) {
                column.set_cell_alignment(CellAlignment::Right);
            }
        }
        table.lines().map(|line| format!("{}\n", line.trim_end())).collect()
    }

    /// Formats the counts and anomalies below the table.
    fn format_totals(&self) -> String {
        let mut text = format!("{} cells on {} ({})", self.cells.len(), self.bus, self.kind);
        let active = self.cells.iter().filter(|cell| cell.has_state("active")).count();
        let bare = self.cells.iter().filter(|cell| cell.configured == Some(false)).count();
        for (count, what) in [(active, "in contact"), (bare, "without parameters")] {
            if count > 0 {
                text += &format!(", {count} {what}");
            }
        }
        text += if self.gateway_heard { ", and a gateway\n" } else { "\n" };
        let shared = self.cells.iter().filter_map(|cell| {
            let (node, one, other) = (cell.node, cell.other_serial?, cell.serial?);
            Some(format!("{node} (serial numbers {one} and {other})"))
        });
        let shared: Vec<_> = shared.collect();
        if !shared.is_empty() {
            text += &format!("node ids that two cells use: {}\n", abbreviate_names(&shared));
        }
        let missing: Vec<_> = self.missing.iter().flatten().map(u8::to_string).collect();
        if !missing.is_empty() {
            text += &format!("cells in {} that sent nothing: {}\n", self.file, abbreviate_names(&missing));
        }
        text
    }
}

impl DescribedBus {
    /// Selects one bus of the skin that was read from `file`.
    pub(super) fn from_skin(skin: &Skin, bus: usize, file: String) -> Self {
        let format = skin.buses.get(bus).map_or(Format::Fd, |bus| bus.format);
        let cells =
            skin.cells_on_bus(bus).map(|cell| (cell.serial, (cell.node, skin.parameters(cell).hash())));
        Self { file, format, cells: cells.collect() }
    }

    /// Returns how a cell differs from its description, or agrees with it, as text.
    fn compare_cell(&self, node: u8, heartbeat: &Heartbeat) -> Option<String> {
        let Some((described, hash)) = self.cells.get(&heartbeat.serial) else {
            return Some("unknown".to_owned());
        };
        let is = match (heartbeat.state.has(State::CONFIGURED), heartbeat.configuration == *hash) {
            (false, _) => "none",
            (true, true) => "yes",
            (true, false) => "other",
        };
        let moved = described.get() != node;
        Some(if moved { format!("{is}, there {described}") } else { is.to_owned() })
    }
}

fn width(text: &str) -> usize {
    text.lines().map(|line| line.chars().count()).max().unwrap_or_default()
}

/// Returns the text that redraws the terminal from the top. Lines that do not fit are dropped.
pub(super) fn terminal_redraw_text(text: &str) -> String {
    let rows = tcgetwinsize(std::io::stdout()).map_or(0, |size| usize::from(size.ws_row));
    let all = text.lines().count();
    let shown = if rows > 2 && all >= rows { rows - 2 } else { all };
    let more = (shown < all).then(|| format!("... and {} more lines", all - shown));
    let lines = text.lines().take(shown).chain(more.as_deref());
    let lines: String = lines.map(|line| format!("{line}\x1b[K\n")).collect();
    format!("\x1b[H{lines}\x1b[J")
}

/// Values of one cell; unreported values are null.
#[derive(Serialize)]
struct DisplayedCell {
    node: u8,
    age_s: f64,
    serial: Option<u32>,
    configured: Option<bool>,
    state: Option<Vec<&'static str>>,
    joint: Option<u16>,
    version: Option<u16>,
    hash: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    skin: Option<String>,
    sent: Option<u16>,
    refused: Option<u16>,
    heard: Option<ReceivedCounts>,
    refused_by: Option<RejectedCounts>,
    tree: Option<DisplayedTree>,
    ports: Option<Vec<DisplayedPort>>,
    parent_changes: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    other_serial: Option<u32>,
}

impl DisplayedCell {
    fn from_listed(node: u8, cell: &ListedCell, known: Option<&DescribedBus>, now: Micros) -> Self {
        let beat = cell.heartbeat.as_ref();
        let configured = beat.filter(|it| it.state.has(State::CONFIGURED));
        #[expect(clippy::cast_precision_loss, reason = "seconds, to the ms, which is what it is known to")]
        let age_s = (cell.time_since_last_packet(now).0 as f64 / 1e3).round() / 1e3;
        Self {
            node,
            age_s,
            serial: beat.map(|it| it.serial),
            configured: beat.map(|_| configured.is_some()),
            state: beat.map(|it| it.state.flag_names().collect()),
            joint: configured.map(|it| it.state.joint()),
            version: beat.map(|it| it.state.version()),
            hash: configured.map(|it| format!("{:04X}", it.configuration)),
            skin: known.and_then(|known| known.compare_cell(node, beat?)),
            sent: beat.map(|it| it.sent),
            refused: beat.map(|it| it.rejected),
            heard: cell.pages.received,
            refused_by: cell.pages.rejected,
            tree: cell.pages.tree.as_ref().map(DisplayedTree::from_tree),
            ports: cell.pages.ports.map(|it| it.ports.iter().map(DisplayedPort::from_port).collect()),
            parent_changes: cell.pages.ports.map(|it| it.changes),
            other_serial: cell.other_serial,
        }
    }

    /// Returns true if the cell has reported this state.
    fn has_state(&self, state: &str) -> bool {
        self.state.iter().flatten().any(|name| *name == state)
    }

    /// Formats the states of the cell. "configured" appears only if the cell reports no other state.
    fn state(&self) -> Option<String> {
        let bare = (self.configured == Some(false)).then_some(&"unconfigured");
        let others = self.state.as_ref()?.iter().filter(|name| **name != "configured");
        let said = space_separated(bare.into_iter().chain(others));
        Some(if said.is_empty() { "configured".to_owned() } else { said })
    }
}

#[derive(Serialize)]
struct DisplayedTree {
    /// Node id of the parent; 0 is the gateway's side.
    parent: Option<u8>,
    depth: Option<u8>,
    sums_sent: u16,
    sums_taken: u16,
    sums_dropped: u16,
}

impl DisplayedTree {
    fn from_tree(it: &TreePage) -> Self {
        let TreePage { parent, depth, sent, accepted: taken, dropped, .. } = *it;
        let depth = parent.map(|_| depth);
        Self { parent, depth, sums_sent: sent, sums_taken: taken, sums_dropped: dropped }
    }

    /// Formats the parent of the cell.
    fn parent_text(&self) -> String {
        match self.parent {
            None => "none".to_owned(),
            Some(0) => "gateway".to_owned(),
            Some(number) => number.to_string(),
        }
    }
}

#[derive(Serialize)]
struct DisplayedPort {
    /// Node id of the neighbour: null if the port receives nothing, 0 for a neighbour without a node id.
    node: Option<u8>,
    port: Option<u8>,
    works: bool,
    other_version: bool,
}

impl DisplayedPort {
    fn from_port(it: &PortState) -> Self {
        let PortState { number, port, receives: hears, works, other_version } = *it;
        Self { node: hears.then_some(number), port: hears.then_some(port), works, other_version }
    }

    /// Formats the neighbour: `?` follows one that receives nothing, `!` one with another protocol version.
    fn neighbour_text(&self) -> String {
        match (self.node, self.works, self.other_version) {
            (None, _, _) => ".".to_owned(),
            (Some(node), _, true) => format!("{node}!"),
            (Some(node), false, false) => format!("{node}?"),
            (Some(node), true, false) => node.to_string(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_in_the_tree_are_words() {
        let up = |parent| DisplayedTree::from_tree(&TreePage { parent, ..TreePage::default() }).parent_text();
        assert_eq!([up(None), up(Some(0)), up(Some(12))], ["none", "gateway", "12"]);
        let heard = PortState { number: 12, receives: true, ..PortState::default() };
        let works = PortState { works: true, ..heard };
        let other = PortState { other_version: true, ..works };
        let all = [PortState::default(), heard, works, other];
        assert_eq!(
            space_separated(all.map(|port| DisplayedPort::from_port(&port).neighbour_text())),
            ". 12? 12 12!"
        );
    }
}
