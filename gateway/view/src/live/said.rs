//! The status message: values that change slowly, as JSON for the page.

use bench::remote::BenchState;
use model::table::{Event, Status};
use protocol::fixed::is_saturated;
use protocol::id::{CellId, Id, Kind};
use protocol::message::{Readings, SensorPage};
use protocol::parameters::Contact;
use protocol::schema::{FieldFormat, PacketSchema};
use protocol::time::Micros;
use serde::Serialize;

use super::bus::LiveBus;
use super::{DecodedFrame, Live, TorqueExplanation};
use crate::command::SelectedCell;
use crate::player::Playback;

/// The maximum number of dead cells that are listed.
const MAX_LISTED_DEAD_CELLS: usize = 20;

/// The status that the page shows as text.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StatusMessage {
    /// The type of this message: `said`.
    pub is: &'static str,
    /// The number of cells in contact.
    pub contacts: usize,
    /// The number of dead cells.
    pub dead: usize,
    /// The first dead cells.
    pub dead_cells: Vec<DeadCell>,
    /// True while any bus is halted.
    pub halted: bool,
    /// The state of each bus.
    pub buses: Vec<BusStatus>,
    /// The details of the cell that the page has chosen.
    pub detail: Option<CellDetail>,
    /// The position in a recording.
    pub playback: Option<Playback>,
    /// The state that the run reports; it lists only the process of the chosen cell.
    pub bench: Option<BenchState>,
}

/// A dead cell.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DeadCell {
    /// The name of its bus.
    pub bus: String,
    /// Its node id.
    pub node: u8,
    /// The time since it was found dead, in s.
    pub for_s: f64,
}

/// The status of a bus.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BusStatus {
    /// The bus's name.
    pub name: String,
    /// True if the bus works.
    pub up: bool,
    /// The share of time that the real bus would be busy: 1 is the bus's capacity.
    pub load: Option<f64>,
    /// Epochs in which at least one reply was due.
    pub epochs_due: u64,
    /// Epochs in which all replies due came in time.
    pub epochs_complete: u64,
    /// Replies due.
    pub due: u64,
    /// Replies in time.
    pub in_time: u64,
    /// Late replies.
    pub late: u64,
    /// Missing replies.
    pub missing: u64,
    /// Packets lost on the way from the cells, by the cells' own counts.
    pub lost: u64,
    /// Packets that arrived damaged or could not be decoded.
    pub rejected: u64,
    /// Torques with a saturated word.
    pub saturated: u64,
    /// Frames that this program did not receive.
    pub dropped: u64,
    /// The mean absolute error of single torques against the central computation, in Nm.
    pub error_nm: Option<f64>,
    /// On a bus with sums, the place of each cell in the tree, in the skin's order; null for a cell that is silent or
    /// has not reported it.
    pub tree: Option<Vec<Option<TreePlace>>>,
}

/// A cell's place in the tree, as the cell reports it.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
pub struct TreePlace(
    /// The parent: the node id of a cell, or 0 for the gateway's side; null if the cell is unreachable.
    pub Option<u8>,
    /// Bit p is set if port p works in both directions.
    pub u8,
);

/// The details of a cell.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CellDetail {
    /// The cell's bus, as an index into the skin's buses.
    pub bus: usize,
    /// The cell's node id.
    pub node: u8,
    /// The cell's serial number.
    pub serial: u32,
    /// The name of its status.
    pub status: &'static str,
    /// The hash of its configuration, and the hash that the skin requires.
    pub configuration: [Option<String>; 2],
    /// Its gains and thresholds, from the skin.
    pub gains: Gains,
    /// The fields of its sensors pages.
    pub readings: Vec<Reading>,
    /// Its force by Algorithm 1, in N.
    pub force_n: f64,
    /// Its last torque.
    pub torque: Option<TorqueReply>,
    /// Replies due, and replies in time.
    pub replies: [u64; 2],
    /// Packets lost, by the cell's own count.
    pub lost: u64,
    /// The number of restarts.
    pub restarts: u32,
    /// The newest frames from and to the cell, newest first.
    pub frames: Vec<DecodedFrame>,
    /// The explanation of the torque in the chosen frame, while that frame is kept.
    pub why: Option<TorqueExplanation>,
}

/// A field of a sensors page, by the schema.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Reading {
    /// The name, without the unit.
    pub name: &'static str,
    /// The unit.
    pub unit: &'static str,
    /// Digits after the decimal point.
    pub decimals: usize,
    /// The value of each element.
    pub values: Vec<f64>,
}

impl Reading {
    /// Returns the fields of a page. The total of a skin's page is left out: the force is shown by Algorithm 1.
    fn from_page(page: SensorPage) -> impl Iterator<Item = Self> {
        let bytes = page.words().map(i16::to_le_bytes);
        let layout = PacketSchema::for_id(Id { kind: Kind::Sensors, node: 1 })
            .and_then(|schema| schema.layouts.iter().find(|layout| layout.number == page.number()));
        layout.into_iter().flat_map(move |layout| {
            let fields = layout.fields.iter().filter(|field| !matches!(field.format, FieldFormat::Total(_)));
            fields.map(move |field| Self {
                name: field.bare_name(),
                unit: &field.unit,
                decimals: layout.decimals(field),
                values: (0..field.elements())
                    .map(|element| field.real(field.raw(bytes.as_flattened(), element)))
                    .collect(),
            })
        })
    }
}

/// The gains and thresholds of Algorithm 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Gains {
    /// alpha_c (a number) and alpha_p in N.
    pub alpha: [f64; 2],
    /// F_c,th in N, F_p,th (0 to 1), F_z,th in N.
    pub thresholds: [f64; 3],
}

impl Gains {
    fn from_contact(contact: Contact) -> Self {
        let Contact { alpha_c, alpha_p, contact_threshold, proximity_threshold, force_threshold } = contact;
        Self {
            alpha: [alpha_c.to_f64(), alpha_p.to_f64()],
            thresholds: [contact_threshold.to_f64(), proximity_threshold.to_f64(), force_threshold.to_f64()],
        }
    }
}

/// A torque reply of a cell.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TorqueReply {
    /// The epoch.
    pub epoch: u8,
    /// The words of the reply.
    pub words: Vec<i16>,
    /// The same values in Nm or N.
    pub distributed: Vec<f64>,
    /// The central computation at the positions of that epoch, while they are known.
    pub central: Option<Vec<f64>>,
    /// J at these positions, while they are known: in m for revolute joints, a number for prismatic ones.
    pub jacobian: Option<Vec<f64>>,
    /// True if a word is saturated.
    pub saturated: bool,
}

impl Live {
    /// Returns the status for all pages, without the details of a cell.
    #[must_use]
    pub fn status_message(&self, now: Micros) -> StatusMessage {
        let (mut contacts, mut dead, mut dead_cells) = (0, 0, Vec::new());
        for bus in &self.buses {
            for ((cell, status), since) in bus.table.statuses(now).zip(&bus.dead_since) {
                contacts += usize::from(matches!(status, Status::Active | Status::Stale));
                dead += usize::from(status == Status::Dead);
                if let Some(since) = since.filter(|_| dead_cells.len() < MAX_LISTED_DEAD_CELLS) {
                    let for_s = (self.seconds(now) - self.seconds(since)).max(0.0);
                    dead_cells.push(DeadCell { bus: bus.name.clone(), node: cell.node.get(), for_s });
                }
            }
        }
        StatusMessage {
            is: "said",
            contacts,
            dead,
            dead_cells,
            halted: self.buses.iter().any(|bus| bus.halted),
            buses: self.buses.iter().map(|bus| bus.status(now)).collect(),
            detail: None,
            playback: None,
            bench: None,
        }
    }

    /// Returns the details of a cell, or `None` if the skin does not have the cell.
    #[must_use]
    pub fn detail(&self, chosen: SelectedCell, now: Micros) -> Option<CellDetail> {
        let SelectedCell { bus: index, node, frame } = chosen;
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
            let joints = self.skin.joints_on_bus(index).len();
            let at = |force_n: f64| {
                let torque = bus.central.torque(place, frames.as_ref()?, force_n);
                Some(torque.into_iter().take(joints).collect())
            };
            TorqueReply {
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
        Some(CellDetail {
            bus: index,
            node,
            serial: cell.serial,
            status: status.name(),
            configuration: [
                cell.heartbeat().map(|it| hash(it.configuration)),
                Some(hash(cell.configuration)),
            ],
            gains: Gains::from_contact(skin_cell.contact),
            readings: Readings { skin: sensors, ..cell.readings() }
                .pages()
                .into_iter()
                .flat_map(Reading::from_page)
                .collect(),
            force_n,
            torque,
            replies: [cell.replies.due, cell.replies.in_time],
            lost: uplink.lost,
            restarts: uplink.restarts,
            frames: self.recent.cell_frames(&self.skin, (index, id), |at| self.seconds(at)),
            why: frame.and_then(|frame| self.recent.explain_torque(&self.skin, frame)),
        })
    }
}

impl LiveBus {
    fn status(&self, now: Micros) -> BusStatus {
        let counters = self.table.counters();
        let uplink = self.table.uplink();
        let account = self.table.replies();
        let accuracy = self.table.accuracy();
        let errors = if self.sums { accuracy.sums } else { accuracy.single };
        BusStatus {
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
                    tree.map(|tree| TreePlace(tree.parent, tree.working_ports))
                });
                cells.collect()
            }),
        }
    }
}
