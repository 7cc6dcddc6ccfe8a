//! The thread that receives on one bus. It maintains the table of the bus's cells, and publishes snapshots for the
//! control loop.

use std::collections::BTreeSet;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{self, Sender};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use protocol::bus::{BusError, ReceivedFrame};
use protocol::id::{CellId, Kind};
use protocol::packet::Epoch;
use protocol::parameters::MAX_JOINTS;
use protocol::time::Micros;

use crate::bus::follow::{FollowStep, FollowedItem, Follower};
use crate::bus::link::{Outages, ReceiveEnd};
use crate::bus::realtime::wall_clock_ns;
use crate::bus::roots::RootWires;
use crate::record::feed::{EpochContacts, RecorderSender, UnrecordedCounts};
use crate::view::{BusView, CellView};
use control::cycle::turn::SharedRunState;
use model::latched::LatchedFrame;
use model::table::{BusTable, Notice, Snapshot};
use trace::capture::BusNote;

/// Interval between checks of timeouts and updates of the view, if no frame arrives.
const CHECK_INTERVAL: Duration = Duration::from_millis(20);
/// Maximum total number of cells for which the interval is [`CHECK_INTERVAL`]. With more cells the interval grows
/// proportionally, up to [`MAX_CHECK_INTERVAL`].
const CELLS_PER_CHECK_INTERVAL: usize = 1_000;
/// Maximum interval between checks of timeouts; a cell counts as dead after 600 ms.
const MAX_CHECK_INTERVAL: Duration = Duration::from_millis(100);

/// Returns the interval between checks of the timeouts while the loop runs, for a skin of `cells` cells. It grows with
/// their number, so that the checks take the same share of time for all skins.
#[must_use]
pub fn check_interval(cells: usize) -> Duration {
    let times = u32::try_from(cells / CELLS_PER_CHECK_INTERVAL).unwrap_or(u32::MAX);
    CHECK_INTERVAL.saturating_mul(times.max(1)).min(MAX_CHECK_INTERVAL)
}

/// An event that a receiver reports to the main thread immediately.
#[derive(Debug)]
pub enum BusEvent {
    /// An event of a cell, or another gateway.
    Notice(Notice),
    /// The bus is down.
    Down(BusError),
    /// The bus works again.
    Up,
    /// The bus is gone; its receiver tries to reopen it.
    Lost(BusError),
    /// The bus exists but cannot be opened.
    Refused(BusError),
}

/// The receiver of one bus.
#[derive(Debug)]
pub struct Receiver {
    /// Index of the bus in the skin.
    pub index: usize,
    /// The end of the bus that the receiver holds.
    pub receive_end: ReceiveEnd,
    /// Follower of the bus. It gathers frames for the time of a tick, because the loop reads no more often.
    pub follower: Follower,
    /// Interval between checks of timeouts and updates of the view while the loop runs.
    pub check_interval: Duration,
    /// State of the bus and its cells.
    pub table: BusTable,
    /// Snapshots for the control loop.
    pub snapshots: triple_buffer::Input<Snapshot>,
    /// Joint positions of each broadcast before they are rounded to words.
    pub positions: rtrb::Consumer<(Epoch, [f64; MAX_JOINTS])>,
    /// Queues to the recorder, if the run is recorded.
    pub outlet: Option<RecorderSender>,
    /// State shared by all threads.
    pub shared: Arc<SharedRunState>,
    /// State shown to the main thread.
    pub view: Arc<Mutex<BusView>>,
    /// Events for the main thread.
    pub events: Sender<(usize, BusEvent)>,
    /// Cells that, as the main thread has found, may have missed messages. They arrive here before the main thread
    /// sends those cells any further message.
    pub possibly_missed: mpsc::Receiver<BTreeSet<CellId>>,
}

/// Result of a receiver.
#[derive(Debug)]
pub struct ReceiverResult {
    /// Final state of the bus and its cells.
    pub table: BusTable,
    /// Number of frames that the bus dropped because they were not read in time.
    pub dropped: u64,
    /// Number of items that did not fit into the recorder's queues.
    pub unrecorded: UnrecordedCounts,
    /// Number and total duration of the bus's losses.
    pub outages: Outages,
    /// Time at which the receiver ended, for which the states of the cells hold, however long the recorder takes to
    /// finish.
    pub ended: Micros,
}

/// State of a receiver's reports to the recorder and the main thread.
#[derive(Debug, Default)]
struct ReceiverReportState {
    /// Number of dropped frames that have been reported to the recorder.
    announced: u64,
    /// Number of the latest joints whose contact states have been recorded.
    newest: Option<u64>,
    outages: Outages,
    /// Number of commands that the bus accepted before it failed, and that were not read back.
    unread: u64,
}

impl Receiver {
    /// Receives until stopped. Waits while the bus is lost, and reopens it if it is gone.
    #[must_use]
    pub fn run(mut self) -> ReceiverResult {
        crate::bus::realtime::prepare_receiver();
        let mut account = ReceiverReportState::default();
        let mut looked = Instant::now();
        while !self.shared.stop.load(Ordering::Relaxed) {
            let wait = self.present_check_interval();
            let step = self.follower.step(&mut self.receive_end, wait);
            self.handle_step(step, &mut account);
            for cells in self.possibly_missed.try_iter() {
                self.table.handle_unreachable_cells(|cell| cells.contains(&cell));
            }
            self.handle_frames();
            if self.shared.sends_to_roots.load(Ordering::Relaxed) {
                self.follower.roots.iter_mut().for_each(RootWires::start_sending);
            }
            self.forward_to_recorder(&mut account);
            if looked.elapsed() >= self.present_check_interval() {
                looked = Instant::now();
                self.refresh_view(&mut account);
            }
            self.publish_snapshot();
        }
        let ended = Micros(wall_clock_ns() / 1_000);
        self.table.finish();
        let unrecorded = self.outlet.as_mut().map_or_else(UnrecordedCounts::default, report_unrecorded_items);
        let dropped = self.follower.dropped_frames();
        ReceiverResult { table: self.table, dropped, unrecorded, outages: account.outages, ended }
    }

    /// Returns the present interval between checks of timeouts. It is short until the loop starts, because the main
    /// thread waits for the cells.
    fn present_check_interval(&self) -> Duration {
        if self.shared.broadcasts.load(Ordering::Relaxed) == 0 { CHECK_INTERVAL } else { self.check_interval }
    }

    /// Handles an outcome of a step other than frames: a change of the bus's state.
    fn handle_step(&mut self, step: FollowStep, account: &mut ReceiverReportState) {
        match step {
            FollowStep::Frames(_) => {
                if self.receive_end.mark_working() {
                    account.outages.end_outage(Instant::now());
                    self.record_bus_note(BusNote::Back);
                    self.send_event(BusEvent::Up);
                }
            }
            FollowStep::Nothing | FollowStep::Leftover(_) => {}
            FollowStep::Down(error) => self.report_bus_loss(false, BusEvent::Down(error), account),
            FollowStep::Drained => self.table.handle_bus_loss(),
            FollowStep::Gone(error) => {
                self.report_bus_loss(true, BusEvent::Lost(error), account);
                self.table.handle_bus_loss();
            }
            FollowStep::Refused(error) => self.send_event(BusEvent::Refused(error)),
        }
    }

    fn report_bus_loss(&mut self, gone: bool, bus_event: BusEvent, account: &mut ReceiverReportState) {
        if self.receive_end.mark_lost(gone) {
            account.outages.begin_outage(Instant::now());
            self.record_bus_note(BusNote::Lost);
            self.send_event(bus_event);
        }
    }

    /// Notes a state of the bus in the recording.
    fn record_bus_note(&mut self, what: BusNote) {
        if let Some(outlet) = &mut self.outlet {
            outlet.push_bus_note(wall_clock_ns(), what);
        }
    }

    /// Handles the received frames.
    fn handle_frames(&mut self) {
        self.table.set_torque_comparison(self.shared.comparing.load(Ordering::Relaxed));
        let Self { follower, table, positions: queue, outlet, .. } = self;
        follower.for_each_item(|part| match part {
            FollowedItem::Feeds(root, feeds) => table.set_root_feeds_gateway(root, feeds),
            FollowedItem::Frame(received) => {
                let at = Micros(received.at_nanos / 1_000);
                let mut positions = |epoch| take_positions(queue, epoch);
                table.handle_frame(at, received.own, &received.frame, &mut positions);
                if let Some(outlet) = outlet {
                    let ReceivedFrame { frame, at_nanos, own } = received;
                    outlet.push_frame(LatchedFrame { at_nanos, from_gateway: own, frame });
                }
            }
        });
    }

    /// Forwards drop counts and, once per epoch, contact states to the recorder.
    fn forward_to_recorder(&mut self, account: &mut ReceiverReportState) {
        let Some(outlet) = &mut self.outlet else { return };
        let dropped = self.follower.dropped_frames();
        if dropped > account.announced {
            outlet.push_dropped_frames(wall_clock_ns(), dropped - account.announced);
            account.announced = dropped;
        }
        let Some((number, epoch, at)) = self.table.newest_joints() else { return };
        if outlet.records_contacts() && account.newest.replace(number) != Some(number) {
            let cells = self.table.presumed_sensors(at).collect();
            outlet.push_contacts(EpochContacts { at_nanos: at.0 * 1_000, epoch: epoch.0, cells });
        }
    }

    fn publish_snapshot(&mut self) {
        let comparing = self.shared.comparing.load(Ordering::Relaxed);
        self.snapshots.input_buffer_mut().copy_from(self.table.snapshot(), comparing);
        self.snapshots.publish();
    }

    /// Checks timeouts, and updates the main thread's view.
    fn refresh_view(&mut self, account: &mut ReceiverReportState) {
        let now = Micros(wall_clock_ns() / 1_000);
        self.table.handle_time(now);
        let notices: Vec<_> = self.table.drain_notices().collect();
        for notice in notices {
            self.send_event(BusEvent::Notice(notice));
        }
        let cells = self.table.statuses(now).map(|(cell, status)| CellView::new(cell, status));
        let (cells, read) = (cells.collect(), self.table.counters().sent_count(Kind::Command));
        if !self.receive_end.link.state.is_working() {
            // The lost bus will not deliver the commands that it has accepted.
            account.unread =
                self.receive_end.link.state.commands.load(Ordering::Relaxed).saturating_sub(read);
        }
        let commands = read + account.unread;
        let network =
            if self.follower.roots.is_some() { self.table.observed_cells(now).collect() } else { Vec::new() };
        if let Ok(mut view) = self.view.lock() {
            *view = BusView::new(cells, commands, network);
        }
    }

    fn send_event(&self, bus_event: BusEvent) {
        // At the end of the run the main thread is gone.
        let _ = self.events.send((self.index, bus_event));
    }
}

/// Reports the items that did not fit into the queues, waiting up to 1 s until the queue has room for the report.
fn report_unrecorded_items(outlet: &mut RecorderSender) -> UnrecordedCounts {
    let give_up = Instant::now() + Duration::from_secs(1);
    while !outlet.report_unrecorded(wall_clock_ns()) && Instant::now() < give_up {
        std::thread::sleep(Duration::from_millis(1));
    }
    outlet.unrecorded_counts()
}

/// Returns the positions of an epoch's joints. Drops positions of earlier epochs, whose broadcasts were not read back.
fn take_positions(
    queue: &mut rtrb::Consumer<(Epoch, [f64; MAX_JOINTS])>,
    epoch: Epoch,
) -> Option<[f64; MAX_JOINTS]> {
    while let Ok((of, q)) = queue.pop() {
        if of == epoch {
            return Some(q);
        }
    }
    None
}
