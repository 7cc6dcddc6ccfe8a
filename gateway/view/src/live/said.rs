//! The status message to the page: values that change slowly, as JSON.

use bench::remote::BenchState;
use model::table::{CellStatus, FrameEvent};
use protocol::fixed::is_saturated;
use protocol::id::{Id, Kind};
use protocol::message::SensorPage;
use protocol::parameters::Contact;
use protocol::quantiles::Quantiles;
use protocol::schema::{FieldFormat, PacketSchema};
use protocol::time::Micros;
use serde::Serialize;

use super::bus::{LiveBus, TimedBus};
use super::{DecodedFrame, LiveState, TorqueExplanation};
use crate::page_command::SelectedCell;
use crate::player::PlayerStatus;

/// The maximum number of dead cells that are listed by name.
const MAX_LISTED_DEAD_CELLS: usize = 20;

/// The status of a bench or a recording, which the page shows as text.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StatusMessage {
    /// The type of the message, always `said`.
    pub is: &'static str,
    /// The number of cells in contact.
    pub contacts: usize,
    /// The number of cells of which no frame has been received, so that their contact is unknown.
    pub unheard: usize,
    /// The number of dead cells.
    pub dead: usize,
    /// Some of the dead cells, at most 20.
    pub dead_cells: Vec<DeadCell>,
    /// True while any bus is halted.
    pub halted: bool,
    /// The state of each bus.
    pub buses: Vec<BusStatus>,
    /// The details of the cell that the page has selected.
    pub detail: Option<CellDetail>,
    /// The state of the playback; null for a live view.
    pub playback: Option<PlayerStatus>,
    /// The state that the bench reports. Of its processes, only that of the selected cell is listed.
    pub bench: Option<BenchState>,
}

/// A dead cell, from which frames have stopped coming.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DeadCell {
    /// The name of the cell's bus.
    pub bus: String,
    /// The node id of the cell.
    pub node: u8,
    /// The time since the cell was found dead, in s.
    pub for_s: f64,
}

/// The status of a bus.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BusStatus {
    /// The name of the bus.
    pub name: String,
    /// True if the bus is open and works.
    pub up: bool,
    /// The share of time for which the frames would occupy a real bus, where 1 is its capacity; null if its bit rates
    /// are unknown.
    pub load: Option<f64>,
    /// The number of epochs in which at least one reply was due.
    pub epochs_due: u64,
    /// The number of epochs in which all replies that were due came in time.
    pub epochs_complete: u64,
    /// The number of replies that were due.
    pub due: u64,
    /// The number of replies that came in time.
    pub in_time: u64,
    /// The number of replies that came late.
    pub late: u64,
    /// The number of replies that did not come.
    pub missing: u64,
    /// The number of packets that cells sent and that were not received, by the cells' own counts.
    pub lost: u64,
    /// The number of packets that were damaged or could not be decoded.
    pub rejected: u64,
    /// The number of torques with a saturated word.
    pub saturated: u64,
    /// The number of frames that this program did not receive.
    pub dropped: u64,
    /// The mean absolute difference between the torques of single cells and those of the central computation, in Nm.
    pub error_nm: Option<f64>,
    /// The times on a bus on which frames take time; null on another one.
    pub timed: Option<TimedBusStatus>,
    /// For a bus whose cells send sums: the wires of each cell in the tree, in the skin's order. It is null for a cell
    /// that has not reported them or is dead.
    pub tree: Option<Vec<Option<CellParentAndWires>>>,
}

/// The replies and the transmit queues of a timed bus.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TimedBusStatus {
    /// The bit rates for which load and upper bound hold, such as `1M/5M`; null if they are unknown.
    pub rates: Option<String>,
    /// The longest time from joints to a reply to them in the last second, in ms; null without a reply.
    pub last_reply_ms: Option<f64>,
    /// The upper bound of `skinbus fit` for this time, in ms; null if there is none.
    pub bound_ms: Option<f64>,
    /// The transmit queues, as the bus's server reports them; null in a recording.
    pub queues: Option<TransmitQueues>,
}

/// The transmit queues of a timed bus, up to a second ago.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TransmitQueues {
    /// The number of frames that wait to be sent.
    pub waiting: u64,
    /// The time from a request to the end of the frame, since the bus is served.
    pub wait_us: Quantiles,
    /// The number of frames that a full queue refused.
    pub refused: u64,
}

/// A cell's parent and wires in the tree, as the cell reports them.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
pub struct CellParentAndWires(
    /// The node id of the parent, or 0 if that is the gateway's side. It is null if the cell is unreachable.
    pub Option<u8>,
    /// A bit for each port: bit p is set if the wire at port p works in both directions.
    pub u8,
);

/// The details of the cell that a page has selected.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CellDetail {
    /// The index of the cell's bus in the skin.
    pub bus: usize,
    /// The node id of the cell.
    pub node: u8,
    /// The serial number of the cell.
    pub serial: u32,
    /// The name of the cell's status.
    pub status: &'static str,
    /// The time at which the cell was found dead, in s of the run; null unless it is dead. Sensors, force and torque are
    /// then the last ones.
    pub dead_at_s: Option<f64>,
    /// The hash of the cell's configuration, and the hash that the skin requires.
    pub configuration: [Option<String>; 2],
    /// The gains and thresholds of the cell, from the skin.
    pub gains: GainsAndThresholds,
    /// The fields of its sensors pages whose values are known.
    pub readings: Vec<SensorReading>,
    /// Its force by Algorithm 1, in N; null if its sensor values are unknown.
    pub force_n: Option<f64>,
    /// The last torque that the cell sent.
    pub torque: Option<TorqueReply>,
    /// The number of replies that were due, and the number that came in time.
    pub replies: [u64; 2],
    /// The number of packets that the cell sent and that were not received, by the cell's own count.
    pub lost: u64,
    /// The number of times that the cell has restarted.
    pub restarts: u32,
    /// The newest frames that the cell sent or received, newest first.
    pub frames: Vec<DecodedFrame>,
    /// The explanation of the torque in the selected frame; null if that frame is no longer stored.
    pub why: Option<TorqueExplanation>,
}

/// A field of a sensors page, by the schema.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SensorReading {
    /// The name, without the unit.
    pub name: &'static str,
    /// The unit.
    pub unit: &'static str,
    /// Digits after the decimal point.
    pub decimals: usize,
    /// The value of each element.
    pub values: Vec<f64>,
}

impl SensorReading {
    /// Returns the fields of a page. The total of a skin's page is left out: the force is shown by Algorithm 1.
    fn fields_of_page(page: SensorPage) -> impl Iterator<Item = Self> {
        let bytes = page.words().map(i16::to_le_bytes);
        let layout = PacketSchema::for_id(Id { kind: Kind::Sensors, node: 1 })
            .and_then(|schema| schema.layouts.iter().find(|layout| layout.number == page.number()));
        layout.into_iter().flat_map(move |layout| {
            let fields = layout.fields.iter().filter(|field| !matches!(field.format, FieldFormat::Total(_)));
            fields.map(move |field| Self {
                name: field.name_without_unit(),
                unit: &field.unit,
                decimals: layout.decimals(field),
                values: (0..field.element_count())
                    .map(|element| field.raw_to_real(field.raw_value(bytes.as_flattened(), element)))
                    .collect(),
            })
        })
    }
}

/// The gains and thresholds with which a cell fuses contact and proximity (the paper's Algorithm 1).
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct GainsAndThresholds {
    /// The gains α_c (a number) and α_p (in N).
    pub alpha: [f64; 2],
    /// The thresholds F_c,th in N, F_p,th (0 to 1) and F_z,th in N.
    pub thresholds: [f64; 3],
}

impl GainsAndThresholds {
    fn from_contact(contact: Contact) -> Self {
        let Contact { alpha_c, alpha_p, contact_threshold, proximity_threshold, force_threshold } = contact;
        Self {
            alpha: [alpha_c.to_f64(), alpha_p.to_f64()],
            thresholds: [contact_threshold.to_f64(), proximity_threshold.to_f64(), force_threshold.to_f64()],
        }
    }
}

/// The last torque of a cell, beside the central computation for the same epoch.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TorqueReply {
    /// The epoch to which the torque belongs.
    pub epoch: u8,
    /// The time at which the torque was received, in s of the run.
    pub at_s: f64,
    /// The torque of each joint as a 16-bit number, as in the packet.
    pub words: Vec<i16>,
    /// The torque of each joint in Nm or N.
    pub distributed: Vec<f64>,
    /// The torque by the central computation at the joint positions of that epoch; null if these are no longer stored.
    pub central: Option<Vec<f64>>,
    /// The Jacobian of the cell for each joint at these positions: in m for a revolute joint, a number for a prismatic
    /// one. It is null if the positions are no longer stored.
    pub jacobian: Option<Vec<f64>>,
    /// True if a torque was too large for its word and was saturated.
    pub saturated: bool,
}

impl LiveState {
    /// Returns the status that all pages get, without the details of a cell.
    #[must_use]
    pub fn status_message(&self, now: Micros) -> StatusMessage {
        let (mut contacts, mut unheard, mut dead, mut dead_cells) = (0, 0, 0, Vec::new());
        for bus in &self.buses {
            for ((cell, status), since) in bus.table.statuses(now).zip(&bus.dead_since) {
                contacts += usize::from(matches!(status, CellStatus::Active | CellStatus::Stale));
                unheard += usize::from(status == CellStatus::Unknown);
                dead += usize::from(status == CellStatus::Dead);
                if let Some(since) = since.filter(|_| dead_cells.len() < MAX_LISTED_DEAD_CELLS) {
                    let for_s = (self.seconds_since_start(now) - self.seconds_since_start(since)).max(0.0);
                    dead_cells.push(DeadCell { bus: bus.name.clone(), node: cell.node.get(), for_s });
                }
            }
        }
        StatusMessage {
            is: "said",
            contacts,
            unheard,
            dead,
            dead_cells,
            halted: self.buses.iter().any(|bus| bus.halted),
            buses: self.buses.iter().map(|bus| bus.bus_status(now)).collect(),
            detail: None,
            playback: None,
            bench: None,
        }
    }

    /// Returns the details of the cell that a page has selected; `None` if the skin does not have this cell.
    #[must_use]
    pub fn cell_detail(&self, chosen: &SelectedCell, now: Micros) -> Option<CellDetail> {
        let SelectedCell { cell, frame } = chosen;
        let (index, id) = cell.find(&self.skin).ok()?;
        let bus = self.buses.get(index)?;
        let place = bus.table.index_of(id)?;
        let cell = bus.table.cells().get(place)?;
        let (sensors, status) = bus.table.presumed_sensors(now).nth(place)?;
        let force_n = sensors.map(|sensors| bus.central.cell_force(place, &sensors));
        let torque = bus.last.get(place).copied().flatten().map(|(received, epoch, words)| {
            let words = words.as_slice();
            let frames = bus.joint_positions_in(epoch).map(|positions| bus.central.link_frames(&positions));
            let joints = self.skin.joints_on_bus(index).len();
            let at = |force_n: f64| {
                let torque = bus.central.cell_torque(place, frames.as_ref()?, force_n);
                Some(torque.into_iter().take(joints).collect())
            };
            TorqueReply {
                epoch: epoch.0,
                at_s: self.seconds_since_start(received),
                words: words.iter().take(joints).copied().collect(),
                distributed: words.iter().take(joints).map(|&word| bus.torque_format.to_real(word)).collect(),
                central: force_n.and_then(at),
                jacobian: at(1.0),
                saturated: words.iter().any(|&word| is_saturated(word)),
            }
        });
        let skin_cell = self.skin.cells.iter().find(|it| it.bus == index && it.node == id)?;
        let hash = |hash: u16| format!("{hash:04X}");
        let uplink = cell.uplink();
        Some(CellDetail {
            bus: index,
            node: id.get(),
            serial: cell.serial,
            status: status.name(),
            dead_at_s: bus.dead_since.get(place).copied().flatten().map(|at| self.seconds_since_start(at)),
            configuration: [
                cell.heartbeat().map(|it| hash(it.configuration)),
                Some(hash(cell.configuration)),
            ],
            gains: GainsAndThresholds::from_contact(skin_cell.contact),
            readings: sensors
                .map(SensorPage::Skin)
                .into_iter()
                .chain(cell.latched_pages().filter(|page| !matches!(page, SensorPage::Skin(_))))
                .flat_map(SensorReading::fields_of_page)
                .collect(),
            force_n,
            torque,
            replies: [cell.replies.due, cell.replies.in_time],
            lost: uplink.lost,
            restarts: uplink.restarts,
            frames: self.recent.cell_frames(&self.skin, (index, id), |at| self.seconds_since_start(at)),
            why: frame.and_then(|frame| self.recent.explain_torque(&self.skin, frame)),
        })
    }
}

impl LiveBus {
    fn timed_bus_status(&self, timed: &TimedBus) -> TimedBusStatus {
        TimedBusStatus {
            rates: self.rates().map(|rates| rates.to_string()),
            last_reply_ms: timed.replies.longest_of_second_ms(),
            bound_ms: timed.last_reply_bound_us.map(|micros| micros * 1e-3),
            queues: timed.figures.as_ref().map(|figures| TransmitQueues {
                waiting: figures.waiting,
                wait_us: figures.wait_us,
                refused: figures.refused,
            }),
        }
    }

    fn bus_status(&self, now: Micros) -> BusStatus {
        let counters = self.table.counters();
        let uplink = self.table.uplink();
        let account = self.table.reply_counts();
        let accuracy = self.table.accuracy();
        let errors = if self.sums { accuracy.sums } else { accuracy.single };
        BusStatus {
            name: self.name.clone(),
            up: self.is_up,
            load: self.bus_load(),
            epochs_due: counters.epochs_due,
            epochs_complete: counters.epochs_complete,
            due: account.due,
            in_time: account.in_time,
            late: account.late,
            missing: account.missing,
            lost: uplink.lost,
            rejected: uplink.rejected,
            saturated: counters.event_count(FrameEvent::Saturated),
            dropped: self.dropped,
            error_nm: errors.mean(),
            timed: self.timed().map(|timed| self.timed_bus_status(timed)),
            tree: self.sums.then(|| {
                let cells = self.table.statuses(now).map(|(cell, status)| {
                    let sends = !matches!(status, CellStatus::Dead | CellStatus::Unknown);
                    let tree = cell.pages().tree.filter(|_| sends);
                    tree.map(|tree| CellParentAndWires(tree.parent, tree.working_ports))
                });
                cells.collect()
            }),
        }
    }
}
