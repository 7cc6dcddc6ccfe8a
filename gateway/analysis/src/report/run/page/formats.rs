//! Compares the torque formats for the torques that occurred on a bus.

use model::table::RoundingErrors;
use protocol::fixed::TorqueFormat;

use super::super::bus_figures::BusFigures;
use super::PageDraft;
use crate::report::figure::{Finding, Table, format_quantity};

/// The rounding errors in each torque format, for the torques of one bus.
struct FormatComparison<'a> {
    bus: &'a str,
    used: TorqueFormat,
    all: [(TorqueFormat, RoundingErrors); TorqueFormat::ALL.len()],
}

impl FormatComparison<'_> {
    fn rounding_errors(&self, format: TorqueFormat) -> RoundingErrors {
        self.all
            .iter()
            .find(|(it, _)| *it == format)
            .map_or_else(RoundingErrors::default, |(_, rounded)| *rounded)
    }

    /// Returns the finest format whose range contains every torque; the format with the widest range if there is none.
    fn best_format(&self) -> TorqueFormat {
        let holds = |(_, rounded): &&(TorqueFormat, RoundingErrors)| rounded.beyond == 0;
        self.all.iter().find(holds).or_else(|| self.all.last()).map_or(self.used, |(format, _)| *format)
    }

    /// Returns a sentence on what a better format gains and costs; `None` if the format of the bus is the best.
    fn advice_on_format(&self) -> Option<String> {
        let (used, best) = (self.used, self.best_format());
        let beyond = self.rounding_errors(used).beyond;
        let cost = |format: TorqueFormat| {
            format_quantity(self.rounding_errors(format).errors.mean().unwrap_or(f64::NAN), "Nm")
        };
        let (costs, instead) = (cost(best), cost(used));
        let (name, bus) = (best.name(), self.bus);
        match (best == used, beyond) {
            (true, _) => None,
            (false, 0) => Some(format!(
                "{bus}: the torque format {name} would have been better: it also covers every torque, and its mean \
                 rounding error is {costs} instead of {instead}."
            )),
            (false, _) => Some(format!(
                "{bus}: the torque format {name} would have been better: {beyond} torques are beyond {}, the range \
                 of {}. Its mean rounding error is {costs} instead of {instead}.",
                format_quantity(used.upper_bound(), "Nm"),
                used.name(),
            )),
        }
    }
}

impl PageDraft<'_> {
    /// Returns the comparison of formats for each bus whose torques were compared.
    fn format_comparisons(&self) -> impl Iterator<Item = FormatComparison<'_>> {
        let buses = self.run.bus_figures.iter().zip(&self.run.skin.buses);
        buses.filter_map(|(BusFigures { name, table, .. }, bus)| {
            let formats = table.accuracy().formats;
            let is_compared = formats.iter().any(|it| it.beyond + it.errors.count() > 0);
            let mut rounded = formats.into_iter();
            let all = TorqueFormat::ALL.map(|format| (format, rounded.next().unwrap_or_default()));
            is_compared.then_some(FormatComparison { bus: name, used: bus.torque_format, all })
        })
    }

    /// Creates the findings on torques beyond the range of a bus's format.
    pub(super) fn range_findings(&self) -> impl Iterator<Item = Finding> {
        self.format_comparisons().map(|choice| {
            let (bus, used) = (choice.bus, choice.used);
            let bound = format_quantity(used.upper_bound(), "Nm");
            let what = format!("{bus}: torques beyond the range of {}, {bound}", used.name());
            super::zero_required_finding(what, choice.rounding_errors(used).beyond)
                .with_origin("skin: torque_format")
        })
    }

    /// Returns advice on better formats, by bus.
    pub(super) fn advice_by_bus(&self) -> Option<String> {
        let all: Vec<_> = self.format_comparisons().filter_map(|choice| choice.advice_on_format()).collect();
        (!all.is_empty()).then(|| all.join(" "))
    }

    pub(super) fn formats_table(&self) -> Option<Table> {
        let unit = self.torque_unit();
        let rows = self.format_comparisons().flat_map(|choice| {
            choice.all.map(|(format, rounded)| {
                let used = if format == choice.used { ", used" } else { "" };
                [
                    format!("{} {}{used}", choice.bus, format.name()),
                    format_quantity(format.upper_bound(), unit),
                    rounded.beyond.to_string(),
                    format_quantity(rounded.errors.mean().unwrap_or(f64::NAN), unit),
                    format_quantity(rounded.errors.max(), unit),
                ]
                .to_vec()
            })
        });
        let rows: Vec<_> = rows.collect();
        (!rows.is_empty()).then(|| {
            Table::new(
                "Torque formats: central torques of single cells, rounded to each format",
                ["", "range", "torques beyond it", "rounding error: mean", "max"],
                rows,
            )
        })
    }
}
