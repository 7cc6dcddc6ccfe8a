//! Results of the requirements as a table, JSON and JUnit.

use std::fmt::Write;
use std::time::Duration;

use conformance::SavedCell;
use conformance::bus::StopReason;
use conformance::findings::{Finding, Verdict};
use protocol::can::Format;
use serde::Serialize;

use crate::junit::{Outcome, TestCase, TestSuite};
use crate::print::{comma_separated, count_with_noun, limit_width, table};

/// Result of a conformance test, as JSON.
#[derive(Debug, Serialize)]
pub(super) struct ConformanceResult {
    bus: String,
    node: u8,
    serial: u32,
    format: &'static str,
    seconds: f64,
    /// Reason why the test ended early, if it did.
    stopped: Option<String>,
    passed: usize,
    failed: usize,
    not_applicable: usize,
    not_tested: usize,
    requirements: Vec<Finding>,
}

impl ConformanceResult {
    pub(super) fn new(
        saved: &SavedCell,
        format: Format,
        took: Duration,
        requirements: Vec<Finding>,
        stopped: Option<&StopReason>,
    ) -> Self {
        let count = |is: fn(&Verdict) -> bool| requirements.iter().filter(|it| is(&it.verdict)).count();
        Self {
            bus: saved.bus.clone(),
            node: saved.node,
            serial: saved.serial,
            format: format.name(),
            seconds: (took.as_secs_f64() * 10.0).round() / 10.0,
            stopped: stopped.map(ToString::to_string),
            passed: count(|it| matches!(it, Verdict::Passed { .. })),
            failed: count(|it| matches!(it, Verdict::Failed { .. })),
            not_applicable: count(|it| matches!(it, Verdict::NotApplicable { .. })),
            not_tested: count(|it| matches!(it, Verdict::NotTested { .. } | Verdict::Open)),
            requirements,
        }
    }

    pub(super) const fn has_failed(&self) -> bool {
        self.failed > 0
    }

    /// Formats a table with one line per requirement, then the frames that show failures, and the requirements that
    /// were not tested.
    pub(super) fn text(&self) -> String {
        let rows = self.requirements.iter().map(|it| {
            let (verdict, more) = verdict_text(&it.verdict);
            let title = it.requirement.title;
            let about = if more.is_empty() { title.to_owned() } else { format!("{title}: {more}") };
            vec![it.requirement.id.to_owned(), verdict.to_owned(), about]
        });
        let table = limit_width(table(["requirement", "verdict", "details"], rows, |_| false));
        let mut text = format!("{table}\n");
        for it in &self.requirements {
            let Verdict::Failed { what, failures, frames } = &it.verdict else { continue };
            let times = if *failures > 1 { format!(" ({failures} times)") } else { String::new() };
            let _ = write!(text, "\n{} failed{times}: {what}\n", it.requirement.id);
            for frame in frames {
                let _ = writeln!(text, "  {frame}");
            }
        }
        let untested = self.requirements.iter().filter(|it| matches!(it.verdict, Verdict::NotTested { .. }));
        let ids = comma_separated(untested.map(|it| it.requirement.id));
        let _ = write!(
            text,
            "\ncell {} on {} ({}, serial number {}), {:.1} s: {} passed, {} failed, {} not applicable, {} not tested{}\n",
            self.node,
            self.bus,
            self.format,
            self.serial,
            self.seconds,
            self.passed,
            self.failed,
            self.not_applicable,
            self.not_tested,
            if ids.is_empty() { String::new() } else { format!(": {ids}") }
        );
        text
    }

    /// Returns a JUnit report with a test case for each requirement.
    pub(super) fn junit(&self) -> String {
        let case = |Finding { requirement, verdict }: &Finding| {
            let document = serde_json::to_value(requirement.document).unwrap_or_default();
            let outcome = match verdict {
                Verdict::Passed { .. } => Outcome::Passed,
                Verdict::Failed { what, frames, .. } => {
                    Outcome::Failed { message: what.clone(), text: frames.join("\n") }
                }
                Verdict::NotApplicable { why } | Verdict::NotTested { why } => {
                    Outcome::Skipped { why: Some(why.clone()) }
                }
                Verdict::Open => Outcome::Skipped { why: None },
            };
            TestCase {
                class: document.as_str().unwrap_or_default().to_owned(),
                name: format!("{} {}", requirement.id, requirement.title),
                outcome,
            }
        };
        let suite = TestSuite {
            name: format!("cell {} on {}", self.node, self.bus),
            seconds: self.seconds,
            cases: self.requirements.iter().map(case).collect(),
        };
        suite.to_xml()
    }
}

/// Returns the word for a verdict, and the details of the verdict as text.
fn verdict_text(verdict: &Verdict) -> (&'static str, String) {
    match verdict {
        Verdict::Passed { checks, but } => {
            let but = but.as_ref().map_or_else(String::new, |but| format!("; not tested: {but}"));
            ("passed", format!("{}{but}", count_with_noun(*checks, "check")))
        }
        Verdict::Failed { .. } => ("FAILED", "see below".to_owned()),
        Verdict::NotApplicable { why } => ("not applicable", why.clone()),
        Verdict::NotTested { why } => ("not tested", why.clone()),
        Verdict::Open => ("not tested", String::new()),
    }
}
