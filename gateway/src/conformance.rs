//! `skinbus conformance`.

mod show;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Args;
use conformance::bus::StopReason;
use conformance::findings::RequirementFilter;
use conformance::live::SocketBus;
use conformance::survey::Survey;
use conformance::{SavedCell, Session};
use protocol::can::Format;
use protocol::skin::CellName;
use protocol::time::Span;
use protocol::usage::Failure;

use self::show::ConformanceResult;
use super::arguments::{BusKinds, FORMATS, one_of_values};
use super::output::{OverwriteOption, print_beside_files};
use super::{input, output};

/// Maximum duration of a test, without the time to listen at the start and to restore the cell at the end.
const MAX_TEST_DURATION: Span = Span::from_millis(80_000);

/// Test a cell from any manufacturer against the documented requirements
///
/// Checks all numbered requirements of cell.md and sensing.md in at most 90 s and prints a verdict on each, with the
/// frames that show a failure. The test commits configurations of its own: it first saves the cell's configuration to a
/// file, and restores it at the end, even after Ctrl-C or SIGTERM. No other cell or gateway may use the bus during the
/// test. Exit code 0: no requirement failed; 1: a requirement failed, or the test could not run; 2: wrong use.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus conformance --bus can0 --cell 12
  skinbus conformance --bus can0 --cell 12 --restart './relay off; sleep 0.2; ./relay on' --junit cell.xml
  skinbus conformance --bus can0 --cell 12 --requirement CONF,COUNT-1
  skinbus conformance --bus can0 --cell 12 --restore conformance-can0-12.json")]
pub(crate) struct ConformanceCommand {
    /// Name of the cell's bus, unless --cell names it
    #[arg(long, value_name = "NAME")]
    bus: Option<String>,
    /// Cell to test, by node id
    #[arg(long, value_name = "[BUS:]NODE")]
    cell: CellName,
    #[command(flatten)]
    kinds: BusKinds,
    /// Frame format of the bus [default: the format of the cell's heartbeats]
    #[arg(long, value_parser = one_of_values(FORMATS))]
    format: Option<Format>,
    /// Test only these requirements, such as CONF-7, or CONF for all whose ids begin with CONF
    #[arg(long, value_name = "ID", value_delimiter = ',')]
    requirement: Vec<String>,
    /// Shell command that switches the cell's power off and on; requirements on the start of a cell are tested only
    /// with it
    #[arg(long, value_name = "COMMAND")]
    restart: Option<String>,
    /// Test even if other cells are on the bus; the joints and halt messages of the test reach and stop them too
    #[arg(long)]
    others_will_stop: bool,
    /// Save the cell's configuration to this file before the test changes it [default: conformance-BUS-NODE.json]
    #[arg(long, value_name = "FILE")]
    save: Option<PathBuf>,
    /// Restore the configuration that an earlier test saved in this file, delete the file, and test nothing
    #[arg(long, value_name = "FILE", conflicts_with_all = ["requirement", "restart", "json", "junit", "save"])]
    restore: Option<PathBuf>,
    /// Print one JSON object instead of the table
    #[arg(long, short)]
    json: bool,
    /// Also write the verdicts to this file as a JUnit report
    #[arg(long, value_name = "FILE")]
    junit: Option<PathBuf>,
    #[command(flatten)]
    overwrite: OverwriteOption,
}

impl ConformanceCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let only = RequirementFilter::new(&self.requirement).map_err(|word| {
            Failure::usage_error(format!(
                "--requirement {word}: no requirement has this id; give an id such as CONF-7, or a group \
                 such as CONF"
            ))
        })?;
        let stopped = input::stop_flag()?;
        let name = match (&self.bus, &self.cell.bus) {
            (None, None) => {
                return Err(Failure::usage_error(
                    "the bus of the cell is missing: add --bus NAME, or write --cell BUS:NODE",
                ));
            }
            (Some(bus), Some(other)) if bus != other => {
                return Err(Failure::usage_error(format!(
                    "--cell {} is not on {bus}: correct --cell, or leave out --bus",
                    self.cell
                )));
            }
            (Some(bus), _) | (None, Some(bus)) => bus.as_str(),
        };
        let node = self.cell.node;
        let kind = self.kinds.kinds_of_buses([name])?.kind_of(name);
        let path = self.save.clone().unwrap_or_else(|| format!("conformance-{name}-{}.json", node).into());
        if self.restore.is_none() && path.exists() {
            let path = path.display();
            return Err(Failure::usage_error(format!(
                "an earlier test left {path} and did not restore the cell: restore the cell with --restore \
                 {path}, or delete the file"
            )));
        }
        let junit = self.junit.as_ref().map(|path| self.overwrite.create("--junit", path)).transpose()?;
        let mut live =
            SocketBus::open(name, kind, stopped, self.restart.clone()).map_err(Failure::usage_error)?;
        let survey = Survey::listen(&mut live, name).map_err(Failure::run_error)?;
        let format = survey
            .check_cell(node, name, self.format, self.others_will_stop || self.restore.is_some())
            .map_err(Failure::run_error)?;
        let mut session = Session::new(&mut live, name, node, format, MAX_TEST_DURATION);
        if let Some(path) = &self.restore {
            return restore_cell(&mut session, &read_saved(path)?, path);
        }
        let began = Instant::now();
        let saved = session.save().map_err(Failure::run_error)?;
        let saved = saved.map_err(|why| Failure::run_error(format!("cell {} on {name}: {why}", node)))?;
        OverwriteOption { overwrite: false }.write(
            "--save",
            &path,
            &super::print::to_pretty_json(&saved)?,
        )?;
        let stopped = conformance::run(&mut session, &only).err();
        let back = restore_cell(&mut session, &saved, &path);
        let whole = ConformanceResult::new(
            &saved,
            format,
            began.elapsed(),
            session.findings.requested_findings(&only, stopped.as_ref()),
            stopped.as_ref(),
        );
        // If one output fails, the others are written nevertheless.
        let shown = super::print::to_pretty_json(&whole).and_then(|json| {
            let shown = if self.json { json } else { whole.text() };
            print_beside_files([self.junit.as_deref()], &shown)
        });
        let reported = junit
            .map_or(Ok(()), |(file, out)| output::write_and_finish("--junit", file, out, &whole.junit()));
        back.and(shown).and(reported)?;
        match stopped {
            Some(StopReason::Interrupted) => {
                Err(Failure::run_error("interrupted; the cell has been restored"))
            }
            Some(stopped) => Err(Failure::run_error(stopped)),
            None if whole.has_failed() => Err(Failure::already_reported()),
            None => Ok(()),
        }
    }
}

/// Reads the configuration that an earlier test saved.
fn read_saved(path: &Path) -> Result<SavedCell, Failure> {
    let wrong = |error: &dyn std::fmt::Display| {
        Failure::usage_error(format!("--restore {}: {error}", path.display()))
    };
    let text = protocol::document::read_text(path).map_err(Failure::usage_error)?;
    serde_json::from_str(&text).map_err(|error| wrong(&error))
}

/// Restores the cell's configuration, and deletes the file on success.
fn restore_cell(session: &mut Session<'_>, saved: &SavedCell, path: &PathBuf) -> Result<(), Failure> {
    let keep = |why: &dyn std::fmt::Display| {
        let path = path.display();
        Failure::run_error(format!(
            "the cell was not restored: {why}; its configuration is in {path}: restore it with --restore \
             {path}"
        ))
    };
    let left = session.restore(saved).map_err(|stop| keep(&stop))?;
    if saved.hash != 0 && !left.is_empty() {
        return Err(keep(&left.join(", ")));
    }
    left.iter().for_each(output::print_note);
    fs::remove_file(path).map_err(|error| Failure::run_error(format!("{}: {error}", path.display())))
}
