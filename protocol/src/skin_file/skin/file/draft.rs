//! The writer of new skin files.

use core::fmt::Write;

use super::Value;
use crate::can::Format;
use crate::usage::printable;

/// The text of a new skin file, written from top to bottom.
#[derive(Clone, Debug, Default)]
pub struct SkinDraft(String);

/// A bus to write into a new skin file.
#[derive(Clone, Copy, Debug)]
pub struct DraftBus<'a> {
    /// Name of the interface.
    pub name: &'a str,
    /// Name of the chain that carries the bus; `None` to omit the key.
    pub chain: Option<&'a str>,
    /// Width of a slot for sums, in µs; `None` if the cells reply with their own torques.
    pub slot_us: Option<u64>,
    /// Frame format of the bus.
    pub format: Format,
}

/// The direction in which a cell faces.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum CellFacing {
    /// Outward normal, in the frame of the cell's row.
    Normal([f64; 3]),
    /// Orientation of the cell in the frame of its row, a unit quaternion x, y, z, w.
    Orientation([f64; 4]),
}

/// A cell to write into a new skin file.
#[derive(Clone, Copy, Debug)]
pub struct DraftCell<'a> {
    /// A comment beside the table header.
    pub remark: Option<&'a str>,
    /// Name of the cell's bus.
    pub bus: &'a str,
    /// Node id of the cell.
    pub node: usize,
    /// Serial number of the cell; `None` to omit the key.
    pub serial: Option<usize>,
    /// Number of the joint that moves the cell, from 1.
    pub joint: usize,
    /// Number of the row that carries the cell; `None` for the row of the joint.
    pub row: Option<usize>,
    /// Position of the cell's centre in the frame of its row, in m.
    pub position: [f64; 3],
    /// Normal or orientation of the cell.
    pub facing: CellFacing,
    /// Node ids of the neighbours at the cell's ports, 0 for a free port; `None` to omit the key.
    pub neighbors: Option<[u8; 4]>,
    /// True if the cell is wired to the gateway.
    pub root: bool,
}

impl SkinDraft {
    /// Adds a comment line.
    pub fn add_comment(&mut self, text: &str) {
        match text {
            "" => self.0.push_str("#\n"),
            text => self.add_line(format_args!("# {}", printable(text))),
        }
    }

    fn add_line(&mut self, text: core::fmt::Arguments<'_>) {
        let _ = writeln!(self.0, "{text}");
    }

    /// Adds an empty line and a table header, with an optional comment. `head` includes the brackets.
    pub fn add_table_header(&mut self, head: &str, remark: Option<&str>) {
        match remark {
            Some(remark) => self.add_line(format_args!("\n{head}   # {}", printable(remark))),
            None => self.add_line(format_args!("\n{head}")),
        }
    }

    /// Adds a key with a value.
    pub fn set(&mut self, key: &str, value: Value<'_>) {
        self.add_line(format_args!("{key} = {value}"));
    }

    /// Adds a key with a value and a comment, separated by `blanks` spaces.
    pub fn set_with_comment(&mut self, key: &str, value: Value<'_>, blanks: usize, remark: &str) {
        self.add_line(format_args!("{key} = {value}{:blanks$}# {}", "", printable(remark)));
    }

    /// Adds a key with an inline table.
    pub fn set_table(&mut self, key: &str, values: &[(&str, Value<'_>)]) {
        self.add_line(format_args!("{key} = {}", inline_table(values)));
    }

    /// Adds a key with an array of inline tables, one per line.
    pub fn set_table_rows<'v>(
        &mut self,
        key: &str,
        remark: Option<&str>,
        rows: impl Iterator<Item = Vec<(&'v str, Value<'v>)>>,
    ) {
        match remark {
            Some(remark) => self.add_line(format_args!("{key} = [   # {}", printable(remark))),
            None => self.add_line(format_args!("{key} = [")),
        }
        rows.for_each(|row| self.add_line(format_args!("  {},", inline_table(&row))));
        self.0.push_str("]\n");
    }

    /// Adds the timing tables with this broadcast frequency in Hz, and the gains and thresholds of the paper.
    pub fn add_paper_settings(&mut self, broadcast_hz: f64) {
        self.add_table_header("[timing]", None);
        self.set("control_hz", Value::Number(500.0));
        self.set("joint_broadcast_hz", Value::Number(broadcast_hz));
        self.add_table_header("[contact]", Some("the paper's Algorithm 1"));
        for (key, value) in [
            ("alpha_c", 1.0),
            ("alpha_p", 0.0),
            ("contact_threshold_n", 0.1),
            ("proximity_threshold", 0.05),
            ("force_threshold_n", 0.1),
        ] {
            self.set(key, Value::Number(value));
        }
    }

    /// Adds the table of a bus.
    pub fn add_bus(&mut self, bus: &DraftBus<'_>) {
        self.add_table_header("[[bus]]", None);
        self.set("name", Value::Text(bus.name));
        if let Some(chain) = bus.chain {
            self.set("chain", Value::Text(chain));
        }
        self.set("reply", Value::Text(if bus.slot_us.is_some() { "sum" } else { "torque" }));
        if let Some(slot_us) = bus.slot_us {
            self.set("slot_us", Value::Integer(i64::try_from(slot_us).unwrap_or(i64::MAX)));
        }
        self.set("format", Value::Text(bus.format.name()));
    }

    /// Adds the table of a cell.
    pub fn add_cell(&mut self, cell: &DraftCell<'_>) {
        let whole = |value: usize| Value::Integer(i64::try_from(value).unwrap_or(i64::MAX));
        self.add_table_header("[[cell]]", cell.remark);
        self.set("bus", Value::Text(cell.bus));
        self.set("node", whole(cell.node));
        if let Some(serial) = cell.serial {
            self.set("serial", whole(serial));
        }
        self.set("joint", whole(cell.joint));
        if let Some(row) = cell.row {
            self.set("row", whole(row));
        }
        self.set("position", Value::Numbers(&cell.position));
        match &cell.facing {
            CellFacing::Normal(normal) => self.set("normal", Value::Numbers(normal)),
            CellFacing::Orientation(turn) => self.set("orientation", Value::Numbers(turn)),
        }
        if let Some(neighbors) = &cell.neighbors {
            self.set("neighbors", Value::Nodes(neighbors));
        }
        if cell.root {
            self.set("root", Value::Flag(true));
        }
    }

    /// Returns the complete text of the file.
    #[must_use]
    pub fn into_text(self) -> String {
        self.0
    }
}

fn inline_table(values: &[(&str, Value<'_>)]) -> String {
    let all: Vec<_> = values.iter().map(|(key, value)| format!("{key} = {value}")).collect();
    format!("{{ {} }}", all.join(", "))
}
