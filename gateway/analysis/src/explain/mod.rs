//! Derives a torque step by step: `skinbus explain`.
//!
//! ```text
//!   frames up to the joints ──> JointsWatcher ──> contact state and answer of each cell ─┐
//!                                                                                        ├──> TorqueExplanation
//!   Skin ──> CentralComputation, f64 ──> force, Jacobian, product, step ─────────────────┘
//! ```
//!
//! A cell's word is `J F_z`, each rounded to 16 bits. The force is an exact function of its contact state, so a word
//! that is not the step nearest to the exact product comes from the cell's own J: [`TorqueRow::verdict`] looks for a J
//! near the exact one that gives this word. Information that the capture lacks is listed in
//! [`TorqueExplanation::missing`].

mod not_found;
mod observed;
mod read;
mod row;
pub mod series;
mod watch;

pub use not_found::{JointsNotFound, other_robot_text};
pub use observed::{ContactOrigin, ObservedCellState, ObservedJoints, RequestedJoints};
pub use read::{FoundJoints, read_to_joints};
pub use row::{MAX_JACOBIAN_ERROR_STEPS, TorqueRow, WordVerdict};
pub use watch::JointsWatcher;

use protocol::fixed::{Q, is_saturated};
use protocol::id::CellId;
use protocol::message::{SkinSensors, State};
use protocol::parameters::MAX_JOINTS;
use protocol::skin::{Cell, MAX_ROBOT_JOINTS, Skin, SkinReply};
use serde::Serialize;

use self::row::{joint_number, max_jacobian_error_steps, torque_row};
use model::central::CentralComputation;

/// The derivation of all torques of one epoch.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TorqueExplanation {
    /// The joints on each bus that has them.
    pub buses: Vec<BusExplanation>,
    /// Cells that were in contact or answered, by bus and node id.
    pub cells: Vec<CellExplanation>,
    /// The total torque of the skin at each joint.
    pub total: Vec<JointTorqueTotal>,
    /// Missing information, one line each.
    pub missing: Vec<String>,
}

impl TorqueExplanation {
    /// Returns the number of cells with an unknown word or force. If above zero, the sums cannot be compared.
    #[must_use]
    pub fn open_cells(&self) -> usize {
        let is_open = |cell: &&CellExplanation| cell.force.is_none() || cell.answered_after_ns.is_none();
        self.cells.iter().filter(is_open).count()
    }

    /// Returns the number of cells with a saturated word, which make the sums inexact.
    #[must_use]
    pub fn saturated_cells(&self) -> usize {
        let has_saturated =
            |cell: &&CellExplanation| cell.rows.iter().any(|row| row.word.is_some_and(is_saturated));
        self.cells.iter().filter(has_saturated).count()
    }
}

/// The explanation of one joint broadcast on a bus, with the torques of all its cells.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BusExplanation {
    /// Name of the bus.
    pub bus: String,
    /// Time of the joints in ns since 1970.
    pub at_ns: u64,
    /// The numbers of the chain's joints in the robot, from 1.
    pub joints: Vec<u8>,
    /// The joint words, in the order of `joints`.
    pub position_words: Vec<i16>,
    /// The positions of these joints, in rad, or m for prismatic joints.
    pub position_rad: Vec<f64>,
    /// The units of the positions.
    pub units: Vec<&'static str>,
    /// Torque format of the bus, such as `Q3.12`.
    pub torque_format: &'static str,
    /// True if the bus was halted.
    pub halted: bool,
}

/// The derivation of one cell's torque.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CellExplanation {
    /// Name of the cell's bus.
    pub bus: String,
    /// Node id of the cell.
    pub node: u8,
    /// The robot's joint that moves the cell, from 1.
    pub joint: u8,
    /// The contact state of the cell, and the force computed from it; absent if unknown.
    pub force: Option<ForceSteps>,
    /// Time in ns from the joints to the torque of the cell; absent if none arrived.
    pub answered_after_ns: Option<u64>,
    /// The derivation of the torque on each joint.
    pub rows: Vec<TorqueRow>,
}

/// The steps of Algorithm 1 from a cell's sensor words to the force F_z.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ForceSteps {
    /// The packet from which the cell's contact state is known.
    pub origin: ContactOrigin,
    /// The three contact words in N.
    pub contact_n: [f64; 3],
    /// The proximity.
    pub proximity: f64,
    /// The sum of the contact words in N, F_c.
    pub touch_n: f64,
    /// Threshold in N: below it, F_c counts as zero.
    pub contact_threshold_n: f64,
    /// Threshold of the proximity: below it, the proximity counts as zero.
    pub proximity_threshold: f64,
    /// Weight alpha_c of F_c.
    pub alpha_c: f64,
    /// Weight alpha_p of the proximity, in N.
    pub alpha_p_n: f64,
    /// The fused force in N: alpha_c F_c + alpha_p F_p, where each term counts only above its threshold.
    pub fused_n: f64,
    /// Threshold in N: below it, the fused force counts as zero.
    pub force_threshold_n: f64,
    /// F_z in steps of 2^-16 N, as used by the cell.
    pub force_steps: i64,
    /// F_z in N.
    pub force_n: f64,
}

/// The torque of the whole skin on one joint, as sent and as computed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct JointTorqueTotal {
    /// Number of the joint in the robot, from 1.
    pub joint: u8,
    /// Unit of the torques on the joint: Nm, or N for a prismatic joint.
    pub unit: &'static str,
    /// The sum of all received words in steps of 2^-12 Nm.
    pub word_steps: i64,
    /// The sum of all received words in Nm.
    pub words_nm: f64,
    /// The sum of the exact products J F_z of the cells that answered, in Nm.
    pub products_nm: f64,
    /// The central computation over all cells with a known contact state, in Nm.
    pub central_nm: f64,
    /// The central computation as in `central_nm`, but with the unrounded values of the skin's file.
    pub unrounded_nm: f64,
    /// Words minus central computation, in Nm.
    pub difference_nm: f64,
    /// Number of cells with a saturated word, which make the sum inexact.
    pub saturated: u32,
    /// Number of cells with an unknown word or force. If above zero, the sums cannot be compared.
    pub open: u32,
}

/// Derives the torques for these joints; `moments` has the joints and answers of each bus of the skin, `None` if
/// missing.
#[must_use]
pub fn explain(skin: &Skin, moments: &[Option<ObservedJoints>]) -> TorqueExplanation {
    Explainer::new(skin).explain(moments)
}

/// The data of a skin that are computed once to explain any number of epochs.
#[derive(Debug)]
pub struct Explainer<'a> {
    skin: &'a Skin,
    buses: Vec<BusOfSkin>,
}

/// The data of one bus of a skin.
#[derive(Debug)]
struct BusOfSkin {
    /// The skin reduced to the bus.
    part: Skin,
    /// Two central computations: with the cells' words, and with the file's numbers.
    central: [CentralComputation; 2],
    /// The cells by node id.
    cells: Vec<CellOfBus>,
}

/// The data of one cell of a bus.
#[derive(Clone, Copy, Debug)]
struct CellOfBus {
    /// Index of the cell in the part of the skin.
    place: usize,
    /// Hash of the configuration that the skin gives to the cell.
    hash: u16,
    /// Maximum error of J in the cell, in steps.
    max_error_steps: i64,
}

impl BusOfSkin {
    fn new(skin: &Skin, bus: usize) -> Self {
        let part = skin.with_cells_of_bus(bus);
        let central = [CentralComputation::new(&part), CentralComputation::without_quantisation(&part)];
        let mut cells: Vec<_> = part.cells.iter().enumerate().collect();
        cells.sort_unstable_by_key(|(_, cell)| cell.node);
        let cells = cells.into_iter().map(|(place, cell)| {
            let parameters = part.parameters(cell);
            let max_error_steps = max_jacobian_error_steps(parameters.rows_to_cell().len());
            CellOfBus { place, hash: parameters.hash(), max_error_steps }
        });
        let cells = cells.collect();
        Self { part, central, cells }
    }
}

impl<'a> Explainer<'a> {
    /// Prepares the central computation of a skin, from which torques are explained.
    #[must_use]
    pub fn new(skin: &'a Skin) -> Self {
        Self { skin, buses: (0..skin.buses.len()).map(|bus| BusOfSkin::new(skin, bus)).collect() }
    }

    /// Derives the torques for these joints; `moments` has the joints and answers of each bus of the skin, `None` if
    /// missing.
    #[must_use]
    pub fn explain(&self, moments: &[Option<ObservedJoints>]) -> TorqueExplanation {
        explain_torques_of_parts(self.skin, &self.buses, moments)
    }
}

fn explain_torques_of_parts(
    skin: &Skin,
    parts: &[BusOfSkin],
    moments: &[Option<ObservedJoints>],
) -> TorqueExplanation {
    let mut explanation =
        TorqueExplanation { buses: Vec::new(), cells: Vec::new(), total: Vec::new(), missing: Vec::new() };
    let mut sums = [JointTorqueSum::default(); MAX_ROBOT_JOINTS];
    for (index, ((bus, of_bus), moment)) in skin.buses.iter().zip(parts).zip(moments).enumerate() {
        let BusOfSkin { part, central: both, cells } = of_bus;
        let name = &bus.name;
        let Some(moment) = moment else {
            if skin.cells_on_bus(index).next().is_some() {
                explanation.missing.push(format!(
                    "{name}: the capture contains no joints message of this epoch; the total does not include this bus"
                ));
            }
            continue;
        };
        if bus.reply != SkinReply::Torque {
            explanation.missing.push(format!(
                "{name}: its cells answer with sums, which do not show the torques of single cells"
            ));
        }
        let positions = moment.joints.positions;
        let [central, _] = both;
        let frames = both.each_ref().map(|central| central.link_frames(&positions));
        let chain: Vec<_> = skin.joints_on_bus(index).collect();
        explanation.buses.push(BusExplanation {
            bus: name.clone(),
            at_ns: moment.at_ns,
            joints: chain.iter().map(|(joint, _)| joint_number(*joint)).collect(),
            position_words: positions.iter().take(chain.len()).map(|word| word.to_bits()).collect(),
            position_rad: central.joint_positions(&positions).into_iter().take(chain.len()).collect(),
            units: chain.iter().map(|(_, joint)| joint.kind.unit()).collect(),
            torque_format: bus.torque_format.name(),
            halted: moment.halted,
        });
        let mut silent = 0;
        for &CellOfBus { place, hash, max_error_steps } in cells {
            let Some(cell) = part.cells.get(place) else { continue };
            let Some(said) = moment.cells.get(cell.node.index()) else { continue };
            let known = usable_contact(name, cell.node, hash, said, &mut explanation.missing);
            let force = known.map(|(sensors, origin)| force_steps_of(cell, &sensors, origin));
            let active = force.is_some_and(|force| force.force_steps > 0);
            if said.answer.is_none() && force.is_none() {
                silent += u32::from(said.contact_state.is_none());
            }
            if said.answer.is_none() && !active {
                continue;
            }
            if active && said.answer.is_none() {
                let why = match said.too_late {
                    Some(at) => too_late_text(at.saturating_sub(moment.at_ns)),
                    None => silence_reason(moment.halted, said.state).to_owned(),
                };
                let node = cell.node;
                explanation.missing.push(format!(
                    "{name} {node}: no torque of this epoch arrived in time: {why}; the sum of received words does not include it"
                ));
            }
            let newtons = force.map_or(0.0, |force| force.effective_fused_n());
            let ([in_words, in_numbers], [rounded, real]) = (both, &frames);
            let exact = in_words.cell_torque(place, rounded, newtons);
            let unit = in_words.cell_torque(place, rounded, 1.0);
            let unrounded = in_numbers.cell_torque(place, real, newtons);
            let words = said.answer.map(|(_, words)| words);
            let format = bus.torque_format;
            let rows = chain.iter().enumerate().map(|(at, joint)| {
                let moves = at < usize::from(cell.joint);
                let steps = moves.then_some(max_error_steps);
                torque_row(joint, at, steps, force.as_ref(), &exact, &unit, format, words.as_ref())
            });
            let rows: Vec<_> = rows.collect();
            for (at, (joint, _)) in chain.iter().enumerate() {
                let Some(sum) = sums.get_mut(*joint) else { continue };
                sum.open += u32::from(force.is_none() || words.is_none());
                let of = |values: &[f64; MAX_JOINTS]| values.get(at).copied().unwrap_or_default();
                sum.central += of(&exact);
                sum.unrounded += of(&unrounded);
                if let Some(word) = words.and_then(|words| words.as_slice().get(at).copied()) {
                    sum.words += i64::from(format.to_finest_steps(word));
                    sum.products += of(&exact);
                    sum.saturated += u32::from(is_saturated(word));
                }
            }
            explanation.cells.push(CellExplanation {
                bus: name.clone(),
                node: cell.node.get(),
                joint: chain.get(usize::from(cell.joint) - 1).map_or(0, |(joint, _)| joint_number(*joint)),
                force,
                answered_after_ns: said.answer.map(|(at, _)| at.saturating_sub(moment.at_ns)),
                rows,
            });
        }
        if silent > 0 {
            explanation.missing.push(format!(
                "{name}: {silent} cells sent nothing, and their contact state is not in the capture; they are assumed \
                 not to be in contact"
            ));
        }
    }
    explanation.total = (1..)
        .zip(sums.into_iter().zip(&skin.robot.joints))
        .map(|(joint, (sum, described))| sum.total(joint, described.kind.torque_unit()))
        .collect();
    explanation
}

#[derive(Clone, Copy, Default)]
struct JointTorqueSum {
    words: i64,
    products: f64,
    central: f64,
    unrounded: f64,
    saturated: u32,
    open: u32,
}

impl JointTorqueSum {
    #[expect(clippy::cast_precision_loss, reason = "254 words a bus: exact")]
    fn total(self, joint: u8, unit: &'static str) -> JointTorqueTotal {
        let words_nm = self.words as f64 / 4_096.0;
        JointTorqueTotal {
            joint,
            unit,
            word_steps: self.words,
            words_nm,
            products_nm: self.products,
            central_nm: self.central,
            unrounded_nm: self.unrounded,
            difference_nm: words_nm - self.central,
            saturated: self.saturated,
            open: self.open,
        }
    }
}

#[expect(clippy::cast_precision_loss, reason = "for display")]
fn too_late_text(nanos: u64) -> String {
    let ms = nanos as f64 / 1e6;
    format!("it arrived {ms:.3} ms after its joints message and after four newer ones, so it is not used")
}

/// Returns the likely reason why a cell in contact sent nothing.
fn silence_reason(halted: bool, state: Option<State>) -> &'static str {
    let has = |bit| state.is_some_and(|state| state.has(bit));
    if halted || has(State::HALTED) {
        "the cell was halted"
    } else if has(State::CLAIMING_NODE_ID) {
        "the cell had just started and was claiming its node id"
    } else if state.is_some_and(|state| !state.has(State::CONFIGURED)) {
        "the cell had no configuration"
    } else {
        "the frame was lost, or the cell was not on the bus"
    }
}

/// Returns the contact state of a cell, if its torque can be computed from that state. Otherwise adds the reason to
/// `missing`, if the cell answered or may be in contact. `target` is the hash of the configuration that the skin gives
/// to the cell.
fn usable_contact(
    bus: &str,
    node: CellId,
    target: u16,
    said: &ObservedCellState,
    missing: &mut Vec<String>,
) -> Option<(SkinSensors, ContactOrigin)> {
    let answered = said.answer.is_some();
    let touched = said.contact_state.is_some_and(|(sensors, _)| sensors != SkinSensors::default());
    match said.hash {
        Some(hash) if hash != target => {
            if answered || touched {
                missing.push(format!(
                    "{bus} {node}: its configuration hash is {hash:04X}, but the skin's is {target:04X}, so its \
                     force and torque cannot be computed from this skin"
                ));
            }
            return None;
        }
        None if answered || touched => missing.push(format!(
            "{bus} {node}: it did not report its configuration hash, which is assumed to be that of the skin, \
             {target:04X}"
        )),
        Some(_) | None => {}
    }
    if answered && said.contact_state.is_none() {
        let why = match said.test_mode {
            Some(false) => "it uses its own sensors, and sent no sensors page in this epoch",
            Some(true) | None => "the capture has no earlier start, stimulus or sensors page of this cell",
        };
        missing.push(format!("{bus} {node}: its contact state is not in the capture: {why}"));
    }
    if said.repeated > 0 {
        missing.push(format!("{bus} {node}: {} further torques of this epoch are not used", said.repeated));
    }
    said.contact_state
}

impl ForceSteps {
    /// Returns the fused force in N, exact and before the cell rounds it; 0 below the threshold.
    const fn effective_fused_n(&self) -> f64 {
        if self.force_steps > 0 { self.fused_n } else { 0.0 }
    }
}

/// Computes Algorithm 1 in `f64`, in which every word, sum and product is exact.
#[expect(clippy::cast_possible_truncation, reason = "at most 2^36 steps of 2^-24: exact")]
fn force_steps_of(cell: &Cell, sensors: &SkinSensors, origin: ContactOrigin) -> ForceSteps {
    let rule = &cell.contact;
    let contact_n = sensors.contact.map(Q::to_f64);
    let touch_n = contact_n.iter().sum();
    let proximity = sensors.proximity.to_f64();
    let above = |value: f64, threshold: f64| if value < threshold { 0.0 } else { value };
    let (alpha_c, alpha_p_n) = (rule.alpha_c.to_f64(), rule.alpha_p.to_f64());
    let (contact_threshold_n, proximity_threshold) =
        (rule.contact_threshold.to_f64(), rule.proximity_threshold.to_f64());
    let force_threshold_n = rule.force_threshold.to_f64();
    let fused_n =
        alpha_c * above(touch_n, contact_threshold_n) + alpha_p_n * above(proximity, proximity_threshold);
    let counts = above(fused_n, force_threshold_n).max(0.0);
    let force_steps = ((counts * 16_777_216.0) as i64 + 128) >> 8;
    ForceSteps {
        origin,
        contact_n,
        proximity,
        touch_n,
        contact_threshold_n,
        proximity_threshold,
        alpha_c,
        alpha_p_n,
        fused_n,
        force_threshold_n,
        force_steps,
        force_n: to_newtons(force_steps),
    }
}

#[expect(clippy::cast_precision_loss, reason = "at most 2^28 steps")]
fn to_newtons(steps: i64) -> f64 {
    steps as f64 / 65_536.0
}

#[cfg(test)]
mod tests;
