//! Derives the topics of a recording, and what each of them holds, from the skin.

use protocol::parameters::MAX_JOINTS;
use protocol::skin::{MAX_ROBOT_JOINTS, Skin};

use model::central::CentralComputation;
use robots::{UniqueNames, chain_prefixes, sanitized};

use super::robot::RecordedRobot;
use super::{BUS_TOPIC_PREFIX, STATE_TOPIC_PREFIX};

/// The name of the frame in which positions are given if no robot description names one.
const DEFAULT_BASE_FRAME: &str = "base";
/// The maximum rate of point clouds of a patch, in Hz.
const MAX_CLOUD_HZ: f64 = 30.0;

/// The cells of one bus on one link. The state of a patch has one topic.
#[derive(Clone, Debug)]
pub struct Patch {
    /// The topic of the patch.
    pub topic: String,
    /// The link that the cells are on, which is a frame of the robot.
    pub link: String,
    /// The index of the bus in the skin.
    pub bus: usize,
    /// The index of the chain, and the number of the joint (from 1) that moves the patch.
    pub joint: (usize, usize),
    /// The cells of the patch: index among the cells of the bus, and node id.
    pub cells: Vec<(usize, u16)>,
}

/// The topics of a skin's recording and the data needed to fill them.
#[derive(Debug)]
pub struct Layout {
    /// The names of the buses.
    pub buses: Vec<String>,
    /// The name of the robot, in the form that topics contain.
    pub arm: String,
    /// The names of the joints.
    pub joints: Vec<String>,
    /// The patches of all buses.
    pub patches: Vec<Patch>,
    /// By bus: for each joint of the bus's chain, its index among the joints of the robot.
    chains: Vec<Vec<usize>>,
    /// By bus: the computation of forces from sensor values, and the positions of the bus's cells.
    pub central: Vec<CentralComputation>,
    /// The number of epochs between two point clouds of a patch.
    pub epochs_per_cloud: u64,
    /// The duration of a tick, in ns.
    pub tick_ns: u64,
    /// The number of ticks between two messages with the poses of links.
    pub ticks_per_poses: u64,
    /// The robot's links and their poses, if they are known.
    pub robot: Option<RecordedRobot>,
}

impl Layout {
    /// Derives the layout from a skin.
    #[must_use]
    pub fn new(skin: &Skin) -> Self {
        let buses: Vec<_> = skin.buses.iter().map(|bus| bus.name.clone()).collect();
        let (chain_words, mut topics) = (chain_prefixes(skin), UniqueNames::default());
        let bus_words =
            UniqueNames::default().assign_unique_names(buses.iter().map(|bus| sanitized(bus)).collect());
        let mut patches = Vec::new();
        for (index, chain) in skin.robot.chains.iter().enumerate() {
            let on_chain = |bus: &usize| skin.buses.get(*bus).is_some_and(|bus| bus.chain == index);
            for joint in 1..=chain.joints.len() {
                let on_bus = |bus: usize| {
                    let on_joint = move |cell: &protocol::skin::Cell| usize::from(cell.joint) == joint;
                    let cells = skin.cells_on_bus(bus).enumerate().filter(move |(_, cell)| on_joint(cell));
                    cells.map(|(place, cell)| (place, u16::from(cell.node.get()))).collect::<Vec<_>>()
                };
                let parts = (0..buses.len()).filter(on_chain).map(|bus| (bus, on_bus(bus)));
                let parts: Vec<_> = parts.filter(|(_, cells)| !cells.is_empty()).collect();
                let several = parts.len() > 1;
                let of_chain = chain_words.get(index).filter(|word| !word.is_empty());
                let link = of_chain.map_or_else(String::new, |word| format!("{word}_"));
                let link = format!("{link}link{joint}");
                patches.extend(parts.into_iter().map(|(bus, cells)| {
                    let name = bus_words.get(bus).filter(|_| several).map(|word| format!("_{word}"));
                    let topic = topics.assign(format!("/skin/{link}{}", name.unwrap_or_default()));
                    Patch { topic, link: link.clone(), bus, joint: (index, joint), cells }
                }));
            }
        }
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "1 Hz to 10 kHz: checked"
        )]
        let epochs_per_cloud = (skin.timing.broadcast_hz() / MAX_CLOUD_HZ).ceil().max(1.0) as u64;
        Self {
            central: (0..buses.len())
                .map(|bus| CentralComputation::new(&skin.with_cells_of_bus(bus)))
                .collect(),
            buses,
            arm: if skin.robot.name.is_empty() { "robot".to_owned() } else { sanitized(&skin.robot.name) },
            joints: skin.robot.joints.iter().map(|joint| joint.name.clone()).collect(),
            chains: (0..skin.buses.len()).map(|bus| skin.chain(bus).joints.clone()).collect(),
            patches,
            epochs_per_cloud,
            tick_ns: skin.timing.tick_nanos(),
            ticks_per_poses: skin.timing.ticks_per_broadcast.into(),
            robot: None,
        }
    }

    /// Adds the robot's links. The patches are then named after them.
    #[must_use]
    pub fn with_robot(mut self, robot: RecordedRobot) -> Self {
        for patch in &mut self.patches {
            if let Some(link) = robot.link_moved_by(patch.joint) {
                link.clone_into(&mut patch.link);
            }
        }
        Self { robot: Some(robot), ..self }
    }

    /// Returns two topics for each bus: one for its frames, and one for frames that were latched before the file began.
    /// The topics differ from those of the patches and from `others`. Readers do not need the topic, because each
    /// message names its bus.
    #[must_use]
    pub fn bus_topics(&self, others: impl Iterator<Item = String>) -> [Vec<String>; 2] {
        let mut taken = UniqueNames::default();
        let points = |Patch { topic, .. }: &Patch| [topic.clone(), format!("{topic}/points")];
        taken.assign_unique_names(others.chain(self.patches.iter().flat_map(points)).collect());
        [BUS_TOPIC_PREFIX, STATE_TOPIC_PREFIX].map(|before| {
            taken.assign_unique_names(self.buses.iter().map(|bus| format!("{before}{bus}")).collect())
        })
    }

    /// Returns true if the poses of links are recorded at this tick.
    #[must_use]
    pub const fn records_poses_at(&self, tick: u64) -> bool {
        self.robot.is_some() && tick.is_multiple_of(self.ticks_per_poses)
    }

    /// Returns the name of the frame in which the positions of cells are given: the robot's base.
    #[must_use]
    pub fn base_frame_name(&self) -> &str {
        self.robot.as_ref().map_or(DEFAULT_BASE_FRAME, RecordedRobot::root_link_name)
    }

    /// Returns the positions of the joints in a bus's chain, taken from those of all joints of the robot.
    #[must_use]
    pub fn chain_positions(&self, bus: usize, q: &[f64; MAX_ROBOT_JOINTS]) -> [f64; MAX_JOINTS] {
        let mut positions = [0.0; MAX_JOINTS];
        for (position, joint) in positions.iter_mut().zip(self.chains.get(bus).into_iter().flatten()) {
            *position = q.get(*joint).copied().unwrap_or_default();
        }
        positions
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::recording::NOTES_TOPIC;
    use model::testing;

    #[test]
    fn a_patch_is_the_cells_of_a_bus_on_a_link() {
        let mut skin = testing::one_cell_skin();
        skin.robot.name = "UR 5/e".to_owned();
        let layout = Layout::new(&skin);
        assert_eq!((layout.arm.as_str(), layout.joints.len()), ("UR_5_e", skin.robot.joints.len()));
        let cells: usize = layout.patches.iter().map(|patch| patch.cells.len()).sum();
        assert_eq!(cells, skin.cells.len(), "each in one patch");
        assert_eq!(layout.epochs_per_cloud, 3, "62.5 Hz are 20.8 clouds a second");
        // A second bus has the same cells. The patches on one link must then be named after their buses.
        let mut other = skin.buses[0].clone();
        other.name = "vcan-1".to_owned();
        skin.buses.push(other);
        let cells: Vec<_> =
            skin.cells.iter().map(|cell| protocol::skin::Cell { bus: 1, ..cell.clone() }).collect();
        skin.cells.extend(cells);
        let topics: Vec<_> = Layout::new(&skin).patches.into_iter().map(|patch| patch.topic).collect();
        let first = layout.patches[0].link.clone();
        assert_eq!(topics[0], format!("/skin/{first}_{}", sanitized(&skin.buses[0].name)));
        assert_eq!(topics[1], format!("/skin/{first}_vcan_1"));
        // Names of buses that become the same word in a topic must stay distinct, and differ from all other topics.
        skin.buses[0].name = "notes".to_owned();
        skin.buses[1].name = "vcan_1".to_owned();
        skin.buses.push(protocol::skin::SkinBus { name: "vcan-1".to_owned(), ..skin.buses[0].clone() });
        let cells: Vec<_> = skin.cells.iter().filter(|cell| cell.bus == 0).cloned().collect();
        skin.cells.extend(cells.into_iter().map(|cell| protocol::skin::Cell { bus: 2, ..cell }));
        let layout = Layout::new(&skin);
        let topics: BTreeSet<_> = layout.patches.iter().map(|patch| patch.topic.as_str()).collect();
        assert_eq!(topics.len(), layout.patches.len());
        assert!(topics.contains(format!("/skin/{first}_vcan_1_2").as_str()), "{topics:?}");
        let others = [NOTES_TOPIC, "/can/torques", "/state/vcan_1"].map(str::to_owned);
        let [can, state] = layout.bus_topics(others.into_iter());
        assert_eq!(can, ["/can/notes_2", "/can/vcan_1", "/can/vcan-1"]);
        assert_eq!(state, ["/state/notes", "/state/vcan_1_2", "/state/vcan-1"]);
    }
}
