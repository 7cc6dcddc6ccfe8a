//! A bench: its buses, its cells' processes, and what all of its threads share.

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

use super::Options;
use super::commander::{Remote, SwitchedBuses};
use super::hosts::Hosts;
use super::network::Network;
use super::receiver::{BusEvent, ReceiverResult};
use crate::bus::link::{Link, Slot, may_return};
use crate::bus::served::ServedBus;
use crate::emulate::Emulation;
use crate::processes::Processes;
use crate::processes::ended::EndedProcesses;
use crate::record::Recorder;
use crate::setup::names;
use crate::view::{CellView, View};
use control::cycle::Cycle;
use control::cycle::turn::{Line, Shared, Timed};
use model::table::Switch;

/// The polling period until the loop begins.
pub(super) const LOOK: Duration = Duration::from_millis(5);

/// The tag of requests to switch cells.
const SWITCH: u8 = 0x5E;

/// One bus of a bench.
#[derive(Debug)]
pub(super) struct BusLink {
    pub(super) link: Arc<Link>,
    pub(super) format: Format,
    /// The loop's end of the bus, until it begins.
    pub(super) line: Option<(Line, Slot)>,
    pub(super) view: Arc<Mutex<View>>,
    pub(super) receiver: Option<JoinHandle<ReceiverResult>>,
    /// Where the receiver learns which cells were not reached.
    pub(super) in_doubt: Sender<BTreeSet<CellId>>,
    /// Other hosts that have the bus.
    pub(super) hosts: Hosts,
    /// Its cells' network, where they answer with sums.
    pub(super) network: Option<Network>,
    pub(super) shared: Arc<Shared>,
}

impl BusLink {
    /// Sends a message. A bus that is lost for a while does not take it, which is counted and does not end the run.
    pub(super) fn send(&self, message: &Message) -> Result<bool, BusError> {
        let frames: Vec<Frame> = message.encode().frames(self.format).collect();
        match self.link.send(&frames).map_err(BusError::from) {
            Err(error) if may_return(&error) => {
                self.shared.unsent.fetch_add(frames.len() as u64, Ordering::Relaxed);
                Ok(false)
            }
            sent => sent.map(|()| true),
        }
    }

    /// Switches a cell, or all; it is repeated to cells that do not confirm it.
    pub(super) fn switch(&self, to: Node, (number, words): Switch) -> Result<bool, BusError> {
        self.send(&Message::Configure { to, tag: SWITCH, request: Request::Write { number, words } })
    }
}

/// A bench whose cells are ready and whose loop has not begun.
#[derive(Debug)]
pub(super) struct Bench<'a> {
    pub(super) options: &'a Options,
    pub(super) began: Instant,
    pub(super) idle: Histogram<u64>,
    /// What the kernel's backlog had dropped before the first bus was opened.
    pub(super) backlog_dropped: Option<u64>,
    pub(super) shared: Arc<Shared>,
    pub(super) bus_links: Vec<BusLink>,
    pub(super) bus_event: Inlet<(usize, BusEvent)>,
    pub(super) signalled: Arc<AtomicBool>,
    pub(super) cycle: Option<Cycle>,
    /// The epoch of the first broadcast.
    pub(super) first_epoch: Epoch,
    pub(super) recorder: Option<Recorder>,
    /// The queue of loop records to be recorded.
    pub(super) recorded: Option<rtrb::Producer<Timed>>,
    /// Who commands it, if anybody does.
    pub(super) remote: Option<Remote>,
    /// Buses that a command has taken down, and not yet brought back.
    pub(super) commanded: SwitchedBuses,
    /// Processes of cells that have ended.
    pub(super) ended: EndedProcesses,
    /// Where frames are recorded, if only this program knows.
    pub(super) log: Option<PathBuf>,
    // In this order they end: the cells before their buses.
    pub(super) processes: Processes,
    /// Held for its lines and files.
    pub(super) _emulation: Option<Emulation>,
    pub(super) served: Vec<ServedBus>,
}

impl Bench<'_> {
    /// The time since it began.
    pub(super) fn now(&self) -> Micros {
        Micros::after(self.began.elapsed())
    }

    /// The name of a bus of the skin.
    pub(super) fn name(&self, bus: usize) -> &str {
        self.options.skin.buses.get(bus).map_or("", |bus| bus.name.as_str())
    }

    /// The view of each receiver.
    pub(super) fn views(&self) -> impl Iterator<Item = (&BusLink, MutexGuard<'_, View>)> {
        self.bus_links.iter().filter_map(|bus_link| Some((bus_link, bus_link.view.lock().ok()?)))
    }

    /// The networks of the cells that answer with sums, with the views of their receivers.
    pub(super) fn networks(&mut self) -> impl Iterator<Item = (&mut Network, MutexGuard<'_, View>)> {
        self.bus_links
            .iter_mut()
            .filter_map(|BusLink { network, view, .. }| Some((network.as_mut()?, view.lock().ok()?)))
    }

    /// How many cells satisfy this.
    pub(super) fn count(&self, is: impl Fn(&CellView) -> bool) -> usize {
        self.views().map(|(_, view)| view.cells.iter().filter(|cell| is(cell)).count()).sum()
    }

    /// The names of some cells as text: `1, 2, 5 on vcan0`.
    pub(super) fn names(&self, target: impl Fn(&CellView) -> bool) -> String {
        let names = self.views().filter_map(|(bus_link, view)| {
            let nodes: Vec<_> = view.cells.iter().filter(|cell| target(cell)).map(|cell| cell.node).collect();
            (!nodes.is_empty()).then(|| names(&nodes, &format!(" on {}", bus_link.link.name)))
        });
        names.collect::<Vec<_>>().join("; ")
    }
}
