//! Compares the joints packet with one number in both captures: its words, and the cells' answers to it.

use model::tracker::PerCell;
use protocol::fixed::{Q1_14, TorqueFormat};
use protocol::id::CellId;
use protocol::message::SkinSensors;
use protocol::packet::Words;
use protocol::schema::BusUnits;
use protocol::skin::{JointKind, Skin};

use super::report::{ContactCounts, FirstDifference, JointCounts, ReplyCounts, UnpairedCounts};
use super::side::AnsweredJoints;
use super::{CompareOptions, PerCapture};
use crate::explain::ObservedCellState;

/// The counts of a comparison for one bus.
#[derive(Debug, Default)]
pub(super) struct ComparisonCounts {
    pub(super) joints: JointCounts,
    pub(super) halts: UnpairedCounts,
    pub(super) contacts: ContactCounts,
    pub(super) torques: ReplyCounts,
    pub(super) sums: ReplyCounts,
    pub(super) cells: PerCell<ReplyCounts>,
}

/// A difference that has been found, not yet described in words.
#[derive(Debug, Default)]
pub(super) struct FoundDifference {
    what: &'static str,
    how: &'static str,
    cell: Option<CellId>,
    /// The pair of words that differ most.
    word: Option<DifferingWords>,
    pub(super) inputs: Vec<&'static str>,
    unknown: Vec<&'static str>,
}

/// The first differences at one joints packet. Missing items are kept apart, because they may be within the tolerance.
#[derive(Debug, Default)]
pub(super) struct FirstDifferences {
    pub(super) missing: Option<FoundDifference>,
    pub(super) other: Option<FoundDifference>,
}

impl FirstDifferences {
    fn note_difference(&mut self, found: FoundDifference) {
        let is_missing = found.how != "different" && matches!(found.what, "epoch" | "torque" | "sum");
        (if is_missing { &mut self.missing } else { &mut self.other }).get_or_insert(found);
    }
}

#[derive(Debug)]
struct DifferingWords {
    place: usize,
    steps: u32,
    words: [i16; 2],
    values: [f64; 2],
    unit: &'static str,
}

impl FoundDifference {
    pub(super) fn missing_epoch(in_a: bool) -> FirstDifferences {
        let found = Self { what: "epoch", how: missing_side_text(in_a), ..Self::default() };
        FirstDifferences { missing: Some(found), other: None }
    }

    /// Returns the cell in which the captures differ; `None` for joints and halts.
    pub(super) const fn cell(&self) -> Option<CellId> {
        self.cell
    }

    /// Describes the difference for the report; `moments` are the joints and answers in both captures, if present.
    pub(super) fn describe_difference(
        self,
        (skin, bus): (&Skin, usize),
        moments: &PerCapture<Option<&AnsweredJoints>>,
        time_s: PerCapture<Option<f64>>,
    ) -> Option<FirstDifference> {
        let moment = moments.a.or(moments.b)?;
        let words = self.word.as_ref();
        let place = words.map(|word| word.place);
        let joint = place.and_then(|place| skin.joints_on_bus(bus).nth(place));
        let pair = |of: fn(&DifferingWords) -> [i16; 2]| words.map(of);
        let [word_a, word_b] = pair(|word| word.words).map_or([None; 2], |words| words.map(Some));
        let [value_a, value_b] = words.map_or([None; 2], |word| word.values.map(Some));
        Some(FirstDifference {
            what: self.what,
            how: self.how,
            bus: skin.buses.get(bus).map(|bus| bus.name.clone()).unwrap_or_default(),
            cell: self.cell.map(CellId::get),
            joint: joint.and_then(|(joint, _)| u8::try_from(joint + 1).ok()),
            epoch: moment.epoch.0,
            number: moment.key.number,
            time_s,
            words: PerCapture { a: word_a, b: word_b },
            values: PerCapture { a: value_a, b: value_b },
            unit: words.map(|word| word.unit),
            steps: words.map(|word| word.steps),
            inputs: self.inputs,
            unknown_inputs: self.unknown,
            occurrence: PerCapture {
                a: moments.a.map(|moment| moment.occurrence),
                b: moments.b.map(|moment| moment.occurrence),
            },
        })
    }
}

const fn missing_side_text(in_a: bool) -> &'static str {
    if in_a { "missing in a" } else { "missing in b" }
}

/// Compares a joints packet that both captures have, and the answers to it. Returns the first differences.
pub(super) fn compare_joints(
    tally: &mut ComparisonCounts,
    (skin, bus): (&Skin, usize),
    moments: PerCapture<&AnsweredJoints>,
    options: &CompareOptions,
) -> FirstDifferences {
    let PerCapture { a, b } = moments;
    let mut first = FirstDifferences::default();
    let joints = largest_joint_difference(skin, bus, moments);
    let steps = joints.as_ref().map_or(0, |joints| joints.steps);
    tally.joints.max_steps = tally.joints.max_steps.max(steps);
    let same_joints = steps == 0;
    if steps == 0 {
        tally.joints.equal += 1;
    } else if steps <= options.joints_tolerance {
        tally.joints.tolerated += 1;
    } else {
        tally.joints.different += 1;
        first.note_difference(FoundDifference {
            what: "joints",
            how: "different",
            word: joints,
            ..FoundDifference::default()
        });
    }
    if a.watched.halted != b.watched.halted {
        tally.halts.count_item(a.watched.halted);
        first.note_difference(FoundDifference {
            what: "halt",
            how: missing_side_text(!a.watched.halted),
            ..FoundDifference::default()
        });
    }
    for ((cell, in_a), in_b) in CellId::all().zip(&a.watched.cells).zip(&b.watched.cells) {
        compare_contact(&mut tally.contacts, cell, (in_a, in_b), &mut first);
        if in_a.answer.is_none() && in_b.answer.is_none() {
            continue;
        }
        let reply = ReplyPair {
            what: "torque",
            cell,
            words: [in_a.answer.map(|(_, words)| words), in_b.answer.map(|(_, words)| words)],
            format: skin.buses.get(bus).map(|bus| bus.torque_format).unwrap_or_default(),
            cells_in: None,
        };
        let inputs = || differing_inputs(moments, same_joints, (in_a, in_b));
        let all = (&mut tally.torques, tally.cells.get_mut(cell));
        reply.compare_reply(
            all,
            moments,
            (BusUnits::for_bus(skin, bus), options.tolerance),
            inputs,
            &mut first,
        );
    }
    compare_sums(tally, (skin, bus), moments, (options.tolerance, same_joints), &mut first);
    first
}

/// Compares the sums of roots.
fn compare_sums(
    tally: &mut ComparisonCounts,
    (skin, bus): (&Skin, usize),
    moments: PerCapture<&AnsweredJoints>,
    (tolerance, same_joints): (u32, bool),
    first: &mut FirstDifferences,
) {
    let PerCapture { a, b } = moments;
    let of = |moment: &AnsweredJoints, root: CellId| {
        let sum = moment.sums.iter().find(|(cell, _)| *cell == root);
        sum.map(|(_, sum)| (sum.words, sum.count))
    };
    let in_b_alone = b.sums.iter().filter(|(root, _)| of(a, *root).is_none());
    for (root, _) in a.sums.iter().chain(in_b_alone) {
        let both = [of(a, *root), of(b, *root)];
        let reply = ReplyPair {
            what: "sum",
            cell: *root,
            words: both.map(|sum| sum.map(|(words, _)| words)),
            format: TorqueFormat::Q7_8,
            cells_in: Some(both.map(|sum| sum.map_or(0, |(_, count)| count))),
        };
        let inputs = || {
            let cells = a.watched.cells.iter().zip(&b.watched.cells);
            let touched =
                |cell: &ObservedCellState| cell.contact_state.is_some_and(|(skin, _)| is_touched(&skin));
            let mut all = (Vec::new(), Vec::new());
            for (in_a, in_b) in cells.filter(|(a, b)| touched(a) || touched(b)) {
                let (differ, unknown) = differing_inputs(moments, same_joints, (in_a, in_b));
                all.0.extend(differ);
                all.1.extend(unknown);
            }
            if !same_joints {
                all.0.push("joints");
            }
            for names in [&mut all.0, &mut all.1] {
                names.sort_unstable();
                names.dedup();
            }
            all
        };
        let all = (&mut tally.sums, tally.cells.get_mut(*root));
        reply.compare_reply(all, moments, (BusUnits::for_bus(skin, bus), tolerance), inputs, first);
    }
}

/// A cell's reply to one joints packet, in both captures.
struct ReplyPair {
    what: &'static str,
    cell: CellId,
    words: [Option<Words>; 2],
    format: TorqueFormat,
    /// For sums, the number of cells in the sum of each capture.
    cells_in: Option<[u8; 2]>,
}

impl ReplyPair {
    fn compare_reply(
        &self,
        (all, of_cell): (&mut ReplyCounts, Option<&mut ReplyCounts>),
        moments: PerCapture<&AnsweredJoints>,
        (units, tolerance): (BusUnits, u32),
        inputs: impl Fn() -> (Vec<&'static str>, Vec<&'static str>),
        first: &mut FirstDifferences,
    ) {
        let mut once = ReplyCounts::default();
        let mut how = None;
        let mut word = None;
        match self.words {
            [Some(a), Some(b)] => {
                word = self.largest_difference(&a, &b, units);
                let steps = word.as_ref().map_or(0, |word| word.steps);
                once.max_steps = steps;
                let other_cells = self.cells_in.is_some_and(|[a, b]| a != b);
                if steps <= tolerance && !other_cells && a.length() == b.length() {
                    *(if steps == 0 { &mut once.equal } else { &mut once.tolerated }) = 1;
                } else {
                    once.different = 1;
                    how = Some("different");
                }
            }
            [a, _] => {
                let is_in_a = a.is_some();
                let other = if is_in_a { moments.b } else { moments.a };
                if other.is_settled {
                    *(if is_in_a { &mut once.missing_in_b } else { &mut once.missing_in_a }) = 1;
                    how = Some(missing_side_text(!is_in_a));
                } else {
                    once.open = 1;
                }
            }
        }
        if let Some(how) = how {
            let (mut differ, unknown) = inputs();
            once.different_with_same_inputs =
                u64::from(once.different > 0 && differ.is_empty() && unknown.is_empty());
            if self.cells_in.is_some_and(|[a, b]| a != b) && once.different > 0 {
                differ.push("cells");
            }
            let (what, cell) = (self.what, Some(self.cell));
            first.note_difference(FoundDifference { what, how, cell, word, inputs: differ, unknown });
        }
        for counts in [Some(all), of_cell].into_iter().flatten() {
            counts.add_counts(&once);
        }
    }

    /// Returns the pair of words of two replies with the largest difference; `None` if the words are equal.
    fn largest_difference(&self, a: &Words, b: &Words, units: BusUnits) -> Option<DifferingWords> {
        // Tolerances are in steps of 1/4096, for sums in steps of 1/256.
        let fine =
            |word| if self.cells_in.is_some() { i32::from(word) } else { self.format.to_finest_steps(word) };
        let places = a.padded().into_iter().zip(b.padded()).enumerate();
        let differing = places.map(|(place, (a, b))| DifferingWords {
            place,
            steps: fine(a).abs_diff(fine(b)),
            words: [a, b],
            values: [a, b].map(|word| self.format.to_real(word)),
            unit: units.torque_unit(place),
        });
        let differing = differing.filter(|word| word.steps > 0);
        differing.reduce(|most, word| if word.steps > most.steps { word } else { most })
    }
}

impl ReplyCounts {
    pub(super) const fn add_counts(&mut self, other: &Self) {
        self.equal += other.equal;
        self.tolerated += other.tolerated;
        self.different += other.different;
        self.different_with_same_inputs += other.different_with_same_inputs;
        self.missing_in_a += other.missing_in_a;
        self.missing_in_b += other.missing_in_b;
        self.open += other.open;
        if other.max_steps > self.max_steps {
            self.max_steps = other.max_steps;
        }
    }
}

/// Returns the joint whose words differ most.
fn largest_joint_difference(
    skin: &Skin,
    bus: usize,
    moments: PerCapture<&AnsweredJoints>,
) -> Option<DifferingWords> {
    let PerCapture { a, b } = moments;
    let pairs = a.watched.joints.positions.iter().zip(&b.watched.joints.positions);
    let kinds = skin.joints_on_bus(bus).map(|(_, joint)| joint.kind);
    let differing = pairs.zip(kinds).enumerate().map(|(place, ((a, b), kind))| {
        let words = [a.to_bits(), b.to_bits()];
        let [one, other] = words;
        let steps = match kind {
            // Angles wrap around.
            JointKind::Revolute => u32::from(one.wrapping_sub(other).unsigned_abs()),
            JointKind::Prismatic => u32::from(one.abs_diff(other)),
        };
        let values = words.map(|word| kind.word_to_position(Q1_14::from_bits(word)));
        DifferingWords { place, steps, words, values, unit: kind.unit() }
    });
    let differing = differing.filter(|word| word.steps > 0);
    differing.reduce(|most, word| if word.steps > most.steps { word } else { most })
}

fn is_touched(skin: &SkinSensors) -> bool {
    *skin != SkinSensors { temperature: skin.temperature, ..SkinSensors::default() }
}

/// Compares the contact of a cell.
fn compare_contact(
    contacts: &mut ContactCounts,
    cell: CellId,
    (in_a, in_b): (&ObservedCellState, &ObservedCellState),
    first: &mut FirstDifferences,
) {
    let both = match (&in_a.contact_state, &in_b.contact_state) {
        (Some((a, _)), Some((b, _))) => Some((is_touched(a), is_touched(b))),
        // Torques decide where stimuli do not.
        _ => in_a.answer.zip(in_b.answer).map(|((_, a), (_, b))| (!a.is_zero(), !b.is_zero())),
    };
    match both {
        Some((true, true)) => contacts.both += 1,
        Some((is_in_a, is_in_b)) if is_in_a != is_in_b => {
            contacts.only.count_item(is_in_a);
            first.note_difference(FoundDifference {
                what: "contact",
                how: missing_side_text(is_in_b),
                cell: Some(cell),
                ..FoundDifference::default()
            });
        }
        Some(_) | None => {}
    }
}

/// Returns the names of a cell's inputs that differ between the captures, and of those that are unknown in one of them.
fn differing_inputs(
    PerCapture { a, b }: PerCapture<&AnsweredJoints>,
    same_joints: bool,
    (in_a, in_b): (&ObservedCellState, &ObservedCellState),
) -> (Vec<&'static str>, Vec<&'static str>) {
    let (mut differ, mut unknown) = (Vec::new(), Vec::new());
    if !same_joints {
        differ.push("joints");
    }
    if a.watched.halted != b.watched.halted {
        differ.push("halt");
    }
    match (&in_a.contact_state, &in_b.contact_state) {
        (Some((a, _)), Some((b, _))) if a != b => differ.push("stimulus"),
        (Some(_), Some(_)) => {}
        _ => unknown.push("stimulus"),
    }
    match (in_a.hash, in_b.hash) {
        (Some(a), Some(b)) if a != b => differ.push("configuration"),
        (Some(_), Some(_)) => {}
        _ => unknown.push("configuration"),
    }
    (differ, unknown)
}
