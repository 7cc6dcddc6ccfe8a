//! Result of a run: the figures of the final table and of `--summary`.
//!
//! The JSON keys are the field names; `docs/reference/summary.md` explains them.

use std::collections::BTreeMap;

use protocol::id::Kind;
use protocol::skin::Skin;
use protocol::time::Micros;
use serde::Serialize;

pub use self::cells::{CellSummary, RepliesSummary};
pub use self::outcome::{CellError, ErrorCells, HaltSummary, Outcome, TickSummary, cells_in_error};
pub use self::uplink::UplinkSummary;
pub(crate) use self::verdict::count_noun;
pub use self::verdict::{MAX_CELL_ERROR_NM, Verdict};
use model::table::{BusTable, CellStatus, Contributions, FrameEvent, SumCounts, TorqueAccuracy};
use protocol::quantiles::Quantiles;
pub use trace::recording::account::{RecordingAccount, WrittenFile};
pub use vcan_setup::embedded::TimedReport;

mod cells;
mod outcome;
mod timed;
mod uplink;
mod verdict;

/// Summary of a run.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Summary {
    /// Name of the skin.
    pub skin: String,
    /// Verdict on the run: all is well, or a list of findings.
    pub verdict: Verdict,
    /// Summary of each cell of the skin, in the order of the skin.
    pub cells: Vec<CellSummary>,
    /// Outcome of the run.
    pub outcome: Outcome,
    /// Reason of the failure, if any.
    pub failure: Option<String>,
    /// Duration of the loop in s.
    pub duration_s: f64,
    /// True if a signal ended the run.
    pub interrupted: bool,
    /// Reason for the halt that lasted to the end of the run, if any.
    pub halted: Option<String>,
    /// All halts, oldest first.
    pub halts: Vec<HaltSummary>,
    /// Number of ended halts beyond the first 100.
    pub further_halts: u64,
    /// Ticks up to the last halt, oldest first.
    pub before_halt: Vec<TickSummary>,
    /// Reason why the external controller counts as absent, if it does. It is `None` if the robot was halted.
    pub no_controller: Option<String>,
    /// Errors that ended processes of cells.
    pub cell_errors: Vec<CellError>,
    /// Time from the start of the program to the first broadcast in s.
    pub first_broadcast_s: f64,
    /// Figures of the control loop.
    #[serde(rename = "loop")]
    pub control: LoopSummary,
    /// Distributed torques compared with central ones.
    pub accuracy: TorqueAccuracy,
    /// Number of packets that the kernel dropped before a socket because a processor's backlog was full, over the whole
    /// machine and all interfaces; `None` if the kernel does not report it.
    pub backlog_dropped: Option<u64>,
    /// Summary of each bus.
    pub buses: Vec<BusSummary>,
    /// Processor use during the loop in cores.
    pub processor: ProcessorUse,
    /// Private memory of the processes.
    #[serde(flatten)]
    pub memory: PrivateMemory,
    /// Summary of the recording, if any.
    pub recording: Option<RecordingAccount>,
}

impl Summary {
    /// Creates an empty summary, for a run that has not started.
    #[must_use]
    pub fn for_unstarted_run(skin: &Skin) -> Self {
        Self {
            skin: skin.name.clone(),
            cells: skin.cells.iter().map(|cell| CellSummary::new(skin, cell, None)).collect(),
            first_broadcast_s: f64::NAN,
            ..Self::default()
        }
    }

    /// Creates the summary of a run that failed before any bus was opened.
    #[must_use]
    pub fn for_failed_start(skin: &Skin, why: String) -> Self {
        Self::for_unstarted_run(skin).with_verdict(Some(why))
    }

    /// Sets the outcome and the verdict according to the other figures. `failure` is the reason why the run ended
    /// early, if it did.
    #[must_use]
    pub fn with_verdict(mut self, failure: Option<String>) -> Self {
        // A lost bus may have caused the halt, but the halt is the more precise outcome.
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
        self.verdict = Verdict::new(&self);
        self
    }

    /// Returns the messages about the end of the run, one line each, or none if all is well. The last one is the reason
    /// of the exit code. Reasons of cells' errors are repeated only if `quiet`, because they have been printed
    /// otherwise.
    #[must_use]
    pub fn end_messages(&self, quiet: bool) -> Vec<String> {
        // The error of a failed run names the lost bus.
        let came_to_its_end = self.failure.is_none() || self.failure == self.lost_frames();
        let lost = self.lost_buses().filter(|_| came_to_its_end);
        let halted = self.halts.last().filter(|_| self.halted.is_some()).map(|halted| {
            let HaltSummary { at_s, epoch, reason, .. } = halted;
            format!(
                "the robot was halted at {at_s:.3} s (epoch {epoch}) and not resumed: {reason}; --summary FILE saves \
                 the ticks before the halt"
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
        (!lost.is_empty()).then(|| format!("these buses did not work when the run ended: {}", names()))
    }

    fn lost_frames(&self) -> Option<String> {
        let RecordingAccount { errors, lost_write, files, .. } = self.recording.as_ref()?;
        let first = errors.first().map_or("", String::as_str);
        let parts = files.iter().map(|file| &file.path).filter(|path| path.ends_with(".part"));
        // The error of an unfinished file already says how to recover it.
        let hint = |path: &String| match errors.iter().find(|error| error.contains(path.as_str())) {
            Some(error) if error == first => String::new(),
            Some(error) => format!("; {error}"),
            None => format!("; the recorded part is in {path}: repair it with `skinbus recover {path}`"),
        };
        let parts: String = parts.map(hint).collect();
        (!errors.is_empty() || *lost_write > 0).then(|| match lost_write {
            0 => format!("the recording has an error: {first}{parts}"),
            _ => format!("the recording is incomplete: {lost_write} frames were not written: {first}{parts}"),
        })
    }
}

/// Figures of the control loop.
#[derive(Clone, Debug, Default, Serialize)]
pub struct LoopSummary {
    /// Number of executed ticks.
    pub ticks: u64,
    /// Number of ticks skipped because the machine was late.
    pub ticks_skipped: u64,
    /// Number of broadcasts sent.
    pub broadcasts: u64,
    /// Number of broadcasts that were skipped together with their ticks.
    pub broadcasts_skipped: u64,
    /// Number of bad cycles by reason.
    pub bad_cycles: BTreeMap<String, u64>,
    /// Counts of an external controller's datagrams by outcome; empty for other controllers.
    pub controller: BTreeMap<String, u64>,
    /// Lateness of the ticks in µs.
    pub late_us: Quantiles,
    /// Wake-up lateness of the idle machine in µs.
    pub idle_late_us: Quantiles,
    /// Duration of the ticks in µs.
    pub took_us: Quantiles,
    /// Duration of the central computation in µs, over ticks that compared it with the distributed torques.
    pub central_us: Quantiles,
    /// Duration in µs of ticks without this comparison.
    pub took_distributed_us: Quantiles,
    /// True if the machine granted SCHED_FIFO.
    pub fifo: bool,
    /// True if the memory was locked.
    pub memory_locked: bool,
    /// Number of tick records that did not fit into their queue.
    pub records_lost: u64,
    /// Number of frames that a bus refused.
    pub unsent: u64,
}

/// Processor use during the loop in cores.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct ProcessorUse {
    /// Processor use of this program.
    pub gateway: f64,
    /// Processor use of all cell processes together.
    pub cells: f64,
    /// Processor use of all servers of embedded buses together.
    pub buses: f64,
}

/// Private memory in KiB.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct PrivateMemory {
    /// Memory of the largest cell process, if the run started cells.
    pub cell_private_kib: Option<u64>,
    /// Memory of this program at the end of the loop.
    pub gateway_private_kib: Option<u64>,
    /// Memory of all bus servers that the run started, if any.
    pub buses_private_kib: Option<u64>,
}

/// Sums that were received along the cells' tree.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct SumsSummary {
    /// Number of cells wired to the gateway's side.
    pub roots: usize,
    /// Received sums by what became of them: received = first + resent + overheard + stale.
    #[serde(flatten)]
    pub counts: SumCounts,
    /// Contributions that cells in contact had to make to sums: due = in time + late + missing.
    pub contributions: Contributions,
}

/// Number and duration of a bus's losses.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct OutagesSummary {
    /// Number of losses.
    pub times: u64,
    /// Total duration of the losses in s, each from its detection to the first frame after it.
    pub lost_s: f64,
    /// True if the bus was lost when the run ended.
    pub at_end: bool,
    /// Number of ticks without data from the bus.
    pub ticks: u64,
}

/// Another host connected to the bus.
#[derive(Clone, Debug, Default, Serialize)]
pub struct HostSummary {
    /// Name of the host.
    pub name: String,
    /// Number of cells that sent from this host.
    pub cells: usize,
    /// Number of times that the host was gone or unreachable.
    pub gone: u64,
    /// Total time in s for which the host was gone or unreachable.
    pub gone_s: f64,
    /// True if the host was reachable at the end.
    pub at_end: bool,
    /// Number of frames lost from the host to this one.
    pub lost_from: u64,
    /// Number of frames lost from this host to the other, as the other reports.
    pub lost_to: u64,
}

/// The network of a bus's cells.
#[derive(Clone, Debug, Default, Serialize)]
pub struct NetworkSummary {
    /// Time in s from the moment when all cells were ready until all had a route to a root; `None` if some never had
    /// one.
    pub tree_ready_s: Option<f64>,
    /// Largest depth that had a slot; a root has depth 0.
    pub deepest: u8,
    /// Differences from the description at the start.
    pub differences: Vec<String>,
    /// Cells that sent and had no route to a root at the end.
    pub unreachable: Vec<u8>,
    /// Longest time in s for which a cell sent but had no route to a root, while the loop ran.
    pub longest_unreachable_s: f64,
    /// Number of parent changes, by the cells' own count.
    pub parent_changes: u64,
}

/// Sensor frames of a bus's cells.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct SensorsSummary {
    /// Number of frames of both pages.
    pub frames: u64,
    /// Number of touches that the frames report.
    pub touches: u64,
    /// Number of releases that the frames report.
    pub releases: u64,
    /// Rate in Hz of the slowest cell. Frames that a report requested are not counted, and cells that sent too few
    /// frames for a rate are left out.
    pub min_hz: Option<f64>,
    /// Mean rate of these cells in Hz.
    pub mean_hz: Option<f64>,
    /// Rate in Hz of the fastest cell.
    pub max_hz: Option<f64>,
}

/// Summary of one bus.
#[derive(Clone, Debug, Default, Serialize)]
pub struct BusSummary {
    /// Name of the bus.
    pub name: String,
    /// Kind of the bus: the name of a [`protocol::bus::BusKind`].
    pub kind: String,
    /// Size of the socket's receive buffer in bytes.
    pub receive_buffer: usize,
    /// Losses of the bus.
    pub outages: OutagesSummary,
    /// Other hosts that `vcan-setup link` connects to the bus.
    pub hosts: Vec<HostSummary>,
    /// Number of cells by status at the end.
    pub cells: BTreeMap<&'static str, usize>,
    /// Cells that were dead at the end, or from which no packet was received.
    pub silent_cells: Vec<u8>,
    /// Figures of a timed bus.
    pub timed: Option<TimedReport>,
    /// Packets from the cells.
    pub uplink: UplinkSummary,
    /// Replies of cells that answer with their own torques.
    pub replies: RepliesSummary,
    /// Sums, if cells answer with them.
    pub sums: Option<SumsSummary>,
    /// Network that carries the sums.
    pub network: Option<NetworkSummary>,
    /// Sensor frames of the cells.
    pub sensors: SensorsSummary,
    /// Number of epochs that some cell had to answer.
    pub epochs_due: u64,
    /// Number of epochs that all cells answered in time.
    pub epochs_complete: u64,
    /// Packets received from other senders, by kind.
    pub received: BTreeMap<&'static str, u64>,
    /// Packets sent by this gateway, as read back from the bus, by kind.
    pub sent: BTreeMap<&'static str, u64>,
    /// Number of irregular events by reason, without zeros.
    pub events: BTreeMap<&'static str, u64>,
    /// Number of frames that the bus dropped because they were not read in time.
    pub dropped_by_bus: u64,
    /// Time in µs from a broadcast to its last reply in time, by the kernel's time stamps.
    pub last_reply_us: Quantiles,
    /// Upper bound of `skinbus fit` for this time in µs, on a timed bus; `None` without one.
    pub last_reply_bound_us: Option<f64>,
    /// Time in µs from a broadcast to each of its replies, including late ones.
    pub reply_us: Quantiles,
    /// Age in µs, at each heartbeat, of joints that were on the bus and that the cell had not received.
    pub joints_not_taken_us: Quantiles,
}

impl BusSummary {
    /// Creates the summary of a bus after its run.
    #[must_use]
    pub fn new(
        name: &str,
        kind: &str,
        receive_buffer: usize,
        table: &BusTable,
        dropped: u64,
        now: Micros,
    ) -> Self {
        let mut cells = BTreeMap::new();
        let mut silent_cells = Vec::new();
        for (cell, status) in table.statuses(now) {
            *cells.entry(status.name()).or_default() += 1;
            if matches!(status, CellStatus::Dead | CellStatus::Unknown) {
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
        let events = FrameEvent::ALL.into_iter().map(|event| (event.name(), counters.event_count(event)));
        Self {
            name: name.to_owned(),
            kind: kind.to_owned(),
            receive_buffer,
            outages: OutagesSummary::default(),
            hosts: Vec::new(),
            cells,
            silent_cells,
            timed: None,
            uplink: UplinkSummary::new(table, dropped),
            replies: replies(table),
            sums: sums(table),
            network: None,
            sensors: sensors(table),
            epochs_due: counters.epochs_due,
            epochs_complete: counters.epochs_complete,
            received: kinds(&|kind| counters.received_count(kind)),
            sent: kinds(&|kind| counters.sent_count(kind)),
            events: events.filter(|(_, count)| *count > 0).collect(),
            dropped_by_bus: dropped,
            last_reply_us: Quantiles::from_histogram(table.delays().last_reply_delays(), 1.0),
            last_reply_bound_us: None,
            reply_us: Quantiles::from_histogram(table.delays().reply_delays(), 1.0),
            joints_not_taken_us: Quantiles::from_histogram(table.delays().pending_joints_ages(), 1.0),
        }
    }
}

fn sensors(table: &BusTable) -> SensorsSummary {
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

fn sums(table: &BusTable) -> Option<SumsSummary> {
    let (counts, contributions) = table.sum_counts()?;
    let roots = table.cells().iter().filter(|cell| cell.root).count();
    Some(SumsSummary { roots, counts, contributions })
}

fn replies(table: &BusTable) -> RepliesSummary {
    let mut summary = RepliesSummary::default();
    table.cells().iter().for_each(|cell| summary.add_replies_of(cell));
    summary
}
