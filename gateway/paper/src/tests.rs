//! Tests that perform every experiment that needs no bench, with few measurements.

use super::*;
use analysis::report::figure::{Figure, FindingVerdict, SeriesShape};
use std::sync::LazyLock;
use std::time::Instant;

static BEGAN: LazyLock<Instant> = LazyLock::new(Instant::now);

/// A lab that has a clock but cannot run benches.
struct Bare;

impl ExperimentLab for Bare {
    type Error = &'static str;

    fn now_ns(&self) -> u64 {
        u64::try_from(BEGAN.elapsed().as_nanos()).unwrap()
    }

    fn run_bench(&mut self, _: ReplyMode, _: Effort) -> Result<BenchRun, &'static str> {
        Err("there is no bench here")
    }

    fn run_scaled_bench(&mut self, _: &scale::ScaleBench) -> Result<Value, &'static str> {
        Err("there is no bench here")
    }

    fn check_stopped(&mut self) -> Result<(), &'static str> {
        Ok(())
    }
}

fn is_drawable(figure: &Figure) {
    assert!(
        !figure.title.is_empty() && !figure.x.caption.is_empty() && !figure.y.caption.is_empty(),
        "{}",
        figure.name
    );
    assert!(!figure.series.is_empty() && figure.series.len() <= Figure::COLOUR_COUNT, "{}", figure.name);
    for series in &figure.series {
        let finite = series.points.iter().all(|(x, y)| x.is_finite() && y.is_finite());
        assert!(series.points.len() >= 2 && finite, "{}: {series:?}", figure.name);
        let rises = series.points.windows(2).all(|pair| pair[0].0 <= pair[1].0);
        assert!(
            rises || matches!(series.shape, SeriesShape::Band | SeriesShape::Points),
            "{}: {}",
            figure.name,
            series.caption
        );
    }
}

/// The test does not check verdicts on times, because a debug build on a busy machine may take any time.
#[test]
fn every_experiment_without_a_bench_has_figures_and_findings_of_its_own() {
    let mut session = Session::new(Effort::Quick);
    let bare = || Experiment::ALL.into_iter().skip(3).filter(|experiment| *experiment != Experiment::Scale);
    let sections: Vec<_> = bare().map(|experiment| session.perform(experiment, &mut Bare).unwrap()).collect();
    let mut names = Vec::new();
    for (section, experiment) in sections.iter().zip(bare()) {
        assert_eq!(section.name, experiment.name());
        assert!(!section.findings.is_empty() && !section.text.is_empty() && !section.figures.is_empty());
        section.figures.iter().for_each(is_drawable);
        names.extend(section.figures.iter().map(|figure| figure.name.clone()));
        for finding in &section.findings {
            assert!(finding.ours.value.is_finite(), "{finding:?}");
            assert_eq!(
                finding.verdict == FindingVerdict::Stated,
                finding.bar.is_none() && is_stated(finding),
                "{finding:?}"
            );
        }
        let rows = section
            .tables
            .iter()
            .flat_map(|table| table.rows.iter().map(|row| (row.len(), table.head.len())));
        assert!(rows.clone().all(|(cells, head)| cells == head));
    }
    let all = names.len();
    names.sort();
    names.dedup();
    assert_eq!(names.len(), all, "figures have names of their own");
}

/// Returns true if a finding has no value of the paper to be compared with, or if the comparison is for information
/// only.
fn is_stated(finding: &analysis::report::figure::Finding) -> bool {
    finding.paper.is_none() || finding.verdict == FindingVerdict::Stated
}

#[test]
fn a_bench_that_fails_fails_its_experiments_and_no_others() {
    let mut session = Session::new(Effort::Quick);
    for experiment in [Experiment::Fig6, Experiment::Fig7, Experiment::Fig8, Experiment::Scale] {
        assert_eq!(session.perform(experiment, &mut Bare).err(), Some("there is no bench here"));
    }
    assert!(session.perform(Experiment::Load, &mut Bare).is_ok());
}

#[test]
fn names_lead_to_experiments_and_others_to_the_list() {
    for experiment in Experiment::ALL {
        assert_eq!(experiment.name().parse(), Ok(experiment));
        assert!(!experiment.description().contains('\n'));
    }
    let error = "fig11".parse::<Experiment>().unwrap_err();
    assert!(error.contains("fig6, fig7, fig8") && error.ends_with("scale"), "{error}");
}
