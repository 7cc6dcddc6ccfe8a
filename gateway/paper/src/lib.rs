//! The experiments of the paper, and further ones: measurements, figures, and verdicts on them.
//!
//! ```text
//!   Lab (a clock, whole benches) ─┐
//!                                 ├─> Session::perform ─> Section: figures, findings with verdicts, tables
//!   Effort (how much) ────────────┘                          └─> report::page, report::svg, files::csv, files::results
//! ```
//!
//! All computations here are pure, except that they read a clock. The implementation of [`ExperimentLab`] runs benches
//! of processes. Each verdict is computed from the measurements of its run.
//!
//! This crate and `reference` use the code of the cells: it counts the operations of that code, and computes sums along
//! a tree without a bus. In every other crate the gateway communicates with cells only over the bus, which
//! `tests/src/architecture.rs` checks.

pub mod arithmetic;
pub mod arm;
pub mod central;
pub mod distributed;
pub mod files;
pub mod line;
pub mod load;
pub mod moving;
pub mod recorded;
pub mod samples;
pub mod scale;
pub mod sums;
pub mod ticks;
pub mod tree;

use std::fmt;
use std::str::FromStr;

use protocol::skin::Skin;
use serde_json::Value;

use analysis::report::figure::Section;
use arm::ReplyMode;
use moving::BenchRun;

/// An experiment of the paper, named by the figure or table that it measures again.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd)]
pub enum Experiment {
    /// Fig. 6: the torques of the moving arm.
    Fig6,
    /// Fig. 7: the velocities and the active cells of the moving arm.
    Fig7,
    /// Fig. 8: the cycle times of the moving arm.
    Fig8,
    /// Fig. 9: the time of the central computation over the number of cells.
    Fig9,
    /// Fig. 10: the time of the central computation over the number of active cells.
    Fig10,
    /// The time of the distributed computation over the numbers of cells and of active cells.
    Distributed,
    /// The error of torque sums along a tree.
    Sums,
    /// The error of the cells' sine function.
    Sine,
    /// The number of operations for a Jacobian.
    Kernels,
    /// The load of a real bus.
    Load,
    /// Whole benches of up to ten thousand cells.
    Scale,
}

impl Experiment {
    /// All experiments, in the order of the page.
    pub const ALL: [Self; 11] = [
        Self::Fig6,
        Self::Fig7,
        Self::Fig8,
        Self::Fig9,
        Self::Fig10,
        Self::Distributed,
        Self::Sums,
        Self::Sine,
        Self::Kernels,
        Self::Load,
        Self::Scale,
    ];

    /// Returns the name and the description of the experiment, and its approximate duration in s for a quick and for a
    /// full measurement.
    const fn name_description_seconds(self) -> (&'static str, &'static str, [u64; 2]) {
        match self {
            Self::Fig6 => (
                "fig6",
                "joint torques of the moving arm, as the cells compute them in Q3.12 and Q7.8, beside those of the control loop",
                [10, 32],
            ),
            Self::Fig7 => ("fig7", "joint velocities and active cells of the moving arm", [1, 1]),
            Self::Fig8 => (
                "fig8",
                "cycle times of the moving arm; the central computation is switched off at 5.7 s",
                [1, 1],
            ),
            Self::Fig9 => {
                ("fig9", "time of the central computation for 0 to 3000 cells, none active (Eq. 29)", [1, 4])
            }
            Self::Fig10 => (
                "fig10",
                "time of the central computation by number of active cells (Eq. 30, 31); maximum number of \
                 cells at 500 Hz",
                [1, 4],
            ),
            Self::Distributed => (
                "distributed",
                "time of the loop's ticks by number of cells and of active cells; time to receive a torque",
                [1, 20],
            ),
            Self::Sums => (
                "sums",
                "error of summed torques by number of active cells: truncated, rounded, or with the \
                          rounding error carried over",
                [1, 10],
            ),
            Self::Sine => ("sine", "error of the 16-bit sine functions over the whole circle", [1, 1]),
            Self::Kernels => {
                ("kernels", "operations to compute the Jacobian of one cell, with both kernels", [1, 1])
            }
            Self::Load => ("load", "bus load by number of cells, for common bit rates", [1, 1]),
            Self::Scale => (
                "scale",
                "whole benches of 253 to 10 000 cells: start time, use of processor and memory, ticks, \
                 replies in time",
                [8, 150],
            ),
        }
    }

    /// Returns the name of the experiment, as used on the command line and in file names.
    #[must_use]
    pub const fn name(self) -> &'static str {
        self.name_description_seconds().0
    }

    /// Returns a description of the experiment, in one line.
    #[must_use]
    pub const fn description(self) -> &'static str {
        self.name_description_seconds().1
    }

    /// Returns the approximate duration in s, without the time for measurements that it shares with earlier
    /// experiments.
    #[must_use]
    pub const fn seconds(self, effort: Effort) -> u64 {
        let [quick, full] = self.name_description_seconds().2;
        match effort {
            Effort::Quick => quick,
            Effort::Full => full,
        }
    }
}

impl fmt::Display for Experiment {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Experiment {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|experiment| experiment.name() == name);
        found.ok_or_else(|| {
            let names: Vec<_> = Self::ALL.iter().map(|experiment| experiment.name()).collect();
            format!("there is no experiment of this name: use all, {}", names.join(", "))
        })
    }
}

/// The number and the size of the measurements.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Effort {
    /// Enough measurements to check that an experiment works. Fitted lines and errors are less precise.
    Quick,
    /// As many measurements as in the paper.
    Full,
}

/// The environment of experiments: a clock, and a way to run benches.
pub trait ExperimentLab {
    /// The error of a bench that failed.
    type Error;

    /// Returns the time of a monotonic clock, in ns.
    fn now_ns(&self) -> u64;

    /// Runs a bench with the arm, and reads its recording.
    ///
    /// # Errors
    /// Returns an error if the bench failed, or if its recording is incomplete.
    fn run_bench(&mut self, reply: ReplyMode, effort: Effort) -> Result<BenchRun, Self::Error>;

    /// Runs a bench with the given numbers of cells and buses. Returns its summary as JSON, even if the run failed.
    ///
    /// # Errors
    /// Returns an error if the bench could not be started.
    fn run_scaled_bench(&mut self, bench: &scale::ScaleBench) -> Result<Value, Self::Error>;

    /// Checks, between two measurements, that the experiments are to continue.
    ///
    /// # Errors
    /// Returns an error if the experiments are to end, for example because the user stopped them.
    fn check_stopped(&mut self) -> Result<(), Self::Error>;
}

/// A sequence of experiments. Measurements that several experiments need are made only once.
#[derive(Debug)]
pub struct Session {
    effort: Effort,
    single: Option<BenchRun>,
    over_cells: Option<central::CentralTimesByCells>,
    large: Option<Skin>,
}

impl Session {
    /// Creates a session without measurements.
    #[must_use]
    pub const fn new(effort: Effort) -> Self {
        Self { effort, single: None, over_cells: None, large: None }
    }

    /// Performs one experiment, and writes a section on its results.
    ///
    /// # Errors
    /// Returns the error of the lab.
    ///
    /// # Panics
    /// Never panics in practice: generated skins are valid, and all lines are fitted to enough points.
    pub fn perform<L: ExperimentLab>(
        &mut self,
        experiment: Experiment,
        lab: &mut L,
    ) -> Result<Section, L::Error> {
        lab.check_stopped()?;
        Ok(match experiment {
            Experiment::Fig6 => {
                let single = self.torque_reply_run(lab)?.clone();
                lab.check_stopped()?;
                moving::fig6_section(&single, &lab.run_bench(ReplyMode::Sum, self.effort)?)
            }
            Experiment::Fig7 => moving::fig7_section(self.torque_reply_run(lab)?),
            Experiment::Fig8 => moving::fig8_section(self.torque_reply_run(lab)?),
            Experiment::Fig9 => central::fig9_section(self.central_times_over_cells(lab)),
            Experiment::Fig10 => {
                let cells = self.central_times_over_cells(lab).clone();
                lab.check_stopped()?;
                let (cells_of_arm, extent) = (self.arm_skin(), self.central_measurement_plan());
                let active = central::measure_over_active(&cells_of_arm, extent, || lab.now_ns());
                central::fig10_section(&active.expect("more than two numbers of active cells"), &cells)
            }
            Experiment::Distributed => {
                let (steps, rounds) = self.choose_by_effort((4, 10), (30, 200));
                let extent = distributed::DistributedMeasurementPlan { steps, rounds };
                let now = || lab.now_ns();
                let measured = distributed::measure_distributed(self.large_skin(), extent, now);
                distributed::distributed_section(&measured.expect("more than two numbers of cells"))
            }
            Experiment::Sums => {
                let (touches, epochs) = self.choose_by_effort((2, 5), (20, 50));
                let arm = self.arm_skin();
                let mut errors = Vec::new();
                for active in sums::active_cell_counts(&arm) {
                    lab.check_stopped()?;
                    errors.push(sums::measure_sum_errors(
                        &arm,
                        active,
                        sums::SumMeasurementPlan { touches, epochs },
                    ));
                }
                sums::sums_section(&arm, &errors)
            }
            Experiment::Sine => arithmetic::sine_section(),
            Experiment::Kernels => {
                let arm = self.arm_skin();
                arithmetic::kernels_section(&arm.robot.name, &arithmetic::JacobianCosts::for_skin(&arm))
            }
            Experiment::Load => load::load_section(),
            Experiment::Scale => scale::scale_section(&scale::measure_scale(lab, self.effort)?),
        })
    }

    fn choose_by_effort<T>(&self, quick: T, full: T) -> T {
        match self.effort {
            Effort::Quick => quick,
            Effort::Full => full,
        }
    }

    fn central_measurement_plan(&self) -> central::CentralMeasurementPlan {
        self.choose_by_effort(
            central::CentralMeasurementPlan { step: 24, rounds: 20, touches: 100 },
            central::CentralMeasurementPlan { step: 100, rounds: 1_000, touches: 8_000 },
        )
    }

    /// Returns the skin of the paper's arm, or of a smaller one for a quick measurement.
    fn arm_skin(&self) -> Skin {
        ticks::generated_skin(self.choose_by_effort(24, 253), 1).expect("so many cells fit on the arm")
    }

    /// Returns a skin with the maximum number of cells in Fig. 9, or fewer for a quick measurement.
    fn large_skin(&mut self) -> &Skin {
        let cells = self.choose_by_effort(240, ticks::MAX_CELLS);
        self.large.get_or_insert_with(|| {
            ticks::generated_skin(cells, ticks::BUSES)
                .expect("so many cells fit on the arm and on so many buses")
        })
    }

    fn central_times_over_cells<L: ExperimentLab>(&mut self, lab: &L) -> &central::CentralTimesByCells {
        let extent = self.central_measurement_plan();
        if self.over_cells.is_none() {
            self.over_cells = central::measure_over_cells(self.large_skin(), extent, || lab.now_ns());
        }
        self.over_cells.as_ref().expect("more than two numbers of cells")
    }

    fn torque_reply_run<L: ExperimentLab>(&mut self, lab: &mut L) -> Result<&BenchRun, L::Error> {
        Ok(match &mut self.single {
            Some(run) => run,
            none => none.insert(lab.run_bench(ReplyMode::Torque, self.effort)?),
        })
    }
}

#[cfg(test)]
mod tests;
