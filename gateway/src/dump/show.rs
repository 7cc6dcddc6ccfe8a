//! Output of `skinbus dump` for each frame.

use std::borrow::Cow;
use std::fmt::Write as _;
use std::io::{self, Write};
use std::sync::Arc;

use analysis::explain::other_robot_text;
use analysis::stats::{CaptureStats, StatsReport};
use model::decode::pick::{FrameFilter, NodeSelector};
use model::decode::settle::OrderedDecoder;
use model::decode::{Decoded, json};
use protocol::can::{Format, Frame};
use protocol::candump::{Direction, Record, Timestamp};
use protocol::id::Kind;
use protocol::message::Message;
use protocol::packet::data_frame_id;
use protocol::schema::BusUnits;
use protocol::skin::Skin;
use protocol::time::Micros;
use protocol::usage::printable;

use crate::output::print_note;
use crate::print::{GREEN, RED, RESET_COLOUR, YELLOW, comma_separated, escape_controls};

/// Colours of a terminal.
const DIM: &str = "\x1b[2m";
const MAGENTA: &str = "\x1b[35m";
const CYAN: &str = "\x1b[36m";

/// Output style of frames.
#[derive(Debug)]
pub(super) enum OutputStyle {
    /// One line per frame, with or without colours.
    Lines { colour: bool },
    /// One line per frame without the raw frame: time since the first frame, bus, and decoded frame.
    Brief { colour: bool },
    /// One JSON object per frame.
    Json,
    /// No lines; statistics at the end.
    Stats(Box<CaptureStats>),
}

/// A frame that waits for the rest of its packet before it can be decoded.
struct PendingFrame {
    time: Timestamp,
    bus: Arc<str>,
    units: BusUnits,
    frame: Frame,
    direction: Option<Direction>,
}

/// Decodes, filters and shows frames.
pub(super) struct FrameOutput<W> {
    out: W,
    settler: OrderedDecoder<PendingFrame>,
    /// Bus of the last frame, with its units.
    bus: Arc<str>,
    units: BusUnits,
    /// Buses that a skin describes, with their units and the numbers of their chains' joints.
    described: Vec<(String, BusUnits, usize)>,
    pick: FrameFilter,
    /// True if only traffic of touches is shown.
    contact: bool,
    how: OutputStyle,
    /// Number of frames that may still be shown before the dump ends.
    remaining: u64,
    /// Buses named by the filters from which no frame has come.
    absent: Vec<String>,
    /// Nodes named by the filters from or to which no frame has come.
    absent_nodes: Vec<NodeSelector>,
    /// Start of the counted seconds, in ns since 1970; `None` until it is known or the first frame comes.
    zero: Option<u64>,
    raw: String,
}

impl<W: Write> FrameOutput<W> {
    pub(super) fn new(
        out: W,
        format: Option<Format>,
        pick: FrameFilter,
        contact: bool,
        how: OutputStyle,
        max: u64,
    ) -> Self {
        let absent = pick.bus_names().map(str::to_owned).collect();
        let absent_nodes = pick.parties.clone();
        Self {
            out,
            settler: OrderedDecoder::new(format),
            absent,
            absent_nodes,
            bus: Arc::from(""),
            units: BusUnits::default(),
            described: Vec::new(),
            pick,
            contact,
            how,
            remaining: max,
            zero: None,
            raw: String::new(),
        }
    }

    /// Sets the time in ns since 1970 from which seconds count. Call it before the first frame.
    pub(super) const fn set_zero_time(&mut self, zero: u64) {
        self.zero = Some(zero);
    }

    /// Sets the units of the skin's buses; other buses keep the default. Call it before the first frame.
    pub(super) fn set_units(&mut self, skin: &Skin) {
        let buses = skin.buses.iter().enumerate();
        let described = buses.map(|(index, bus)| {
            (bus.name.clone(), BusUnits::for_bus(skin, index), skin.joints_on_bus(index).len())
        });
        self.described = described.collect();
    }

    /// Adds the next frame. It is shown as soon as its packet is complete or known to be incomplete, if the filters
    /// select it.
    pub(super) fn add_frame(&mut self, record: &Record<'_>) -> io::Result<()> {
        let Record { time, interface, frame, direction } = *record;
        if *self.bus != *interface {
            self.bus = Arc::from(interface);
            self.absent.retain(|name| name != interface);
            let described = self.described.iter().find(|(name, ..)| name == interface);
            self.units = described.map_or_else(BusUnits::default, |(_, units, _)| *units);
        }
        let waiting = PendingFrame { time, bus: Arc::clone(&self.bus), units: self.units, frame, direction };
        self.settler.push(Micros(time.nanos / 1_000), interface, &frame, waiting);
        self.show_settled_frames()
    }

    /// Settles and shows frames whose packets have been incomplete for too long at `now`; call it when no frame
    /// arrives.
    pub(super) fn handle_time(&mut self, now: Micros) -> io::Result<()> {
        self.settler.handle_time(now);
        self.show_settled_frames()
    }

    /// Settles and shows all waiting frames at the end of the input.
    pub(super) fn finish(&mut self) -> io::Result<()> {
        self.settler.finish();
        self.show_settled_frames()
    }

    /// Returns true if any frame waits for the rest of its packet.
    pub(super) fn is_waiting(&self) -> bool {
        self.settler.is_waiting()
    }

    /// Shows the frames whose meaning is settled.
    fn show_settled_frames(&mut self) -> io::Result<()> {
        while self.remaining > 0
            && let Some((PendingFrame { time, bus, units, frame, direction }, decoded)) = self.settler.pop()
        {
            self.check_joint_count(&bus, &decoded);
            if !self.absent_nodes.is_empty()
                && let Ok(id) = data_frame_id(&frame)
                && !matches!(decoded, Decoded::Foreign(_))
            {
                self.absent_nodes.retain(|node| !node.matches(id, &bus));
            }
            let is_described = self.described.iter().any(|(name, ..)| **name == *bus);
            let units = if is_described { units } else { BusUnits::default() };
            self.show(&Record { time, interface: &bus, frame, direction }, &decoded, units)?;
        }
        Ok(())
    }

    /// Returns which buses and nodes the options name although no frame came of them, such as `of vcan3`.
    pub(super) fn absent_text(&self) -> Option<String> {
        let is_on_absent = |it: &&NodeSelector| it.bus.as_ref().is_some_and(|bus| self.absent.contains(bus));
        let nodes: Vec<_> =
            self.absent_nodes.iter().filter(|it| !is_on_absent(it)).map(ToString::to_string).collect();
        let buses = (!self.absent.is_empty()).then(|| format!("of {}", comma_separated(&self.absent)));
        let nodes = (!nodes.is_empty()).then(|| format!("from or to {}", comma_separated(&nodes)));
        let texts: Vec<_> = buses.into_iter().chain(nodes).collect();
        (!texts.is_empty() && self.remaining > 0).then(|| texts.join(", or "))
    }

    /// Returns true if no further frames are to be shown.
    pub(super) const fn is_limit_reached(&self) -> bool {
        self.remaining == 0
    }

    /// If a bus's joints differ in number from those of its chain in the skin, drops the bus's description, because the
    /// skin is for another robot.
    fn check_joint_count(&mut self, bus: &str, decoded: &Decoded) {
        let Some(Message::Joints { joints, .. }) = decoded.message() else { return };
        let came = usize::from(joints.in_use);
        let is_other = |it: &(String, BusUnits, usize)| it.0 == bus && it.2 != came;
        if let Some(at) = self.described.iter().position(is_other) {
            let (name, _, chain) = self.described.remove(at);
            let another = other_robot_text(&name, came, chain);
            print_note(format_args!(
                "{another}; from here on, torques on this bus are decoded as Q3.12 and joints as revolute"
            ));
            self.bus = Arc::from("");
        }
    }

    /// Shows a frame if the filters select it.
    fn show(&mut self, record: &Record<'_>, decoded: &Decoded, units: BusUnits) -> io::Result<()> {
        let nanos = record.time.nanos;
        let zero = *self.zero.get_or_insert(nanos);
        if !self.pick.matches(zero, nanos, record.interface, &record.frame, decoded)
            || self.contact && !decoded.is_contact()
        {
            return Ok(());
        }
        let said = decoded.in_units(units);
        let interface = &printable(record.interface);
        match &mut self.how {
            OutputStyle::Stats(stats) => stats.record(record, decoded),
            OutputStyle::Json => {
                // The bus name is the only free text in the line.
                if let Cow::Borrowed(_) = printable(record.interface) {
                    json::write_json_line(&mut self.out, record, decoded, units)?;
                } else {
                    let mut line = Vec::new();
                    json::write_json_line(&mut line, record, decoded, units)?;
                    self.out
                        .write_all(escape_controls(String::from_utf8_lossy(&line).into_owned()).as_bytes())?;
                }
            }
            OutputStyle::Brief { colour } => {
                // Times before the loop's start, or of a capture whose times run backwards, are negative.
                let (sign, since) = if nanos < zero { ("-", zero - nanos) } else { ("", nanos - zero) };
                let (seconds, micros) = (since / 1_000_000_000, since / 1_000 % 1_000_000);
                let (dim, of, plain) =
                    if *colour { (DIM, colour_of(decoded), RESET_COLOUR) } else { ("", "", "") };
                writeln!(self.out, "{dim}{sign}{seconds}.{micros:06} {interface}{plain} {of}{said}{plain}")?;
            }
            OutputStyle::Lines { colour } => {
                self.raw.clear();
                let way = match record.direction {
                    None => "",
                    Some(Direction::Sent) => " T",
                    Some(Direction::Received) => " R",
                };
                // Writing to a string never fails.
                let _ = write!(self.raw, "{}{way}", Record { interface, ..*record });
                let raw = &self.raw;
                if *colour {
                    let colour = colour_of(decoded);
                    writeln!(self.out, "{DIM}{raw}{RESET_COLOUR}\t{colour}{said}{RESET_COLOUR}")?;
                } else {
                    writeln!(self.out, "{raw}\t{said}")?;
                }
            }
        }
        self.remaining -= 1;
        Ok(())
    }

    /// Counts frames that were lost before this point.
    pub(super) fn count_dropped(&mut self, bus: &str, frames: u64) {
        if let OutputStyle::Stats(stats) = &mut self.how {
            stats.record_dropped(bus, frames);
        }
    }

    /// Notes that the frames have no valid times, so that statistics give no rates.
    pub(super) const fn disable_rates(&mut self) {
        if let OutputStyle::Stats(stats) = &mut self.how {
            stats.mark_untimed();
        }
    }

    pub(super) fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }

    /// Returns the statistics, if they are collected.
    pub(super) fn report(&self) -> Option<StatsReport> {
        match &self.how {
            OutputStyle::Stats(stats) => Some(stats.report()),
            OutputStyle::Lines { .. } | OutputStyle::Brief { .. } | OutputStyle::Json => None,
        }
    }
}

/// Returns the colour in which a decoded frame is shown.
fn colour_of(decoded: &Decoded) -> &'static str {
    match decoded {
        Decoded::Foreign(_) | Decoded::Wire(..) | Decoded::Segment { .. } => DIM,
        Decoded::Damaged { .. } | Decoded::Meaningless { .. } => RED,
        Decoded::Message(_) if decoded.is_saturated() => YELLOW,
        Decoded::Message(message) => match message.id().kind {
            Kind::Command => CYAN,
            Kind::Torque | Kind::Sum => RESET_COLOUR,
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

    /// Output for one frame on this bus.
    fn line(bus: &str, how: OutputStyle) -> String {
        let pick = FrameFilter::default();
        let mut show = FrameOutput::new(Vec::new(), None, pick, false, how, 1);
        let frame = candump::parse_frame("123#00").unwrap();
        let time = Timestamp::with_six_digits(1_000_000_000);
        show.add_frame(&Record { time, interface: bus, frame, direction: None }).unwrap();
        show.finish().unwrap();
        String::from_utf8(show.out).unwrap()
    }

    #[test]
    fn the_name_of_a_bus_makes_no_line_and_no_column_and_no_terminal_obeys_it() {
        let forged = "can0 1#\tok\n(2.000000) can1";
        for how in [OutputStyle::Lines { colour: false }, OutputStyle::Brief { colour: false }] {
            let said = line(forged, how);
            assert_eq!(said.matches('\n').count(), 1, "{said}");
            assert!(said.contains(r"can0 1#\u{9}ok\u{a}(2.000000) can1"), "{said}");
        }
        let escapes = "can\x1b[2J\u{9b}\0\r\u{202e}";
        let said = line(escapes, OutputStyle::Lines { colour: false });
        assert!(said.starts_with("(1.000000) can\\u{1b}[2J\\u{9b}\\u{0}\\u{d}\\u{202e} 123#00\t"), "{said}");
        let said = line(escapes, OutputStyle::Json);
        assert!(said.contains(r#""bus":"can\u001b[2J\u009b\u0000\r\u202e""#), "{said}");
    }
}
