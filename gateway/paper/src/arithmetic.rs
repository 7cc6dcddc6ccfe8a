//! Experiments on the arithmetic of the cells: the error of the sine over the whole circle, and the operations that one
//! Jacobian takes.

use cell_node::kernel::oracle::{CountingWord, Projection};
use cell_node::kernel::{Kernel, Operations, Wrench};
use cell_node::sine::{paper_sine, sine};
use protocol::fixed::Q1_14;
use protocol::packet::pad_with_defaults;
use protocol::parameters::{MAX_JOINTS, Parameters};
use protocol::skin::Skin;

use super::line::count_to_f64;
use super::ticks::ARM_POSE_RAD;
use analysis::paper;
use analysis::report::figure::{Axis, Figure, Finding, Section, SeriesShape, Table};

/// The number of angles between two that are drawn.
const ANGLES_BETWEEN_DRAWN: usize = 16;
/// The number of angles in each part of the circle for which a maximum error is drawn.
const ANGLES_PER_PART: usize = 256;

/// The error of a fixed-point sine function over the whole circle.
#[derive(Clone, Debug)]
pub struct SineError {
    /// The mean absolute error over all angles.
    pub mean: f64,
    /// The maximum absolute error over all angles.
    pub max: f64,
    /// The angles that are drawn, in quarter turns, with the signed error at each.
    pub points: Vec<(f64, f64)>,
    /// For each part of the circle: the angle in its middle in quarter turns, and the maximum absolute error in it.
    pub parts: Vec<(f64, f64)>,
}

impl SineError {
    /// Computes the error of `function` for all 65 536 angles that a 16-bit number can hold.
    #[must_use]
    pub fn of_function(function: impl Fn(Q1_14) -> Q1_14) -> Self {
        let (mut sum, mut max) = (0.0, 0.0_f64);
        let (mut points, mut parts) = (Vec::new(), vec![(0.0, 0.0_f64); 65_536 / ANGLES_PER_PART]);
        for (place, bits) in (i16::MIN..=i16::MAX).enumerate() {
            let angle = Q1_14::from_bits(bits);
            let error = function(angle).to_f64() - angle.to_radians().sin();
            sum += error.abs();
            max = max.max(error.abs());
            if place % ANGLES_BETWEEN_DRAWN == 0 {
                points.push((angle.to_f64(), error));
            }
            if let Some((middle, max)) = parts.get_mut(place / ANGLES_PER_PART) {
                *middle += angle.to_f64() / count_to_f64(ANGLES_PER_PART);
                *max = max.max(error.abs());
            }
        }
        Self { mean: sum / 65_536.0, max, points, parts }
    }
}

/// Writes the section on the error of the sine.
#[must_use]
pub fn sine_section() -> Section {
    let [fifth, eighths, rounded] = [
        SineError::of_function(paper_sine),
        SineError::of_function(sine),
        SineError::of_function(|angle| Q1_14::nearest(angle.to_radians().sin())),
    ];
    let figure = |name: &str, title: &str, error: &str| {
        let angle = Axis::new("angle", "quarter turns").with_ends(-2.0, 2.0);
        Figure::new(name, title, angle, Axis::new(error, ""))
    };
    let mean = |what: &str, error: &SineError, bar: f64| {
        Finding::less_is_better(what, paper::SINE_MEAN_ERROR, error.mean).at_most(bar)
    };
    let max = |what: &str, error: &SineError, bar: f64| Finding::new_unrated(what, error.max).at_most(bar);
    Section::new("sine", "The sine in 16 bits")
        .with_paragraph(
            "The figures show the difference from the sine in double precision, over all 65 536 angles of a 16-bit \
             word. The paper gives a mean error for the polynomial of fifth order. Cells use short \
             polynomials of the distance from the nearest quarter turn. The lowest curve is the error of rounding to Q1.14 \
             alone.",
        )
        .with_figures([
            figure("sine-fifth", "Error of the paper's fifth-order polynomial (Eq. 17)", "error").draw_series(
                "fifth order",
                SeriesShape::Line,
                fifth.points.clone(),
            ),
            figure("sine-max", "Maximum error in each of 256 parts of the circle", "maximum error")
                .draw_series("fifth order", SeriesShape::Steps, fifth.parts.clone())
                .draw_series("polynomials of the cells (one for each eighth of a turn)", SeriesShape::Steps, eighths.parts.clone())
                .draw_series("rounding alone", SeriesShape::Steps, rounded.parts.clone()),
        ])
        .with_findings([
            mean("mean error of the sine of fifth order", &fifth, 1.9e-4),
            max("maximum error of the sine of fifth order", &fifth, 4.6e-4),
            mean("mean error of the sine by eighths of a turn", &eighths, 2e-5),
            max("maximum error of the sine by eighths of a turn", &eighths, 1e-4),
            Finding::new_unrated("mean error of rounding to Q1.14 alone", rounded.mean),
        ])
}

/// The operations that a cell needs to compute its Jacobian, by the link that the cell is on.
#[derive(Clone, Debug)]
pub struct JacobianCosts {
    /// The operations of the wrench kernel, which the cells use, for a cell on link 1, 2, ...
    pub wrench: Vec<Operations>,
    /// The operations of the projections in the paper, for a cell on link 1, 2, ...
    pub projection: Vec<Operations>,
}

impl JacobianCosts {
    /// Counts the operations for a cell on each link of the skin's robot. Both kernels are run on numbers that count
    /// operations.
    #[must_use]
    pub fn for_skin(skin: &Skin) -> Self {
        let joints = u8::try_from(skin.robot.joints.len()).unwrap_or(u8::MAX);
        let on = |joint| {
            let cell = skin.cells.first().map(|cell| skin.parameters(cell)).unwrap_or_default();
            Parameters { joint, row: 0, table_rows: 0, ..cell }
        };
        let words: [Q1_14; MAX_JOINTS] =
            pad_with_defaults(&ARM_POSE_RAD.map(|angle| Q1_14::from_radians(angle).unwrap_or_default()));
        Self {
            wrench: (1..=joints)
                .map(|joint| count_jacobian_operations::<Wrench<CountingWord>>(&on(joint), &words))
                .collect(),
            projection: (1..=joints)
                .map(|joint| count_jacobian_operations::<Projection<CountingWord>>(&on(joint), &words))
                .collect(),
        }
    }
}

/// Counts the operations of one Jacobian at these joint positions.
fn count_jacobian_operations<K: Kernel<CountingWord>>(
    cell: &Parameters,
    words: &[Q1_14; MAX_JOINTS],
) -> Operations {
    let kernel = K::new(cell);
    Operations::count_operations(|| kernel.jacobian(words)).1
}

/// Returns the counts of operations with their names, in the order of the paper.
fn named_counts(done: &Operations) -> [(&'static str, u32); 4] {
    let Operations { multiplications, additions, sines, cosines, .. } = *done;
    [("multiplications", multiplications), ("additions", additions), ("sines", sines), ("cosines", cosines)]
}

/// The maximum number of operations of each kind that the wrench kernel may need, in the order of the paper.
const MAX_WRENCH_OPERATIONS: [u32; 4] = [40, 24, 5, 5];

/// Writes the section that compares the operations of both kernels.
#[must_use]
pub fn kernels_section(robot: &str, costs: &JacobianCosts) -> Section {
    let links = |costs: &[Operations]| (1_u8..).zip(costs.to_vec()).collect::<Vec<_>>();
    let products = |costs: &[Operations]| {
        let of_link =
            |(link, done): (u8, Operations)| (link.into(), (done.multiplications + done.additions).into());
        links(costs).into_iter().map(of_link).collect::<Vec<_>>()
    };
    let last = |costs: &[Operations]| named_counts(&costs.last().copied().unwrap_or_default());
    let finding = |((name, ours), paper): ((&str, u32), u32), kernel: &str| {
        let what = format!("{name} of {kernel}, cell on the last link");
        Finding::less_is_better(what, f64::from(paper), f64::from(ours))
    };
    let wrench = last(&costs.wrench).into_iter().zip(paper::JACOBIAN_OPERATIONS).zip(MAX_WRENCH_OPERATIONS);
    let projection = last(&costs.projection).into_iter().zip(paper::JACOBIAN_OPERATIONS);
    let figure = Figure::new(
        "kernels",
        "Number of multiplications and additions, by the link that carries the cell",
        Axis::new("link", "").with_ends(0.0, 7.0),
        Axis::new("multiplications and additions", ""),
    );
    let rows = [("wrench", &costs.wrench), ("projections", &costs.projection)];
    let rows = rows.into_iter().flat_map(|(kernel, costs)| {
        links(costs).into_iter().map(move |(link, done)| {
            let counts = named_counts(&done).map(|(_, count)| count.to_string());
            [kernel.to_owned(), link.to_string()].into_iter().chain(counts).collect::<Vec<_>>()
        })
    });
    Section::new("kernels", "Operations to compute the Jacobian of one cell")
        .with_paragraph(format!(
            "The operations were counted by running the cells' code with a number type that counts them, on a \
             {robot}. The wrench kernel transforms the force and the moment of the contact to the base; the paper's \
             kernel transforms frames from the base to the cell.",
        ))
        .with_figures([figure
            .draw_series("wrench", SeriesShape::Line, products(&costs.wrench))
            .draw_series("the paper's projections", SeriesShape::Line, products(&costs.projection))])
        .with_findings(wrench.map(|(counts, bar)| finding(counts, "the wrench kernel").at_most(bar.into())))
        .with_findings(projection.map(|counts| finding(counts, "the paper's projections")))
        .with_tables([Table::new("Operations", ["kernel", "link", "mul", "add", "sin", "cos"], rows)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ticks;
    use analysis::report::figure::FindingVerdict;

    #[test]
    fn the_sines_errors_are_within_their_bars_and_over_the_whole_circle() {
        let section = sine_section();
        assert!(
            section.findings.iter().all(|finding| finding.verdict != FindingVerdict::Worse),
            "{section:?}"
        );
        let drawn =
            section.figures.iter().flat_map(|figure| &figure.series).map(|series| series.points.len());
        assert_eq!(drawn.collect::<Vec<_>>(), [65_536 / ANGLES_BETWEEN_DRAWN, 256, 256, 256]);
        let error = SineError::of_function(sine);
        let max = error.parts.iter().map(|(_, error)| *error).fold(0.0, f64::max);
        assert!((max - error.max).abs() < 1e-15 && (error.parts[128].0 - 0.0078).abs() < 1e-4);
        assert!(section.findings[0].ours.value > 1e-4 && section.findings[2].ours.value > 1e-5);
        let wrong = SineError::of_function(|angle| sine(angle.wrapping_add(Q1_14::from_bits(100))));
        assert!(wrong.mean > 1e-3, "a phase of 100 words is seen");
    }

    #[test]
    fn the_kernels_cost_what_they_may_and_more_on_farther_links() {
        let costs = JacobianCosts::for_skin(&ticks::generated_skin(1, 1).unwrap());
        let section = kernels_section("UR5", &costs);
        assert!(
            section.findings.iter().all(|finding| finding.verdict == FindingVerdict::Better
                || finding.verdict == FindingVerdict::Same)
        );
        let ours: Vec<_> = section.findings.iter().map(|finding| finding.ours.to_string()).collect();
        assert_eq!(ours, ["40", "24", "5", "5", "103", "56", "6", "6"]);
        for costs in [&costs.wrench, &costs.projection] {
            assert!(costs.windows(2).all(|pair| pair[0].multiplications <= pair[1].multiplications));
        }
    }
}
