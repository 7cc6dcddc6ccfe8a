//! Commissioning of the buses of a skin, each in a thread of its own: clocks and sockets around [`Commission`], which
//! makes all decisions.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, ScopedJoinHandle};
use std::time::{Duration, Instant};

use model::commission::{Commission, Progress, Report, Wish};
use model::decode::Decoded;
use protocol::bus::{BusError, Filter, GATEWAY_RECEIVE_BUFFER, Kinds, Options};
use protocol::can::Format;
use protocol::id::{Command, Id, Kind};
use protocol::skin::Skin;
use protocol::time::Micros;

use crate::bus::listen::{self, Listener, passing, send};
use crate::bus::roots::Roots;

/// Longest time without a check for a signal.
const LOOK: Duration = Duration::from_millis(50);
/// Interval between progress reports.
const TELL: Duration = Duration::from_millis(20);
/// Pause while an interface is down.
const DOWN: Duration = Duration::from_millis(20);
/// Bytes that the kernel counts in a socket's buffer for each waiting frame.
const FRAME_BYTES: usize = 1_024;

/// An open bus whose cells are to be commissioned.
#[derive(Debug)]
pub struct Bench {
    index: usize,
    listener: Listener,
    format: Format,
    /// Wires to the roots of a network, whose cells may have no node ids yet.
    roots: Option<Roots>,
}

/// The result of commissioning a bus.
#[derive(Debug)]
pub struct Done {
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
pub fn open(skin: &Skin, index: usize, kinds: &Kinds) -> Result<Bench, BusError> {
    let described = skin.buses.get(index);
    let (name, format) = described.map_or(("", Format::Fd), |bus| (bus.name.as_str(), bus.format));
    let mut roots = Roots::of(skin, index);
    // The roots' messages are received from the beginning.
    roots.iter_mut().for_each(Roots::explore);
    let mut filters = [Kind::Network, Kind::Configure, Kind::Configured].map(Filter::kind).to_vec();
    filters.push(Filter::exact(Id::command(Command::Joints)));
    filters.extend(roots.iter().flat_map(Roots::filters));
    let receive_buffer = GATEWAY_RECEIVE_BUFFER as usize;
    let options = Options { filters, receive_buffer, ..Options::default() };
    let bus = listen::open(name, kinds.of(name), Some(format), options)?;
    if roots.is_some() && !bus.is_virtual()? {
        // Real cells have real wires; do not simulate wires among them.
        roots = None;
    }
    Ok(Bench { index, listener: Listener::new(bus, Some(format)), format, roots })
}

/// Commissions the cells of all buses until done or stopped, and shows the progress.
pub fn commission(
    benches: Vec<Bench>,
    skin: &Skin,
    wish: Wish,
    stopped: &AtomicBool,
    mut show: impl FnMut(&[Progress]),
) -> Vec<Done> {
    let far = Mutex::new(vec![None; benches.len()]);
    let waiting: Vec<_> = benches.into_iter().map(|bench| Mutex::new(Some(bench))).collect();
    let work = |(place, bench): (usize, &Mutex<Option<Bench>>)| {
        let bench = bench.lock().ok()?.take()?;
        Some(bench.work(skin, wish, stopped, |progress| {
            if let Some(own) = far.lock().ok().as_mut().and_then(|far| far.get_mut(place)) {
                *own = Some(progress);
            }
        }))
    };
    thread::scope(|scope| {
        let start = |bench| thread::Builder::new().spawn_scoped(scope, move || work(bench)).ok();
        let started: Vec<_> = waiting.iter().enumerate().map(|bench| (bench, start(bench))).collect();
        // If the system grants no thread, this thread commissions the bus.
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
                far.lock().map(|far| far.iter().copied().flatten().collect()).unwrap_or_default();
            if !now.is_empty() {
                show(&now);
            }
            thread::sleep(TELL);
        }
        threads.into_iter().filter_map(|(thread, done)| done.or_else(|| thread?.join().ok()?)).collect()
    })
}

impl Bench {
    /// Commissions the cells of the bus until done or stopped, and reports the progress.
    fn work(mut self, skin: &Skin, wish: Wish, stopped: &AtomicBool, tell: impl FnMut(Progress)) -> Done {
        let frames = match self.format {
            Format::Fd => 1,
            Format::Classic => 2,
        };
        let room = self.listener.bus().receive_buffer().checked_div(FRAME_BYTES * frames).unwrap_or(0);
        let began = Instant::now();
        let clock = || Micros::after(began.elapsed());
        let mut commission = Commission::new(skin, self.index, wish, room, clock());
        let lost = self.converse(&mut commission, &clock, stopped, tell).err();
        if lost.is_some() {
            commission.stop();
        }
        let bus = self.listener.bus();
        let report = commission.report();
        let trouble = report.trouble.map(|trouble| trouble.on(bus.name()));
        Done {
            name: bus.name().to_owned(),
            kind: bus.kind().to_string(),
            report,
            failure: lost.map(|lost| lost.to_string()).or(trouble),
            dropped: self.listener.dropped(),
        }
    }

    fn converse(
        &mut self,
        commission: &mut Commission,
        clock: &impl Fn() -> Micros,
        stopped: &AtomicBool,
        mut tell: impl FnMut(Progress),
    ) -> Result<(), BusError> {
        let Self { listener, roots, format, .. } = self;
        loop {
            if stopped.load(Ordering::Relaxed) {
                commission.stop();
            }
            commission.handle_time(clock());
            tell(commission.progress());
            if let Some(roots) = roots.as_mut().filter(|_| commission.speaks()) {
                roots.speak(listener.bus());
            }
            while let Some(message) = commission.poll_transmit() {
                // A packet that was not sent gets no answer, and is sent again.
                passing(send(listener.bus(), &message, *format), DOWN)?;
            }
            let Some(next) = commission.poll_timeout() else { return Ok(()) };
            let quiet = roots.as_ref().filter(|_| commission.speaks()).map_or(LOOK, Roots::timeout);
            let wait = Duration::from_micros(next.since(clock()).0).min(quiet).min(LOOK);
            passing(listener.hear(wait), DOWN)?;
            for (received, decoded) in listener.decoded() {
                if roots.as_mut().is_some_and(|roots| roots.take(&received.frame)) {
                    continue;
                }
                if let Decoded::Message(message) = decoded {
                    commission.handle_message(clock(), &message);
                }
            }
        }
    }
}
