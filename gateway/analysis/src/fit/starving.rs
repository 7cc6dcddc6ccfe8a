//! The frames without a bound on an overloaded bus. The bus always sends the lowest identifier first, so the frames from
//! some identifier on get only the time that the lower identifiers leave.

use std::iter::{once, repeat_n};

use serde::Serialize;

use super::case::{AnswerPlan, BusCase};

/// A kind of periodic frames, named as in the tables of `skinbus fit`.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum FrameKind {
    /// Joints, from the gateway.
    Joints,
    /// Torques of single cells.
    Torques,
    /// Sums of torques.
    Sums,
    /// Sensors, of all pages.
    Sensors,
    /// Heartbeats.
    Heartbeats,
}

impl FrameKind {
    /// Returns the name of the kind.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Joints => "joints",
            Self::Torques => "torques",
            Self::Sums => "sums",
            Self::Sensors => "sensors",
            Self::Heartbeats => "heartbeats",
        }
    }
}

/// Frames of one kind that starve: higher or equal priorities fill the bus.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
pub struct StarvingFrames {
    /// The kind of the frames.
    pub frames: FrameKind,
    /// Number of cells whose frames starve; `None` for joints.
    pub cells: Option<u32>,
    /// The lowest node id of these cells. The frames of all higher ones starve, too.
    pub from_node: Option<u8>,
}

/// Returns the position of the first identifier without a bound, of identifiers in order of priority with their shares
/// of the bus's time: the first at which the sum of the shares reaches 1.
#[must_use]
pub fn first_starving(loads: impl IntoIterator<Item = f64>) -> Option<usize> {
    let sums = loads.into_iter().scan(0.0, |sum, load| {
        *sum += load;
        Some(*sum)
    });
    sums.into_iter().position(|sum| sum >= 1.0)
}

/// Returns the frames that starve in the worst case of a bus, highest priority first. `nodes` are the node ids of its
/// cells in increasing order.
#[must_use]
pub fn starving_frames(case: &BusCase, nodes: &[u8]) -> Vec<StarvingFrames> {
    let load = case.load();
    let answers = match case.answers {
        AnswerPlan::Torques { .. } => FrameKind::Torques,
        AnswerPlan::Sums { .. } => FrameKind::Sums,
    };
    // The pages of a cell's sensors have one identifier.
    let by_cell = [
        (answers, load.answers),
        (FrameKind::Sensors, load.sensors),
        (FrameKind::Heartbeats, load.heartbeats),
    ];
    let by_cell = by_cell.into_iter().filter(|(_, load)| *load > 0.0);
    let loads_of_cells = by_cell.clone().flat_map(|(_, load)| {
        #[expect(clippy::cast_precision_loss, reason = "at most 254 cells")]
        repeat_n(load / nodes.len() as f64, nodes.len())
    });
    let Some(first) = first_starving(once(load.joints).chain(loads_of_cells)) else { return Vec::new() };
    let joints = StarvingFrames { frames: FrameKind::Joints, cells: None, from_node: None };
    let joints = (first == 0).then_some(joints);
    let of_kind = |(index, (frames, _)): (usize, (FrameKind, f64))| {
        // Number of this kind's cells before the first identifier that starves.
        let bounded = first.saturating_sub(1 + index * nodes.len());
        let starving = nodes.get(bounded..)?;
        let cells = u32::try_from(starving.len()).ok();
        starving.first().map(|&node| StarvingFrames { frames, cells, from_node: Some(node) })
    };
    joints.into_iter().chain(by_cell.enumerate().filter_map(of_kind)).collect()
}
