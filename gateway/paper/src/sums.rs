//! The error of torque sums along a tree relative to the central computation, over the number of active cells. Three
//! kinds of cells are compared: cells that truncate, cells that round, and cells that round and carry the rounding
//! error into their next value.

use protocol::fixed::Q5_10;
use protocol::message::SkinSensors;
use protocol::parameters::MAX_JOINTS;
use protocol::skin::Skin;
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::line::count_to_f64;
use super::tree::{EpochSums, SumTree};
use analysis::paper;
use analysis::report::figure::{Axis, Figure, Finding, Section, Series, SeriesShape, Table, format_number};

/// The numbers of active cells that are measured. About twenty were active on the arm in the paper.
const ACTIVE_CELL_COUNTS: [usize; 10] = [1, 2, 5, 10, 20, 40, 80, 120, 180, 253];
/// The number of active cells at which the findings are stated.
const FINDINGS_ACTIVE_CELLS: usize = 20;
/// The number of epochs over which the sum of a constant touch is averaged.
const AVERAGED_EPOCHS: u32 = 32;
/// The maximum torque in Nm. Touches that cause a larger torque are left out, because Q7.8 cannot hold it.
const MAX_TORQUE_NM: f64 = 127.0;

/// The number of measurements.
#[derive(Clone, Copy, Debug)]
pub struct SumMeasurementPlan {
    /// The number of touches for each number of active cells.
    pub touches: usize,
    /// The number of epochs for which each touch lasts while the arm moves.
    pub epochs: u32,
}

/// The mean absolute errors of the sums for the joints that the cells load, in Nm, by the kind of cells.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SumErrors {
    /// The number of active cells.
    pub active: usize,
    /// The error if each cell truncates its torque.
    pub truncated: f64,
    /// The error if each cell rounds its torque to the nearest value.
    pub rounded: f64,
    /// The error if each cell rounds its torque and carries the rounding error into its next torque.
    pub carried: f64,
    /// The error of the average over 32 epochs of a constant touch, if each cell rounds.
    pub rounded_average: f64,
    /// The error of the average over 32 epochs of a constant touch, if each cell rounds and carries the rounding error.
    pub carried_average: f64,
}

/// Selects random cells of a skin, each with sensor values for a force of 0.6 to 6 N.
fn random_touches(dice: &mut Pcg64Mcg, cells: usize, active: usize) -> Vec<(usize, SkinSensors)> {
    let mut places: Vec<usize> = (0..cells).collect();
    places.shuffle(dice);
    let touched_cell = |place| {
        let contact = [0; 3].map(|_| Q5_10::nearest(dice.random_range(0.2..2.0)));
        (place, SkinSensors { contact, ..SkinSensors::default() })
    };
    places.into_iter().take(active).map(touched_cell).collect()
}

/// A mean of absolute errors.
#[derive(Clone, Copy, Debug, Default)]
struct MeanError {
    sum: f64,
    count: u32,
}

impl MeanError {
    /// Adds the absolute errors of the first `loaded` joints.
    fn add_absolute_errors(&mut self, loaded: usize, got: &[f64; MAX_JOINTS], target: &[f64; MAX_JOINTS]) {
        for (got, target) in
            got.iter().zip(target).take(loaded).filter(|(_, target)| target.abs() < MAX_TORQUE_NM)
        {
            self.sum += (got - target).abs();
            self.count += 1;
        }
    }

    fn mean(self) -> f64 {
        self.sum / f64::from(self.count)
    }
}

/// Returns those numbers of active cells that a skin has enough cells for.
pub fn active_cell_counts(skin: &Skin) -> impl Iterator<Item = usize> + use<> {
    let cells = skin.cells.len();
    ACTIVE_CELL_COUNTS.into_iter().filter(move |&active| active <= cells)
}

/// Measures the errors for a number of active cells. Equal arguments give equal results.
#[must_use]
pub fn measure_sum_errors(skin: &Skin, active: usize, extent: SumMeasurementPlan) -> SumErrors {
    let mut dice = Pcg64Mcg::seed_from_u64(active as u64);
    let (mut rounding, mut carrying) = (SumTree::new(skin, false), SumTree::new(skin, true));
    let [mut truncated, mut rounded, mut carried] = [MeanError::default(); 3];
    let [mut rounded_average, mut carried_average] = [MeanError::default(); 2];
    for _ in 0..extent.touches {
        let touch = random_touches(&mut dice, skin.cells.len(), active);
        let phase: [f64; MAX_JOINTS] = core::array::from_fn(|_| dice.random_range(0.0..6.0));
        for epoch in 0..extent.epochs {
            let q = phase.map(|phase| (phase + f64::from(epoch) * 0.016).sin());
            let (round, carry) = (rounding.run_epoch(&q, &touch), carrying.run_epoch(&q, &touch));
            truncated.add_absolute_errors(round.loaded, &round.truncated, &round.central);
            rounded.add_absolute_errors(round.loaded, &round.sum, &round.central);
            carried.add_absolute_errors(carry.loaded, &carry.sum, &carry.central);
        }
        let q = phase.map(|phase| 1.5 * phase.sin());
        // Cells that carry begin each touch without a rounding error from the one before.
        let mut fresh = SumTree::new(skin, true);
        for (tree, average) in [(&mut rounding, &mut rounded_average), (&mut fresh, &mut carried_average)] {
            let (mean, last) = average_sum(tree, &q, &touch);
            average.add_absolute_errors(last.loaded, &mean, &last.central);
        }
    }
    SumErrors {
        active,
        truncated: truncated.mean(),
        rounded: rounded.mean(),
        carried: carried.mean(),
        rounded_average: rounded_average.mean(),
        carried_average: carried_average.mean(),
    }
}

/// Returns the mean of the sums over the epochs of a constant touch, while the arm does not move.
fn average_sum(
    tree: &mut SumTree,
    q: &[f64; MAX_JOINTS],
    touch: &[(usize, SkinSensors)],
) -> ([f64; MAX_JOINTS], EpochSums) {
    let (mut mean, mut last) = ([0.0; MAX_JOINTS], EpochSums::default());
    for _ in 0..AVERAGED_EPOCHS {
        last = tree.run_epoch(q, touch);
        for (mean, sum) in mean.iter_mut().zip(last.sum) {
            *mean += sum / f64::from(AVERAGED_EPOCHS);
        }
    }
    (mean, last)
}

/// A kind of sum: its heading in a table, the text of its finding, and its value in [`SumErrors`].
type SumMethod = (&'static str, &'static str, fn(&SumErrors) -> f64);

/// All kinds of sums that are compared.
const SUM_METHODS: [SumMethod; 5] = [
    ("truncated", "mean error per epoch, with truncation", |at| at.truncated),
    ("rounded", "mean error per epoch, with rounding", |at| at.rounded),
    ("carried", "mean error per epoch, with rounding errors carried over", |at| at.carried),
    ("rounded, average of 32", "mean error of the average over 32 epochs, with rounding", |at| {
        at.rounded_average
    }),
    (
        "carried, average of 32",
        "mean error of the average over 32 epochs, with rounding errors carried over",
        |at| at.carried_average,
    ),
];

/// Writes the section on the error of sums over the number of active cells.
#[must_use]
pub fn sums_section(skin: &Skin, errors: &[SumErrors]) -> Section {
    let of = skin.cells.len();
    let figure = Figure::new(
        "sums",
        format!(
            "Mean error of the summed torque (Q7.8) at the loaded joints, by number of active cells out of {of}"
        ),
        Axis::new("active cells", "").with_log_scale().with_ends(0.9, 300.0),
        Axis::new("mean absolute error", "Nm").with_log_scale().with_ends(1e-5, 1.0),
    );
    let series = SUM_METHODS.map(|(caption, _, error)| {
        let points = errors.iter().map(|errors| (count_to_f64(errors.active), error(errors))).collect();
        Series::new(caption, SeriesShape::Line, points)
    });
    let at = errors.iter().filter(|errors| errors.active == FINDINGS_ACTIVE_CELLS).take(1);
    let findings = at.flat_map(|at| {
        SUM_METHODS.map(|(caption, what, error)| {
            let what = format!("sum of {FINDINGS_ACTIVE_CELLS} active cells of {of}: {what}");
            let found = Finding::less_is_better(what, paper::SUMMED_ERROR_NM, (error(at), "Nm"));
            if caption == "rounded" { found.at_most(0.005) } else { found }
        })
    });
    let rows = errors.iter().map(|at| {
        let errors = SUM_METHODS.map(|(_, _, error)| format_number(error(at)));
        core::iter::once(at.active.to_string()).chain(errors).collect::<Vec<_>>()
    });
    let [a, b, c, d, e] = SUM_METHODS.map(|(caption, ..)| caption);
    Section::new("sums", "Sums along the tree: truncating, rounding, carrying")
        .with_paragraph(
            "Random cells measure 0.6 to 6 N while the arm moves; every cell computes and adds with the code of its \
             microcontroller. Truncation to Q7.8 makes the torque of every cell too low by half a step of 0.0039 Nm \
             on average, so the error of the sum grows with the number of cells. With rounding it grows with the \
             square root of that number. A cell that carries its rounding error into its next value has a larger \
             error in single epochs, but none on average.",
        )
        .with_paragraph(format!(
            "The paper's {} Nm is the error of truncated sums with about twenty active cells.",
            format_number(paper::SUMMED_ERROR_NM)
        ))
        .with_figures([figure.with_series(series)])
        .with_findings(findings)
        .with_tables([Table::new("Mean absolute error in Nm", ["active cells", a, b, c, d, e], rows)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ticks;

    #[test]
    fn truncated_sums_drift_with_the_cells_rounded_ones_do_not_and_carried_ones_are_right_on_average() {
        let skin = ticks::generated_skin(64, 1).unwrap();
        let measure = || -> Vec<_> {
            active_cell_counts(&skin)
                .map(|active| measure_sum_errors(&skin, active, SumMeasurementPlan { touches: 6, epochs: 4 }))
                .collect()
        };
        let errors = measure();
        assert_eq!(errors.iter().map(|at| at.active).collect::<Vec<_>>(), [1, 2, 5, 10, 20, 40]);
        let (one, forty) = (errors[0], errors[5]);
        // A cell that truncates is too low by half a step of 1/256 Nm on average. Cells near the base load fewer
        // joints.
        let drift = |at: &SumErrors| at.truncated / (count_to_f64(at.active) / 512.0);
        assert!((0.6..1.1).contains(&drift(&one)) && (0.6..1.0).contains(&drift(&forty)), "{errors:?}");
        assert!((25.0..45.0).contains(&(forty.truncated / one.truncated)), "{errors:?}");
        // A cell that rounds is off by a quarter of a step on average, and the error of the sum grows with the square
        // root of the number of cells.
        assert!(forty.rounded < 0.012 && forty.truncated > 4.0 * forty.rounded, "{errors:?}");
        assert!(forty.carried_average < forty.rounded_average / 2.0, "{errors:?}");
        let section = sums_section(&skin, &errors);
        assert_eq!(section.findings.len(), 5);
        assert!(section.figures[0].series.iter().all(|series| series.points.len() == 6));
        assert_eq!(measure(), errors, "the same again");
    }
}
