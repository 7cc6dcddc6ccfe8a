//! Findings: measured numbers, compared with the paper's or with a requirement.

use std::fmt;

use serde::Serialize;

use super::number::{format_interval, format_quantity};

/// A result compared with the paper's number or with a limit.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// The measured quantity, and how it was measured.
    pub what: String,
    /// The paper's value, if it has one.
    pub paper: Option<Quantity>,
    /// The value that was measured here.
    pub ours: Quantity,
    /// The requirement as text: `at most 0.005 Nm`.
    pub bar: Option<String>,
    /// Text shown if there is no requirement: the reference of the rating, such as `below the paper's value`, or the
    /// reason why it was not rated.
    pub against: Option<String>,
    /// Source of the requirement: an option, the skin's file, a default.
    pub origin: Option<String>,
    /// A command that shows the details.
    pub command: Option<String>,
    /// The result of comparing the measured value.
    pub verdict: FindingVerdict,
}

impl Finding {
    /// Creates a finding that is rated against the paper's value: less is better, and within 5 % of it the two count as
    /// the same.
    #[must_use]
    pub fn less_is_better(what: impl Into<String>, paper: f64, ours: impl Into<Quantity>) -> Self {
        let finding =
            Self::new_unrated(what, ours).with_paper_value(paper).with_reference("below the paper's value");
        Self { verdict: FindingVerdict::less_is_better(paper, finding.ours.value), ..finding }
    }

    /// Creates a finding that is rated against the paper's value: more is better, and within 5 % of it the two count as
    /// the same.
    #[must_use]
    pub fn more_is_better(what: impl Into<String>, paper: f64, ours: impl Into<Quantity>) -> Self {
        let finding =
            Self::new_unrated(what, ours).with_paper_value(paper).with_reference("above the paper's value");
        Self { verdict: FindingVerdict::less_is_better(finding.ours.value, paper), ..finding }
    }

    /// Creates a finding for information, without a rating.
    #[must_use]
    pub fn new_unrated(what: impl Into<String>, ours: impl Into<Quantity>) -> Self {
        Self {
            what: what.into(),
            paper: None,
            ours: ours.into(),
            bar: None,
            against: None,
            origin: None,
            command: None,
            verdict: FindingVerdict::Stated,
        }
    }

    /// Adds the paper's value in the same unit, for comparison without a rating.
    #[must_use]
    pub fn with_paper_value(mut self, paper: f64) -> Self {
        self.paper = Some(Quantity::new(paper, self.ours.unit.clone()));
        self
    }

    /// Sets the text shown without a requirement: the reference of the rating, or why there is no rating.
    #[must_use]
    pub fn with_reference(mut self, what: impl Into<String>) -> Self {
        self.against = Some(what.into());
        self
    }

    /// Sets where the requirement comes from.
    #[must_use]
    pub fn with_origin(mut self, origin: impl Into<String>) -> Self {
        self.origin = Some(origin.into());
        self
    }

    /// Sets the command that shows the details, if any.
    #[must_use]
    pub fn with_command(mut self, command: Option<String>) -> Self {
        self.command = command;
        self
    }

    /// Rates the value by an upper limit, which has the same unit.
    #[must_use]
    pub fn at_most(self, limit: f64) -> Self {
        let kept = self.ours.value <= limit;
        let bar = format!("at most {}", format_quantity(limit, &self.ours.unit));
        self.with_requirement(bar, kept)
    }

    /// Rates the value by a requirement, given as text; `kept` is true if the value meets it.
    #[must_use]
    pub fn with_requirement(mut self, bar: impl Into<String>, kept: bool) -> Self {
        self.bar = Some(bar.into());
        self.verdict = if kept { FindingVerdict::Better } else { FindingVerdict::Worse };
        self
    }

    /// Turns a bad rating into a warning, because a busy or slow machine explains the value.
    #[must_use]
    pub fn or_busy_machine(mut self) -> Self {
        if self.verdict == FindingVerdict::Worse {
            self.verdict = FindingVerdict::Busy;
        }
        self
    }
}

/// The result of a comparison with the paper or with a requirement.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub enum FindingVerdict {
    /// The value is better than the paper's, or meets the requirement.
    Better,
    /// The value is within 5 % of the paper's.
    Same,
    /// The value is worse than the paper's, or violates the requirement, and a busy or slow machine explains it.
    Busy,
    /// The value is worse than the paper's, or violates the requirement.
    Worse,
    /// The value is stated without a rating.
    #[default]
    Stated,
}

impl FindingVerdict {
    /// Compares two values for which less is better; within 5 % of `paper` they count as the same.
    #[must_use]
    pub fn less_is_better(paper: f64, ours: f64) -> Self {
        if !(paper.is_finite() && ours.is_finite()) {
            Self::Stated
        } else if (ours - paper).abs() <= 0.05 * paper.abs() {
            Self::Same
        } else if ours < paper {
            Self::Better
        } else {
            Self::Worse
        }
    }
}

impl fmt::Display for FindingVerdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Better => "better",
            Self::Same => "the same",
            Self::Busy => "busy machine",
            Self::Worse => "worse",
            Self::Stated => "",
        })
    }
}

/// A number with its unit.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Quantity {
    /// The value.
    pub value: f64,
    /// The unit; empty for counts.
    pub unit: String,
    /// Half the width of the value's 95 % confidence interval, if known.
    pub plus_minus: Option<f64>,
}

impl Quantity {
    /// Creates a quantity.
    #[must_use]
    pub fn new(value: f64, unit: impl Into<String>) -> Self {
        Self { value, unit: unit.into(), plus_minus: None }
    }

    /// Sets half the width of the value's 95 % confidence interval.
    #[must_use]
    pub const fn with_half_interval(mut self, half: f64) -> Self {
        self.plus_minus = Some(half);
        self
    }
}

impl<T: Into<String>> From<(f64, T)> for Quantity {
    fn from((value, unit): (f64, T)) -> Self {
        Self::new(value, unit)
    }
}

impl From<f64> for Quantity {
    /// Creates a quantity without a unit.
    fn from(value: f64) -> Self {
        Self::new(value, "")
    }
}

impl fmt::Display for Quantity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&format_interval(self.value, self.plus_minus, &self.unit))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn verdicts_know_which_way_is_better_and_what_is_the_same() {
        let quantity = |value| Quantity::new(value, "Nm");
        let less = |ours| Finding::less_is_better("", 2.0, quantity(ours)).verdict;
        let more = |ours| Finding::more_is_better("", 2.0, quantity(ours)).verdict;
        assert_eq!(
            [1.0, 1.91, 2.09, 2.2].map(less),
            [FindingVerdict::Better, FindingVerdict::Same, FindingVerdict::Same, FindingVerdict::Worse]
        );
        assert_eq!(
            [1.0, 1.95, 2.05, 3.0].map(more),
            [FindingVerdict::Worse, FindingVerdict::Same, FindingVerdict::Same, FindingVerdict::Better]
        );
        assert_eq!(less(f64::NAN), FindingVerdict::Stated);
        assert_eq!(
            Finding::new_unrated("", quantity(0.0)).with_requirement("none", true).verdict,
            FindingVerdict::Better
        );
    }
}
