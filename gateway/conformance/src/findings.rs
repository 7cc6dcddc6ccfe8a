//! What was found of each requirement.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::bus::Stop;
use crate::requirements::{REQUIREMENTS, Requirement};

/// Frames that show a failure, at most.
const FRAMES: usize = 24;

/// What came of one requirement.
#[derive(Clone, Debug, Default, Eq, PartialEq, Serialize)]
#[serde(tag = "verdict", rename_all = "kebab-case")]
pub enum Verdict {
    /// Every check of it passed.
    Passed {
        /// How many checks.
        checks: usize,
        /// What of it could not be checked.
        #[serde(skip_serializing_if = "Option::is_none")]
        but: Option<String>,
    },
    /// A check of it failed.
    Failed {
        /// What was expected, and what came.
        what: String,
        /// How many checks failed.
        failures: usize,
        /// The frames that show it, as candump writes them; the last ones, if there are many.
        frames: Vec<String>,
    },
    /// This cell does not have what the requirement is about.
    NotApplicable {
        /// Why.
        why: String,
    },
    /// It could not be tested.
    NotTested {
        /// Why.
        why: String,
    },
    /// Nothing was found yet.
    #[default]
    #[serde(skip)]
    Open,
}

/// One requirement, and what came of it.
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
pub struct Finding {
    /// The requirement.
    #[serde(flatten)]
    pub requirement: &'static Requirement,
    /// What came of it.
    #[serde(flatten)]
    pub verdict: Verdict,
}

#[derive(Clone, Debug, Default)]
struct Tally {
    passed: usize,
    failed: usize,
    failure: Option<(String, Vec<String>)>,
    not_applicable: Option<String>,
    not_tested: Option<String>,
}

/// All that was found.
#[derive(Clone, Debug, Default)]
pub struct Findings(BTreeMap<&'static str, Tally>);

impl Findings {
    fn tally(&mut self, id: &'static str) -> &mut Tally {
        debug_assert!(REQUIREMENTS.iter().any(|it| it.id == id), "{id} is no requirement");
        self.0.entry(id).or_default()
    }

    /// A check passed.
    pub(crate) fn pass(&mut self, id: &'static str) {
        self.tally(id).passed += 1;
    }

    /// A check failed; the first failure of a requirement is kept.
    pub(crate) fn fail(&mut self, id: &'static str, what: String, frames: impl FnOnce() -> Vec<String>) {
        let tally = self.tally(id);
        tally.failed += 1;
        tally.failure.get_or_insert_with(|| {
            let mut frames = frames();
            frames.drain(..frames.len().saturating_sub(FRAMES));
            (what, frames)
        });
    }

    /// The cell does not have that.
    pub(crate) fn not_applicable(&mut self, id: &'static str, why: impl Into<String>) {
        self.tally(id).not_applicable.get_or_insert_with(|| why.into());
    }

    /// It, or a part of it, could not be tested.
    pub(crate) fn not_tested(&mut self, id: &'static str, why: impl Into<String>) {
        self.tally(id).not_tested.get_or_insert_with(|| why.into());
    }

    /// The ids of the requirements that failed.
    #[must_use]
    pub fn failed(&self) -> Vec<&'static str> {
        self.0.iter().filter(|(_, tally)| tally.failed > 0).map(|(id, _)| *id).collect()
    }

    /// The ids that have failed more often than there.
    pub(crate) fn failed_since(&self, before: &Self) -> impl Iterator<Item = &'static str> {
        let failed = |of: &Self, id| of.0.get(id).map_or(0, |tally| tally.failed);
        self.0.keys().copied().filter(move |id| failed(self, *id) > failed(before, *id))
    }

    /// What failed of a requirement since then does not count.
    pub(crate) fn forgive(&mut self, id: &'static str, before: &Self) {
        let Tally { failed, failure, .. } = before.0.get(id).cloned().unwrap_or_default();
        let tally = self.tally(id);
        (tally.failed, tally.failure) = (failed, failure);
    }

    /// What came of a requirement; `why` it was not tested if nothing says so.
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

    /// All requirements that are asked for, in the order of the documents, and why the test ended early, if it did.
    #[must_use]
    pub fn list(&self, only: &Only, stopped: Option<&Stop>) -> Vec<Finding> {
        let why = stopped.map_or_else(|| "there is no check of it".to_owned(), ToString::to_string);
        let asked = REQUIREMENTS.iter().filter(|it| only.has(it.id));
        asked
            .map(|requirement| Finding { requirement, verdict: self.verdict(requirement.id, &why) })
            .collect()
    }
}

/// Which requirements are asked for.
#[derive(Clone, Debug, Default)]
pub struct Only(Vec<String>);

impl Only {
    /// These ids, or all that begin so: `CONF-7`, `CONF`; all if there are none.
    ///
    /// # Errors
    /// The word that names no requirement.
    pub fn new(words: &[String]) -> Result<Self, String> {
        let words: Vec<_> = words.iter().map(|word| word.to_uppercase()).collect();
        let one = |word: &String| Self(vec![word.clone()]);
        match words.iter().find(|word| !REQUIREMENTS.iter().any(|it| one(word).has(it.id))) {
            Some(word) => Err(word.clone()),
            None => Ok(Self(words)),
        }
    }

    /// Whether this one is asked for.
    #[must_use]
    pub fn has(&self, id: &str) -> bool {
        let is = |word: &String| id == word || id.split_once('-').is_some_and(|(kind, _)| kind == word);
        self.0.is_empty() || self.0.iter().any(is)
    }
}
