//! Commissioning the buses of a skin, each by a thread of its own: clocks and sockets. It decides nothing.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use model::commission::{Commission, Progress, Report, Wish};
use model::decode::Decoded;
use model::network::Uplinks;
use protocol::bus::{BusError, Filter, GATEWAY_RECEIVE_BUFFER, Kinds, Options};
use protocol::can::{Format, Frame};
use protocol::id::{Command, Id, Kind, Node};
use protocol::message::Message;
use protocol::skin::{Reply, Skin};
use protocol::time::Micros;
use protocol::wire::Lane;

use crate::listen::{self, Listener, passing, send};

/// How long a signal to end may wait, when nothing comes.
const LOOK: Duration = Duration::from_millis(50);
/// How often it is looked how far the buses are.
const TELL: Duration = Duration::from_millis(20);
/// The pause while an interface is down.
const DOWN: Duration = Duration::from_millis(20);
/// Bytes that a waiting frame takes in a socket, as the kernel counts.
const FRAME_BYTES: usize = 1_024;

/// An open bus of a skin.
#[derive(Debug)]
pub struct Bench {
    index: usize,
    listener: Listener,
    format: Format,
    /// Where this side speaks to the roots of a network, whose cells may have no numbers yet.
    roots: Vec<Lane>,
}

/// What became of a bus.
#[derive(Debug)]
pub struct Done {
    /// The bus.
    pub name: String,
    /// Its kind.
    pub kind: String,
    /// What became of its cells.
    pub report: Report,
    /// Why it was ended: somebody else is there, or the bus is gone.
    pub failure: Option<String>,
    /// Frames that came faster than they were read.
    pub dropped: u32,
}

/// Opens a bus of a skin.
///
/// # Errors
/// When it cannot be opened.
pub fn open(skin: &Skin, index: usize, kinds: &Kinds) -> Result<Bench, BusError> {
    let described = skin.buses.get(index);
    let (name, format) = described.map_or(("", Format::Fd), |bus| (bus.name.as_str(), bus.format));
    let sums = described.is_some_and(|bus| matches!(bus.reply, Reply::Sum { .. }));
    let mut roots: Vec<_> = skin.wires(index).roots().map(|(_, lane)| lane).filter(|_| sums).collect();
    let mut filters = [Kind::Network, Kind::Configure, Kind::Configured].map(Filter::kind).to_vec();
    filters.push(Filter::exact(Id::command(Command::Joints)));
    filters.extend(roots.iter().map(|lane| Filter::lane(lane.reversed())));
    let receive_buffer = GATEWAY_RECEIVE_BUFFER as usize;
    let options = Options { filters, receive_buffer, ..Options::default() };
    let bus = listen::open(name, kinds.of(name), Some(format), options)?;
    if !roots.is_empty() && !bus.is_virtual()? {
        // Simulated wires have no place among real cells, which have real ones.
        roots.clear();
    }
    Ok(Bench { index, listener: Listener::new(bus, Some(format)), format, roots })
}

/// Commissions the cells of all buses, or as many as it can until it is stopped; shows how far they are.
pub fn commission(
    benches: Vec<Bench>,
    skin: &Skin,
    wish: Wish,
    stopped: &AtomicBool,
    mut show: impl FnMut(&[Progress]),
) -> Vec<Done> {
    let far = Mutex::new(vec![None; benches.len()]);
    thread::scope(|scope| {
        let work = |(place, bench): (usize, Bench)| {
            let far = &far;
            scope.spawn(move || {
                bench.work(skin, wish, stopped, |progress| {
                    if let Some(own) = far.lock().ok().as_mut().and_then(|far| far.get_mut(place)) {
                        *own = Some(progress);
                    }
                })
            })
        };
        let threads: Vec<_> = benches.into_iter().enumerate().map(work).collect();
        while threads.iter().any(|thread| !thread.is_finished()) {
            let now: Vec<Progress> =
                far.lock().map(|far| far.iter().copied().flatten().collect()).unwrap_or_default();
            if !now.is_empty() {
                show(&now);
            }
            thread::sleep(TELL);
        }
        threads.into_iter().filter_map(|thread| thread.join().ok()).collect()
    })
}

impl Bench {
    /// Commissions the bus' cells, or as many as it can until it is stopped; tells how far it is.
    fn work(mut self, skin: &Skin, wish: Wish, stopped: &AtomicBool, tell: impl FnMut(Progress)) -> Done {
        let frames = match self.format {
            Format::Fd => 1,
            Format::Classic => 2,
        };
        let room = self.listener.bus().receive_buffer().checked_div(FRAME_BYTES * frames).unwrap_or(0);
        let began = Instant::now();
        let clock = || Micros(u64::try_from(began.elapsed().as_micros()).unwrap_or(u64::MAX));
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
        let mut network = Network::new(roots, clock());
        loop {
            if stopped.load(Ordering::Relaxed) {
                commission.stop();
            }
            commission.handle_time(clock());
            tell(commission.progress());
            if commission.speaks() {
                let frames = network.frames(clock());
                passing(listener.bus().send(&frames).map_err(BusError::from), DOWN)?;
            }
            while let Some(message) = commission.poll_transmit() {
                // What was not sent is not answered, and is sent again.
                passing(send(listener.bus(), &message, *format), DOWN)?;
            }
            let Some(next) = commission.poll_timeout() else { return Ok(()) };
            let next = if commission.speaks() { next.min(network.due()) } else { next };
            let wait = Duration::from_micros(next.since(clock()).0).min(LOOK);
            passing(listener.hear(wait), DOWN)?;
            for (received, decoded) in listener.decoded() {
                if let Decoded::Message(message) = decoded {
                    network.hear(&message);
                    commission.handle_message(clock(), &message);
                } else {
                    network.take(clock(), &received.frame);
                }
            }
        }
    }
}

/// This side's ends of the wires to the roots: cells without numbers get theirs from here.
struct Network<'a> {
    roots: &'a [Lane],
    uplinks: Uplinks,
}

impl<'a> Network<'a> {
    fn new(roots: &'a [Lane], now: Micros) -> Self {
        // Another number than that of the walks of whoever was here before.
        let walk = std::process::id().to_le_bytes()[0].wrapping_mul(37);
        Self { roots, uplinks: Uplinks::new(roots.len(), walk, now) }
    }

    /// Somebody with a number speaks.
    fn hear(&mut self, message: &Message) {
        if let Message::Network { from: Node::Cell(cell), .. } = message {
            self.uplinks.claimed(*cell);
        }
    }

    fn take(&mut self, now: Micros, frame: &Frame) {
        for (root, lane) in self.roots.iter().enumerate() {
            if let Some(message) = lane.reversed().read(frame) {
                self.uplinks.handle(now, root, message);
            }
        }
    }

    /// What is to be said to the roots now.
    fn frames(&mut self, now: Micros) -> Vec<Frame> {
        if self.roots.is_empty() {
            return Vec::new();
        }
        self.uplinks.handle_time(now);
        let (uplinks, roots) = (&mut self.uplinks, self.roots);
        let said = std::iter::from_fn(|| uplinks.poll_transmit());
        said.filter_map(|(root, message)| Some(roots.get(root)?.frame(message))).collect()
    }

    fn due(&self) -> Micros {
        if self.roots.is_empty() { Micros(u64::MAX) } else { self.uplinks.poll_timeout() }
    }
}
