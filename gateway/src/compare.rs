//! `skinbus compare`.

mod files;
mod show;

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::time::Instant;

use analysis::compare::{CaptureSide, CompareOptions, CompareReport, Comparison, PerCapture};
use analysis::explain::JointsNotFound;
use clap::Args;
use model::decode::Decoder;
use protocol::input::{can_be_read_again, is_standard_input};
use protocol::skin::Skin;
use protocol::stop;
use protocol::time::Micros;
use protocol::usage::Failure;
use serde::Serialize;
use trace::capture::{CaptureEntry, CaptureFormat, NoteKind, Reader};

use self::files::{first_joints_numbers, recording_parts};
use super::input;
use super::input::{
    first_skin_difference, format_name, location, no_frame_failure, open_capture, require_frames,
    skin_of_recording,
};
use super::output::{self, OverwriteOption, check_distinct_files, print_beside_files};
use super::print::{count_with_noun, to_pretty_json};

/// Compare two recordings or logs of one skin, epoch by epoch
///
/// Aligns joints messages and their replies by the number of their epoch. Epochs that one run has before the other
/// starts, or after it ends, are reported but not compared. Reply times, late replies and lost packets are shown side
/// by side and are no differences. docs/how-to/compare.md explains the rules. Exit code 0: equal; 1: different, or a
/// file is damaged; 2: wrong use, or two skins.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus compare yesterday.mcap today.mcap
  skinbus compare run.mcap run.log --skin skin.toml
  skinbus compare a.mcap b.mcap --tolerance 2 --joints-tolerance 8 --junit compare.xml
  skinbus compare a.mcap b.mcap --json | jq .first

Keys of --json:
  a, b, skin         names; tolerance, joints_tolerance, allow_missing as given
  equal, differs     true if nothing relevant differs; the aspects that differ
  captures.a, .b     frames, epochs, first and last number, last_s, torques, sums,
                     late, lost, restarts, reply_us; dropped, unfinished
  epochs             compared; missing_in_a, missing_in_b; before, after: only_a, only_b
  joints             epochs equal, tolerated, different; max_steps
  torques, sums      equal, tolerated, different, different_with_same_inputs, missing_in_a,
                     missing_in_b, open (the other run ended first), max_steps
  contacts, halts    both; only_a, only_b
  cells, extra_cells cells with differences or losses; cells in only one run
  first              the first difference: what, how, bus, cell, joint, epoch, number, time_s,
                     words, values, unit, steps, inputs, unknown_inputs, occurrence")]
pub(crate) struct CompareCommand {
    /// MCAP recording or candump log; - for standard input. For a split recording, name the first part: the other parts
    /// are found beside it
    #[arg(value_name = "A")]
    a: PathBuf,
    /// The MCAP recording or candump log to compare A with
    #[arg(value_name = "B")]
    b: PathBuf,
    /// Skin file of A and B [default: the skin in A or B]
    #[arg(long, value_name = "SKIN")]
    skin: Option<PathBuf>,
    /// Accept torques that differ by up to this many steps: 1/4096 Nm in Q3.12, 1/256 Nm in sums
    #[arg(long, value_name = "STEPS", default_value_t = 0)]
    tolerance: u16,
    /// Accept joint positions that differ by up to this many steps; a step is 1/16384 of a quarter turn or of a metre
    #[arg(long, value_name = "STEPS", default_value_t = 0)]
    joints_tolerance: u16,
    /// Accept up to this many replies and joints messages that one of the two runs lacks
    #[arg(long, value_name = "N", default_value_t = 0)]
    allow_missing: u64,
    /// Print one JSON object instead of the table
    #[arg(long, short)]
    json: bool,
    /// Also write a JUnit report, with a test case for each compared aspect: epochs, joints, halts, contacts, torques, sums, cells
    #[arg(long, value_name = "FILE")]
    junit: Option<PathBuf>,
    #[command(flatten)]
    overwrite: OverwriteOption,
}

/// Result of the comparison with its inputs, as JSON.
#[derive(Serialize)]
struct CompareOutput<'a> {
    a: &'a str,
    b: &'a str,
    skin: &'a str,
    tolerance: u16,
    joints_tolerance: u16,
    allow_missing: u64,
    #[serde(flatten)]
    report: &'a CompareReport,
}

/// A capture that is being read.
struct CaptureInput {
    files: Vec<PathBuf>,
    name: String,
    reader: Reader,
    decoder: Decoder,
    missing: input::LossCounts,
    has_frames: bool,
    /// Error that ended the reading of the capture early, if any.
    damage: Option<Failure>,
}

impl CaptureInput {
    fn open(files: Vec<PathBuf>) -> Result<Self, Failure> {
        let reader = open_capture(&files, |file| Box::new(file))?;
        let (name, missing) = (reader.name().to_owned(), input::LossCounts::default());
        let decoder = Decoder::new(None);
        Ok(Self { files, name, reader, decoder, missing, has_frames: false, damage: None })
    }

    /// Passes the frames that are latched at the start of the capture to the comparison.
    fn pass_latched(&mut self, which: CaptureSide, comparison: &mut Comparison<'_>) {
        for before in &self.reader.extras().latched {
            let at = Micros(before.nanos / 1_000);
            if let Some(message) = self.decoder.decode(at, &before.bus, &before.frame).message() {
                comparison.receive_latched(which, before.nanos, &before.bus, message);
            }
        }
    }

    /// Passes the next entry to the comparison.
    fn read_entry(&mut self, which: CaptureSide, comparison: &mut Comparison<'_>) {
        match self.reader.next() {
            Ok(Some(CaptureEntry::Frame(record))) => {
                self.has_frames = true;
                let nanos = record.time.nanos;
                let decoded = self.decoder.decode(Micros(nanos / 1_000), record.interface, &record.frame);
                comparison.receive(which, nanos, record.interface, decoded.message());
            }
            Ok(Some(CaptureEntry::Note(note))) => {
                self.missing.count(&note);
                match note.kind {
                    NoteKind::Dropped(frames) => comparison.record_dropped(which, frames),
                    NoteKind::Unreadable(why) if self.missing.unreadable_count() == 1 => {
                        output::print_note(format_args!("{}: {why}", location(&self.name, note.line)));
                    }
                    NoteKind::Text | NoteKind::CanXl | NoteKind::Unreadable(_) => {}
                }
            }
            Ok(None) => {
                if !self.reader.has_times() {
                    comparison.mark_untimed(which);
                }
                comparison.end_capture(which, self.reader.extras().unfinished.is_some());
            }
            Err(error) => {
                self.damage = Some(Failure::run_error(error));
                comparison.end_capture(which, true);
            }
        }
    }
}

impl CompareCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let began = Instant::now();
        let read = [&self.a, &self.b].into_iter().chain(&self.skin).map(PathBuf::as_path);
        check_distinct_files([("--junit", self.junit.as_deref())], read)?;
        if [&self.a, &self.b].iter().all(|file| is_standard_input(file)) {
            return Err(Failure::usage_error(
                "both inputs are - (standard input), which can be read only once: name a file for one of them",
            ));
        }
        let files = PerCapture { a: recording_parts(&self.a)?, b: recording_parts(&self.b)? };
        let skin = self.common_skin(&files)?;
        let junit = self.junit.as_ref().map(|path| self.overwrite.create("--junit", path)).transpose()?;
        let mut comparison = Comparison::new(&skin, self.options(), first_joints_numbers(&files, &skin)?);
        let PerCapture { a, b } = files;
        let mut inputs = PerCapture { a: CaptureInput::open(a)?, b: CaptureInput::open(b)? };
        for which in [CaptureSide::A, CaptureSide::B] {
            inputs.get_mut(which).pass_latched(which, &mut comparison);
        }
        while let Some(which) = comparison.next_side() {
            inputs.get_mut(which).read_entry(which, &mut comparison);
        }
        if stop::stop_flag().load(Ordering::Relaxed) {
            return Err(Failure::run_error("interrupted before the comparison was complete"));
        }
        for which in [CaptureSide::A, CaptureSide::B] {
            self.check_capture(inputs.get_mut(which), which, &mut comparison, &skin)?;
        }
        let report = comparison.report();
        for which in [CaptureSide::A, CaptureSide::B] {
            let input = inputs.get(which);
            input.missing.print_counts(&input.reader, "left out");
        }
        let shown = show::ComparisonText {
            inputs: PerCapture { a: capture_names(&inputs.a), b: capture_names(&inputs.b) },
            skin: self.skin.as_deref(),
            report: &report,
        };
        let whole = CompareOutput {
            a: &inputs.a.name,
            b: &inputs.b.name,
            skin: &skin.name,
            tolerance: self.tolerance,
            joints_tolerance: self.joints_tolerance,
            allow_missing: self.allow_missing,
            report: &report,
        };
        let text = if self.json { to_pretty_json(&whole)? } else { shown.text() };
        let printed = print_beside_files([self.junit.as_deref()], &text);
        let reported = junit.map_or(Ok(()), |(file, out)| {
            output::write_and_finish("--junit", file, out, &shown.junit(began.elapsed()).to_xml())
        });
        printed.and(reported)?;
        match inputs.a.damage.or(inputs.b.damage) {
            Some(damage) => Err(damage),
            None if report.equal => Ok(()),
            None => Err(Failure::already_reported()),
        }
    }

    fn options(&self) -> CompareOptions {
        CompareOptions {
            tolerance: self.tolerance.into(),
            joints_tolerance: self.joints_tolerance.into(),
            missing: self.allow_missing,
        }
    }

    /// Returns the skin of both captures: from the option, or else from a recording. Refuses a recording of another
    /// skin.
    fn common_skin(&self, files: &PerCapture<Vec<PathBuf>>) -> Result<Skin, Failure> {
        let named = self.skin.as_deref().map(input::read_skin).transpose()?;
        let (mut skin, mut name) = (named, self.skin.clone());
        for (path, files) in [(&self.a, &files.a), (&self.b, &files.b)] {
            // A log has no skin attached. Standard input can be read only once, so its skin is compared at the end.
            if !can_be_read_again(path)
                || Reader::open_all(files).map_err(Failure::usage_error)?.format() == CaptureFormat::Candump
            {
                continue;
            }
            let own = match skin_of_recording(files) {
                Err(_) if skin.is_some() => continue,
                own => own?,
            };
            match (&skin, &name) {
                (Some(skin), Some(name)) => check_same_skin((name, skin), (path, &own))?,
                _ => (skin, name) = (Some(own), Some(path.clone())),
            }
        }
        if let Some(skin) = skin {
            return Ok(skin);
        }
        // Report a capture without frames first, because naming a skin would not help.
        for (path, files) in [(&self.a, &files.a), (&self.b, &files.b)] {
            if can_be_read_again(path) {
                require_frames(files)?;
            }
        }
        let (a, b) = (self.a.display(), self.b.display());
        Err(Failure::usage_error(format!(
            "neither {a} nor {b} contains a skin: name the skin file with --skin"
        )))
    }

    /// Refuses a capture without frames or joints, or of another skin.
    fn check_capture(
        &self,
        input: &mut CaptureInput,
        which: CaptureSide,
        comparison: &mut Comparison<'_>,
        skin: &Skin,
    ) -> Result<(), Failure> {
        if let Some(damage) = input.damage.take_if(|_| !input.has_frames) {
            return Err(damage);
        }
        if !input.has_frames {
            return Err(no_frame_failure(&input.reader));
        }
        let name = &input.name;
        if let Some(Ok(own)) = input.reader.extras().skin() {
            let of = self.skin.as_ref().unwrap_or(&self.a);
            check_same_skin((of, skin), (Path::new(name), &own))?;
        }
        if let Some(error) = comparison.not_found_reason(which) {
            let text = format!("{name}: {error}");
            let is_other = matches!(error, JointsNotFound::Buses { .. } | JointsNotFound::Robot { .. });
            return Err(if is_other { Failure::usage_error(text) } else { Failure::run_error(text) });
        }
        comparison.reported_and_matching_cells(which).map_or(Ok(()), |(all, same)| {
            Err(Failure::usage_error(format!(
                "{name} was recorded with another skin than {}: of {}, only {same} have the parameters of \
                 this skin; name the right skin with --skin",
                skin.name,
                count_with_noun(all, "cell")
            )))
        })
    }
}

/// Returns an error if the two captures are of different skins.
fn check_same_skin(
    (one, skin): (impl AsRef<Path>, &Skin),
    (other, own): (impl AsRef<Path>, &Skin),
) -> Result<(), Failure> {
    let Some((what, is, was)) = first_skin_difference(skin, own) else { return Ok(()) };
    let (one, other) = (one.as_ref().display(), other.as_ref().display());
    Err(Failure::usage_error(format!(
        "{one} and {other} were recorded with different skins ({what}: {is}, in the other: {was}); only runs \
         with the same skin can be compared"
    )))
}

fn capture_names(input: &CaptureInput) -> show::CaptureNames<'_> {
    show::CaptureNames { name: &input.name, format: format_name(&input.reader), files: &input.files }
}
