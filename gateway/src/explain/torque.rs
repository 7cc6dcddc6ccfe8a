//! Torques that a force on a cell causes, computed centrally and as the cell computes them: `skinbus explain SKIN
//! --force`.

use core::f64::consts::TAU;
use std::path::{Path, PathBuf};

use clap::Args;
use model::central::CentralComputation;
use model::scenario::MAX_FORCE_N;
use protocol::document;
use protocol::fixed::{Q1_14, is_saturated};
use protocol::parameters::MAX_JOINTS;
use protocol::skin::{CellName, JointKind, Skin};
use protocol::usage::{Failure, print_text};
use reference::ReferenceCell;
use serde::Serialize;

use crate::arguments::find_cell;
use crate::columns::{Columns, CsvTable};
use crate::input::read_skin_or_recording;
use crate::print::{count_with_noun, json_line, table};

/// Maximum size in bytes of a file of rows.
const MAX_BATCH_BYTES: u64 = 256 << 20;

/// Columns of a file of rows.
const COLUMNS: Columns = Columns { needed: &["cell", "force_n", "q"], optional: &[] };

/// Options for a force on a cell, or rows of them.
#[derive(Args, Debug)]
pub(super) struct TorqueOptions {
    /// Compute the torques of this force, which presses on the cell against its outward normal: 0 to 95.997 N, the most
    /// that a cell's three contact sensors can report
    #[arg(long, value_name = "N", requires_all = ["cell", "joints"], conflicts_with_all = ["epoch", "skin"], allow_negative_numbers = true)]
    force: Option<f64>,
    /// Positions of the chain's joints in rad or m, separated by spaces
    #[arg(long, value_name = "POSITIONS", requires = "force", allow_hyphen_values = true)]
    joints: Option<String>,
    /// Compute the torques for each row of a CSV file with the columns cell, force_n and q
    #[arg(long, value_name = "ROWS.csv", conflicts_with_all = ["force", "cell", "epoch", "skin"])]
    batch: Option<PathBuf>,
}

/// Torques of a row, computed both ways, in Nm (prismatic joints: N).
#[derive(Serialize)]
struct ComputedRow {
    cell: String,
    force_n: f64,
    joints: Vec<String>,
    units: Vec<&'static str>,
    central: Vec<f64>,
    fixed: Vec<f64>,
    difference: Vec<f64>,
    saturated: bool,
}

impl TorqueOptions {
    /// Computes the torques for a skin, or the skin in a recording, and prints them.
    pub(super) fn print_torques(
        &self,
        files: &[PathBuf],
        cell: Option<&CellName>,
        as_json: bool,
    ) -> Result<(), Failure> {
        let [file] = files else {
            return Err(Failure::usage_error("--force and --batch need exactly one skin: name one file"));
        };
        let skin = read_skin_or_recording(file)?;
        let calculator = Calculator::new(&skin);
        let rows = match (cell, &self.batch) {
            (_, Some(path)) => calculator.compute_batch_file(path)?,
            (Some(cell), None) => {
                let (force, joints) =
                    (self.force.unwrap_or_default(), self.joints.as_deref().unwrap_or_default());
                vec![
                    calculator
                        .compute_for_named_cell(cell, "--cell", force, joints)
                        .map_err(Failure::usage_error)?,
                ]
            }
            (None, None) => Vec::new(),
        };
        if as_json {
            return rows.iter().try_for_each(|row| print_text(&json_line(row)?));
        }
        rows.iter().try_for_each(|row| print_text(&row.to_text()))
    }
}

/// Computes the torques of a force on a cell of one skin both ways: centrally, and as the cell does.
struct Calculator<'a> {
    skin: &'a Skin,
    /// Central computation of each bus.
    central: Vec<CentralComputation>,
}

impl<'a> Calculator<'a> {
    fn new(skin: &'a Skin) -> Self {
        let central = (0..skin.buses.len())
            .map(|bus| CentralComputation::without_quantisation(&skin.with_cells_of_bus(bus)));
        Self { skin, central: central.collect() }
    }

    fn compute_batch_file(&self, path: &Path) -> Result<Vec<ComputedRow>, Failure> {
        let file = path.display().to_string();
        let text = document::read_text_up_to(path, MAX_BATCH_BYTES).map_err(Failure::usage_error)?;
        let mut table = CsvTable::new(&file, &text, COLUMNS)?;
        let mut rows = Vec::new();
        while let Some(line) = table.next_row()? {
            let at = format!("{file}, row {}: cell", rows.len() + 1);
            let named = line
                .text("cell")
                .parse::<CellName>()
                .map_err(|error| Failure::usage_error(format!("{at} {error}")))?;
            let force = line.number("force_n")?;
            rows.push(
                self.compute_for_named_cell(&named, &at, force, line.text("q"))
                    .map_err(Failure::usage_error)?,
            );
        }
        if rows.is_empty() {
            return Err(Failure::usage_error(format!(
                "{file}: it contains no rows: write a line for each computation"
            )));
        }
        Ok(rows)
    }

    /// Computes the torques of one row both ways. Returns the reason if this is not possible; `option` names the option
    /// that gave the cell.
    fn compute_for_named_cell(
        &self,
        named: &CellName,
        option: &str,
        force: f64,
        positions: &str,
    ) -> Result<ComputedRow, String> {
        let index = find_cell(self.skin, named, option).map_err(|failure| failure.to_string())?;
        self.compute_row(index, force, positions).map_err(|why| format!("{option} {named}: {why}"))
    }

    /// Computes the torques of one row for the cell with this index.
    fn compute_row(&self, index: usize, force: f64, positions: &str) -> Result<ComputedRow, String> {
        let skin = self.skin;
        let Some(cell) = skin.cells.get(index) else { return Err("no such cell".to_owned()) };
        let joints: Vec<_> = skin.joints_on_bus(cell.bus).map(|(_, joint)| joint).collect();
        if !(0.0..=MAX_FORCE_N).contains(&force) {
            return Err(format!(
                "force {force} N: the force against the outward normal must be 0 to {MAX_FORCE_N:.3} N, the \
                 most that a cell's three contact sensors can report"
            ));
        }
        let given: Vec<&str> = positions.split([' ', ',']).filter(|text| !text.is_empty()).collect();
        if given.len() != joints.len() {
            let names = joints.iter().map(|joint| joint.name.as_str()).collect::<Vec<_>>().join(", ");
            let (got, needed) =
                (count_with_noun(given.len(), "position"), count_with_noun(joints.len(), "joint"));
            return Err(format!("{got} given, but one is needed for each of the chain's {needed}: {names}"));
        }
        let mut q = Vec::with_capacity(given.len());
        let mut words = [Q1_14::ZERO; MAX_JOINTS];
        for ((text, joint), word) in given.iter().zip(&joints).zip(&mut words) {
            let position =
                text.parse().ok().and_then(|value: f64| Some((value, joint.kind.position_to_word(value)?)));
            let Some((position, nearest)) = position else {
                return Err(format!(
                    "position {text:?} of {}: use a number in {}",
                    joint.name,
                    joint.kind.unit()
                ));
            };
            let ([min, max], unit) = (joint.limits, joint.kind.unit());
            // Angles beyond the limits are allowed, as they make sense, but not angles that are given in degrees by
            // mistake.
            let [min, max] = match joint.kind {
                JointKind::Prismatic => [min, max],
                JointKind::Revolute => [min.min(-TAU), max.max(TAU)],
            };
            if !(min..=max).contains(&position) {
                return Err(format!(
                    "position {text} {unit}: {} allows {min:.4} to {max:.4} {unit}",
                    joint.name
                ));
            }
            q.push(position);
            *word = nearest;
        }
        let parameters = skin.parameters(cell);
        let reference = ReferenceCell::new(&parameters);
        let words = reference.torque_for_force(&words, force);
        // Position of the cell on its bus.
        let place = skin.cells_on_bus(cell.bus).position(|other| other.node == cell.node).unwrap_or_default();
        let central = self
            .central
            .get(cell.bus)
            .map(|central| central.cell_torque(place, &central.frames_at_positions(&q), force));
        // Adding 0.0 turns -0.0 into 0.0.
        let central: Vec<f64> =
            central.into_iter().flatten().take(joints.len()).map(|value| value + 0.0).collect();
        let words = words.get(..joints.len()).unwrap_or_default();
        let fixed: Vec<f64> = words.iter().map(|&word| reference.format().to_real(word)).collect();
        let bus = skin.buses.get(cell.bus).map_or("", |bus| &bus.name);
        Ok(ComputedRow {
            cell: format!("{bus}:{}", cell.node),
            force_n: force,
            joints: joints.iter().map(|joint| joint.name.clone()).collect(),
            units: joints.iter().map(|joint| joint.kind.torque_unit()).collect(),
            difference: fixed.iter().zip(&central).map(|(fixed, central)| fixed - central).collect(),
            central,
            fixed,
            saturated: words.iter().any(|&word| is_saturated(word)),
        })
    }
}

impl ComputedRow {
    fn to_text(&self) -> String {
        let numbers = self.central.iter().zip(&self.fixed).zip(&self.difference);
        let rows = self.joints.iter().zip(&self.units).zip(numbers).map(
            |((name, unit), ((central, fixed), difference))| {
                vec![
                    name.clone(),
                    format!("{central:.6}"),
                    format!("{fixed:.6}"),
                    format!("{difference:+.6}"),
                    (*unit).to_owned(),
                ]
            },
        );
        let head = ["joint", "central", "cell", "difference", "unit"];
        let table = table(head, rows, |column| (1..4).contains(&column));
        let saturated =
            if self.saturated { "\nsaturated: a word is at the end of its format's range" } else { "" };
        format!("cell {}, {} N{saturated}\n{table}\n", self.cell, self.force_n)
    }
}
