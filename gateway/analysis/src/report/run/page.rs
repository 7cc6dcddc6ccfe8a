//! The contents of a run's report, in order.

mod arm;
mod bus;
mod facts;
mod formats;
mod moments;
mod skin;

use super::RunData;
use super::bus_figures::BusFigures;
use super::frames_only::FramesOnlyCapture;
use super::moments::ListedLoss;
use crate::fit::verdict::FitVerdict;
use crate::paper;
use crate::report::figure::{
    Axis, Figure, Finding, MarkLine, Page, Section, Series, SeriesShape, format_number, format_quantity,
};
use crate::report::thin::ThinnedLine;
use crate::shadow::BusShadow;
use model::table::{CellState, TorqueAccuracy, UplinkCounts};

/// The paper's number of cells, control loop rate and broadcast rate.
const PAPER_CELLS: f64 = 253.0;
const PAPER_CONTROL_HZ: f64 = 500.0;
const PAPER_BROADCAST_HZ: f64 = 62.5;
/// The paper's law of the central computation (Eq. 29 and 30), in µs: per active cell, per cell, and fixed.
const PAPER_CENTRAL_TIME_US: [f64; 3] = [0.798, 0.827, 10.7];

/// Maximum number of stuck cells that are listed.
const MAX_LISTED_CELLS: usize = 10;

/// The inputs of a page.
struct PageDraft<'a> {
    run: &'a RunData,
    /// Start of the loop, or of the joints in a capture with frames only, in s after the recording's first message.
    zero: f64,
    /// The timing on the real bus, for each bus of the skin with frames.
    bus_shadows: Vec<BusShadow>,
}

pub(super) fn report_page(run: &RunData, command: &str, missing: Option<&str>) -> Page {
    let bus_shadows = run.shadow.report().buses;
    let bus_shadows = bus_shadows.into_iter().filter(|bus| run.skin.bus_index(&bus.bus).is_some()).collect();
    let draft = PageDraft { run, zero: run.motion.first.unwrap_or(0.0), bus_shadows };
    let mut intro = match &run.frames_only {
        Some(frames_only) => intro_of_frames(run, frames_only),
        None => intro_of_run(run),
    };
    if let Some(missing) = missing {
        intro = format!("The run is incomplete: {missing}. {intro}");
    }
    let mut sections = vec![draft.summary_section(), draft.touch_section()];
    if run.motion.counts.ticks > 0 || run.has_joints() {
        sections.extend([
            draft.torque_section(),
            draft.motion_section(),
            draft.cells_section(),
            draft.cycle_section(),
        ]);
    }
    sections.extend([draft.replies_section(), draft.load_section(), draft.losses_section()]);
    let of = if run.frames_only.is_some() { "a capture" } else { "a run" };
    let facts = facts::capture_facts(run, command);
    Page { title: format!("{}: report on {of}", run.skin.name), intro, facts, sections }
}

fn intro_of_run(run: &RunData) -> String {
    format!(
        "{} on {}: a run of {} with a control loop of {}, from the recording {}. Times count from the first tick.",
        skin_size_text(run),
        count_text(run.skin.buses.len(), "bus", "buses"),
        format_seconds(run.motion.duration_s()),
        format_quantity(run.skin.timing.control_hz, "Hz"),
        run.name,
    )
}

fn intro_of_frames(run: &RunData, frames_only: &FramesOnlyCapture) -> String {
    let remarks: String = run.remarks.iter().map(|remark| format!(" {remark}.")).collect();
    format!(
        "Frames of {} on {} during {}, from the {} {}. Times count from the first joints message. This capture does \
         not contain: {}.{remarks}",
        skin_size_text(run),
        count_text(run.skin.buses.len(), "bus", "buses"),
        format_seconds(run.motion.duration_s()),
        frames_only.format,
        run.name,
        run.missing_parts(),
    )
}

fn skin_size_text(run: &RunData) -> String {
    format!("{} with {} cells", run.skin.name, run.skin.cells.len())
}

fn format_seconds(seconds: f64) -> String {
    format_quantity((seconds * 100.0).round() / 100.0, "s")
}

impl PageDraft<'_> {
    fn points(&self, thinned: &ThinnedLine) -> Vec<(f64, f64)> {
        thinned.points().into_iter().map(|(x, y)| (x - self.zero, y)).collect()
    }

    fn thinned_series(&self, caption: impl Into<String>, thinned: &ThinnedLine) -> Series {
        Series::new(caption, SeriesShape::Line, self.points(thinned))
    }

    /// Creates a figure of full width over the time of the run.
    fn time_figure(&self, name: impl Into<String>, title: impl Into<String>, y: Axis) -> Figure {
        Figure::new(name, title, self.time_axis(), y)
    }

    fn time_axis(&self) -> Axis {
        let axis = Axis::new("time", "s");
        let seconds = self.run.motion.duration_s();
        if seconds > 0.0 { axis.with_ends(0.0, seconds) } else { axis }
    }

    fn marks(&self) -> Vec<MarkLine> {
        self.run.motion.changes.iter().map(|&(at, what)| MarkLine::at_x(at - self.zero, what)).collect()
    }

    fn bus_caption(&self, bus_figures: &BusFigures) -> String {
        if self.run.bus_figures.len() > 1 { bus_figures.name.clone() } else { String::new() }
    }

    /// Creates the section with all numbers that the paper has, too, and with the requirements.
    fn summary_section(&self) -> Section {
        let (skin, motion) = (&self.run.skin, &self.run.motion);
        let mut findings = Vec::new();
        let accuracy = self
            .run
            .bus_figures
            .iter()
            .map(|bus_figures| bus_figures.table.accuracy())
            .reduce(TorqueAccuracy::merged);
        let accuracy = accuracy.unwrap_or_default();
        let farthest = self.run.bus_figures.iter().filter_map(|bus_figures| bus_figures.largest_error);
        let farthest =
            farthest.max_by(|one, other| one.1.total_cmp(&other.1)).map(|(at, _)| self.view_command(at));
        for (what, theirs, errors, is_whole) in [
            (
                "torques of single cells, at the joints that they load",
                paper::SINGLE_CELL_ERROR_NM,
                accuracy.single,
                false,
            ),
            ("the whole skin's torque, at all joints", paper::SUMMED_ERROR_NM, accuracy.whole, true),
            (
                "sums along the tree, at the joints that their cells load",
                paper::SUMMED_ERROR_NM,
                accuracy.sums,
                true,
            ),
        ] {
            let finding = |mean| {
                let what = format!("{what}: mean absolute error");
                Finding::less_is_better(what, theirs, (mean, "Nm"))
                    .with_command(farthest.clone().filter(|_| is_whole))
            };
            findings.extend(errors.mean().map(finding));
        }
        let central = motion.central_took.times.histogram();
        if !central.is_empty() {
            let median = central.value_at_quantile(0.5) as f64 * 1e-3;
            let (active, ticks) = motion.active_sum;
            let active = active as f64 / ticks.max(1) as f64;
            let [of_active, of_each, of_none] = PAPER_CENTRAL_TIME_US;
            let law = of_active * active + of_each * skin.cells.len() as f64 + of_none;
            let what = format!(
                "median of the central computation per tick (paper: value of its formula for {} cells, {} of them \
                 active on average)",
                skin.cells.len(),
                format_number((active * 10.0).round() / 10.0)
            );
            findings.push(Finding::less_is_better(what, law, (median, "µs")).or_busy_machine());
        }
        findings.push(
            Finding::new_unrated("number of cells", skin.cells.len() as f64).with_paper_value(PAPER_CELLS),
        );
        findings.extend(self.first_touch_finding());
        if motion.duration_s() > 0.0 {
            let hertz = |count: u64, seconds: f64| (count.saturating_sub(1) as f64 / seconds, "Hz");
            if motion.counts.ticks > 0 {
                let ticks = motion.counts.ticks.saturating_add(motion.counts.unrecorded);
                let loop_hz = hertz(ticks, motion.duration_s());
                findings.push(
                    Finding::new_unrated("rate of the control loop", loop_hz)
                        .with_paper_value(PAPER_CONTROL_HZ),
                );
            }
            let joints = self.run.bus_figures.iter().filter_map(|bus_figures| bus_figures.joints);
            let most = joints.max_by_key(|(_, _, count)| *count).filter(|(first, last, _)| last > first);
            if let Some((first, last, count)) = most {
                let finding = Finding::new_unrated("rate of joints messages", hertz(count, last - first));
                findings.push(finding.with_paper_value(PAPER_BROADCAST_HZ));
            }
            if motion.counts.ticks > 0 {
                let skipped = zero_required_finding("ticks skipped".to_owned(), motion.counts.skipped);
                let at = motion.skip.map(|(at, _)| self.view_command(at));
                findings.push(skipped.or_busy_machine().with_command(at));
            }
        }
        let accounts = self.run.bus_figures.iter().map(BusFigures::reply_counts);
        let (due, in_time) = accounts.fold((0, 0), |sum, one| (sum.0 + one.due, sum.1 + one.in_time));
        if due > 0 {
            let what = format!("replies not received before the next joints message, of {due} due");
            let period = 1.0 / skin.timing.broadcast_hz();
            let bar = format!("none after {}", format_quantity(period, "s"));
            let late = due - in_time;
            let finding = Finding::new_unrated(what, late as f64).with_requirement(bar, late == 0);
            let finding = if self.are_losses_late_only() { finding.or_busy_machine() } else { finding };
            let worst = self.worst_loss_command(|loss| loss.late + loss.missing);
            findings.push(finding.with_origin("skin: joint_broadcast_hz").with_command(worst));
        }
        findings.push(self.halts_finding());
        findings.extend(self.range_findings());
        findings.extend(self.fit_findings());
        let uplink: UplinkCounts =
            self.run.bus_figures.iter().map(|bus_figures| bus_figures.table.uplink()).sum();
        let lost =
            zero_required_finding("lost packets, according to the cells' counters".to_owned(), uplink.lost);
        findings.push(lost.with_command(self.worst_loss_command(|loss| loss.packets)));
        findings.extend(self.stuck_cells_finding());
        Section::new("summary", "In numbers").with_findings(findings).with_paragraph(
            "Compared with the paper (Efficient Distributed Torque Computation for Large Scale Robot Skin). Numbers within \
             5 % of the paper's count as the same. Each command shows the moment of the recording at which a number \
             is worst.",
        )
    }

    /// Returns the finding of cells that sent constant words while the expected words changed; `None` without any.
    fn stuck_cells_finding(&self) -> Option<Finding> {
        let cells = self.run.bus_figures.iter().flat_map(|bus_figures| {
            let name = |cell: &CellState| {
                let kinds: Vec<_> = cell
                    .stuck_word_runs()
                    .map(|(kind, words)| format!("{words} equal {kind} words"))
                    .collect();
                (!kinds.is_empty())
                    .then(|| format!("{} {}: {}", bus_figures.name, cell.node, kinds.join(", ")))
            };
            bus_figures.table.cells().iter().filter_map(name)
        });
        let cells: Vec<_> = cells.collect();
        let more = if cells.len() > MAX_LISTED_CELLS { ", and others" } else { "" };
        let named: Vec<_> = cells.iter().take(MAX_LISTED_CELLS).map(String::as_str).collect();
        let what = format!(
            "stuck cells, which sent constant words while the expected words changed ({}{more})",
            named.join("; ")
        );
        (!cells.is_empty()).then(|| zero_required_finding(what, cells.len() as u64))
    }

    /// Returns a sentence about a part that only a recording of a run has; `None` for such a recording.
    fn missing_sentence(&self, what: &str) -> Option<String> {
        self.run.frames_only.as_ref()?;
        Some(format!("This capture does not contain {what}."))
    }

    /// Returns true if the replies that were not in time were late or skipped as on a busy machine, and no bus was too
    /// slow for them.
    fn are_losses_late_only(&self) -> bool {
        let is_slow = |bus: &BusShadow| {
            let verdict = bus.this_run.as_ref().map(|fit| fit.verdict);
            bus.is_timed && matches!(verdict, Some(FitVerdict::Bandwidth | FitVerdict::Deadline))
        };
        let lost: u64 = self.run.bus_figures.iter().map(BusFigures::lost_reply_count).sum();
        lost == 0 && !self.bus_shadows.iter().any(is_slow)
    }

    /// Returns the command that shows the loss with the highest count.
    fn worst_loss_command(&self, of: impl Fn(&ListedLoss) -> u64) -> Option<String> {
        let all = self.run.bus_figures.iter().filter_map(|bus_figures| bus_figures.moments.largest_loss(&of));
        all.max_by_key(|loss| of(loss)).map(|loss| self.view_command(loss.seconds.0))
    }
}

/// Removes series without points; returns `None` if nothing is left.
fn without_empty_series(mut figure: Figure) -> Option<Figure> {
    figure.series.retain(|series| series.points.iter().any(|(x, y)| x.is_finite() && y.is_finite()));
    (!figure.series.is_empty()).then_some(figure)
}

/// Creates a finding whose count must be zero.
fn zero_required_finding(what: String, count: u64) -> Finding {
    Finding::new_unrated(what, count as f64).with_requirement("none", count == 0).with_origin("default")
}

fn count_text(count: usize, one: &str, more: &str) -> String {
    format!("{count} {}", if count == 1 { one } else { more })
}
