//! The result of a run: the figures of the table at its end, and of `--summary`.
//!
//! The keys of the JSON are the names of the fields here; `docs/reference/summary.md` explains them.

use std::collections::BTreeMap;

use protocol::id::Kind;
use protocol::skin::Skin;
use protocol::time::Micros;
use serde::Serialize;

pub use self::cells::{CellSummary, RepliesSummary};
pub use self::outcome::{CellError, ErrorCells, Halted, Outcome, TickBefore, cells_in_error};
pub(crate) use self::verdict::many;
pub use self::verdict::{CELL_ERROR_NM, Verdict};
use model::quantiles::Quantiles;
use model::table::{Accuracy, Contributions, Event, Status, SumCounts, Table};
pub use trace::recording::account::{Recording, Written};

mod cells;
mod outcome;
mod verdict;

/// A whole run.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Summary {
    /// The skin's name.
    pub skin: String,
    /// All is well, or what to look at.
    pub verdict: Verdict,
    /// Each cell in it.
    pub cells: Vec<CellSummary>,
    /// How it ended.
    pub outcome: Outcome,
    /// Why it failed, if it did.
    pub failure: Option<String>,
    /// How long the loop ran, in s.
    pub duration_s: f64,
    /// Whether it was ended by a signal.
    pub interrupted: bool,
    /// Why the robot was halted at the end, if it was.
    pub halted: Option<String>,
    /// Each time that it was halted, oldest first.
    pub halts: Vec<Halted>,
    /// Halts beyond the first 100 that have ended.
    pub further_halts: u64,
    /// The ticks up to the last halt, oldest first.
    pub before_halt: Vec<TickBefore>,
    /// Why the external controller counts as absent, if it does; none of a halted robot.
    pub no_controller: Option<String>,
    /// Errors by which processes of cells ended.
    pub cell_errors: Vec<CellError>,
    /// From the start of the program to the first broadcast, in s.
    pub first_broadcast_s: f64,
    /// The control loop.
    #[serde(rename = "loop")]
    pub control: Loop,
    /// Distributed against central torques.
    pub accuracy: Accuracy,
    /// Packets of the whole machine, any interface's, that the kernel dropped before they came to a socket,
    /// because a processor's backlog was full; none if it does not report them.
    pub backlog_dropped: Option<u64>,
    /// Each bus.
    pub buses: Vec<BusSummary>,
    /// Processor time while the loop ran, in cores.
    pub processor: Processor,
    /// Private memory.
    #[serde(flatten)]
    pub memory: Memory,
    /// What was recorded, and what was lost.
    pub recording: Option<Recording>,
}

impl Summary {
    /// The summary of a run of which nothing is known yet.
    #[must_use]
    pub fn empty(skin: &Skin) -> Self {
        Self {
            skin: skin.name.clone(),
            cells: skin.cells.iter().map(|cell| CellSummary::new(skin, cell, None)).collect(),
            first_broadcast_s: f64::NAN,
            ..Self::default()
        }
    }

    /// The summary of a run that failed before any bus was opened.
    #[must_use]
    pub fn of_no_run(skin: &Skin, why: String) -> Self {
        Self::empty(skin).rated(Some(why))
    }

    /// Sets the outcome and the verdict from what else is known; `failure` is why it did not come to its end.
    #[must_use]
    pub fn rated(mut self, failure: Option<String>) -> Self {
        // A lost bus may be why the robot was halted, and the halt is the more precise outcome.
        let lost_buses = || self.lost_buses().filter(|_| self.halted.is_none());
        self.failure = failure.or_else(|| self.lost_frames()).or_else(lost_buses);
        self.outcome = match &self.failure {
            Some(_) => Outcome::Failed,
            None if self.halted.is_some() => Outcome::Halted,
            None if self.no_controller.is_some() => Outcome::NoController,
            None if !self.cell_errors.is_empty() => Outcome::CellError,
            None if self.interrupted => Outcome::Interrupted,
            None => Outcome::Done,
        };
        self.verdict = Verdict::of(&self);
        self
    }

    /// The messages about its end, a line each and the reason of its exit code last; none when all is well. Reasons of
    /// cells' errors are not repeated unless the run was `quiet`.
    #[must_use]
    pub fn complaints(&self, quiet: bool) -> Vec<String> {
        // The error of a failed run names the lost bus.
        let came_to_its_end = self.failure.is_none() || self.failure == self.lost_frames();
        let lost = self.lost_buses().filter(|_| came_to_its_end);
        let halted = self.halts.last().filter(|_| self.halted.is_some()).map(|halted| {
            let Halted { at_s, epoch, reason, .. } = halted;
            format!(
                "the robot was halted at {at_s:.3} s (epoch {epoch}) and not resumed: {reason}; --summary FILE keeps \
                 the ticks before it"
            )
        });
        let absent = self.no_controller.clone();
        [lost, cells_in_error(&self.cell_errors, quiet), absent, halted, self.failure.clone()]
            .into_iter()
            .flatten()
            .collect()
    }

    fn lost_buses(&self) -> Option<String> {
        let lost: Vec<_> = self.buses.iter().filter(|bus| bus.outages.at_end).collect();
        let names = || lost.iter().map(|bus| bus.name.as_str()).collect::<Vec<_>>().join(", ");
        (!lost.is_empty()).then(|| format!("lost at the end of the run: {}", names()))
    }

    fn lost_frames(&self) -> Option<String> {
        let Recording { errors, lost_write, files, .. } = self.recording.as_ref()?;
        let first = errors.first().map_or("", String::as_str);
        let parts = files.iter().map(|file| &file.path).filter(|path| path.ends_with(".part"));
        // The error of such a file says what to do with it.
        let hint = |path: &String| match errors.iter().find(|error| error.contains(path.as_str())) {
            Some(error) if error == first => String::new(),
            Some(error) => format!("; {error}"),
            None => format!("; what was recorded is in {path}: repair it with `skinbus recover {path}`"),
        };
        let parts: String = parts.map(hint).collect();
        (!errors.is_empty() || *lost_write > 0).then(|| match lost_write {
            0 => format!("the recording is not as it should be: {first}{parts}"),
            _ => format!("the recording is incomplete, {lost_write} frames were not written: {first}{parts}"),
        })
    }
}

/// The control loop.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Loop {
    /// Ticks that happened.
    pub ticks: u64,
    /// Ticks that were skipped because the machine was late.
    pub ticks_skipped: u64,
    /// Broadcasts sent.
    pub broadcasts: u64,
    /// Broadcasts skipped with their ticks.
    pub broadcasts_skipped: u64,
    /// Bad cycles, by reason.
    pub bad_cycles: BTreeMap<String, u64>,
    /// Outcomes of an external controller's datagrams, by name; empty for other controllers.
    pub controller: BTreeMap<String, u64>,
    /// How late ticks began.
    pub late_us: Quantiles,
    /// How late the same machine wakes an idle thread.
    pub idle_late_us: Quantiles,
    /// How long a tick took.
    pub took_us: Quantiles,
    /// How long the central computation took of that, in ticks that compared.
    pub central_us: Quantiles,
    /// How long a tick took in ticks that did not compare.
    pub took_distributed_us: Quantiles,
    /// Whether the machine granted SCHED_FIFO.
    pub fifo: bool,
    /// Whether it locked the memory.
    pub memory_locked: bool,
    /// Records of ticks that did not fit into their queue.
    pub records_lost: u64,
    /// Frames that a bus did not take.
    pub unsent: u64,
}

/// Processor time while the loop ran, in cores.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Processor {
    /// This program.
    pub gateway: f64,
    /// All cells together.
    pub cells: f64,
    /// Embedded buses.
    pub buses: f64,
}

/// Private memory, in KiB.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Memory {
    /// Of the largest cell process, if cells were started.
    pub cell_private_kib: Option<u64>,
    /// Of this program, at the end of the loop.
    pub gateway_private_kib: Option<u64>,
    /// Of all processes that were started to serve buses; none without any.
    pub buses_private_kib: Option<u64>,
}

/// Packets from the cells: sent = delivered + rejected + unheard + lost, and lost = dropped + backlog + outage + hosts
/// + unknown.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct UplinkSummary {
    /// Sent, by the cells' own count, as of their last heartbeats.
    pub sent: u64,
    /// Arrived and understood.
    pub delivered: u64,
    /// Arrived and refused.
    pub rejected: u64,
    /// Sums for another cell, which this gateway did not take.
    pub unheard: u64,
    /// Sent and not arrived, because the bus dropped frames that were not read in time.
    pub dropped: u64,
    /// Sent and not arrived, as far as the kernel's backlog drops explain it.
    pub backlog: u64,
    /// Sent and not arrived, while the bus was lost.
    pub outage: u64,
    /// Sent and not arrived, explained by frames that were lost between hosts.
    pub hosts: u64,
    /// Sent and not arrived, for an unknown reason.
    pub unknown: u64,
    /// Arrived more often than sent.
    pub surplus: u64,
    /// Of these, heartbeats of other senders under a cell's node id.
    pub outsiders: u64,
    /// Arrived of what a cell sent between its last heartbeat and its restart: what else it sent then is
    /// unknown.
    pub in_doubt: u64,
    /// Arrived after a cell's last heartbeat, which nothing can be compared with.
    pub unsettled: u64,
    /// Cells that restarted.
    pub restarts: u32,
}

impl UplinkSummary {
    /// Attributes unknown losses to links between hosts, at most so many.
    pub fn explain_by_hosts(&mut self, at_most: u64) {
        let explained = self.unknown.min(at_most);
        self.unknown -= explained;
        self.hosts += explained;
    }

    /// Attributes unknown losses to the kernel's backlog, at most so many; how many.
    pub fn explain_by_backlog(&mut self, at_most: u64) -> u64 {
        let explained = self.unknown.min(at_most);
        self.unknown -= explained;
        self.backlog += explained;
        explained
    }
}

/// Sums along the cells' tree.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct SumsSummary {
    /// Cells that are wired to the gateway's side.
    pub roots: usize,
    /// What was done with the received ones: received = first + resent + overheard + stale.
    #[serde(flatten)]
    pub counts: SumCounts,
    /// Cells that had to be in sums, and were: due = in time + late + missing.
    pub contributions: Contributions,
}

/// How often a bus was lost, and for how long.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct OutagesSummary {
    /// How often.
    pub times: u64,
    /// Its total time in s, each from when it was noticed to the first frame after it.
    pub lost_s: f64,
    /// Whether it was lost at the end.
    pub at_end: bool,
    /// Ticks without it.
    pub ticks: u64,
}

/// Another host that has the bus too.
#[derive(Clone, Debug, Default, Serialize)]
pub struct HostSummary {
    /// Its name.
    pub name: String,
    /// Cells that sent from there.
    pub cells: usize,
    /// How often it was gone, or not reached.
    pub gone: u64,
    /// For how long in total, in s.
    pub gone_s: f64,
    /// Whether it was reached at the end.
    pub at_end: bool,
    /// Frames from there that did not get here.
    pub lost_from: u64,
    /// Frames from here that did not get there, as it reports.
    pub lost_to: u64,
}

/// The network of a bus' cells.
#[derive(Clone, Debug, Default, Serialize)]
pub struct NetworkSummary {
    /// From the time when all cells were ready until all had a route to a root, in s; none if some never had.
    pub tree_ready_s: Option<f64>,
    /// The largest depth for which there was a slot; a root's is 0.
    pub deepest: u8,
    /// Differences from the description at the start.
    pub differences: Vec<String>,
    /// Cells that sent and had no route to a root at the end.
    pub unreachable: Vec<u8>,
    /// The longest time that a cell sent and had none while the loop ran, in s.
    pub longest_unreachable_s: f64,
    /// How often a cell's parent changed, by the cells' own count.
    pub parent_changes: u64,
}

/// The sensors frames of a bus' cells.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct SensorsSummary {
    /// Frames, of either page.
    pub frames: u64,
    /// Touches in them.
    pub touches: u64,
    /// Releases in them.
    pub releases: u64,
    /// Frames a second, without those that a report asked for, of the cell with the fewest; of cells that sent enough for
    /// a rate.
    pub min_hz: Option<f64>,
    /// The mean over these cells.
    pub mean_hz: Option<f64>,
    /// Of the cell with the most.
    pub max_hz: Option<f64>,
}

/// One bus.
#[derive(Clone, Debug, Default, Serialize)]
pub struct BusSummary {
    /// Its name.
    pub name: String,
    /// socketcan or embedded.
    pub kind: String,
    /// Bytes that the socket may hold.
    pub receive_buffer: usize,
    /// How often it was lost.
    pub outages: OutagesSummary,
    /// Other hosts that `vcan-setup link` joins it with.
    pub hosts: Vec<HostSummary>,
    /// Cells by status at the end.
    pub cells: BTreeMap<&'static str, usize>,
    /// Cells that were dead or were never received at the end.
    pub silent_cells: Vec<u8>,
    /// Packets from the cells.
    pub uplink: UplinkSummary,
    /// Replies of cells that answer themselves.
    pub replies: RepliesSummary,
    /// Sums, where cells answer with them.
    pub sums: Option<SumsSummary>,
    /// The network that they go along.
    pub network: Option<NetworkSummary>,
    /// Sensors frames of the cells.
    pub sensors: SensorsSummary,
    /// Epochs that some cell had to answer, and those that all answered in time.
    pub epochs_due: u64,
    /// See above.
    pub epochs_complete: u64,
    /// Packets by kind, received from others.
    pub received: BTreeMap<&'static str, u64>,
    /// Packets by kind, sent by this gateway as read back from the bus.
    pub sent: BTreeMap<&'static str, u64>,
    /// Irregular events by reason; zeros are left out.
    pub events: BTreeMap<&'static str, u64>,
    /// Frames that the bus dropped because they were not read in time.
    pub dropped_by_bus: u64,
    /// From a broadcast to its last reply in time, by the kernel's time stamps.
    pub last_reply_us: Quantiles,
    /// From a broadcast to each reply, late ones included.
    pub reply_us: Quantiles,
    /// At heartbeats, for how long joints had stood on the bus that the cell had not taken.
    pub joints_not_taken_us: Quantiles,
}

impl BusSummary {
    /// The figures of a bus whose run is over.
    #[must_use]
    pub fn new(
        name: &str,
        kind: &str,
        receive_buffer: usize,
        table: &Table,
        dropped: u64,
        now: Micros,
    ) -> Self {
        let mut cells = BTreeMap::new();
        let mut silent_cells = Vec::new();
        for (cell, status) in table.statuses(now) {
            *cells.entry(status.name()).or_default() += 1;
            if matches!(status, Status::Dead | Status::Unknown) {
                silent_cells.push(cell.node.get());
            }
        }
        let counters = table.counters();
        let kinds = |count: &dyn Fn(Kind) -> u64| {
            Kind::ALL
                .into_iter()
                .map(|kind| (kind.name(), count(kind)))
                .filter(|(_, count)| *count > 0)
                .collect()
        };
        let events = Event::ALL.into_iter().map(|event| (event.name(), counters.events(event)));
        Self {
            name: name.to_owned(),
            kind: kind.to_owned(),
            receive_buffer,
            outages: OutagesSummary::default(),
            hosts: Vec::new(),
            cells,
            silent_cells,
            uplink: uplink(table, dropped),
            replies: replies(table),
            sums: sums(table),
            network: None,
            sensors: sensors(table),
            epochs_due: counters.epochs_due,
            epochs_complete: counters.epochs_complete,
            received: kinds(&|kind| counters.received(kind)),
            sent: kinds(&|kind| counters.sent(kind)),
            events: events.filter(|(_, count)| *count > 0).collect(),
            dropped_by_bus: dropped,
            last_reply_us: Quantiles::of(table.delays().of_last_replies(), 1.0),
            reply_us: Quantiles::of(table.delays().of_replies(), 1.0),
            joints_not_taken_us: Quantiles::of(table.delays().of_joints_not_taken(), 1.0),
        }
    }
}

fn sensors(table: &Table) -> SensorsSummary {
    let sensed = || table.cells().iter().map(|cell| cell.sensed);
    let rates: Vec<f64> = sensed().filter_map(|sensed| sensed.rate_hz()).collect();
    let cells = u32::try_from(rates.len()).ok().filter(|&cells| cells > 0);
    SensorsSummary {
        frames: sensed().map(|sensed| sensed.frames).sum(),
        touches: sensed().map(|sensed| sensed.touches).sum(),
        releases: sensed().map(|sensed| sensed.releases).sum(),
        min_hz: rates.iter().copied().reduce(f64::min),
        mean_hz: cells.map(|cells| rates.iter().sum::<f64>() / f64::from(cells)),
        max_hz: rates.iter().copied().reduce(f64::max),
    }
}

fn uplink(table: &Table, dropped_by_bus: u64) -> UplinkSummary {
    let total = table.uplink();
    let unexplained = total.lost - total.outage;
    let dropped = unexplained.min(dropped_by_bus);
    UplinkSummary {
        sent: total.sent,
        delivered: total.delivered,
        rejected: total.rejected,
        unheard: total.unheard,
        dropped,
        backlog: 0,
        outage: total.outage,
        hosts: 0,
        unknown: unexplained - dropped,
        surplus: total.surplus,
        outsiders: total.outsiders,
        in_doubt: total.in_doubt,
        unsettled: total.unsettled,
        restarts: total.restarts,
    }
}

fn sums(table: &Table) -> Option<SumsSummary> {
    let (counts, contributions) = table.sums()?;
    let roots = table.cells().iter().filter(|cell| cell.root).count();
    Some(SumsSummary { roots, counts, contributions })
}

fn replies(table: &Table) -> RepliesSummary {
    let mut summary = RepliesSummary::default();
    table.cells().iter().for_each(|cell| summary.add(cell));
    summary
}
