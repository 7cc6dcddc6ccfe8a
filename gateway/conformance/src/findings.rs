//! The results of the checks, by requirement.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::bus::StopReason;
use crate::requirements::{REQUIREMENTS, Requirement};

/// The maximum number of frames that are shown for a failure.
const MAX_FAILURE_FRAMES: usize = 24;

/// The verdict on one requirement.
#[derive(Clone, Debug, Default, Eq, PartialEq, Serialize)]
#[serde(tag = "verdict", rename_all = "kebab-case")]
pub enum Verdict {
    /// All checks of the requirement passed.
    Passed {
        /// The number of checks.
        checks: usize,
        /// The part that could not be checked.
        #[serde(skip_serializing_if = "Option::is_none")]
        but: Option<String>,
    },
    /// A check of the requirement failed.
    Failed {
        /// A description of the failure: the expected behaviour, and the observed one.
        what: String,
        /// The number of failed checks.
        failures: usize,
        /// The frames that show the failure, in candump's notation; the last ones, if there are many.
        frames: Vec<String>,
    },
    /// The requirement does not apply to this cell.
    NotApplicable {
        /// The reason.
        why: String,
    },
    /// The requirement could not be tested.
    NotTested {
        /// The reason.
        why: String,
    },
    /// The requirement has no result yet.
    #[default]
    #[serde(skip)]
    Open,
}

/// A requirement and its verdict.
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
pub struct Finding {
    /// The requirement.
    #[serde(flatten)]
    pub requirement: &'static Requirement,
    /// The verdict.
    #[serde(flatten)]
    pub verdict: Verdict,
}

#[derive(Clone, Debug, Default)]
struct RequirementTally {
    passed: usize,
    failed: usize,
    failure: Option<(String, Vec<String>)>,
    not_applicable: Option<String>,
    not_tested: Option<String>,
}

/// The results of all checks.
#[derive(Clone, Debug, Default)]
pub struct Findings(BTreeMap<&'static str, RequirementTally>);

impl Findings {
    fn tally(&mut self, id: &'static str) -> &mut RequirementTally {
        debug_assert!(REQUIREMENTS.iter().any(|it| it.id == id), "{id} is not a requirement");
        self.0.entry(id).or_default()
    }

    /// Counts a passed check.
    pub(crate) fn count_passed(&mut self, id: &'static str) {
        self.tally(id).passed += 1;
    }

    /// Counts a failed check; the first failure of a requirement is kept.
    pub(crate) fn count_failed(
        &mut self,
        id: &'static str,
        what: String,
        frames: impl FnOnce() -> Vec<String>,
    ) {
        let tally = self.tally(id);
        tally.failed += 1;
        tally.failure.get_or_insert_with(|| {
            let mut frames = frames();
            frames.drain(..frames.len().saturating_sub(MAX_FAILURE_FRAMES));
            (what, frames)
        });
    }

    /// Notes that the requirement does not apply to the cell.
    pub(crate) fn mark_not_applicable(&mut self, id: &'static str, why: impl Into<String>) {
        self.tally(id).not_applicable.get_or_insert_with(|| why.into());
    }

    /// Notes that the requirement, or a part of it, could not be tested.
    pub(crate) fn mark_not_tested(&mut self, id: &'static str, why: impl Into<String>) {
        self.tally(id).not_tested.get_or_insert_with(|| why.into());
    }

    /// Returns the ids of the requirements that failed.
    #[must_use]
    pub fn failed_requirements(&self) -> Vec<&'static str> {
        self.0.iter().filter(|(_, tally)| tally.failed > 0).map(|(id, _)| *id).collect()
    }

    /// Returns the ids of the requirements with more failures than in `before`.
    pub(crate) fn failed_since(&self, before: &Self) -> impl Iterator<Item = &'static str> {
        let failed = |of: &Self, id| of.0.get(id).map_or(0, |tally| tally.failed);
        self.0.keys().copied().filter(move |id| failed(self, *id) > failed(before, *id))
    }

    /// Retracts the failures of a requirement since `before`.
    pub(crate) fn retract_failures(&mut self, id: &'static str, before: &Self) {
        let RequirementTally { failed, failure, .. } = before.0.get(id).cloned().unwrap_or_default();
        let tally = self.tally(id);
        (tally.failed, tally.failure) = (failed, failure);
    }

    /// Returns the verdict on a requirement; `why` is the reason for an untested one without a reason of its own.
    fn verdict(&self, id: &str, why: &str) -> Verdict {
        let tally = self.0.get(id).cloned().unwrap_or_default();
        if let Some((what, frames)) = tally.failure {
            return Verdict::Failed { what, failures: tally.failed, frames };
        }
        if tally.passed > 0 {
            return Verdict::Passed { checks: tally.passed, but: tally.not_tested };
        }
        if let Some(why) = tally.not_applicable {
            return Verdict::NotApplicable { why };
        }
        Verdict::NotTested { why: tally.not_tested.unwrap_or_else(|| why.to_owned()) }
    }

    /// Returns all requested requirements with their verdicts, in the order of the documents. `stopped` is the reason
    /// why the test ended early, if it did.
    #[must_use]
    pub fn requested_findings(&self, only: &RequirementFilter, stopped: Option<&StopReason>) -> Vec<Finding> {
        let why = stopped
            .map_or_else(|| "this program has no check for the requirement".to_owned(), ToString::to_string);
        let asked = REQUIREMENTS.iter().filter(|it| only.is_selected(it.id));
        asked
            .map(|requirement| Finding { requirement, verdict: self.verdict(requirement.id, &why) })
            .collect()
    }
}

/// A selection of requirements to test.
#[derive(Clone, Debug, Default)]
pub struct RequirementFilter(Vec<String>);

impl RequirementFilter {
    /// Selects requirements by id or by kind: `CONF-7`, `CONF`; without words, selects everything.
    ///
    /// # Errors
    /// Returns the first word that does not match a requirement.
    pub fn new(words: &[String]) -> Result<Self, String> {
        let words: Vec<_> = words.iter().map(|word| word.to_uppercase()).collect();
        let one = |word: &String| Self(vec![word.clone()]);
        match words.iter().find(|word| !REQUIREMENTS.iter().any(|it| one(word).is_selected(it.id))) {
            Some(word) => Err(word.clone()),
            None => Ok(Self(words)),
        }
    }

    /// Returns true if this requirement is selected.
    #[must_use]
    pub fn is_selected(&self, id: &str) -> bool {
        let is = |word: &String| id == word || id.split_once('-').is_some_and(|(kind, _)| kind == word);
        self.0.is_empty() || self.0.iter().any(is)
    }
}
