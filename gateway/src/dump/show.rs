//! Output for each frame.

use std::borrow::Cow;
use std::fmt::Write as _;
use std::io::{self, Write};
use std::sync::Arc;

use analysis::explain::another_robot;
use analysis::stats::{Report, Stats};
use model::decode::pick::Pick;
use model::decode::settle::Settler;
use model::decode::{Decoded, json};
use protocol::can::{Format, Frame};
use protocol::candump::{Direction, Record, Timestamp};
use protocol::id::Kind;
use protocol::message::Message;
use protocol::schema::Units;
use protocol::skin::Skin;
use protocol::time::Micros;
use protocol::usage::shown;

use crate::output::note;
use crate::print::{GREEN, PLAIN, RED, YELLOW, harmless, list};

/// Colours of a terminal.
const DIM: &str = "\x1b[2m";
const MAGENTA: &str = "\x1b[35m";
const CYAN: &str = "\x1b[36m";

/// How frames are shown.
#[derive(Debug)]
pub(super) enum How {
    /// One line each, in colours or not.
    Lines { colour: bool },
    /// The same without the raw frame: the time since the first one, the bus, and the decoded frame.
    Brief { colour: bool },
    /// One JSON object each.
    Json,
    /// None; statistics at the end.
    Stats(Box<Stats>),
}

/// A frame that is not settled yet.
struct Waiting {
    time: Timestamp,
    bus: Arc<str>,
    units: Units,
    frame: Frame,
    direction: Option<Direction>,
}

/// Decodes, picks and shows frames.
pub(super) struct Show<W> {
    out: W,
    settler: Settler<Waiting>,
    /// The bus of the last frame, and its units.
    bus: Arc<str>,
    units: Units,
    /// Those of the buses that a skin describes, and how many joints their chains have.
    described: Vec<(String, Units, usize)>,
    pick: Pick,
    /// Only traffic of touches.
    contact: bool,
    how: How,
    /// Frames that may still be shown.
    left: u64,
    /// Buses that the filters name, as long as none of their frames came.
    absent: Vec<String>,
    /// The time that seconds count from; until it is known, or the first frame comes, `None`.
    zero: Option<u64>,
    raw: String,
}

impl<W: Write> Show<W> {
    pub(super) fn new(out: W, format: Option<Format>, pick: Pick, contact: bool, how: How, max: u64) -> Self {
        let absent = pick.bus_names().map(str::to_owned).collect();
        Self {
            out,
            settler: Settler::new(format),
            absent,
            bus: Arc::from(""),
            units: Units::default(),
            described: Vec::new(),
            pick,
            contact,
            how,
            left: max,
            zero: None,
            raw: String::new(),
        }
    }

    /// Counts seconds from this time on; before the first frame.
    pub(super) const fn count_from(&mut self, zero: u64) {
        self.zero = Some(zero);
    }

    /// Takes the units of the skin's buses; of others they stay the default. Before the first frame.
    pub(super) fn describe(&mut self, skin: &Skin) {
        let buses = skin.buses.iter().enumerate();
        let described =
            buses.map(|(index, bus)| (bus.name.clone(), Units::of(skin, index), skin.joints_of(index).len()));
        self.described = described.collect();
    }

    /// Takes the next frame; it is shown once it is settled, if the filters select it.
    pub(super) fn frame(&mut self, record: &Record<'_>) -> io::Result<()> {
        let Record { time, interface, frame, direction } = *record;
        if *self.bus != *interface {
            self.bus = Arc::from(interface);
            self.absent.retain(|name| name != interface);
            let described = self.described.iter().find(|(name, ..)| name == interface);
            self.units = described.map_or_else(Units::default, |(_, units, _)| *units);
        }
        let waiting = Waiting { time, bus: Arc::clone(&self.bus), units: self.units, frame, direction };
        self.settler.push(Micros(time.nanos / 1_000), interface, &frame, waiting);
        self.settled()
    }

    /// Time passed without a frame.
    pub(super) fn handle_time(&mut self, now: Micros) -> io::Result<()> {
        self.settler.handle_time(now);
        self.settled()
    }

    /// No more frames follow.
    pub(super) fn finish(&mut self) -> io::Result<()> {
        self.settler.finish();
        self.settled()
    }

    /// Whether frames wait that are not shown yet.
    pub(super) fn is_waiting(&self) -> bool {
        self.settler.is_waiting()
    }

    /// Shows the frames that are settled.
    fn settled(&mut self) -> io::Result<()> {
        while self.left > 0
            && let Some((Waiting { time, bus, units, frame, direction }, decoded)) = self.settler.pop()
        {
            self.check_robot(&bus, &decoded);
            let is_described = self.described.iter().any(|(name, ..)| **name == *bus);
            let units = if is_described { units } else { Units::default() };
            self.show(&Record { time, interface: &bus, frame, direction }, &decoded, units)?;
        }
        Ok(())
    }

    /// Buses that the options name and of which no frame came, in words.
    pub(super) fn absent_buses(&self) -> Option<String> {
        (!self.absent.is_empty() && self.left > 0).then(|| list(&self.absent))
    }

    /// Whether no more frames are to be shown.
    pub(super) const fn has_enough(&self) -> bool {
        self.left == 0
    }

    /// Joints of another number than the chain's: the skin is of another robot, and says nothing of this bus.
    fn check_robot(&mut self, bus: &str, decoded: &Decoded) {
        let Some(Message::Joints { joints, .. }) = decoded.message() else { return };
        let came = usize::from(joints.in_use);
        let is_other = |it: &(String, Units, usize)| it.0 == bus && it.2 != came;
        if let Some(at) = self.described.iter().position(is_other) {
            let (name, _, chain) = self.described.remove(at);
            let another = another_robot(&name, came, chain);
            note(format_args!(
                "{another}; its torques are read as Q3.12 and joints as revolute from here on"
            ));
            self.bus = Arc::from("");
        }
    }

    /// Shows a frame if the filters select it.
    fn show(&mut self, record: &Record<'_>, decoded: &Decoded, units: Units) -> io::Result<()> {
        let nanos = record.time.nanos;
        let zero = *self.zero.get_or_insert(nanos);
        if !self.pick.takes(zero, nanos, record.interface, &record.frame, decoded)
            || self.contact && !decoded.is_contact()
        {
            return Ok(());
        }
        let said = decoded.in_units(units);
        let interface = &shown(record.interface);
        match &mut self.how {
            How::Stats(stats) => stats.take(record, decoded),
            How::Json => {
                // Nothing else in it is free text.
                if let Cow::Borrowed(_) = shown(record.interface) {
                    json::write(&mut self.out, record, decoded, units)?;
                } else {
                    let mut line = Vec::new();
                    json::write(&mut line, record, decoded, units)?;
                    self.out.write_all(harmless(String::from_utf8_lossy(&line).into_owned()).as_bytes())?;
                }
            }
            How::Brief { colour } => {
                // Before the run's loop began, and where times run backwards.
                let (sign, since) = if nanos < zero { ("-", zero - nanos) } else { ("", nanos - zero) };
                let (seconds, micros) = (since / 1_000_000_000, since / 1_000 % 1_000_000);
                let (dim, of, plain) = if *colour { (DIM, of(decoded), PLAIN) } else { ("", "", "") };
                writeln!(self.out, "{dim}{sign}{seconds}.{micros:06} {interface}{plain} {of}{said}{plain}")?;
            }
            How::Lines { colour } => {
                self.raw.clear();
                let way = match record.direction {
                    None => "",
                    Some(Direction::Sent) => " T",
                    Some(Direction::Received) => " R",
                };
                // A string takes everything.
                let _ = write!(self.raw, "{}{way}", Record { interface, ..*record });
                let raw = &self.raw;
                if *colour {
                    let colour = of(decoded);
                    writeln!(self.out, "{DIM}{raw}{PLAIN}\t{colour}{said}{PLAIN}")?;
                } else {
                    writeln!(self.out, "{raw}\t{said}")?;
                }
            }
        }
        self.left -= 1;
        Ok(())
    }

    /// Frames were lost before this point.
    pub(super) fn dropped(&mut self, bus: &str, frames: u64) {
        if let How::Stats(stats) = &mut self.how {
            stats.dropped(bus, frames);
        }
    }

    /// The times of the frames are none.
    pub(super) const fn without_times(&mut self) {
        if let How::Stats(stats) = &mut self.how {
            stats.without_times();
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

/// The colour of a decoded frame.
fn of(decoded: &Decoded) -> &'static str {
    match decoded {
        Decoded::Foreign(_) | Decoded::Wire(..) | Decoded::Segment { .. } => DIM,
        Decoded::Damaged { .. } | Decoded::Meaningless { .. } => RED,
        Decoded::Message(_) if decoded.is_saturated() => YELLOW,
        Decoded::Message(message) => match message.id().kind {
            Kind::Command => CYAN,
            Kind::Torque | Kind::Sum => PLAIN,
            Kind::Stimulus | Kind::Sensors => MAGENTA,
            Kind::Configure | Kind::Configured => GREEN,
            Kind::Network => DIM,
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::candump;

    /// What is written of a frame on this bus.
    fn line(bus: &str, how: How) -> String {
        let pick = Pick::default();
        let mut show = Show::new(Vec::new(), None, pick, false, how, 1);
        let frame = candump::parse_frame("123#00").unwrap();
        let time = Timestamp::six_digits(1_000_000_000);
        show.frame(&Record { time, interface: bus, frame, direction: None }).unwrap();
        show.finish().unwrap();
        String::from_utf8(show.out).unwrap()
    }

    #[test]
    fn the_name_of_a_bus_makes_no_line_and_no_column_and_no_terminal_obeys_it() {
        let forged = "can0 1#\tok\n(2.000000) can1";
        for how in [How::Lines { colour: false }, How::Brief { colour: false }] {
            let said = line(forged, how);
            assert_eq!(said.matches('\n').count(), 1, "{said}");
            assert!(said.contains(r"can0 1#\u{9}ok\u{a}(2.000000) can1"), "{said}");
        }
        let escapes = "can\x1b[2J\u{9b}\0\r\u{202e}";
        let said = line(escapes, How::Lines { colour: false });
        assert!(said.starts_with("(1.000000) can\\u{1b}[2J\\u{9b}\\u{0}\\u{d}\\u{202e} 123#00\t"), "{said}");
        let said = line(escapes, How::Json);
        assert!(said.contains(r#""bus":"can\u001b[2J\u009b\u0000\r\u202e""#), "{said}");
    }
}
