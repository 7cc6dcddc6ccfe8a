//! The shell of one bus' commissioning: its clock and its socket. It decides nothing.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use gateway::commission::{Commission, Progress, Report, Wish};
use gateway::decode::{Decoded, Decoder};
use protocol::bus::{Bus, BusError, Choice, Filter, GATEWAY_RECEIVE_BUFFER, Inbox, Options};
use protocol::can::{Format, Frame};
use protocol::id::{Command, Id, Kind};
use protocol::skin::Skin;
use protocol::time::Micros;

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
pub(super) fn open(skin: &Skin, index: usize, kind: Choice) -> Result<Bench, BusError> {
    let (name, format) =
        skin.buses.get(index).map_or(("", Format::Fd), |bus| (bus.name.as_str(), bus.format));
    let of_kind =
        |kind| Filter { id: u32::from(Id { kind, node: 0 }.to_bits()), mask: Filter::EXACT_MASK & !0xFF };
    let mut filters = [Kind::Network, Kind::Configure, Kind::Configured].map(of_kind).to_vec();
    filters.push(Filter::exact(Id::command(Command::Joints)));
    let options = Options {
        filters,
        fd: format == Format::Fd,
        receive_buffer: GATEWAY_RECEIVE_BUFFER as usize,
        ..Options::default()
    };
    Ok(Bench { index, bus: Arc::new(Bus::open(name, kind, &options)?), format })
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
        loop {
            if stopped.load(Ordering::Relaxed) {
                commission.stop();
            }
            commission.handle_time(clock());
            tell(commission.progress());
            while let Some(message) = commission.poll_transmit() {
                let frames: Vec<Frame> = message.encode().frames(self.format).collect();
                // What was not sent is not answered, and is sent again.
                passing(self.bus.send(&frames).map_err(BusError::from))?;
            }
            let Some(next) = commission.poll_timeout() else { return Ok(()) };
            let wait = Duration::from_micros(next.since(clock()).0).min(LOOK);
            if passing(self.bus.wait(Some(wait)))?.unwrap_or(false) {
                passing(self.bus.receive(inbox))?;
                for received in inbox.frames() {
                    let at = Micros(received.at_nanos / 1_000);
                    if let Decoded::Message(message) = decoder.decode(at, self.bus.name(), &received.frame) {
                        commission.handle_message(clock(), &message);
                    }
                }
                inbox.clear();
            }
        }
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
