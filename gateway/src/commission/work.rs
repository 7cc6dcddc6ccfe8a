//! The shell of one bus' commissioning: its clock and its socket. It decides nothing.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use model::commission::{Commission, Progress, Report, Wish};
use model::decode::{Decoded, Decoder};
use model::network::Uplinks;
use protocol::bus::{Bus, BusError, Filter, GATEWAY_RECEIVE_BUFFER, Inbox, Kinds, Options};
use protocol::can::{Format, Frame};
use protocol::id::{Command, Id, Kind, Node};
use protocol::message::Message;
use protocol::skin::{Reply, Skin};
use protocol::time::Micros;
use protocol::wire::Lane;

/// How long a signal to end may wait, when nothing comes.
const LOOK: Duration = Duration::from_millis(50);
/// The pause while an interface is down.
const DOWN: Duration = Duration::from_millis(20);
/// Bytes that a waiting frame takes in a socket, as the kernel counts.
const FRAME_BYTES: usize = 1_024;

/// An open bus of a skin.
#[derive(Clone, Debug)]
pub(super) struct Bench {
    index: usize,
    bus: Arc<Bus>,
    format: Format,
    /// Where this side speaks to the roots of a network, whose cells may have no numbers yet.
    roots: Vec<Lane>,
}

/// What became of a bus.
#[derive(Debug)]
pub(super) struct Done {
    pub(super) name: String,
    pub(super) kind: String,
    pub(super) report: Report,
    /// Why it was ended: somebody else is there, or the bus is gone.
    pub(super) failure: Option<String>,
    /// Frames that came faster than they were read.
    pub(super) dropped: u32,
}

/// Opens a bus of a skin.
pub(super) fn open(skin: &Skin, index: usize, kinds: &Kinds) -> Result<Bench, BusError> {
    let described = skin.buses.get(index);
    let (name, format) = described.map_or(("", Format::Fd), |bus| (bus.name.as_str(), bus.format));
    let sums = described.is_some_and(|bus| matches!(bus.reply, Reply::Sum { .. }));
    let mut roots: Vec<_> = skin.wires(index).roots().map(|(_, lane)| lane).filter(|_| sums).collect();
    let mut filters = [Kind::Network, Kind::Configure, Kind::Configured].map(Filter::kind).to_vec();
    filters.push(Filter::exact(Id::command(Command::Joints)));
    filters.extend(roots.iter().map(|lane| Filter::lane(lane.reversed())));
    let options = Options {
        filters,
        fd: format == Format::Fd,
        receive_buffer: GATEWAY_RECEIVE_BUFFER as usize,
        ..Options::default()
    };
    let bus = Bus::open(name, kinds.of(name), &options)?;
    if !roots.is_empty() && !bus.is_virtual()? {
        // Simulated wires have no place among real cells, which have real ones.
        roots.clear();
    }
    Ok(Bench { index, bus: Arc::new(bus), format, roots })
}

impl Bench {
    /// Commissions the bus' cells, or as many as it can until it is stopped; tells how far it is.
    pub(super) fn work(
        &self,
        skin: &Skin,
        wish: Wish,
        stopped: &AtomicBool,
        tell: impl FnMut(Progress),
    ) -> Done {
        let frames = match self.format {
            Format::Fd => 1,
            Format::Classic => 2,
        };
        let room = self.bus.receive_buffer().checked_div(FRAME_BYTES * frames).unwrap_or(0);
        let began = Instant::now();
        let clock = || Micros(u64::try_from(began.elapsed().as_micros()).unwrap_or(u64::MAX));
        let mut commission = Commission::new(skin, self.index, wish, room, clock());
        let mut inbox = Inbox::new();
        let lost = self.converse(&mut commission, &mut inbox, &clock, stopped, tell).err();
        if lost.is_some() {
            commission.stop();
        }
        let report = commission.report();
        let trouble = report.trouble.map(|trouble| trouble.on(self.bus.name()));
        Done {
            name: self.bus.name().to_owned(),
            kind: self.bus.kind().to_string(),
            report,
            failure: lost.map(|lost| lost.to_string()).or(trouble),
            dropped: inbox.dropped(),
        }
    }

    fn converse(
        &self,
        commission: &mut Commission,
        inbox: &mut Inbox,
        clock: &impl Fn() -> Micros,
        stopped: &AtomicBool,
        mut tell: impl FnMut(Progress),
    ) -> Result<(), BusError> {
        let mut decoder = Decoder::new(Some(self.format));
        let mut network = Network::new(&self.roots, clock());
        loop {
            if stopped.load(Ordering::Relaxed) {
                commission.stop();
            }
            commission.handle_time(clock());
            tell(commission.progress());
            if commission.speaks() {
                let frames = network.frames(clock());
                passing(self.bus.send(&frames).map_err(BusError::from))?;
            }
            while let Some(message) = commission.poll_transmit() {
                let frames: Vec<Frame> = message.encode().frames(self.format).collect();
                // What was not sent is not answered, and is sent again.
                passing(self.bus.send(&frames).map_err(BusError::from))?;
            }
            let Some(next) = commission.poll_timeout() else { return Ok(()) };
            let next = if commission.speaks() { next.min(network.due()) } else { next };
            let wait = Duration::from_micros(next.since(clock()).0).min(LOOK);
            if passing(self.bus.wait(Some(wait)))?.unwrap_or(false) {
                passing(self.bus.receive(inbox))?;
                for received in inbox.frames() {
                    let at = Micros(received.at_nanos / 1_000);
                    if let Decoded::Message(message) = decoder.decode(at, self.bus.name(), &received.frame) {
                        network.hear(&message);
                        commission.handle_message(clock(), &message);
                    } else {
                        network.take(clock(), &received.frame);
                    }
                }
                inbox.clear();
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

/// A bus that is down or full may be used again soon.
fn passing<T>(done: Result<T, BusError>) -> Result<Option<T>, BusError> {
    match done {
        Ok(done) => Ok(Some(done)),
        Err(error) if error.may_pass() => {
            std::thread::sleep(DOWN);
            Ok(None)
        }
        Err(error) => Err(error),
    }
}
