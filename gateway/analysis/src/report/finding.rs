//! Findings: measured numbers and their comparison.

use std::fmt;

use serde::Serialize;

use super::number::{interval, quantity};

/// A result compared with the paper's number or with a limit.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// The quantity, with the method of measurement.
    pub what: String,
    /// The paper's value, if it has one.
    pub paper: Option<Quantity>,
    /// The measured value.
    pub ours: Quantity,
    /// The requirement as text: `at most 0.005 Nm`.
    pub bar: Option<String>,
    /// The reference of the rating if there is no requirement, or the reason why it is not rated: `below the paper's`.
    pub against: Option<String>,
    /// The source of the requirement: an option, the skin's file, a default.
    pub origin: Option<String>,
    /// A command that shows the details.
    pub command: Option<String>,
    /// The result of the comparison.
    pub verdict: Verdict,
}

impl Finding {
    /// Creates a finding for which less is better than the paper; within 5 % the two are the same.
    #[must_use]
    pub fn less_is_better(what: impl Into<String>, paper: f64, ours: impl Into<Quantity>) -> Self {
        let finding = Self::stated(what, ours).beside(paper).against("below the paper's");
        Self { verdict: Verdict::less_is_better(paper, finding.ours.value), ..finding }
    }

    /// Creates a finding for which more is better than the paper; within 5 % the two are the same.
    #[must_use]
    pub fn more_is_better(what: impl Into<String>, paper: f64, ours: impl Into<Quantity>) -> Self {
        let finding = Self::stated(what, ours).beside(paper).against("above the paper's");
        Self { verdict: Verdict::less_is_better(finding.ours.value, paper), ..finding }
    }

    /// Creates a finding for information, without a rating.
    #[must_use]
    pub fn stated(what: impl Into<String>, ours: impl Into<Quantity>) -> Self {
        Self {
            what: what.into(),
            paper: None,
            ours: ours.into(),
            bar: None,
            against: None,
            origin: None,
            command: None,
            verdict: Verdict::Stated,
        }
    }

    /// Adds the paper's value in the same unit, for comparison without a rating.
    #[must_use]
    pub fn beside(mut self, paper: f64) -> Self {
        self.paper = Some(Quantity::new(paper, self.ours.unit.clone()));
        self
    }

    /// Sets the reference of the rating, or the reason why it is not rated.
    #[must_use]
    pub fn against(mut self, what: impl Into<String>) -> Self {
        self.against = Some(what.into());
        self
    }

    /// Sets the source of the requirement.
    #[must_use]
    pub fn from(mut self, origin: impl Into<String>) -> Self {
        self.origin = Some(origin.into());
        self
    }

    /// Sets the command that shows the details, if any.
    #[must_use]
    pub fn with_command(mut self, command: Option<String>) -> Self {
        self.command = command;
        self
    }

    /// Rates the value by an upper limit in its own unit.
    #[must_use]
    pub fn at_most(self, limit: f64) -> Self {
        let kept = self.ours.value <= limit;
        let bar = format!("at most {}", quantity(limit, &self.ours.unit));
        self.must(bar, kept)
    }

    /// Rates the value by a requirement; if it is met, the verdict is [`Verdict::Better`].
    #[must_use]
    pub fn must(mut self, bar: impl Into<String>, kept: bool) -> Self {
        self.bar = Some(bar.into());
        self.verdict = if kept { Verdict::Better } else { Verdict::Worse };
        self
    }
}

/// The result of a comparison with the paper or with a requirement.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub enum Verdict {
    /// Better than the paper, or meets the requirement.
    Better,
    /// Within 5 % of the paper.
    Same,
    /// Worse than the paper, or violates the requirement.
    Worse,
    /// Not rated.
    #[default]
    Stated,
}

impl Verdict {
    /// Compares numbers for which less is better; within 5 % of `paper` they are the same.
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

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Better => "better",
            Self::Same => "the same",
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
    /// Half the width of its 95 % interval, if known.
    pub plus_minus: Option<f64>,
}

impl Quantity {
    /// Creates a quantity.
    #[must_use]
    pub fn new(value: f64, unit: impl Into<String>) -> Self {
        Self { value, unit: unit.into(), plus_minus: None }
    }

    /// Sets half the width of its 95 % interval.
    #[must_use]
    pub const fn plus_minus(mut self, half: f64) -> Self {
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
    /// Creates a count.
    fn from(value: f64) -> Self {
        Self::new(value, "")
    }
}

impl fmt::Display for Quantity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&interval(self.value, self.plus_minus, &self.unit))
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
            [Verdict::Better, Verdict::Same, Verdict::Same, Verdict::Worse]
        );
        assert_eq!(
            [1.0, 1.95, 2.05, 3.0].map(more),
            [Verdict::Worse, Verdict::Same, Verdict::Same, Verdict::Better]
        );
        assert_eq!(less(f64::NAN), Verdict::Stated);
        assert_eq!(Finding::stated("", quantity(0.0)).must("none", true).verdict, Verdict::Better);
    }
}
