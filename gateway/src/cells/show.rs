//! The list as a table and as JSON.

use std::collections::BTreeMap;

use comfy_table::{CellAlignment, ContentArrangement, Table, presets};
use model::listing::{self, Cell, Listing};
use protocol::can::Format;
use protocol::id::CellId;
use protocol::message::{Heard, Heartbeat, PortState, Refused, State, Tree};
use protocol::time::Micros;
use protocol::usage::Failure;
use rustix::termios::tcgetwinsize;
use serde::Serialize;

use crate::commission::some;

/// What a description says of a bus.
pub(super) struct Known {
    pub(super) file: String,
    pub(super) format: Format,
    /// Numbers and hashes, by serial number.
    pub(super) cells: BTreeMap<u32, (CellId, u16)>,
}

/// What is shown now.
pub(super) struct Shown<'a> {
    pub(super) bus: &'a str,
    pub(super) kind: &'a str,
    pub(super) listing: &'a Listing,
    pub(super) known: Option<&'a Known>,
    pub(super) now: Micros,
}

/// A column: its head, and what stands there of a cell that has said it.
type Column<'a> = (&'static str, Box<dyn Fn(u8, &Cell) -> Option<String> + 'a>);

impl Shown<'_> {
    /// All of it.
    pub(super) fn text(&self, json: bool, watch: bool) -> Result<String, Failure> {
        if !json {
            return Ok(self.table());
        }
        let whole = self.json();
        let text = if watch { serde_json::to_string(&whole) } else { serde_json::to_string_pretty(&whole) };
        text.map(|text| text + "\n").map_err(Failure::run)
    }

    fn table(&self) -> String {
        let whole = self.lines(self.columns().into_iter().chain(counters()).collect());
        let wide = Table::new().width();
        let text = match wide {
            Some(wide) if width(&whole) > usize::from(wide) => self.lines(self.columns()),
            _ => whole,
        };
        text + &self.end()
    }

    fn columns(&self) -> Vec<Column<'_>> {
        let beat =
            |what: fn(&Heartbeat) -> Option<String>| move |_: u8, cell: &Cell| what(cell.heartbeat.as_ref()?);
        let mut columns: Vec<Column<'_>> = vec![
            ("cell", Box::new(|number, _| Some(number.to_string()))),
            ("serial", Box::new(beat(|it| Some(it.serial.to_string())))),
            ("state", Box::new(beat(|it| Some(state(it.state))))),
            ("joint", Box::new(beat(|it| configured(it).then(|| it.state.joint().to_string())))),
            ("up", Box::new(|_, cell| cell.tree.as_ref().map(listing::parent))),
            ("depth", Box::new(|_, cell| depth(cell.tree.as_ref()?))),
            ("ports", Box::new(|_, cell| cell.ports.as_ref().map(listing::ports))),
            ("hash", Box::new(beat(|it| configured(it).then(|| format!("{:04X}", it.configuration))))),
        ];
        if let Some(known) = self.known {
            columns.push(("skin", Box::new(|number, cell| known.says(number, cell.heartbeat.as_ref()?))));
        }
        let now = self.now;
        columns.push(("age", Box::new(move |_, cell| Some(seconds(cell, now)))));
        columns
    }

    /// One line a cell; a column in which nobody has said anything is left out.
    fn lines(&self, columns: Vec<Column<'_>>) -> String {
        let there =
            |(_, of): &Column<'_>| self.listing.cells().any(|(number, cell)| of(number, cell).is_some());
        let columns: Vec<_> = columns.into_iter().filter(there).collect();
        let mut table = Table::new();
        table.load_style(presets::NOTHING).set_content_arrangement(ContentArrangement::Disabled);
        table.set_header(columns.iter().map(|(head, _)| *head));
        for (number, cell) in self.listing.cells() {
            table.add_row(columns.iter().map(|(_, of)| of(number, cell).unwrap_or_else(|| "-".to_owned())));
        }
        for (column, (head, _)) in table.column_iter_mut().zip(&columns) {
            column.set_padding((0, 1));
            if !matches!(*head, "state" | "ports" | "skin") {
                column.set_cell_alignment(CellAlignment::Right);
            }
        }
        table.lines().map(|line| format!("{}\n", line.trim_end())).collect()
    }

    /// How many there are, and what is odd.
    fn end(&self) -> String {
        let count = |is: &dyn Fn(&Heartbeat) -> bool| {
            self.listing.cells().filter(|(_, cell)| cell.heartbeat.as_ref().is_some_and(is)).count()
        };
        let all = self.listing.cells().len();
        let mut text = format!("{all} cells on {} ({})", self.bus, self.kind);
        let (active, bare) = (count(&|it| it.state.has(State::ACTIVE)), count(&|it| !configured(it)));
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

    fn missing<'a>(&'a self, known: &'a Known) -> impl Iterator<Item = CellId> + 'a {
        let silent = known.cells.iter().filter(|(serial, _)| self.listing.number_of(**serial).is_none());
        silent.map(|(_, (cell, _))| *cell)
    }

    fn json(&self) -> Whole<'_> {
        let cell = |(node, cell): (u8, &Cell)| {
            let beat = cell.heartbeat.as_ref();
            CellShown {
                node,
                age_s: age_s(cell, self.now),
                serial: beat.map(|it| it.serial),
                configured: beat.map(configured),
                state: beat.map(|it| names(it.state).collect()),
                joint: beat.filter(|it| configured(it)).map(|it| it.state.joint()),
                version: beat.map(|it| it.state.version()),
                hash: beat.filter(|it| configured(it)).map(|it| format!("{:04X}", it.configuration)),
                skin: self.known.and_then(|known| known.says(node, beat?)),
                sent: beat.map(|it| it.sent),
                refused: beat.map(|it| it.rejected),
                heard: cell.heard.as_ref().map(HeardShown::of),
                refused_by: cell.refused.as_ref().map(RefusedShown::of),
                tree: cell.tree.as_ref().map(TreeShown::of),
                ports: cell.ports.as_ref().map(|it| it.ports.iter().map(PortShown::of).collect()),
                parent_changes: cell.ports.as_ref().map(|it| it.changes),
                other_serial: cell.other,
            }
        };
        Whole {
            bus: self.bus,
            kind: self.kind,
            gateway_heard: self.listing.has_gateway(),
            cells: self.listing.cells().map(cell).collect(),
            missing: self.known.map(|known| self.missing(known).map(CellId::get).collect()),
        }
    }
}

/// Counters, for who has the room.
fn counters() -> Vec<Column<'static>> {
    fn of(count: u16) -> String {
        count.to_string()
    }
    vec![
        ("sent", Box::new(|_, cell| cell.heartbeat.map(|it| of(it.sent)))),
        ("refused", Box::new(|_, cell| cell.heartbeat.map(|it| of(it.rejected)))),
        ("joints", Box::new(|_, cell| cell.heard.map(|it| of(it.joints)))),
        ("late", Box::new(|_, cell| cell.heard.map(|it| of(it.joints_late)))),
        ("torques", Box::new(|_, cell| cell.heard.map(|it| of(it.torques)))),
        ("stimuli", Box::new(|_, cell| cell.heard.map(|it| of(it.stimuli)))),
        ("sums", Box::new(|_, cell| cell.tree.map(|it| of(it.sent)))),
        ("taken", Box::new(|_, cell| cell.tree.map(|it| of(it.taken)))),
        ("dropped", Box::new(|_, cell| cell.tree.map(|it| of(it.dropped)))),
    ]
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
    if others.is_empty() { "configured".to_owned() } else { others.join(" ") }
}

fn depth(tree: &Tree) -> Option<String> {
    tree.parent.map(|_| tree.depth.to_string())
}

#[expect(clippy::cast_precision_loss, reason = "seconds")]
fn age_s(cell: &Cell, now: Micros) -> f64 {
    // To the ms, which is what it is known to.
    (cell.age(now).0 as f64 / 1e3).round() / 1e3
}

fn seconds(cell: &Cell, now: Micros) -> String {
    format!("{:.2}", age_s(cell, now))
}

impl Known {
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
    let lines: Vec<_> = text.lines().collect();
    let all = lines.len();
    let shown = if rows > 2 && all >= rows {
        let mut shown: Vec<String> = lines.iter().take(rows - 2).map(|line| (*line).to_owned()).collect();
        shown.push(format!("... and {} more lines", all - (rows - 2)));
        shown
    } else {
        lines.into_iter().map(str::to_owned).collect()
    };
    let lines: String = shown.iter().map(|line| format!("{line}\x1b[K\n")).collect();
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
    heard: Option<HeardShown>,
    refused_by: Option<RefusedShown>,
    tree: Option<TreeShown>,
    ports: Option<Vec<PortShown>>,
    parent_changes: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    other_serial: Option<u32>,
}

#[derive(Serialize)]
struct HeardShown {
    joints: u16,
    joints_late: u16,
    joints_repeated: u16,
    stimuli: u16,
    stimuli_late: u16,
    torques: u16,
}

impl HeardShown {
    const fn of(it: &Heard) -> Self {
        let Heard { joints, joints_late, joints_repeated, stimuli, stimuli_late, torques } = *it;
        Self { joints, joints_late, joints_repeated, stimuli, stimuli_late, torques }
    }
}

#[derive(Serialize)]
struct RefusedShown {
    length: u16,
    crc: u16,
    foreign: u16,
    meaning: u16,
    incomplete: u16,
    stimuli: u16,
}

impl RefusedShown {
    const fn of(it: &Refused) -> Self {
        let Refused { length, crc, foreign, meaning, incomplete, stimuli } = *it;
        Self { length, crc, foreign, meaning, incomplete, stimuli }
    }
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
        let Tree { parent, depth, sent, taken, dropped, .. } = *it;
        let depth = parent.map(|_| depth);
        Self { parent, depth, sums_sent: sent, sums_taken: taken, sums_dropped: dropped }
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
