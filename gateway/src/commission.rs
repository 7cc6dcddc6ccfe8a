//! `skinbus commission`.

mod show;

use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::time::Instant;

use bench::commission::{CommissionedBus, commission, open};
use bench::progress::Progress as Line;
use clap::Args;
use model::commission::node_ids::{NodeIds, renumber_nodes};
use model::commission::{CommissionOptions, Outcome, Progress};
use protocol::document;
use protocol::skin::Skin;
use protocol::usage::Failure;

use super::arguments::{BusKinds, bus_names, find_bus};
use super::output::{OverwriteOption, check_distinct_files, print_beside_files};
use super::print::{abbreviate_names, comma_separated};
use super::{input, output};

/// Write the parameters in a skin file into its cells, and read them back
///
/// Finds each cell by its serial number, writes the robot's table, the pose, gains and thresholds into its flash, reads
/// everything back and compares. A cell applies its new parameters all at once, so the command may be interrupted at
/// any moment and run again: cells with the right configuration are skipped. Cells that the skin does not have are
/// listed and not changed. Exit code 0: all cells have the skin's configuration; 1: some do not, and the table gives
/// the reason; 2: wrong use or configuration.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus commission skin.toml
  skinbus commission skin.toml --dry-run
  skinbus commission skin.toml --verify --json | jq '.buses[0].failed'
  skinbus commission skin.toml --node-ids as-wired.toml && skinbus run as-wired.toml --no-spawn")]
pub(crate) struct CommissionCommand {
    /// Skin file (TOML) that describes the robot, buses and cells
    skin: PathBuf,
    /// Commission the cells of this bus only
    #[arg(long, value_name = "NAME")]
    bus: Option<String>,
    #[command(flatten)]
    kinds: BusKinds,
    /// Write nothing to the cells: only list those found, and which of them need writing
    #[arg(long)]
    dry_run: bool,
    /// Also read back and compare the parameters of cells whose configuration hash is already right
    #[arg(long)]
    verify: bool,
    /// Write a copy of the skin file with the node ids that the cells actually use
    #[arg(long, value_name = "FILE")]
    node_ids: Option<PathBuf>,
    #[command(flatten)]
    overwrite: OverwriteOption,
    /// Show only the table at the end, without progress
    #[arg(long, short)]
    quiet: bool,
    /// Print one JSON object instead of the table
    #[arg(long, short)]
    json: bool,
}

impl CommissionCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let text = document::read_text(&self.skin).map_err(Failure::usage_error)?;
        let file = self.skin.display().to_string();
        let skin = Skin::parse(&file, &text).map_err(Failure::usage_error)?;
        let target = match &self.bus {
            Some(name) => vec![find_bus(&skin, &file, name)?],
            None => (0..skin.buses.len()).collect(),
        };
        check_distinct_files([("--node-ids", self.node_ids.as_deref())], [self.skin.as_path()])?;
        // Open the file before cells are written, so that an error of the file is reported first.
        let begun =
            self.node_ids.as_ref().map(|path| self.overwrite.create("--node-ids", path)).transpose()?;
        let wish = CommissionOptions { dry_run: self.dry_run, verify: self.verify };
        let stopped = input::stop_flag()?;
        let kinds = self.kinds.kinds_of_buses(bus_names(&skin))?;
        // Open all buses before anything is sent.
        let benches = target.into_iter().map(|bus| open(&skin, bus, &kinds)).collect::<Result<Vec<_>, _>>();
        let benches = benches.map_err(Failure::usage_error)?;
        let began = Instant::now();
        let mut line = Line::new(self.quiet);
        let done =
            commission(benches, &skin, wish, &stopped, |far| line.show_line(|_width| progress_text(far)));
        line.clear_line();
        let interrupted = stopped.load(Ordering::Relaxed);
        check_reached(&file, &done, interrupted)?;
        let whole = show::CommissionResult {
            skin: &skin.name,
            file: &file,
            seconds: began.elapsed().as_secs_f64(),
            dry_run: self.dry_run,
            interrupted,
            buses: done.iter().map(show::DisplayedBus::from_bus).collect(),
        };
        if !self.quiet && !self.json {
            whole.notes(self.node_ids.is_some()).iter().for_each(output::print_note);
        }
        let shown = if self.json { super::print::to_pretty_json(&whole)? } else { whole.table() };
        print_beside_files([self.node_ids.as_deref()], &shown)?;
        if let Some((file, out)) = begun {
            let node_ids: NodeIds =
                done.iter().flat_map(|done| &done.report.cells).map(|it| (it.serial, it.number)).collect();
            let copy = renumber_nodes(&skin, &text, &node_ids);
            let copy = copy.map_err(|error| {
                Failure::run_error(format!("--node-ids {}: {error}", file.path().display()))
            })?;
            output::write_and_finish("--node-ids", file, out, &copy)?;
        }
        whole.outcome()
    }
}

/// Formats the progress of all buses in one line.
fn progress_text(all: &[Progress]) -> String {
    let sum = |part: fn(&Progress) -> usize| all.iter().map(part).sum::<usize>();
    let [cells, found] = [sum(|it| it.cells), sum(|it| it.found)];
    let [done, failed] = [sum(|it| it.done), sum(|it| it.failed)];
    // The slowest bus determines the displayed activity.
    let doing = all.iter().filter(|it| it.activity != "done").map(|it| it.activity).next().unwrap_or("done");
    let failed = if failed == 0 { String::new() } else { format!(", {failed} failed") };
    format!("{doing}: {found} of {cells} cells found, {done} done{failed}")
}

/// Returns an error with the reason if no cell could be reached on any bus.
fn check_reached(file: &str, done: &[CommissionedBus], interrupted: bool) -> Result<(), Failure> {
    let begun = done.iter().any(|done| {
        let is_well = |outcome| !matches!(outcome, Outcome::Failed(_));
        done.report.requests > 0 || done.report.cells.iter().any(|cell| is_well(cell.outcome))
    });
    if begun {
        return Ok(());
    }
    if let Some(done) = done.iter().find(|done| done.failure.is_some()) {
        return Err(Failure::run_error(done.failure.clone().unwrap_or_default()));
    }
    if interrupted {
        return Err(Failure::run_error("interrupted before anything was written"));
    }
    let found = done.iter().flat_map(|done| &done.report.cells).any(|it| it.number.is_some());
    if found {
        return Ok(());
    }
    let unknown_nodes: Vec<_> = done.iter().flat_map(|done| &done.report.unknown_nodes).collect();
    let buses = comma_separated(done.iter().map(|done| &done.name));
    Err(Failure::run_error(if unknown_nodes.is_empty() {
        format!("no cells were found on {buses}: start them or switch them on, then run the command again")
    } else {
        let serials: Vec<_> =
            unknown_nodes.iter().map(|unknown_node| unknown_node.serial.to_string()).collect();
        format!(
            "none of the cells on {buses} is in {file}: their serial numbers are {}; name the skin file \
             with these numbers",
            abbreviate_names(&serials)
        )
    }))
}
