//! The thread that receives on one bus: it keeps the table, and leaves snapshots for the tick.

use std::collections::BTreeSet;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{self, Sender};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use protocol::bus::{BusError, Received};
use protocol::id::{CellId, Kind};
use protocol::packet::Epoch;
use protocol::parameters::MAX_JOINTS;
use protocol::time::Micros;

use crate::bus::follow::{Follower, Part, Step};
use crate::bus::link::{Outages, ReceiveEnd};
use crate::bus::realtime::wall;
use crate::bus::roots::Roots;
use crate::record::feed::{Outlet, Touched, Unrecorded};
use crate::view::{CellView, View};
use control::cycle::turn::Shared;
use model::latched::Seen;
use model::table::{Notice, Snapshot, Table};
use trace::capture::BusNote;

/// How often timeouts are checked if nothing comes, and the view is renewed.
const LOOK: Duration = Duration::from_millis(20);
/// The same of so many cells on all buses together; of more it is proportionally longer, but at most [`LONGEST_LOOK`].
const CELLS_A_LOOK: usize = 1_000;
/// See [`CELLS_A_LOOK`]; a cell is dead after 600 ms.
const LONGEST_LOOK: Duration = Duration::from_millis(100);

/// How often the timeouts of a skin of so many cells are checked while the loop runs: all of them cost the same.
#[must_use]
pub fn look_at(cells: usize) -> Duration {
    let times = u32::try_from(cells / CELLS_A_LOOK).unwrap_or(u32::MAX);
    LOOK.saturating_mul(times.max(1)).min(LONGEST_LOOK)
}

/// What a receiver reports to the main thread at once.
#[derive(Debug)]
pub enum BusEvent {
    /// Of a cell, or another gateway.
    Notice(Notice),
    /// The bus does not work for now.
    Down(BusError),
    /// It works again.
    Up,
    /// The bus is gone: it has to be reopened, which its receiver tries.
    Lost(BusError),
    /// It is there and cannot be opened.
    Refused(BusError),
}

/// One bus, as its receiver sees it.
#[derive(Debug)]
pub struct Receiver {
    /// The index of this bus in the skin.
    pub index: usize,
    /// The bus.
    pub receive_end: ReceiveEnd,
    /// Follows it: frames gather for a tick, as the loop reads no more often.
    pub follower: Follower,
    /// How often timeouts are checked and the view is renewed while the loop runs.
    pub look: Duration,
    /// What is known of it.
    pub table: Table,
    /// Where snapshots go.
    pub snapshots: triple_buffer::Input<Snapshot>,
    /// Unrounded positions of the broadcasts.
    pub positions: rtrb::Consumer<(Epoch, [f64; MAX_JOINTS])>,
    /// Where everything to be recorded goes, if it is recorded.
    pub outlet: Option<Outlet>,
    /// What all threads share.
    pub shared: Arc<Shared>,
    /// What the main thread sees.
    pub view: Arc<Mutex<View>>,
    /// What is reported to it at once.
    pub bus_event: Sender<(usize, BusEvent)>,
    /// Cells that it says were not reached, before it sends them anything again.
    pub in_doubt: mpsc::Receiver<BTreeSet<CellId>>,
}

/// The result of a receiver.
#[derive(Debug)]
pub struct ReceiverResult {
    /// All that is known of the bus.
    pub table: Table,
    /// Frames that the bus dropped because they were not read in time.
    pub dropped: u64,
    /// What did not fit into the recorder's queues.
    pub unrecorded: Unrecorded,
    /// How often the bus was lost, and for how long.
    pub outages: Outages,
    /// When it ended: what its cells are is of then, however long a recording takes to be complete.
    pub ended: Micros,
}

/// What was reported of a bus so far.
#[derive(Debug, Default)]
struct Account {
    /// Dropped frames that the recorder knows of.
    announced: u64,
    /// The newest joints whose contact states the recorder has.
    newest: Option<u64>,
    outages: Outages,
    /// Commands that the bus took and did not carry, because it was lost.
    unread: u64,
}

impl Receiver {
    /// Receives until it is stopped. A lost bus is waited for, and reopened if it is gone.
    #[must_use]
    pub fn run(mut self) -> ReceiverResult {
        crate::bus::realtime::prepare_receiver();
        let mut account = Account::default();
        let mut looked = Instant::now();
        while !self.shared.stop.load(Ordering::Relaxed) {
            let wait = self.look_now();
            let step = self.follower.step(&mut self.receive_end, wait);
            self.take(step, &mut account);
            for cells in self.in_doubt.try_iter() {
                self.table.interrupt_cells(|cell| cells.contains(&cell));
            }
            self.hear();
            if self.shared.explore.load(Ordering::Relaxed) {
                self.follower.roots.iter_mut().for_each(Roots::explore);
            }
            self.record(&mut account);
            if looked.elapsed() >= self.look_now() {
                looked = Instant::now();
                self.look(&mut account);
            }
            self.publish();
        }
        let ended = Micros(wall() / 1_000);
        self.table.finish();
        let unrecorded = self.outlet.as_mut().map_or_else(Unrecorded::default, last_words);
        let dropped = self.follower.dropped();
        ReceiverResult { table: self.table, dropped, unrecorded, outages: account.outages, ended }
    }

    /// How often to look now: until the loop begins the main thread waits for what cells say.
    fn look_now(&self) -> Duration {
        if self.shared.broadcasts.load(Ordering::Relaxed) == 0 { LOOK } else { self.look }
    }

    /// Notes and reports what a step says of the bus itself.
    fn take(&mut self, step: Step, account: &mut Account) {
        match step {
            Step::Frames(_) => {
                if self.receive_end.regain() {
                    account.outages.end(Instant::now());
                    self.note(BusNote::Back);
                    self.tell(BusEvent::Up);
                }
            }
            Step::Nothing | Step::Leftover(_) => {}
            Step::Down(error) => self.lose(false, BusEvent::Down(error), account),
            Step::Drained => self.table.interrupt(),
            Step::Gone(error) => {
                self.lose(true, BusEvent::Lost(error), account);
                self.table.interrupt();
            }
            Step::Refused(error) => self.tell(BusEvent::Refused(error)),
        }
    }

    fn lose(&mut self, gone: bool, bus_event: BusEvent, account: &mut Account) {
        if self.receive_end.lose(gone) {
            account.outages.begin(Instant::now());
            self.note(BusNote::Lost);
            self.tell(bus_event);
        }
    }

    /// Notes in the recording what has become of the bus.
    fn note(&mut self, what: BusNote) {
        if let Some(outlet) = &mut self.outlet {
            outlet.bus(wall(), what);
        }
    }

    /// Takes what came.
    fn hear(&mut self) {
        self.table.set_comparing(self.shared.comparing.load(Ordering::Relaxed));
        let Self { follower, table, positions: queue, outlet, .. } = self;
        follower.parts(|part| match part {
            Part::Feeds(root, feeds) => table.set_feeds(root, feeds),
            Part::Frame(received) => {
                let at = Micros(received.at_nanos / 1_000);
                let mut positions = |epoch| positions_of(queue, epoch);
                table.handle_frame(at, received.own, &received.frame, &mut positions);
                if let Some(outlet) = outlet {
                    let Received { frame, at_nanos, own } = received;
                    outlet.frame(Seen { at_nanos, own, frame });
                }
            }
        });
    }

    /// Hands on what is no frame: what the bus dropped, and once an epoch the contact states.
    fn record(&mut self, account: &mut Account) {
        let Some(outlet) = &mut self.outlet else { return };
        let dropped = self.follower.dropped();
        if dropped > account.announced {
            outlet.dropped(wall(), dropped - account.announced);
            account.announced = dropped;
        }
        let Some((number, epoch, at)) = self.table.newest() else { return };
        if outlet.wants_touched() && account.newest.replace(number) != Some(number) {
            let cells = self.table.sensors(at).collect();
            outlet.touched(Touched { at_nanos: at.0 * 1_000, epoch: epoch.0, cells });
        }
    }

    fn publish(&mut self) {
        let comparing = self.shared.comparing.load(Ordering::Relaxed);
        self.snapshots.input_buffer_mut().take(self.table.snapshot(), comparing);
        self.snapshots.publish();
    }

    /// Checks timeouts, and renews the main thread's view.
    fn look(&mut self, account: &mut Account) {
        let now = Micros(wall() / 1_000);
        self.table.handle_time(now);
        let notices: Vec<_> = self.table.notices().collect();
        for notice in notices {
            self.tell(BusEvent::Notice(notice));
        }
        let cells = self.table.statuses(now).map(|(cell, status)| CellView::of(cell, status));
        let (cells, read) = (cells.collect(), self.table.counters().sent(Kind::Command));
        if !self.receive_end.link.state.is_there() {
            // What it took and has not carried by now it will not carry.
            account.unread =
                self.receive_end.link.state.commands.load(Ordering::Relaxed).saturating_sub(read);
        }
        let commands = read + account.unread;
        let network =
            if self.follower.roots.is_some() { self.table.network(now).collect() } else { Vec::new() };
        if let Ok(mut view) = self.view.lock() {
            *view = View::new(cells, commands, network);
        }
    }

    fn tell(&self, bus_event: BusEvent) {
        // At the end of the run there is no receiver any more.
        let _ = self.bus_event.send((self.index, bus_event));
    }
}

/// Reports what did not fit; the recorder makes room as long as a receiver runs.
fn last_words(outlet: &mut Outlet) -> Unrecorded {
    let give_up = Instant::now() + Duration::from_secs(1);
    while !outlet.tell(wall()) && Instant::now() < give_up {
        std::thread::sleep(Duration::from_millis(1));
    }
    outlet.unrecorded()
}

/// The positions of an epoch; those of earlier ones, whose broadcast was not read back, are dropped.
fn positions_of(
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
