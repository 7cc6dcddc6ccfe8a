//! What changes more slowly, as JSON for the page.

use bench::remote::State;
use model::table::{Event, Status};
use protocol::fixed::is_saturated;
use protocol::id::CellId;
use protocol::parameters::Contact;
use protocol::time::Micros;
use serde::Serialize;

use super::bus::LiveBus;
use super::{FrameSaid, Live, Why};
use crate::command::Chosen;
use crate::player::Playback;

/// Dead cells that are named.
const NAMED: usize = 20;

/// What the page shows in words.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Said {
    /// What this message is: `said`.
    pub is: &'static str,
    /// Cells in contact.
    pub contacts: usize,
    /// Cells that fell silent.
    pub dead: usize,
    /// The first of them.
    pub dead_cells: Vec<Dead>,
    /// Whether a halt stands.
    pub halted: bool,
    /// Each bus.
    pub buses: Vec<BusSaid>,
    /// The cell that the page has chosen.
    pub detail: Option<Detail>,
    /// Where in a recording this is.
    pub playback: Option<Playback>,
    /// What the run that the page belongs to says of itself; of its processes only that of the chosen cell.
    pub bench: Option<State>,
}

/// A cell that fell silent.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Dead {
    /// Its bus.
    pub bus: String,
    /// Its node id.
    pub node: u8,
    /// For so many seconds.
    pub for_s: f64,
}

/// One bus.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BusSaid {
    /// Its name.
    pub name: String,
    /// Whether it works.
    pub up: bool,
    /// The share of its time that a real bus would be busy, 0 to 1 and above.
    pub load: Option<f64>,
    /// Epochs that somebody had to answer.
    pub epochs_due: u64,
    /// Of these, those that all answered in time.
    pub epochs_complete: u64,
    /// Replies.
    pub due: u64,
    /// In time.
    pub in_time: u64,
    /// Late.
    pub late: u64,
    /// Missing.
    pub missing: u64,
    /// Packets of cells that never came, by the cells' own counts.
    pub lost: u64,
    /// Packets that came damaged or without a meaning.
    pub rejected: u64,
    /// Torques with a saturated word.
    pub saturated: u64,
    /// Frames that this program did not receive.
    pub dropped: u64,
    /// Mean absolute error of single torques against the central computation, in Nm.
    pub error_nm: Option<f64>,
    /// Of a bus with sums, the place in the tree of each cell, in the skin's order; none of a cell that is silent or has not reported it.
    pub tree: Option<Vec<Option<Wires>>>,
}

/// A cell's place in the tree, as it reports.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
pub struct Wires(
    /// Where its sums go: the node id of a cell, 0 for the gateway's side; none where it is unreachable.
    pub Option<u8>,
    /// Bit p: port p works in both directions.
    pub u8,
);

/// A cell in detail.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Detail {
    /// Its bus, as an index into the skin's.
    pub bus: usize,
    /// Its node id.
    pub node: u8,
    /// Its serial number.
    pub serial: u32,
    /// Its status in a word.
    pub status: &'static str,
    /// The hash of its configuration, and the one it must have.
    pub configuration: [Option<String>; 2],
    /// Its gains and thresholds, as the skin has them.
    pub gains: Gains,
    /// Its three contact forces in N.
    pub contact_n: [f64; 3],
    /// Its proximity, 0 to 1.
    pub proximity: f64,
    /// Its temperatures in °C.
    pub temperature_c: [f64; 2],
    /// The force by Algorithm 1, in N.
    pub force_n: f64,
    /// Its last torque.
    pub torque: Option<Answer>,
    /// Replies due and in time.
    pub replies: [u64; 2],
    /// Packets lost by its own count, and restarts.
    pub lost: u64,
    /// Restarts.
    pub restarts: u32,
    /// The newest frames from it and to it, the newest first.
    pub frames: Vec<FrameSaid>,
    /// Why the torque in the chosen frame is what it is, while that is kept.
    pub why: Option<Why>,
}

/// The gains and thresholds of Algorithm 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Gains {
    /// alpha_c, and alpha_p in N.
    pub alpha: [f64; 2],
    /// F_c,th in N, F_p,th from 0 to 1, F_z,th in N.
    pub thresholds: [f64; 3],
}

impl Gains {
    fn of(contact: Contact) -> Self {
        let Contact { alpha_c, alpha_p, contact_threshold, proximity_threshold, force_threshold } = contact;
        Self {
            alpha: [alpha_c.to_f64(), alpha_p.to_f64()],
            thresholds: [contact_threshold.to_f64(), proximity_threshold.to_f64(), force_threshold.to_f64()],
        }
    }
}

/// A torque of a cell.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Answer {
    /// Its epoch.
    pub epoch: u8,
    /// Its words.
    pub words: Vec<i16>,
    /// The same in Nm or N.
    pub distributed: Vec<f64>,
    /// The central computation at the positions of that epoch, while they are known.
    pub central: Option<Vec<f64>>,
    /// J at these positions, in m, of prismatic joints a number, while they are known.
    pub jacobian: Option<Vec<f64>>,
    /// Whether a word is saturated.
    pub saturated: bool,
}

impl Live {
    /// What is to be said now to all pages: the details of a cell are none.
    #[must_use]
    pub fn said(&self, now: Micros) -> Said {
        let (mut contacts, mut dead, mut dead_cells) = (0, 0, Vec::new());
        for bus in &self.buses {
            for ((cell, status), since) in bus.table.statuses(now).zip(&bus.dead_since) {
                contacts += usize::from(matches!(status, Status::Active | Status::Stale));
                dead += usize::from(status == Status::Dead);
                if let Some(since) = since.filter(|_| dead_cells.len() < NAMED) {
                    let for_s = (self.seconds(now) - self.seconds(since)).max(0.0);
                    dead_cells.push(Dead { bus: bus.name.clone(), node: cell.node.get(), for_s });
                }
            }
        }
        Said {
            is: "said",
            contacts,
            dead,
            dead_cells,
            halted: self.buses.iter().any(|bus| bus.halted),
            buses: self.buses.iter().map(|bus| bus.said(now)).collect(),
            detail: None,
            playback: None,
            bench: None,
        }
    }

    /// A cell in detail; none if the skin has no such cell.
    #[must_use]
    pub fn detail(&self, chosen: Chosen, now: Micros) -> Option<Detail> {
        let Chosen { bus: index, node, frame } = chosen;
        let bus = self.buses.get(index)?;
        let id = CellId::new(node.into()).ok()?;
        let place = bus.table.place(id)?;
        let cell = bus.table.cells().get(place)?;
        let (sensors, status) = bus.table.sensors(now).nth(place)?;
        let sensors = sensors.unwrap_or_default();
        let force_n = bus.central.force(place, &sensors);
        let torque = bus.last.get(place).copied().flatten().map(|(epoch, words)| {
            let words = words.as_slice();
            let frames = bus.positions_of(epoch).map(|positions| bus.central.frames(&positions));
            let joints = self.skin.joints_of(index).len();
            let at = |force_n: f64| {
                let torque = bus.central.torque(place, frames.as_ref()?, force_n);
                Some(torque.into_iter().take(joints).collect())
            };
            Answer {
                epoch: epoch.0,
                words: words.iter().take(joints).copied().collect(),
                distributed: words.iter().take(joints).map(|&word| bus.torque_format.real(word)).collect(),
                central: at(force_n),
                jacobian: at(1.0),
                saturated: words.iter().any(|&word| is_saturated(word)),
            }
        });
        let skin_cell = self.skin.cells.iter().find(|it| it.bus == index && it.node == id)?;
        let hash = |hash: u16| format!("{hash:04X}");
        let uplink = cell.uplink();
        Some(Detail {
            bus: index,
            node,
            serial: cell.serial,
            status: status.name(),
            configuration: [
                cell.heartbeat().map(|it| hash(it.configuration)),
                Some(hash(cell.configuration)),
            ],
            gains: Gains::of(skin_cell.contact),
            contact_n: sensors.contact.map(|word| word.to_f64()),
            proximity: sensors.proximity.to_f64(),
            temperature_c: sensors.temperature.map(|word| word.to_f64()),
            force_n,
            torque,
            replies: [cell.replies.due, cell.replies.in_time],
            lost: uplink.lost,
            restarts: uplink.restarts,
            frames: self.recent.of_cell(&self.skin, (index, id), |at| self.seconds(at)),
            why: frame.and_then(|frame| self.recent.why(&self.skin, frame)),
        })
    }
}

impl LiveBus {
    fn said(&self, now: Micros) -> BusSaid {
        let counters = self.table.counters();
        let uplink = self.table.uplink();
        let account = self.table.replies();
        let accuracy = self.table.accuracy();
        let errors = if self.sums { accuracy.sums } else { accuracy.single };
        BusSaid {
            name: self.name.clone(),
            up: self.is_up,
            load: self.load(),
            epochs_due: counters.epochs_due,
            epochs_complete: counters.epochs_complete,
            due: account.due,
            in_time: account.in_time,
            late: account.late,
            missing: account.missing,
            lost: uplink.lost,
            rejected: uplink.rejected,
            saturated: counters.events(Event::Saturated),
            dropped: self.dropped,
            error_nm: errors.mean(),
            tree: self.sums.then(|| {
                let cells = self.table.statuses(now).map(|(cell, status)| {
                    let sends = !matches!(status, Status::Dead | Status::Unknown);
                    let tree = cell.pages().tree.filter(|_| sends);
                    tree.map(|tree| Wires(tree.parent, tree.works))
                });
                cells.collect()
            }),
        }
    }
}
