//! The cells' arithmetic: the sine's error over the whole circle, and what one Jacobian costs.

use cell_node::kernel::witness::Counted;
use cell_node::kernel::{Kernel, Operations, Projection, Wrench};
use cell_node::sine::{paper_sine, sine};
use protocol::fixed::Q1_14;
use protocol::parameters::{MAX_JOINTS, Parameters};
use protocol::skin::Skin;

use super::line::count;
use super::ticks::POSE;
use analysis::paper;
use analysis::report::figure::{Axis, Figure, Finding, Quantity, Section, Series, Shape, Table};

/// One in so many angles is drawn.
const DRAWN: usize = 16;
/// Angles of which the greatest error is drawn.
const PART: usize = 256;

/// The error of a sine over all angles there are.
#[derive(Clone, Debug)]
pub struct SineError {
    /// Mean absolute error.
    pub mean: f64,
    /// Greatest absolute error.
    pub greatest: f64,
    /// Angle in quarter turns, signed error.
    pub points: Vec<(f64, f64)>,
    /// The middle of each part of the circle in quarter turns, the greatest absolute error there.
    pub parts: Vec<(f64, f64)>,
}

impl SineError {
    /// Over all 65 536 words.
    #[must_use]
    pub fn of(function: impl Fn(Q1_14) -> Q1_14) -> Self {
        let (mut sum, mut greatest) = (0.0, 0.0_f64);
        let (mut points, mut parts) = (Vec::new(), vec![(0.0, 0.0_f64); 65_536 / PART]);
        for (place, bits) in (i16::MIN..=i16::MAX).enumerate() {
            let angle = Q1_14::from_bits(bits);
            let error = function(angle).to_f64() - angle.to_radians().sin();
            sum += error.abs();
            greatest = greatest.max(error.abs());
            if place % DRAWN == 0 {
                points.push((angle.to_f64(), error));
            }
            if let Some((middle, greatest)) = parts.get_mut(place / PART) {
                *middle += angle.to_f64() / count(PART);
                *greatest = greatest.max(error.abs());
            }
        }
        Self { mean: sum / 65_536.0, greatest, points, parts }
    }
}

/// The sine's error over the whole circle.
#[must_use]
pub fn sine_section() -> Section {
    let [fifth, seventh, rounded] = [
        SineError::of(paper_sine),
        SineError::of(sine),
        SineError::of(|angle| Q1_14::nearest(angle.to_radians().sin())),
    ];
    let figure = |name: &str, title: &str, error: &str, series| Figure {
        name: name.to_owned(),
        title: title.to_owned(),
        x: Axis::new("angle", "quarter turns").between(-2.0, 2.0),
        y: Axis::new(error, ""),
        series,
        ..Figure::default()
    };
    let greatest_there =
        |label: &str, error: &SineError| Series::new(label, Shape::Steps, error.parts.clone());
    let mean = |what: &str, error: &SineError, bar: f64| {
        Finding::less_is_better(what, Quantity::new(paper::SINE, ""), Quantity::new(error.mean, ""))
            .must(format!("at most {bar}"), error.mean <= bar)
    };
    let greatest = |what: &str, error: &SineError, bar: f64| {
        Finding::told(what, Quantity::new(error.greatest, ""))
            .must(format!("at most {bar}"), error.greatest <= bar)
    };
    Section {
        name: "sine".to_owned(),
        title: "The sine in 16 bits".to_owned(),
        text: vec![
            "The difference to the sine in double precision, over all 65 536 angles that a word can say. Of the \
             polynomial of fifth order the paper gives a mean error; the one of seventh order is what cells compute with, and \
             costs one multiplication more. Below it is what rounding to Q1.14 alone costs."
                .to_owned(),
        ],
        figures: vec![
            figure(
                "sine-fifth",
                "Fifth order, the paper's (Eq. 17)",
                "error",
                vec![Series::new("fifth order", Shape::Line, fifth.points.clone())],
            ),
            figure(
                "sine-greatest",
                "The greatest errors in 256 parts of the circle",
                "greatest error",
                vec![
                    greatest_there("fifth order", &fifth),
                    greatest_there("seventh order, the cells'", &seventh),
                    greatest_there("rounding alone", &rounded),
                ],
            ),
        ],
        findings: vec![
            mean("sine of fifth order, mean error", &fifth, 1.9e-4),
            greatest("sine of fifth order, greatest error", &fifth, 4.6e-4),
            mean("sine of seventh order, mean error", &seventh, 2e-5),
            greatest("sine of seventh order, greatest error", &seventh, 1e-4),
            Finding::told("rounding to Q1.14 alone, mean error", Quantity::new(rounded.mean, "")),
        ],
        tables: Vec::new(),
    }
}

/// What the Jacobian of a cell on each link of a robot costs.
#[derive(Clone, Debug)]
pub struct Costs {
    /// By the wrench, for a cell on link 1, 2, ...
    pub wrench: Vec<Operations>,
    /// By the paper's projections.
    pub projection: Vec<Operations>,
}

impl Costs {
    /// Of a skin's robot, counted by running the kernels on numbers that count.
    #[must_use]
    pub fn of(skin: &Skin) -> Self {
        let joints = u8::try_from(skin.robot.joints.len()).unwrap_or(u8::MAX);
        let on = |joint| {
            let cell = skin.cells.first().map(|cell| skin.parameters(cell)).unwrap_or_default();
            Parameters { joint, ..cell }
        };
        let words: [Q1_14; MAX_JOINTS] = POSE.map(|angle| Q1_14::from_radians(angle).unwrap_or_default());
        let wrench = |joint| {
            let kernel = <Wrench<Counted> as Kernel<Counted>>::new(&on(joint));
            Operations::count(|| kernel.jacobian(&words)).1
        };
        let projection = |joint| {
            let kernel = <Projection<Counted> as Kernel<Counted>>::new(&on(joint));
            Operations::count(|| kernel.jacobian(&words)).1
        };
        Self {
            wrench: (1..=joints).map(wrench).collect(),
            projection: (1..=joints).map(projection).collect(),
        }
    }
}

/// Operations by name, in the paper's order.
fn named(done: &Operations) -> [(&'static str, u32); 4] {
    let Operations { multiplications, additions, sines, cosines, .. } = *done;
    [("multiplications", multiplications), ("additions", additions), ("sines", sines), ("cosines", cosines)]
}

/// What the wrench kernel is to need at most.
const WRENCH: [u32; 4] = [40, 24, 5, 5];

/// Operations of both kernels.
#[must_use]
pub fn kernels_section(robot: &str, costs: &Costs) -> Section {
    let products = |costs: &[Operations]| {
        (1..)
            .zip(costs)
            .map(|(link, done): (u8, _)| (f64::from(link), f64::from(done.multiplications + done.additions)))
            .collect::<Vec<_>>()
    };
    let number = |value: u32| Quantity::new(f64::from(value), "");
    let mut findings = Vec::new();
    let last = |costs: &[Operations]| costs.last().copied().unwrap_or_default();
    for (((name, ours), paper), bar) in
        named(&last(&costs.wrench)).into_iter().zip(paper::OPERATIONS).zip(WRENCH)
    {
        let what = format!("{name} of the wrench kernel, cell on the last link");
        findings.push(
            Finding::less_is_better(what, number(paper), number(ours))
                .must(format!("at most {bar}"), ours <= bar),
        );
    }
    for ((name, ours), paper) in named(&last(&costs.projection)).into_iter().zip(paper::OPERATIONS) {
        let what = format!("{name} of the paper's projections, cell on the last link");
        findings.push(Finding::less_is_better(what, number(paper), number(ours)));
    }
    let rows = [("wrench", &costs.wrench), ("projections", &costs.projection)];
    Section {
        name: "kernels".to_owned(),
        title: "Operations of one cell's Jacobian".to_owned(),
        text: vec![format!(
            "Counted by running the cells' code on words that count what is done to them, on a {robot}. The wrench kernel \
             carries the contact's force and moment down to the base; the paper carries frames up to the cell.",
        )],
        figures: vec![Figure {
            name: "kernels".to_owned(),
            title: "Multiplications and additions over the link that the cell is on".to_owned(),
            x: Axis::new("link", "").between(0.0, 7.0),
            y: Axis::new("multiplications and additions", ""),
            series: vec![
                Series::new("wrench", Shape::Line, products(&costs.wrench)),
                Series::new("the paper's projections", Shape::Line, products(&costs.projection)),
            ],
            ..Figure::default()
        }],
        findings,
        tables: vec![Table {
            title: "Operations".to_owned(),
            head: ["kernel", "link", "mul", "add", "sin", "cos"].map(str::to_owned).to_vec(),
            rows: rows
                .into_iter()
                .flat_map(|(kernel, costs)| {
                    (1..).zip(costs).map(move |(link, done): (u8, _)| {
                        let counts = named(done).map(|(_, count)| count.to_string());
                        [kernel.to_owned(), link.to_string()].into_iter().chain(counts).collect()
                    })
                })
                .collect(),
        }],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ticks;
    use analysis::report::figure::Verdict;

    #[test]
    fn the_sines_errors_are_within_their_bars_and_over_the_whole_circle() {
        let section = sine_section();
        assert!(section.findings.iter().all(|finding| finding.verdict != Verdict::Worse), "{section:?}");
        let drawn =
            section.figures.iter().flat_map(|figure| &figure.series).map(|series| series.points.len());
        assert_eq!(drawn.collect::<Vec<_>>(), [65_536 / DRAWN, 256, 256, 256]);
        let error = SineError::of(sine);
        let greatest = error.parts.iter().map(|(_, error)| *error).fold(0.0, f64::max);
        assert!((greatest - error.greatest).abs() < 1e-15 && (error.parts[128].0 - 0.0078).abs() < 1e-4);
        assert!(section.findings[0].ours.value > 1e-4 && section.findings[2].ours.value > 1e-5);
        let wrong = SineError::of(|angle| sine(angle.wrapping_add(Q1_14::from_bits(100))));
        assert!(wrong.mean > 1e-3, "a phase of 100 words is seen");
    }

    #[test]
    fn the_kernels_cost_what_they_may_and_more_on_farther_links() {
        let costs = Costs::of(&ticks::skin(1, 1).unwrap());
        let section = kernels_section("UR5", &costs);
        assert!(
            section
                .findings
                .iter()
                .all(|finding| finding.verdict == Verdict::Better || finding.verdict == Verdict::Same)
        );
        let ours: Vec<_> = section.findings.iter().map(|finding| finding.ours.to_string()).collect();
        assert_eq!(ours, ["40", "24", "5", "5", "103", "56", "6", "6"]);
        for costs in [&costs.wrench, &costs.projection] {
            assert!(costs.windows(2).all(|pair| pair[0].multiplications <= pair[1].multiplications));
        }
    }
}
