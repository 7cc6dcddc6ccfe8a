//! Single packets: `skinbus frame`.

mod addressee;
mod others;
mod packets;
mod sensing;

use std::fmt::Write;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use bench::answers::ReceivedAnswers;
use bench::bus::listen::{self, Listener};
use bench::sensing as switching;
use clap::Args;
use model::decode::Decoded;
use model::decode::pick::NodeSelector;
use protocol::bus::{Bus, BusError, BusOptions, KindChoice, KindChoices};
use protocol::can::{BIT_RATE_SWITCH, Format, Frame as CanFrame};
use protocol::id::CellId;
use protocol::message::{Answer, Message};
use protocol::skin::{CellName, Skin};
use protocol::usage::{Failure, print_text};

use super::arguments::{BusKinds, FORMATS, find_bus, find_cell, one_of_values};
use super::output;
use super::print::comma_separated;
use addressee::single_cell;
use packets::PacketCommand;

/// Time within which present cells send a heartbeat and their answers.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(1);

/// Build a frame with the right CRC, and print it for cansend, or send it
///
/// Prints one line for a CAN FD bus, two for a classic one. With --bus, --skin or a bus in --cell, sends the frame
/// instead, also on an embedded bus, which cansend cannot use. Then waits for the answers to a configure and prints
/// them. Exit code 1: no addressed cell of a stimulus or configure is on the bus, or a cell refused.
#[derive(Args, Debug)]
#[command(mut_args(|arg| arg.global(true)), after_help = "Examples, of which the first three press cell 12 with 3 N from the next joints message on:
  cansend vcan0 $(skinbus frame configure --cell 12 --write mode 1)
  cansend vcan0 $(skinbus frame stimulus --cell 12 --force 3.0)
  skinbus frame stimulus --cell 12 --force 3.0 --bus vcan0
  skinbus frame resume --skin skin.toml
  skinbus frame sensing continuous 62.5 --bus vcan0")]
pub(crate) struct FrameCommand {
    #[command(subcommand)]
    what: PacketCommand,
    /// Frame format of the packet [default: fd; with --skin, the format of each bus in the skin]
    #[arg(long, value_parser = one_of_values(FORMATS))]
    format: Option<Format>,
    /// Send the frame on these buses instead of printing it
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    bus: Vec<String>,
    /// Send the frame on all buses of this skin file, or only on those that --bus names
    #[arg(long, value_name = "SKIN")]
    skin: Option<PathBuf>,
    #[command(flatten)]
    kinds: BusKinds,
}

impl FrameCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let message = self.what.message().map_err(Failure::usage_error)?;
        let (targets, kinds) = self.targets()?;
        if targets.is_empty() {
            return print_text(&cansend_lines(&message, self.format.unwrap_or(Format::Fd)));
        }
        // Open all buses before anything is sent.
        let open = |(name, format): &(String, Format)| {
            self.open(name, kinds.kind_of(name), *format).map_err(Failure::usage_error)
        };
        let buses = targets.iter().map(open).collect::<Result<Vec<_>, _>>()?;
        let done =
            buses.into_iter().zip(&targets).map(|(bus, (_, format))| self.send(bus, *format, &message));
        let failures: Vec<_> = done.filter_map(Result::err).collect();
        let mut failures = failures.into_iter();
        failures.next().map_or(Ok(()), |first| Err(failures.fold(first, Failure::append)))
    }

    /// Returns the buses on which the frame is sent, with their formats, and the kinds of the buses. Without buses, the
    /// frame is printed.
    fn targets(&self) -> Result<(Vec<(String, Format)>, KindChoices), Failure> {
        let format = |of_skin: Format| self.format.unwrap_or(of_skin);
        let to = self.what.addressee();
        let of_cell = to.and_then(|to| to.bus.as_ref());
        let mut targets: Vec<_> = match &self.skin {
            Some(path) => {
                let skin = Skin::read(path).map_err(Failure::usage_error)?;
                let file = path.display().to_string();
                self.bus.iter().chain(of_cell).try_for_each(|name| find_bus(&skin, &file, name).map(drop))?;
                // A node id on several buses names several cells.
                let only = match to.filter(|_| self.bus.is_empty() && of_cell.is_none()).and_then(single_cell)
                {
                    Some(node) => {
                        let index = find_cell(&skin, &CellName { bus: None, node }, "--cell")?;
                        skin.cells.get(index).map(|cell| cell.bus)
                    }
                    None => None,
                };
                let buses = skin.buses.into_iter().enumerate();
                let buses = buses.filter(|(index, _)| only.is_none_or(|only| only == *index));
                let buses = buses.map(|(_, bus)| (bus.name, format(bus.format)));
                buses.filter(|(name, _)| self.bus.is_empty() || self.bus.contains(name)).collect()
            }
            None => {
                let of_cell = of_cell.filter(|_| self.bus.is_empty());
                self.bus.iter().chain(of_cell).map(|name| (name.clone(), format(Format::Fd))).collect()
            }
        };
        let names = comma_separated(targets.iter().map(|(name, _)| name));
        let kinds = self.kinds.kinds_of_buses(targets.iter().map(|(name, _)| name.as_str()))?;
        if let Some(NodeSelector { bus: Some(bus), node }) = to {
            targets.retain(|(name, _)| name == bus);
            if targets.is_empty() {
                return Err(Failure::usage_error(format!(
                    "--cell {bus}:{node} is not on --bus {names}: correct --cell or --bus"
                )));
            }
        }
        Ok((targets, kinds))
    }

    /// Opens a bus for sending, and for receiving if answers are awaited.
    fn open(&self, name: &str, kind: KindChoice, format: Format) -> Result<Bus, BusError> {
        match self.what.addressee() {
            // A socket that only sends cannot show whether a cell is present.
            Some(_) => switching::open_bus(name, kind, format),
            None => {
                let nothing = BusOptions { filters: Vec::new(), ..BusOptions::default() };
                listen::open_bus(name, kind, Some(format), nothing)
            }
        }
    }

    /// Sends the frame on a bus, and waits for the cells' answers.
    fn send(&self, bus: Bus, format: Format, message: &Message) -> Result<(), Failure> {
        let (name, only) = (bus.name().to_owned(), self.what.addressee().and_then(single_cell));
        if let PacketCommand::Sensing(switch) = &self.what {
            return switch.send(bus, format);
        }
        listen::send_message(&bus, message, format).map_err(Failure::run_error)?;
        output::print_note(format_args!("sent on {name} ({})", bus.kind()));
        let tag = if let Message::Configure { tag, .. } = message {
            Some(*tag)
        } else if let Message::Stimulus { .. } = message {
            None
        } else {
            return Ok(());
        };
        let answers =
            wait_for_answers(Listener::new(bus, Some(format)), only, tag).map_err(Failure::run_error)?;
        report_answers(&answers, only, tag, (&name, format))
    }
}

/// Waits for answers. A request to all cells waits for the whole time limit, because the number of cells is unknown.
fn wait_for_answers(
    mut listener: Listener,
    only: Option<CellId>,
    tag: Option<u8>,
) -> Result<ReceivedAnswers, BusError> {
    let mut answers = ReceivedAnswers::new(only, tag);
    let are_complete = |answers: &ReceivedAnswers| match (only, tag) {
        (_, None) => !answers.present_cells().is_empty(),
        (Some(_), Some(_)) => !answers.received_answers().is_empty(),
        (None, Some(_)) => false,
    };
    let began = Instant::now();
    while began.elapsed() < ANSWER_TIMEOUT && !are_complete(&answers) {
        answers.receive(&mut listener)?;
    }
    Ok(answers)
}

/// Prints the values that cells answered. Returns an error if a cell refused, or none is present or answered.
fn report_answers(
    answers: &ReceivedAnswers,
    only: Option<CellId>,
    tag: Option<u8>,
    (bus, format): (&str, Format),
) -> Result<(), Failure> {
    let (mut lines, mut refused) = (String::new(), Vec::new());
    for &(from, answer) in answers.received_answers() {
        let decoded = Decoded::Message(Message::Configured { from, tag: tag.unwrap_or_default(), answer });
        let line = decoded.to_string();
        let line = line.trim_start_matches(decoded.verdict_word()).trim_start();
        match answer {
            Answer::Value { .. } => lines += &format!("{line}\n"),
            Answer::Refused { .. } => refused.push(line.to_owned()),
        }
    }
    print_text(&lines)?;
    let who = only.map_or_else(|| "a cell".to_owned(), |cell| format!("cell {cell}"));
    let (waited, other) = (ANSWER_TIMEOUT.as_secs_f64(), format.other_format().name());
    if !refused.is_empty() {
        return Err(Failure::run_error(comma_separated(&refused)));
    }
    if answers.present_cells().is_empty() {
        let silent = match only {
            None => "no cell sent anything".to_owned(),
            Some(_) => format!("{who} sent nothing"),
        };
        return Err(Failure::run_error(format!(
            "{silent} on {bus} for {waited} s: check the cells with `skinbus cells {bus}`; if the bus uses \
             the other frame format, add --format {other}"
        )));
    }
    if tag.is_some() && lines.is_empty() {
        let why = format!("{who} is on {bus}, but did not answer within {waited} s: send the frame again");
        return Err(Failure::run_error(why));
    }
    Ok(())
}

fn cansend_lines(message: &Message, format: Format) -> String {
    let mut text = String::new();
    for frame in message.encode().frames(format) {
        // cansend needs only the flag of the bit-rate switch: `##1`, as documented.
        let flags = frame.flags() & BIT_RATE_SWITCH;
        let frame = CanFrame::with_data(frame.id(), format, flags, frame.data()).unwrap_or(frame);
        writeln!(text, "{frame}").expect("a string takes whatever is written");
    }
    text
}
