//! Numbers that were found, and how they compare.

use std::fmt;

use serde::Serialize;

use super::number::{interval, quantity};

/// A result beside the paper's number.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// What was measured, with how.
    pub what: String,
    /// What the paper says, where it does.
    pub paper: Option<Quantity>,
    /// What was found.
    pub ours: Quantity,
    /// What it must reach, in words: `at most 0.005 Nm`.
    pub bar: Option<String>,
    /// What it is rated against, when that is no bar, or why it is not rated: `below the paper's`.
    pub against: Option<String>,
    /// Where the bar comes from: an option, the skin's file, a default.
    pub origin: Option<String>,
    /// A command that shows where it comes from.
    pub command: Option<String>,
    /// How the two compare.
    pub verdict: Verdict,
}

impl Finding {
    /// A number of which less is better, beside the paper's: within 5 % of that it is the same.
    #[must_use]
    pub fn less_is_better(what: impl Into<String>, paper: f64, ours: impl Into<Quantity>) -> Self {
        let finding = Self::stated(what, ours).beside(paper).against("below the paper's");
        Self { verdict: Verdict::less_is_better(paper, finding.ours.value), ..finding }
    }

    /// A number of which more is better, beside the paper's: within 5 % of that it is the same.
    #[must_use]
    pub fn more_is_better(what: impl Into<String>, paper: f64, ours: impl Into<Quantity>) -> Self {
        let finding = Self::stated(what, ours).beside(paper).against("above the paper's");
        Self { verdict: Verdict::less_is_better(finding.ours.value, paper), ..finding }
    }

    /// A number for information, not rated.
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

    /// The same beside the paper's in the same unit, where neither more nor less is better.
    #[must_use]
    pub fn beside(mut self, paper: f64) -> Self {
        self.paper = Some(Quantity::new(paper, self.ours.unit.clone()));
        self
    }

    /// The same with what it is rated against, or why it is not rated.
    #[must_use]
    pub fn against(mut self, what: impl Into<String>) -> Self {
        self.against = Some(what.into());
        self
    }

    /// The same with where its bar comes from.
    #[must_use]
    pub fn from(mut self, origin: impl Into<String>) -> Self {
        self.origin = Some(origin.into());
        self
    }

    /// The same with a command that shows where it comes from, if there is one.
    #[must_use]
    pub fn look(mut self, command: Option<String>) -> Self {
        self.command = command;
        self
    }

    /// The same, rated by a limit in its own unit.
    #[must_use]
    pub fn at_most(self, limit: f64) -> Self {
        let kept = self.ours.value <= limit;
        let bar = format!("at most {}", quantity(limit, &self.ours.unit));
        self.must(bar, kept)
    }

    /// The same, rated by a requirement: met is [`Verdict::Better`].
    #[must_use]
    pub fn must(mut self, bar: impl Into<String>, kept: bool) -> Self {
        self.bar = Some(bar.into());
        self.verdict = if kept { Verdict::Better } else { Verdict::Worse };
        self
    }
}

/// How a number compares with the paper's, or with what it must reach.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub enum Verdict {
    /// Better than the paper's, or within the bar.
    Better,
    /// The paper's, by 5 %.
    Same,
    /// Worse than the paper's, or outside of the bar.
    Worse,
    /// Not rated.
    #[default]
    Stated,
}

impl Verdict {
    /// Compares numbers of which less is better: within 5 % of `paper` they are the same.
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
    /// How much.
    pub value: f64,
    /// Of what; empty for numbers of things.
    pub unit: String,
    /// Half the width of its 95 % interval, where it has one.
    pub plus_minus: Option<f64>,
}

impl Quantity {
    /// A number with its unit.
    #[must_use]
    pub fn new(value: f64, unit: impl Into<String>) -> Self {
        Self { value, unit: unit.into(), plus_minus: None }
    }

    /// The same, with half the width of its 95 % interval.
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
    /// A number of things.
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
