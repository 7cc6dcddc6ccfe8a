//! The list as a table and as JSON.

use std::collections::BTreeMap;

use bench::cells::Watch;
use comfy_table::{CellAlignment, ContentArrangement, Table, presets};
use model::listing::{self, Cell, Listing};
use protocol::can::Format;
use protocol::id::CellId;
use protocol::message::{Heard, Heartbeat, PortState, Refused, State, Tree};
use protocol::skin::Skin;
use protocol::time::Micros;
use protocol::usage::Failure;
use rustix::termios::tcgetwinsize;
use serde::Serialize;

use crate::print::{self, filled, some, words};

/// What a description says of a bus.
pub(super) struct Known {
    file: String,
    pub(super) format: Format,
    /// Numbers and hashes, by serial number.
    cells: BTreeMap<u32, (CellId, u16)>,
}

/// What is shown now.
pub(super) struct Shown<'a> {
    bus: &'a str,
    kind: String,
    listing: &'a Listing,
    known: Option<&'a Known>,
    now: Micros,
}

/// What stands in a column of a cell that has said it.
type Text<'a> = Box<dyn Fn(&(u8, &'a Cell)) -> Option<String> + 'a>;

/// A column: its head and its text.
type Column<'a> = (&'static str, Text<'a>);

/// A counter: its head and its value.
type Counter = (&'static str, fn(&Cell) -> Option<u16>);

/// What stands in a column of what heartbeats say.
fn of_heartbeat<'a>(what: fn(&Heartbeat) -> Option<String>) -> Text<'a> {
    Box::new(move |(_, cell)| what(cell.heartbeat.as_ref()?))
}

/// Columns that are not of numbers.
const OF_WORDS: [&str; 3] = ["state", "ports", "skin"];

impl<'a> Shown<'a> {
    /// What was heard, beside what a description says.
    pub(super) fn of(watch: &'a Watch, known: Option<&'a Known>) -> Self {
        let (bus, kind) = (watch.bus().name(), watch.bus().kind().to_string());
        Self { bus, kind, listing: watch.listing(), known, now: watch.now() }
    }

    /// One line a cell, and what is odd; without counters where there is no room for them.
    pub(super) fn table(&self) -> String {
        let whole = self.lines(self.columns().into_iter().chain(counters()));
        let wide = Table::new().width();
        let text = match wide {
            Some(wide) if width(&whole) > usize::from(wide) => self.lines(self.columns()),
            _ => whole,
        };
        text + &self.end()
    }

    fn columns(&self) -> Vec<Column<'_>> {
        let now = self.now;
        let mut columns: Vec<Column<'_>> = vec![
            ("cell", Box::new(|(number, _)| Some(number.to_string()))),
            ("serial", of_heartbeat(|it| Some(it.serial.to_string()))),
            ("state", of_heartbeat(|it| Some(state(it.state)))),
            ("joint", of_heartbeat(|it| configured(it).then(|| it.state.joint().to_string()))),
            ("up", Box::new(|(_, cell)| cell.tree.as_ref().map(listing::parent))),
            ("depth", Box::new(|(_, cell)| depth(cell.tree.as_ref()?).map(|depth| depth.to_string()))),
            ("ports", Box::new(|(_, cell)| cell.ports.as_ref().map(listing::ports))),
            ("hash", of_heartbeat(hash)),
        ];
        if let Some(known) = self.known {
            columns.push(("skin", Box::new(|(number, cell)| known.says(*number, cell.heartbeat.as_ref()?))));
        }
        columns.push(("age", Box::new(move |(_, cell)| Some(format!("{:.2}", age_s(cell, now))))));
        columns
    }

    /// One line a cell; a column in which nobody has said anything is left out.
    fn lines<'b>(&'b self, columns: impl IntoIterator<Item = Column<'b>>) -> String {
        let cells: Vec<_> = self.listing.cells().collect();
        let (heads, lines) = filled(columns, &cells, "-");
        let mut table = Table::new();
        table.load_style(presets::NOTHING).set_content_arrangement(ContentArrangement::Disabled);
        table.set_header(&heads).add_rows(lines);
        for (column, head) in table.column_iter_mut().zip(&heads) {
            column.set_padding((0, 1));
            if !OF_WORDS.contains(head) {
                column.set_cell_alignment(CellAlignment::Right);
            }
        }
        table.lines().map(|line| format!("{}\n", line.trim_end())).collect()
    }

    /// How many there are, and what is odd.
    fn end(&self) -> String {
        let number = |is: fn(&Heartbeat) -> bool| {
            self.listing.cells().filter(|(_, cell)| cell.heartbeat.as_ref().is_some_and(is)).count()
        };
        let all = self.listing.cells().len();
        let mut text = format!("{all} cells on {} ({})", self.bus, self.kind);
        let (active, bare) = (number(|it| it.state.has(State::ACTIVE)), number(|it| !configured(it)));
        for (count, what) in [(active, "in contact"), (bare, "without parameters")] {
            if count > 0 {
                text += &format!(", {count} {what}");
            }
        }
        if self.listing.has_gateway() {
            text += ", and a gateway";
        }
        text.push('\n');
        let shared = self.listing.cells().filter_map(|(number, cell)| {
            let (one, other) = (cell.other?, cell.heartbeat?.serial);
            Some(format!("{number} by the serial numbers {one} and {other}"))
        });
        let shared: Vec<_> = shared.collect();
        if !shared.is_empty() {
            text += &format!("numbers under which two cells speak: {}\n", some(&shared));
        }
        if let Some(known) = self.known {
            let missing: Vec<_> = self.missing(known).map(|cell| cell.to_string()).collect();
            if !missing.is_empty() {
                text += &format!("cells of {} that were not heard: {}\n", known.file, some(&missing));
            }
        }
        text
    }

    fn missing<'b>(&'b self, known: &'b Known) -> impl Iterator<Item = CellId> + 'b {
        let silent = known.cells.iter().filter(|(serial, _)| self.listing.number_of(**serial).is_none());
        silent.map(|(_, (cell, _))| *cell)
    }

    /// One object, in one line if it is one of many.
    pub(super) fn json(&self, is_one_of_many: bool) -> Result<String, Failure> {
        let whole = Whole {
            bus: self.bus,
            kind: &self.kind,
            gateway_heard: self.listing.has_gateway(),
            cells: self.listing.cells().map(|(node, cell)| self.cell(node, cell)).collect(),
            missing: self.known.map(|known| self.missing(known).map(CellId::get).collect()),
        };
        if is_one_of_many {
            return serde_json::to_string(&whole).map(|text| text + "\n").map_err(Failure::run);
        }
        print::json(&whole)
    }

    fn cell(&self, node: u8, cell: &Cell) -> CellShown {
        let beat = cell.heartbeat.as_ref();
        CellShown {
            node,
            age_s: age_s(cell, self.now),
            serial: beat.map(|it| it.serial),
            configured: beat.map(configured),
            state: beat.map(|it| names(it.state).collect()),
            joint: beat.filter(|it| configured(it)).map(|it| it.state.joint()),
            version: beat.map(|it| it.state.version()),
            hash: beat.and_then(hash),
            skin: self.known.and_then(|known| known.says(node, beat?)),
            sent: beat.map(|it| it.sent),
            refused: beat.map(|it| it.rejected),
            heard: cell.heard,
            refused_by: cell.refused,
            tree: cell.tree.as_ref().map(TreeShown::of),
            ports: cell.ports.map(|it| it.ports.iter().map(PortShown::of).collect()),
            parent_changes: cell.ports.map(|it| it.changes),
            other_serial: cell.other,
        }
    }
}

/// Counters, for who has the room.
fn counters<'a>() -> impl Iterator<Item = Column<'a>> {
    let counters: [Counter; 9] = [
        ("sent", |cell| cell.heartbeat.map(|it| it.sent)),
        ("refused", |cell| cell.heartbeat.map(|it| it.rejected)),
        ("joints", |cell| cell.heard.map(|it| it.joints)),
        ("late", |cell| cell.heard.map(|it| it.joints_late)),
        ("torques", |cell| cell.heard.map(|it| it.torques)),
        ("stimuli", |cell| cell.heard.map(|it| it.stimuli)),
        ("sums", |cell| cell.tree.map(|it| it.sent)),
        ("taken", |cell| cell.tree.map(|it| it.taken)),
        ("dropped", |cell| cell.tree.map(|it| it.dropped)),
    ];
    counters.into_iter().map(|(head, of)| -> Column<'a> {
        (head, Box::new(move |(_, cell)| of(cell).map(|count| count.to_string())))
    })
}

const fn configured(heartbeat: &Heartbeat) -> bool {
    heartbeat.state.has(State::CONFIGURED)
}

/// The names of the bits that are set.
fn names(state: State) -> impl Iterator<Item = &'static str> {
    State::NAMES.into_iter().filter(move |(bit, _)| state.has(*bit)).map(|(_, name)| name)
}

/// In words; that a cell is configured is said when there is nothing else to say.
fn state(state: State) -> String {
    let bare = (!state.has(State::CONFIGURED)).then_some("unconfigured");
    let others: Vec<_> = bare.into_iter().chain(names(state).filter(|name| *name != "configured")).collect();
    if others.is_empty() { "configured".to_owned() } else { words(others) }
}

/// Of a cell that has a parent.
fn depth(tree: &Tree) -> Option<u8> {
    tree.parent.map(|_| tree.depth)
}

/// The configuration, of a cell that has one.
fn hash(heartbeat: &Heartbeat) -> Option<String> {
    configured(heartbeat).then(|| format!("{:04X}", heartbeat.configuration))
}

#[expect(clippy::cast_precision_loss, reason = "seconds")]
fn age_s(cell: &Cell, now: Micros) -> f64 {
    // To the ms, which is what it is known to.
    (cell.age(now).0 as f64 / 1e3).round() / 1e3
}

impl Known {
    /// What a skin, from this file, says of one of its buses.
    pub(super) fn of(skin: &Skin, bus: usize, file: String) -> Self {
        let format = skin.buses.get(bus).map_or(Format::Fd, |bus| bus.format);
        let cells = skin.cells_of(bus).map(|cell| (cell.serial, (cell.node, skin.parameters(cell).hash())));
        Self { file, format, cells: cells.collect() }
    }

    /// Whether a cell is as the description has it.
    fn says(&self, number: u8, heartbeat: &Heartbeat) -> Option<String> {
        let Some((described, hash)) = self.cells.get(&heartbeat.serial) else {
            return Some("unknown".to_owned());
        };
        let is = match (configured(heartbeat), heartbeat.configuration == *hash) {
            (false, _) => "none",
            (true, true) => "yes",
            (true, false) => "other",
        };
        let moved = described.get() != number;
        Some(if moved { format!("{is}, there {described}") } else { is.to_owned() })
    }
}

fn width(text: &str) -> usize {
    text.lines().map(|line| line.chars().count()).max().unwrap_or_default()
}

/// A screen that is drawn over the last one; what does not fit is left out.
pub(super) fn screen(text: &str) -> String {
    let rows = tcgetwinsize(std::io::stdout()).map_or(0, |size| usize::from(size.ws_row));
    let all = text.lines().count();
    let shown = if rows > 2 && all >= rows { rows - 2 } else { all };
    let more = (shown < all).then(|| format!("... and {} more lines", all - shown));
    let lines = text.lines().take(shown).chain(more.as_deref());
    let lines: String = lines.map(|line| format!("{line}\x1b[K\n")).collect();
    format!("\x1b[H{lines}\x1b[J")
}

#[derive(Serialize)]
struct Whole<'a> {
    bus: &'a str,
    kind: &'a str,
    gateway_heard: bool,
    cells: Vec<CellShown>,
    #[serde(skip_serializing_if = "Option::is_none")]
    missing: Option<Vec<u8>>,
}

/// What it has not said is null.
#[derive(Serialize)]
struct CellShown {
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
    heard: Option<Heard>,
    refused_by: Option<Refused>,
    tree: Option<TreeShown>,
    ports: Option<Vec<PortShown>>,
    parent_changes: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    other_serial: Option<u32>,
}

#[derive(Serialize)]
struct TreeShown {
    /// 0 is the gateway's side.
    parent: Option<u8>,
    depth: Option<u8>,
    sums_sent: u16,
    sums_taken: u16,
    sums_dropped: u16,
}

impl TreeShown {
    fn of(it: &Tree) -> Self {
        let Tree { parent, sent, taken, dropped, .. } = *it;
        Self { parent, depth: depth(it), sums_sent: sent, sums_taken: taken, sums_dropped: dropped }
    }
}

#[derive(Serialize)]
struct PortShown {
    /// Of the cell at the other end; null where nothing is heard, 0 of a cell without a number.
    node: Option<u8>,
    port: Option<u8>,
    works: bool,
    other_version: bool,
}

impl PortShown {
    fn of(it: &PortState) -> Self {
        let PortState { number, port, hears, works, other_version } = *it;
        Self { node: hears.then_some(number), port: hears.then_some(port), works, other_version }
    }
}
