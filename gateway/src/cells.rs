//! `gateway cells`.

mod show;

use std::collections::BTreeMap;
use std::io::{self, IsTerminal};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use clap::Args;
use model::decode::{Decoded, Decoder};
use model::listing::Listing;
use protocol::bus::{Bus, BusError, Choice, Filter, GATEWAY_RECEIVE_BUFFER, Inbox, Options};
use protocol::can::{Format, Frame};
use protocol::id::{Command, Id, Kind};
use protocol::message::Message;
use protocol::skin::Skin;
use protocol::time::Micros;
use protocol::usage::{Failure, print};

use self::show::{Known, Shown};
use super::input;

/// How long is listened, unless it is told.
const LISTEN_S: f64 = 1.0;
/// Cells say a heartbeat four times a second, from which their frames' format is seen.
const FORMAT: Duration = Duration::from_millis(300);
/// How often it is drawn anew, and asked anew.
const DRAW: Duration = Duration::from_millis(500);
const ASK: Duration = Duration::from_secs(2);
const LOOK: Duration = Duration::from_millis(50);

/// List the cells on a bus: what each says of itself
///
/// Asks all cells for their counters and their place in the network, and listens for a second. What a cell has not
/// said is `-`; a column in which nobody has said anything is left out, and so are the counters where a terminal is
/// too narrow. Ports: the number of the cell at the other end, `?` after it when that one hears nothing from here,
/// `!` when it speaks another version, `.` where nothing is heard.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  gateway cells vcan0
  gateway cells can0 --skin skin.toml --watch
  gateway cells vcan0 --json | jq '.cells[] | select(.configured | not) | .node'")]
pub(crate) struct Cells {
    /// The bus
    bus: String,
    /// Compare with this description: which cells have its configuration, and which are missing
    #[arg(long, value_name = "FILE")]
    skin: Option<PathBuf>,
    /// Go on, and draw it anew, until Ctrl-C
    #[arg(long)]
    watch: bool,
    /// One JSON object; with --watch, one a line
    #[arg(long)]
    json: bool,
    /// Listen for so many seconds; 1 unless told, without end with --watch
    #[arg(long = "for", value_name = "S", value_parser = seconds, allow_negative_numbers = true)]
    seconds: Option<f64>,
    /// socketcan or embedded; else SocketCAN where the kernel has CAN, the embedded bus where not
    #[arg(long, value_name = "KIND", default_value_t = Choice::Auto)]
    bus_kind: Choice,
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if seconds > 0.0 && seconds <= 1e7 => Ok(seconds),
        _ => Err("a number of seconds above 0, up to 1e7".to_owned()),
    }
}

impl Cells {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let known = self.known()?;
        let stopped = input::stopped()?;
        let bus = open(&self.bus, self.bus_kind).map_err(Failure::usage)?;
        let mut watch = Watch {
            asks_in: known.as_ref().map(|known| known.format),
            bus: &bus,
            began: Instant::now(),
            decoder: Decoder::new(None),
            inbox: Inbox::new(),
            listing: Listing::new(),
            others: 0,
            asked: None,
        };
        let seconds = self.seconds.or_else(|| (!self.watch).then_some(LISTEN_S));
        let end = seconds.map(|seconds| watch.began + Duration::from_secs_f64(seconds));
        let show = |watch: &Watch<'_>| {
            let kind = bus.kind().to_string();
            Shown {
                bus: &self.bus,
                kind: &kind,
                listing: &watch.listing,
                known: known.as_ref(),
                now: watch.now(),
            }
            .text(self.json, self.watch)
        };
        let terminal = io::stdout().is_terminal() && !self.json;
        let mut drawn = watch.began;
        while end.is_none_or(|end| Instant::now() < end) && !stopped.load(Ordering::Relaxed) {
            watch.ask(self.watch)?;
            watch.hear(&stopped)?;
            if self.watch && drawn.elapsed() >= DRAW {
                drawn = Instant::now();
                let text = show(&watch)?;
                print(&if terminal { show::screen(&text) } else { text })?;
            }
        }
        if !self.watch && watch.listing.cells().len() == 0 {
            let (name, seconds) = (&self.bus, watch.began.elapsed().as_secs_f64());
            let others = match watch.others {
                0 => String::new(),
                others => format!(" ({others} frames are none of a cell; `gateway dump` shows them)"),
            };
            return Err(Failure::run(format!(
                "no cell was heard on {name} for {seconds:.1} s{others}: start them, or switch them on"
            )));
        }
        if self.watch { Ok(()) } else { print(&show(&watch)?) }
    }

    /// What the description says of this bus.
    fn known(&self) -> Result<Option<Known>, Failure> {
        let Some(path) = &self.skin else { return Ok(None) };
        let skin = Skin::read(path).map_err(Failure::usage)?;
        let (file, name) = (path.display().to_string(), &self.bus);
        let index = skin.bus_named(name).ok_or_else(|| {
            let names = skin.buses.iter().map(|bus| bus.name.as_str()).collect::<Vec<_>>().join(", ");
            Failure::usage(format!("bus {name} is not in {file}, which has {names}"))
        })?;
        let format = skin.buses.get(index).map_or(Format::Fd, |bus| bus.format);
        let cells = skin.cells_of(index).map(|cell| (cell.serial, (cell.node, skin.parameters(cell).hash())));
        let cells: BTreeMap<_, _> = cells.collect();
        Ok(Some(Known { file, format, cells }))
    }
}

/// Opens a bus to hear cells and gateways; a classic interface too.
fn open(name: &str, kind: Choice) -> Result<Bus, BusError> {
    let kinds = Kind::ALL.into_iter().filter(|kind| kind.is_from_cells());
    let mut filters: Vec<_> = kinds.map(Filter::kind).collect();
    filters.push(Filter::exact(Id::command(Command::Joints)));
    let options = |fd| Options {
        fd,
        filters: filters.clone(),
        receive_buffer: GATEWAY_RECEIVE_BUFFER as usize,
        ..Options::default()
    };
    match Bus::open(name, kind, &options(true)) {
        Err(BusError::ClassicOnly { .. }) => Bus::open(name, kind, &options(false)),
        opened => opened,
    }
}

/// What is heard, and when it was asked for.
struct Watch<'a> {
    bus: &'a Bus,
    began: Instant,
    decoder: Decoder,
    inbox: Inbox,
    listing: Listing,
    /// Frames that no packet came of.
    others: u64,
    /// What the description has packets travel in.
    asks_in: Option<Format>,
    asked: Option<Instant>,
}

impl Watch<'_> {
    fn now(&self) -> Micros {
        Micros(u64::try_from(self.began.elapsed().as_micros()).unwrap_or(u64::MAX))
    }

    /// Asks for everything, once it is known in which frames; again and again if wanted.
    fn ask(&mut self, again: bool) -> Result<(), Failure> {
        let due = self.asked.is_none_or(|asked| again && asked.elapsed() >= ASK);
        let waited = (self.began.elapsed() >= FORMAT).then_some(Format::Fd);
        let Some(format) = self.asks_in.or_else(|| self.listing.format()).or(waited).filter(|_| due) else {
            return Ok(());
        };
        self.asked = Some(Instant::now());
        let frames: Vec<Frame> =
            [Message::Report, Message::Sync].iter().flat_map(|it| it.encode().frames(format)).collect();
        match self.bus.send(&frames).map_err(BusError::from) {
            // Who cannot be asked may be heard all the same.
            Err(BusError::FdFrame { .. }) => Ok(()),
            Err(error) if error.may_pass() => Ok(()),
            done => done.map_err(Failure::run),
        }
    }

    fn hear(&mut self, stopped: &AtomicBool) -> Result<(), Failure> {
        let heard = self.bus.wait(Some(LOOK)).and_then(|ready| match ready {
            true => self.bus.receive(&mut self.inbox),
            false => Ok(0),
        });
        match heard {
            Ok(0) => return Ok(()),
            Ok(_) => {}
            Err(error) if error.may_pass() && !stopped.load(Ordering::Relaxed) => {
                std::thread::sleep(LOOK);
                return Ok(());
            }
            Err(error) => return Err(Failure::run(error)),
        }
        let now = self.now();
        for received in self.inbox.frames() {
            let at = Micros(received.at_nanos / 1_000);
            let decoded = self.decoder.decode(at, self.bus.name(), &received.frame);
            if let Decoded::Message(message) = decoded {
                self.listing.hear(now, received.frame.format(), &message);
            } else {
                self.others += 1;
            }
        }
        Ok(())
    }
}
