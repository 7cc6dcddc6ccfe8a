//! Commissioning of the buses of a skin, each in a thread of its own: clocks and sockets around [`Commission`], which
//! makes all decisions.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, ScopedJoinHandle};
use std::time::{Duration, Instant};

use model::commission::{Commission, CommissionOptions, Progress, Report};
use model::decode::Decoded;
use protocol::bus::{BusError, BusOptions, Filter, GATEWAY_RECEIVE_BUFFER_BYTES, KindChoices};
use protocol::can::Format;
use protocol::id::{Command, Id, Kind};
use protocol::skin::Skin;
use protocol::time::Micros;

use crate::bus::listen::{self, Listener, send_message, tolerate_transient_error};
use crate::bus::roots::RootWires;

/// Maximum time between two checks for a signal.
const POLL_TIMEOUT: Duration = Duration::from_millis(50);
/// Interval between progress reports.
const PROGRESS_INTERVAL: Duration = Duration::from_millis(20);
/// Pause while an interface is down.
const INTERFACE_DOWN_PAUSE: Duration = Duration::from_millis(20);
/// Bytes that the kernel counts in a socket's buffer for each waiting frame.
const SOCKET_BYTES_PER_FRAME: usize = 1_024;

/// An open bus whose cells are to be commissioned.
#[derive(Debug)]
pub struct BusCommissioner {
    index: usize,
    listener: Listener,
    format: Format,
    /// Wires to the roots of a network, whose cells may have no node ids yet.
    roots: Option<RootWires>,
}

/// The result of commissioning a bus.
#[derive(Debug)]
pub struct CommissionedBus {
    /// Name of the bus.
    pub name: String,
    /// Kind of the bus.
    pub kind: String,
    /// Results of the cells.
    pub report: Report,
    /// Reason for an early end: another gateway is on the bus, or the bus is gone.
    pub failure: Option<String>,
    /// Number of frames lost because they arrived faster than they were read.
    pub dropped: u32,
}

/// Opens a bus of a skin for commissioning.
///
/// # Errors
/// Returns [`BusError`] if the bus cannot be opened.
pub fn open(skin: &Skin, index: usize, kinds: &KindChoices) -> Result<BusCommissioner, BusError> {
    let described = skin.buses.get(index);
    let (name, format) = described.map_or(("", Format::Fd), |bus| (bus.name.as_str(), bus.format));
    let mut roots = RootWires::for_bus(skin, index);
    // Start the wires before the first frame arrives, so that no message of a root is missed.
    roots.iter_mut().for_each(RootWires::start_sending);
    let mut filters = [Kind::Network, Kind::Configure, Kind::Configured].map(Filter::for_kind).to_vec();
    filters.push(Filter::exact(Id::command(Command::Joints)));
    filters.extend(roots.iter().flat_map(RootWires::filters));
    let receive_buffer = GATEWAY_RECEIVE_BUFFER_BYTES as usize;
    let options = BusOptions { filters, receive_buffer, ..BusOptions::default() };
    let bus = listen::open_bus(name, kinds.kind_of(name), Some(format), options)?;
    if roots.is_some() && !bus.is_virtual()? {
        // Real cells have real wires; do not simulate wires among them.
        roots = None;
    }
    Ok(BusCommissioner { index, listener: Listener::new(bus, Some(format)), format, roots })
}

/// Commissions the cells of all buses until done or stopped, and shows the progress.
pub fn commission(
    benches: Vec<BusCommissioner>,
    skin: &Skin,
    wish: CommissionOptions,
    stopped: &AtomicBool,
    mut show: impl FnMut(&[Progress]),
) -> Vec<CommissionedBus> {
    let progress_by_bus = Mutex::new(vec![None; benches.len()]);
    let waiting: Vec<_> = benches.into_iter().map(|bench| Mutex::new(Some(bench))).collect();
    let work = |(place, bench): (usize, &Mutex<Option<BusCommissioner>>)| {
        let bench = bench.lock().ok()?.take()?;
        Some(bench.commission_cells(skin, wish, stopped, |progress| {
            if let Some(own) = progress_by_bus.lock().ok().as_mut().and_then(|far| far.get_mut(place)) {
                *own = Some(progress);
            }
        }))
    };
    thread::scope(|scope| {
        let start = |bench| thread::Builder::new().spawn_scoped(scope, move || work(bench)).ok();
        let started: Vec<_> = waiting.iter().enumerate().map(|bench| (bench, start(bench))).collect();
        // If the system grants no thread, commission the bus in this thread.
        let here = |(bench, thread)| match thread {
            Some(thread) => (Some(thread), None),
            None => (None, work(bench)),
        };
        let threads: Vec<_> = started.into_iter().map(here).collect();
        let is_busy = |(thread, _): &(Option<ScopedJoinHandle<'_, _>>, _)| {
            thread.as_ref().is_some_and(|thread| !thread.is_finished())
        };
        while threads.iter().any(is_busy) {
            let now: Vec<Progress> =
                progress_by_bus.lock().map(|far| far.iter().copied().flatten().collect()).unwrap_or_default();
            if !now.is_empty() {
                show(&now);
            }
            thread::sleep(PROGRESS_INTERVAL);
        }
        threads.into_iter().filter_map(|(thread, done)| done.or_else(|| thread?.join().ok()?)).collect()
    })
}

impl BusCommissioner {
    /// Commissions the cells of the bus until done or stopped, and reports the progress.
    fn commission_cells(
        mut self,
        skin: &Skin,
        wish: CommissionOptions,
        stopped: &AtomicBool,
        tell: impl FnMut(Progress),
    ) -> CommissionedBus {
        let frames = match self.format {
            Format::Fd => 1,
            Format::Classic => 2,
        };
        let room = self
            .listener
            .bus()
            .receive_buffer_bytes()
            .checked_div(SOCKET_BYTES_PER_FRAME * frames)
            .unwrap_or(0);
        let began = Instant::now();
        let clock = || Micros::from_elapsed(began.elapsed());
        let mut commission = Commission::new(skin, self.index, wish, room, clock());
        let lost = self.exchange_messages(&mut commission, &clock, stopped, tell).err();
        if lost.is_some() {
            commission.stop();
        }
        let bus = self.listener.bus();
        let report = commission.report();
        let trouble = report.trouble.map(|trouble| trouble.describe(bus.name()));
        CommissionedBus {
            name: bus.name().to_owned(),
            kind: bus.kind().to_string(),
            report,
            failure: lost.map(|lost| lost.to_string()).or(trouble),
            dropped: self.listener.dropped_frames(),
        }
    }

    fn exchange_messages(
        &mut self,
        commission: &mut Commission,
        clock: &impl Fn() -> Micros,
        stopped: &AtomicBool,
        mut on_progress: impl FnMut(Progress),
    ) -> Result<(), BusError> {
        let Self { listener, roots, format, .. } = self;
        loop {
            if stopped.load(Ordering::Relaxed) {
                commission.stop();
            }
            commission.handle_time(clock());
            on_progress(commission.progress());
            if let Some(roots) = roots.as_mut().filter(|_| commission.may_send()) {
                roots.send_due_messages(listener.bus());
            }
            while let Some(message) = commission.poll_transmit() {
                // A packet that was not sent gets no answer, and is sent again.
                tolerate_transient_error(
                    send_message(listener.bus(), &message, *format),
                    INTERFACE_DOWN_PAUSE,
                )?;
            }
            let Some(next) = commission.poll_timeout() else { return Ok(()) };
            let quiet = roots
                .as_ref()
                .filter(|_| commission.may_send())
                .map_or(POLL_TIMEOUT, RootWires::next_message_timeout);
            let wait = Duration::from_micros(next.elapsed_since(clock()).0).min(quiet).min(POLL_TIMEOUT);
            tolerate_transient_error(listener.receive(wait), INTERFACE_DOWN_PAUSE)?;
            for (received, decoded) in listener.decoded_frames() {
                if roots.as_mut().is_some_and(|roots| roots.handle_frame(&received.frame)) {
                    continue;
                }
                if let Decoded::Message(message) = decoded {
                    commission.handle_message(clock(), &message);
                }
            }
        }
    }
}
