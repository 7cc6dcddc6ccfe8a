//! What is shown of each frame.

use std::fmt::Write as _;
use std::io::{self, Write};

use gateway::decode::pick::Pick;
use gateway::decode::stats::{Report, Stats};
use gateway::decode::{Decoded, Decoder, json};
use protocol::candump::{Direction, Record};
use protocol::message::Message;
use protocol::time::Micros;

/// Colours of a terminal.
const DIM: &str = "\x1b[2m";
const RED: &str = "\x1b[31m";
const GREEN: &str = "\x1b[32m";
const YELLOW: &str = "\x1b[33m";
const MAGENTA: &str = "\x1b[35m";
const CYAN: &str = "\x1b[36m";
const PLAIN: &str = "\x1b[0m";

/// How frames are shown.
#[derive(Debug)]
pub(super) enum How {
    /// One line each, in colours or not.
    Lines { colour: bool },
    /// The same without the raw frame: the time since the first one, the bus, and what it says.
    Brief { colour: bool },
    /// One JSON object each.
    Json,
    /// Not each; all of them in numbers at the end.
    Stats(Box<Stats>),
}

/// Whether there is more to be shown.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum Flow {
    More,
    Enough,
}

/// Decodes, picks and shows frames.
pub(super) struct Show<W> {
    out: W,
    decoder: Decoder,
    pick: Pick,
    /// Only what tells of a touch.
    contact: bool,
    how: How,
    /// Frames that may still be shown.
    left: u64,
    /// When the first frame came.
    first: Option<u64>,
    raw: String,
}

impl<W: Write> Show<W> {
    pub(super) const fn new(out: W, decoder: Decoder, pick: Pick, contact: bool, how: How, max: u64) -> Self {
        Self { out, decoder, pick, contact, how, left: max, first: None, raw: String::new() }
    }

    /// Shows a frame if it is wanted.
    pub(super) fn frame(&mut self, record: &Record<'_>) -> io::Result<Flow> {
        if self.left == 0 {
            return Ok(Flow::Enough);
        }
        let nanos = record.time.nanos;
        let first = *self.first.get_or_insert(nanos);
        let decoded = self.decoder.decode(Micros(nanos / 1_000), record.interface, &record.frame);
        if !self.pick.takes(first, nanos, &record.frame) || self.contact && !decoded.is_contact() {
            return Ok(Flow::More);
        }
        match &mut self.how {
            How::Stats(stats) => stats.take(record, &decoded),
            How::Json => json::write(&mut self.out, record, &decoded)?,
            How::Brief { colour } => {
                // Where times run backwards a frame may be before the first one.
                let (sign, since) = if nanos < first { ("-", first - nanos) } else { ("", nanos - first) };
                let (seconds, micros) = (since / 1_000_000_000, since / 1_000 % 1_000_000);
                let (dim, of, plain) = if *colour { (DIM, of(&decoded), PLAIN) } else { ("", "", "") };
                let bus = record.interface;
                writeln!(self.out, "{dim}{sign}{seconds}.{micros:06} {bus}{plain} {of}{decoded}{plain}")?;
            }
            How::Lines { colour } => {
                self.raw.clear();
                let way = match record.direction {
                    None => "",
                    Some(Direction::Sent) => " T",
                    Some(Direction::Received) => " R",
                };
                // A string takes everything.
                let _ = write!(self.raw, "{record}{way}");
                let raw = &self.raw;
                if *colour {
                    let colour = of(&decoded);
                    writeln!(self.out, "{DIM}{raw}{PLAIN}\t{colour}{decoded}{PLAIN}")?;
                } else {
                    writeln!(self.out, "{raw}\t{decoded}")?;
                }
            }
        }
        self.left -= 1;
        Ok(if self.left == 0 { Flow::Enough } else { Flow::More })
    }

    /// Frames were lost before this point.
    pub(super) fn dropped(&mut self, bus: &str, frames: u64) {
        if let How::Stats(stats) = &mut self.how {
            stats.dropped(bus, frames);
        }
    }

    pub(super) fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }

    /// The numbers, where these are shown.
    pub(super) fn report(&self) -> Option<Report> {
        match &self.how {
            How::Stats(stats) => Some(stats.report()),
            How::Lines { .. } | How::Brief { .. } | How::Json => None,
        }
    }
}

/// The colour of what a frame says.
fn of(decoded: &Decoded) -> &'static str {
    match decoded {
        Decoded::Foreign(_) | Decoded::Wire(..) | Decoded::Half { .. } => DIM,
        Decoded::Refused { .. } | Decoded::Meaningless { .. } => RED,
        Decoded::Message(_) if decoded.is_saturated() => YELLOW,
        Decoded::Message(message) => match message {
            Message::Halt | Message::Joints { .. } | Message::Sync | Message::Resume | Message::Report => {
                CYAN
            }
            Message::Torque { .. } | Message::Sum { .. } => PLAIN,
            Message::Stimulus { .. } | Message::Sensors { .. } => MAGENTA,
            Message::Configure { .. } | Message::Configured { .. } => GREEN,
            Message::Network { .. } => DIM,
        },
    }
}
