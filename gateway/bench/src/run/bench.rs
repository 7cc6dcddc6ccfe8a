//! A bench: its buses, its cells' processes, and the state that all its threads share.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver as Inlet, Sender};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use protocol::bus::BusError;
use protocol::can::{Format, Frame};
use protocol::id::{CellId, Node};
use protocol::message::{Message, Request};
use protocol::packet::Epoch;
use protocol::time::Micros;

use super::RunOptions;
use super::commander::{RemoteControl, SwitchedBuses};
use super::hosts::OtherHosts;
use super::network::Network;
use super::receiver::{BusEvent, ReceiverResult};
use crate::bus::link::{BusSlot, SharedBus, is_recoverable};
use crate::bus::served::ServedBus;
use crate::emulate::Emulation;
use crate::processes::Processes;
use crate::processes::ended::EndedProcesses;
use crate::record::Recorder;
use crate::setup::format_cells;
use crate::summary::TimedReport;
use crate::view::{BusView, CellView};
use control::cycle::ControlCycle;
use control::cycle::turn::{BusPort, SharedRunState, TimedRecord};
use model::table::SwitchTarget;

/// Interval between polls until the loop starts.
pub(super) const POLL_INTERVAL: Duration = Duration::from_millis(5);

/// Tag of `configure` requests that set switches of cells.
const SWITCH_REQUEST_TAG: u8 = 0x5E;

/// One bus of a bench.
#[derive(Debug)]
pub(super) struct RunBus {
    pub(super) link: Arc<SharedBus>,
    pub(super) format: Format,
    /// The control loop's end of the bus; `None` once the loop has started.
    pub(super) port: Option<(BusPort, BusSlot)>,
    pub(super) view: Arc<Mutex<BusView>>,
    pub(super) receiver: Option<JoinHandle<ReceiverResult>>,
    /// Sends the receiver the cells that may have missed a message.
    pub(super) possibly_missed: Sender<BTreeSet<CellId>>,
    /// Other hosts connected to the bus.
    pub(super) hosts: OtherHosts,
    /// Network of its cells, if they answer with sums.
    pub(super) network: Option<Network>,
    pub(super) shared: Arc<SharedRunState>,
    /// Figures of the bus before this run, if frames take time on it.
    pub(super) figures_before: Option<TimedReport>,
}

impl RunBus {
    /// Sends a message. A lost bus refuses it, which is counted and does not end the run.
    pub(super) fn send(&self, message: &Message) -> Result<bool, BusError> {
        let frames: Vec<Frame> = message.encode().frames(self.format).collect();
        match self.link.send(&frames).map_err(BusError::from) {
            Err(error) if is_recoverable(&error) => {
                self.shared.unsent.fetch_add(frames.len() as u64, Ordering::Relaxed);
                Ok(false)
            }
            sent => sent.map(|()| true),
        }
    }

    /// Sends a switch to one cell or to all cells. The caller repeats it for cells that do not confirm.
    pub(super) fn send_switch(&self, to: Node, (number, words): SwitchTarget) -> Result<bool, BusError> {
        self.send(&Message::Configure {
            to,
            tag: SWITCH_REQUEST_TAG,
            request: Request::Write { number, words },
        })
    }
}

/// A bench whose cells are ready and whose loop has not started.
#[derive(Debug)]
pub(super) struct Bench<'a> {
    pub(super) options: &'a RunOptions,
    pub(super) began: Instant,
    pub(super) idle: Histogram<u64>,
    /// Number of packets that the kernel's backlog had dropped before the first bus was opened.
    pub(super) backlog_dropped: Option<u64>,
    pub(super) shared: Arc<SharedRunState>,
    pub(super) bus_links: Vec<RunBus>,
    pub(super) events: Inlet<(usize, BusEvent)>,
    pub(super) signalled: Arc<AtomicBool>,
    pub(super) cycle: Option<ControlCycle>,
    /// Epoch of the first broadcast.
    pub(super) first_epoch: Epoch,
    pub(super) recorder: Option<Recorder>,
    /// Queue of loop records to the recorder.
    pub(super) recorded: Option<rtrb::Producer<TimedRecord>>,
    /// Programs that control the run.
    pub(super) remotes: Vec<RemoteControl>,
    /// True if a command has ended the run.
    pub(super) is_end_requested: bool,
    /// Buses that a command has taken down and that have not worked since.
    pub(super) commanded: SwitchedBuses,
    /// Processes of cells that have ended.
    pub(super) ended: EndedProcesses,
    /// Path of the frame log, if this program chose it and must report it.
    pub(super) log: Option<PathBuf>,
    // The order of the fields matters: the cells are dropped before their buses.
    pub(super) processes: Processes,
    /// Keeps the slcan lines and the files of emulated cells in existence.
    pub(super) _emulation: Option<Emulation>,
    pub(super) served: Vec<ServedBus>,
}

impl Bench<'_> {
    /// Time since the start of the bench.
    pub(super) fn now(&self) -> Micros {
        Micros::from_elapsed(self.began.elapsed())
    }

    /// Returns the name of a bus of the skin.
    pub(super) fn bus_name(&self, bus: usize) -> &str {
        self.options.skin.buses.get(bus).map_or("", |bus| bus.name.as_str())
    }

    /// Returns each bus with the view that its receiver maintains.
    pub(super) fn bus_views(&self) -> impl Iterator<Item = (&RunBus, MutexGuard<'_, BusView>)> {
        self.bus_links.iter().filter_map(|bus_link| Some((bus_link, bus_link.view.lock().ok()?)))
    }

    /// Returns the networks of cells that answer with sums, with the views of their receivers.
    pub(super) fn networks(&mut self) -> impl Iterator<Item = (&mut Network, MutexGuard<'_, BusView>)> {
        self.bus_links
            .iter_mut()
            .filter_map(|RunBus { network, view, .. }| Some((network.as_mut()?, view.lock().ok()?)))
    }

    /// Returns the number of cells that satisfy a predicate.
    pub(super) fn count_cells(&self, is: impl Fn(&CellView) -> bool) -> usize {
        self.bus_views().map(|(_, view)| view.cells.iter().filter(|cell| is(cell)).count()).sum()
    }

    /// Returns the selected cells as text: `1, 2, 5 on vcan0`.
    pub(super) fn selected_cell_names(&self, selects: impl Fn(&CellView) -> bool) -> String {
        let names = self.bus_views().filter_map(|(bus_link, view)| {
            let nodes: Vec<_> =
                view.cells.iter().filter(|cell| selects(cell)).map(|cell| cell.node).collect();
            (!nodes.is_empty()).then(|| format_cells(&nodes, &format!(" on {}", bus_link.link.name)))
        });
        names.collect::<Vec<_>>().join("; ")
    }
}
