//! `skinbus experiment`.

mod benches;
mod folder;

use std::io::{self, IsTerminal};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use analysis::report::figure::{Finding, FindingVerdict, Page, Section};
use analysis::report::{page, svg};
use bench::bus::realtime;
use bench::record::facts;
use clap::Args;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use paper::arm::ReplyMode;
use paper::moving::BenchRun;
use paper::scale::ScaleBench;
use paper::{Effort, Experiment as Named, ExperimentLab, Session, files};
use protocol::quantiles::Quantiles;
use protocol::usage::{Failure, print_text, shell_quoted_os};
use serde_json::Value;

use super::input::stop_flag;
use super::output::{OverwriteOption, print_note};
use super::print::{KeyValueTable, to_pretty_json};
use benches::BenchRunner;
use folder::ResultFolder;

/// Repeat the experiments of a paper (docs/explanation/paper.md), and rate the results
///
/// Writes to DIR: report.html, each figure as SVG with its data as CSV, results.json with each finding beside the
/// paper's and its verdict, and the recordings of the benches. Writes nothing if a measurement fails or is interrupted.
/// A directory that is not empty needs --overwrite. `skinbus experiment list` lists the experiments.
///
/// The benches of the moving arm are 253 processes on an embedded bus of their own; those of scale have up to 10 000
/// cells, one process per bus. All experiments take about five minutes, half of that for scale. Exit code 0: done,
/// whatever the verdicts; 1: something failed or was ended; 2: wrong use.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus experiment list
  skinbus experiment fig9 fig10 -o laws
  skinbus experiment all -o experiments")]
pub(crate) struct ExperimentCommand {
    /// Names of experiments; `all` runs each of them, `list` describes them
    #[arg(value_name = "NAME", required = true)]
    names: Vec<ExperimentArgument>,
    /// Directory for the results (required, except for `list`; created if absent)
    #[arg(long, short, value_name = "DIR")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: OverwriteOption,
    /// Try out the experiments with few cells for a few seconds; the results are not valid
    #[arg(long)]
    quick: bool,
    /// Show neither progress nor findings
    #[arg(long, short)]
    quiet: bool,
}

/// An argument of the command: an experiment, or one of the keywords.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum ExperimentArgument {
    All,
    List,
    One(Named),
}

impl FromStr for ExperimentArgument {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, String> {
        match word {
            "all" => Ok(Self::All),
            "list" => Ok(Self::List),
            _ => word
                .parse()
                .map(Self::One)
                .map_err(|error| format!("{error}; `skinbus experiment list` describes them")),
        }
    }
}

impl ExperimentCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        if self.names.contains(&ExperimentArgument::List) {
            return list_experiments();
        }
        let Some(output) = &self.output else {
            return Err(Failure::usage_error(
                "-o DIR is missing: name the folder for report.html and the figures",
            ));
        };
        let is_selected = |named: &Named| {
            self.names.iter().any(|word| {
                matches!(word, ExperimentArgument::All) || *word == ExperimentArgument::One(*named)
            })
        };
        let named: Vec<Named> = Named::ALL.into_iter().filter(is_selected).collect();
        let stop = stop_flag()?;
        // Create the directory before any measurement, so that an error of the directory is reported first.
        let folder = ResultFolder::create(output, self.overwrite)?;
        let page = self.perform(&named, &folder, stop)?;
        write_results(&page, &folder)?;
        // Keep the measured data even if it cannot be drawn.
        write_report(&page, folder).map_err(|failure| {
            failure.append(format_args!(
                "{} contains the results, the data of the figures and the recordings",
                output.display()
            ))
        })?;
        if self.quiet { Ok(()) } else { print_findings(&page, &output.join("report.html")) }
    }

    fn perform(
        &self,
        named: &[Named],
        folder: &ResultFolder,
        stop: Arc<AtomicBool>,
    ) -> Result<Page, Failure> {
        let effort = if self.quick { Effort::Quick } else { Effort::Full };
        let progress = Progress::new(named.iter().map(|named| named.seconds(effort)).sum(), self.quiet);
        let benches = BenchRunner { folder: folder.staging_directory(), stop: Arc::clone(&stop) };
        let mut lab = LocalLab { benches, stop, idle: None };
        let mut session = Session::new(effort);
        let mut sections = Vec::with_capacity(named.len());
        for named in named {
            progress.begin_experiment(*named);
            sections.push(session.perform(*named, &mut lab)?);
            progress.add_finished_seconds(named.seconds(effort));
        }
        lab.check_stopped()?;
        progress.clear();
        Ok(self.page(sections, lab.idle))
    }

    fn page(&self, sections: Vec<Section>, idle: Option<String>) -> Page {
        let words = std::env::args_os().enumerate().map(|(place, word)| {
            // Leave out the directory of the program.
            let name = Path::new(&word).file_name().filter(|_| place == 0);
            shell_quoted_os(name.unwrap_or(&word))
        });
        let command = words.collect::<Vec<_>>().join(" ");
        let about = facts::program_metadata(std::slice::from_ref(&command), 0);
        let fact = |key: &str| about.get(key).cloned().unwrap_or_default();
        let quick = "quick: few cells and few measurements; these numbers are not valid results";
        let facts = [
            ("command", Some(command)),
            ("program", Some(format!("{}, revision {}", fact("program"), fact("git_revision")))),
            ("machine", Some(machine())),
            ("late wake-ups, idle", idle),
            ("effort", self.quick.then(|| quick.to_owned())),
        ];
        let facts = facts.into_iter().filter_map(|(name, fact)| Some((name.to_owned(), fact?))).collect();
        Page {
            title: "The paper's experiments".to_owned(),
            intro: "Efficient Distributed Torque Computation for Large Scale Robot Skin, repeated on a simulated \
                    skin: each figure is measured again, and each number is shown beside the paper's."
                .to_owned(),
            facts,
            sections,
        }
    }
}

/// Runs the measurements of experiments on this machine.
struct LocalLab {
    benches: BenchRunner,
    stop: Arc<AtomicBool>,
    /// Wake-up lateness of the idle machine before a bench, as text.
    idle: Option<String>,
}

impl ExperimentLab for LocalLab {
    type Error = Failure;

    fn now_ns(&self) -> u64 {
        realtime::monotonic_ns()
    }

    fn run_bench(&mut self, reply: ReplyMode, effort: Effort) -> Result<BenchRun, Failure> {
        let run = self.benches.run_arm_bench(reply, effort);
        // If a signal has ended the bench, return that it was interrupted, not that it failed.
        self.check_stopped()?;
        let run = run?;
        let late = |key: &str| run.summary_number(&["loop", "idle_late_us", key]);
        self.idle.get_or_insert_with(|| {
            format!("median {:.0}, 99 % {:.0}, max {:.0} µs", late("p50"), late("p99"), late("max"))
        });
        Ok(run)
    }

    fn run_scaled_bench(&mut self, bench: &ScaleBench) -> Result<Value, Failure> {
        let summary = self.benches.run_scaled(bench);
        self.check_stopped()?;
        summary
    }

    fn check_stopped(&mut self) -> Result<(), Failure> {
        if self.stop.load(Ordering::Relaxed) {
            return Err(Failure::run_error("ended by a signal: nothing was written"));
        }
        Ok(())
    }
}

/// Returns the names of the processor and the kernel in one line.
fn machine() -> String {
    let about = facts::machine_metadata(&Quantiles::default());
    let fact = |key: &str| about.get(key).cloned().unwrap_or_default();
    let cpu = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = cpu.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": "));
    let name = name.map_or("unknown processor", |(_, name)| name.trim());
    format!(
        "{name}, {} processors in use, {} {} {}",
        fact("processors"),
        fact("sysname"),
        fact("release"),
        fact("machine")
    )
}

fn list_experiments() -> Result<(), Failure> {
    let line = |named: Named| format!("{:12} {}\n", named.name(), named.description());
    print_text(&Named::ALL.into_iter().map(line).collect::<String>())
}

/// Writes the findings and the data of the figures, and publishes them with the recordings.
fn write_results(page: &Page, folder: &ResultFolder) -> Result<(), Failure> {
    folder.write("results.json", &to_pretty_json(&files::findings_json(page))?)?;
    for figure in page.sections.iter().flat_map(|section| &section.figures) {
        folder.write(&format!("{}.csv", figure.name), &files::csv(figure))?;
    }
    folder.publish_files()
}

/// Writes the HTML page and the figures.
fn write_report(page: &Page, folder: ResultFolder) -> Result<(), Failure> {
    folder.write("report.html", &page::page_html(page))?;
    for figure in page.sections.iter().flat_map(|section| &section.figures) {
        folder.write(&format!("{}.svg", figure.name), &svg::draw_figure(figure))?;
    }
    folder.finish()
}

/// Prints the findings and the path of the page.
fn print_findings(page: &Page, report: &Path) -> Result<(), Failure> {
    let mut rows = KeyValueTable::new("", "here", "paper, limit");
    for section in &page.sections {
        rows.add_section(&section.title, "", "");
        for Finding { what, paper, ours, bar, verdict, .. } in &section.findings {
            let beside = [paper.as_ref().map(|paper| format!("paper {paper}")), bar.clone()];
            let beside = beside.into_iter().flatten().collect::<Vec<_>>().join("; ");
            let verdict = match verdict {
                FindingVerdict::Stated => String::new(),
                FindingVerdict::Better
                | FindingVerdict::Same
                | FindingVerdict::Busy
                | FindingVerdict::Worse => format!("  {verdict}"),
            };
            rows.add_row(what, ours, format!("{beside}{verdict}"));
        }
    }
    let worse = page.sections.iter().flat_map(|section| &section.findings);
    let worse = worse.filter(|finding| finding.verdict == FindingVerdict::Worse).count();
    let worse = if worse == 0 {
        String::new()
    } else {
        format!("results that are worse than the paper's, or than required: {worse}\n")
    };
    print_text(&format!("{}{worse}{}\n", rows.to_text(), report.display()))
}

/// A progress bar on a terminal; elsewhere one line per experiment.
struct Progress {
    bar: ProgressBar,
    lines: bool,
}

impl Progress {
    fn new(seconds: u64, quiet: bool) -> Self {
        let lines = !io::stderr().is_terminal() && !quiet;
        if quiet || lines {
            return Self { bar: ProgressBar::hidden(), lines };
        }
        let bar = ProgressBar::with_draw_target(Some(seconds), ProgressDrawTarget::stderr());
        let style = ProgressStyle::with_template("{spinner} {wide_bar} {msg}  {elapsed} of about {len} s");
        bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
        bar.enable_steady_tick(Duration::from_millis(100));
        Self { bar, lines }
    }

    fn begin_experiment(&self, named: Named) {
        self.bar.set_message(named.name());
        if self.lines {
            print_note(format_args!("{named}: {}", named.description()));
        }
    }

    fn add_finished_seconds(&self, seconds: u64) {
        self.bar.inc(seconds);
    }

    fn clear(&self) {
        self.bar.finish_and_clear();
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.clear();
    }
}
