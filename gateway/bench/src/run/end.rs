//! End of a bench: final reports of the cells, the recording, the summary.

use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use protocol::bus::BusKind;
use protocol::message::Message;
use protocol::skin::Cell;
use protocol::usage::eprint_line;

use super::bench::{Bench, RunBus};
use super::measured::LoopTotals;
use super::receiver::ReceiverResult;
use super::watch::MAIN_THREAD_INTERVAL;
use crate::error::RunError;
use crate::record::feed::UnrecordedCounts;
use crate::record::{Recorder, backlog};
use crate::summary::{
    BusSummary, CellSummary, LoopSummary, NetworkSummary, OutagesSummary, Summary, TimedReport,
};
use crate::view::BusView;
use model::table::{ResponseFlags, TorqueAccuracy};
use protocol::quantiles::Quantiles;
use trace::recording::account::RecordingAccount;

/// Time that cells have to send their final reports; an overloaded machine needs it.
const FINAL_REPORT_TIMEOUT: Duration = Duration::from_secs(3);

impl Bench<'_> {
    /// Runs the control loop to its end or to its failure. Returns the summary.
    pub(super) fn run_loop(mut self) -> Summary {
        let mut summary = Summary::for_unstarted_run(&self.options.skin);
        let mut measured = LoopTotals::new();
        let failure = self.control_loop(&mut summary, &mut measured).err().map(|error| error.to_string());
        let timed = self.timed_reports();
        let received = self.stop_receivers();
        summary.recording = self.finish_recording(&received);
        if failure.is_some() {
            self.print_kept_files(summary.recording.as_ref());
        }
        self.summarise(summary, &measured, &received, timed).with_verdict(failure)
    }

    /// Returns the figures of the timed buses since the start of this run, each with the name of the bus.
    fn timed_reports(&self) -> Vec<(String, TimedReport)> {
        let since_start = |bus_link: &RunBus| {
            let report = bus_link.link.request_figures()?;
            Some((bus_link.link.name.clone(), report.since(bus_link.figures_before.as_ref()?)))
        };
        self.bus_links.iter().filter_map(since_start).collect()
    }

    /// Waits until the transmit queues of timed buses are empty, so that what they still hold is not missing.
    fn wait_for_transmit_queues(&self) {
        let give_up = Instant::now() + FINAL_REPORT_TIMEOUT;
        let is_waiting = |(_, report): &(String, TimedReport)| report.waiting > 0;
        while self.timed_reports().iter().any(is_waiting) && Instant::now() < give_up {
            thread::sleep(MAIN_THREAD_INTERVAL);
        }
    }

    /// Ends a bench whose loop never started.
    pub(super) fn end_without_loop(mut self, error: RunError) -> Result<Summary, RunError> {
        let mut summary = Summary::for_unstarted_run(&self.options.skin);
        let received = self.stop_receivers();
        summary.recording = self.recorder.take().map(Recorder::discard);
        self.print_kept_files(summary.recording.as_ref());
        if error.exit_code() != 1 {
            return Err(error);
        }
        let summary = self.summarise(summary, &LoopTotals::new(), &received, Vec::new());
        Ok(summary.with_verdict(Some(error.to_string())))
    }

    /// Prints the paths of the files that contain the frames received before a failure.
    fn print_kept_files(&self, recording: Option<&RecordingAccount>) {
        if self.options.quiet {
            return;
        }
        for file in recording.into_iter().flat_map(|recording| &recording.files) {
            eprint_line(&format!(
                "{} frames received before the run ended are in {}",
                file.frames, file.path
            ));
        }
    }

    /// Waits for late replies, and requests the counters and a last heartbeat of all cells.
    pub(super) fn request_final_reports(&self, interrupted: bool) -> Result<(), RunError> {
        let two_periods = Duration::try_from_secs_f64(2.0 / self.options.skin.timing.broadcast_hz());
        thread::sleep(two_periods.unwrap_or_default());
        self.wait_for_transmit_queues();
        self.wait_until(Self::have_receivers_caught_up);
        self.send_to_all(&Message::Report)?;
        self.wait_until(|bench| {
            bench.have_receivers_caught_up() && bench.all_cells_reported(|said| said.counters)
        });
        if interrupted {
            self.send_to_all(&Message::Halt)?;
        }
        // Send the sync last, so that the count in each cell's heartbeat covers all other packets of the cell.
        self.send_to_all(&Message::Sync)?;
        self.wait_until(|bench| {
            bench.have_receivers_caught_up() && bench.all_cells_reported(|said| said.heartbeat)
        });
        Ok(())
    }

    /// Returns true if the receivers have read back all commands that this run has sent, and so all earlier frames.
    /// Lost buses are not considered.
    fn have_receivers_caught_up(&self) -> bool {
        self.bus_links.iter().all(|bus_link| {
            let read = bus_link.view.lock().map_or(u64::MAX, |view| view.commands);
            !bus_link.link.state.is_working() || read >= bus_link.link.state.commands.load(Ordering::Relaxed)
        })
    }

    /// Returns true if all ready cells on working buses have sent a report for which `said` is true.
    fn all_cells_reported(&self, said: impl Fn(&ResponseFlags) -> bool) -> bool {
        self.bus_links.iter().filter(|bus_link| bus_link.link.state.is_working()).all(|bus_link| {
            let all = |view: &BusView| view.cells.iter().all(|cell| !cell.ready || said(&cell.responded));
            bus_link.view.lock().map_or(true, |view| all(&view))
        })
    }

    /// Waits until a condition holds, but not longer than the timeout. After a timeout, the summary shows what is
    /// missing.
    fn wait_until(&self, done: impl Fn(&Self) -> bool) {
        let give_up = Instant::now() + FINAL_REPORT_TIMEOUT;
        while !done(self) && Instant::now() < give_up {
            thread::sleep(MAIN_THREAD_INTERVAL);
        }
    }

    /// Stops the receivers and returns their results, with `None` for a receiver that panicked.
    fn stop_receivers(&mut self) -> Vec<Option<ReceiverResult>> {
        self.shared.stop.store(true, Ordering::Relaxed);
        let end = |bus_link: &mut RunBus| bus_link.receiver.take().and_then(|thread| thread.join().ok());
        self.bus_links.iter_mut().map(end).collect()
    }

    /// Ends the recording after all threads have stopped queuing.
    fn finish_recording(&mut self, received: &[Option<ReceiverResult>]) -> Option<RecordingAccount> {
        let add = |all: UnrecordedCounts, one: &ReceiverResult| UnrecordedCounts {
            frames: all.frames + one.unrecorded.frames,
            epochs: all.epochs + one.unrecorded.epochs,
        };
        let unrecorded = received.iter().flatten().fold(UnrecordedCounts::default(), add);
        let ticks = self.shared.records_unrecorded.load(Ordering::Relaxed);
        self.recorder.take().map(|recorder| recorder.finish(unrecorded, ticks))
    }

    /// Adds the measured and received figures to the summary.
    fn summarise(
        &self,
        summary: Summary,
        measured: &LoopTotals,
        received: &[Option<ReceiverResult>],
        timed: Vec<(String, TimedReport)>,
    ) -> Summary {
        let backlog_dropped = backlog::dropped_packets()
            .zip(self.backlog_dropped)
            .map(|(now, before)| now.saturating_sub(before));
        let all = received.iter().flatten().map(|received| received.table.accuracy());
        let mut cells = self.cell_summaries(received);
        let mut buses = self.bus_summaries(received, backlog_dropped, measured);
        for (name, report) in timed {
            cells
                .iter_mut()
                .filter(|cell| cell.bus == name)
                .for_each(|cell| cell.attribute_refusals(&report));
            if let Some(bus) = buses.iter_mut().find(|bus| bus.name == name) {
                *bus = std::mem::take(bus).with_time(report);
                bus.replies.attribute_refusals(cells.iter().filter(|cell| cell.bus == name));
            }
        }
        Summary {
            cells,
            cell_errors: self.ended.errors(),
            halted: measured.halts.present_halt_reason().map(str::to_owned),
            halts: measured.halts.halt_summaries(),
            further_halts: measured.halts.further,
            before_halt: measured.halts.ticks_before_halt(&self.options.skin),
            first_broadcast_s: measured.first_broadcast_s.unwrap_or(f64::NAN),
            control: self.loop_summary(measured, summary.control),
            accuracy: all.fold(TorqueAccuracy::default(), TorqueAccuracy::merged),
            backlog_dropped,
            buses,
            ..summary
        }
    }

    fn loop_summary(&self, measured: &LoopTotals, summary: LoopSummary) -> LoopSummary {
        let count = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        LoopSummary {
            ticks: measured.ticks,
            ticks_skipped: measured.skipped,
            broadcasts: count(&self.shared.broadcasts),
            broadcasts_skipped: count(&self.shared.broadcasts_skipped),
            bad_cycles: measured.bad.clone(),
            late_us: Quantiles::from_histogram(&measured.late, 1e-3),
            idle_late_us: Quantiles::from_histogram(&self.idle, 1e-3),
            took_us: Quantiles::from_histogram(&measured.took, 1e-3),
            central_us: Quantiles::from_histogram(&measured.central, 1e-3),
            took_distributed_us: Quantiles::from_histogram(&measured.took_distributed, 1e-3),
            records_lost: count(&self.shared.records_lost),
            unsent: count(&self.shared.unsent),
            ..summary
        }
    }

    fn cell_summaries(&self, received: &[Option<ReceiverResult>]) -> Vec<CellSummary> {
        let skin = &self.options.skin;
        let known = |described: &Cell| {
            let ReceiverResult { table, .. } = received.get(described.bus)?.as_ref()?;
            table.cells().iter().find(|cell| cell.node == described.node)
        };
        skin.cells.iter().map(|described| CellSummary::new(skin, described, known(described))).collect()
    }

    fn bus_summaries(
        &self,
        received: &[Option<ReceiverResult>],
        backlog_dropped: Option<u64>,
        measured: &LoopTotals,
    ) -> Vec<BusSummary> {
        let summary = |(index, (bus_link, received)): (usize, (&RunBus, &Option<ReceiverResult>))| {
            let &ReceiverResult { ref table, ref outages, dropped, ended, .. } = received.as_ref()?;
            let link = &bus_link.link;
            let network = bus_link.network.as_ref().map(|network| NetworkSummary {
                tree_ready_s: network.tree_ready.map(protocol::time::Span::seconds),
                deepest: network.max_slot_depth(),
                differences: network.differences.iter().map(ToString::to_string).collect(),
                unreachable: network.unreachable_nodes().collect(),
                longest_unreachable_s: network.longest_unreachable.seconds(),
                parent_changes: table.parent_change_count(),
            });
            let outages = OutagesSummary {
                times: outages.count,
                lost_s: outages.total_lost_time(Instant::now()).as_secs_f64(),
                at_end: outages.is_ongoing(),
                ticks: measured.missing.get(index.min(31)).copied().unwrap_or(0),
            };
            let kind = link.kind.to_string();
            let summary = BusSummary::new(&link.name, &kind, link.receive_buffer, table, dropped, ended);
            let mut summary =
                BusSummary { outages, network, hosts: bus_link.hosts.host_summaries(), ..summary };
            summary.uplink.attribute_losses_to_hosts(bus_link.hosts.lost_frames());
            Some(summary)
        };
        let mut summaries: Vec<_> =
            self.bus_links.iter().zip(received).enumerate().filter_map(summary).collect();
        // The buses of the dropped packets are unknown.
        let mut backlog = backlog_dropped.unwrap_or(0);
        for summary in summaries.iter_mut().filter(|summary| summary.kind == BusKind::SocketCan.name()) {
            backlog -= summary.uplink.attribute_losses_to_backlog(backlog);
        }
        summaries
    }
}
