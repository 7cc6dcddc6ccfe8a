//! Messages that the subcommands of `skinbus frame` create.

use clap::{Args, Subcommand};
use model::decode::parameter;
use model::decode::pick::NodeSelector;
use model::scenario::contact_words;
use protocol::fixed::{Q, Q1_14, Q5_10};
use protocol::message::{Joints, Message, Request, SensorPage, SkinSensors, StimulusStart};
use protocol::packet::Epoch;
use protocol::parameters::MAX_JOINTS;

use super::addressee::addressee;
use super::others::{OtherPageOptions, stimulus_layouts};
use super::sensing;

#[derive(Debug, Subcommand)]
pub(super) enum PacketCommand {
    /// Make cells stop sending torques until a resume
    #[command(after_help = "Example:\n  skinbus frame halt")]
    Halt,
    /// Make cells leave the halted state
    #[command(after_help = "Example:\n  skinbus frame resume")]
    Resume,
    /// Make each cell send a heartbeat as soon as it has finished with the last joints message
    #[command(after_help = "Example:\n  skinbus frame sync")]
    Sync,
    /// Make cells send their counters and sensor values
    #[command(after_help = "Example:\n  skinbus frame report")]
    Report,
    Joints(JointsCommand),
    Stimulus(StimulusCommand),
    Configure(ConfigureCommand),
    Sensing(sensing::SensingCommand),
}

/// Make cells compute torques for these joint positions
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus frame joints --epoch 7 --rad 0 -1.2 1.0 -1.4 -1.57 0
  skinbus frame joints --epoch 7 --words 0 0xCF1C 0x28BE 0xC6F5 0xC008 0")]
pub(super) struct JointsCommand {
    /// Epoch of this broadcast, 0 to 255; cells ignore a message with the same epoch as the last one
    #[arg(long, value_name = "E")]
    epoch: u8,
    #[command(flatten)]
    positions: Angles,
}

#[derive(Args, Debug)]
#[group(required = true, multiple = false)]
struct Angles {
    /// Positions of the chain's joints (1 to 14) in rad; each is wrapped to one turn
    #[arg(long, value_name = "RAD", num_args = 1.., allow_negative_numbers = true)]
    rad: Option<Vec<String>>,
    /// Positions of the joints as 16-bit words, -32768 to 32767 or 0x0 to 0xFFFF, in steps of 1/65536 turn
    #[arg(long, value_name = "WORD", num_args = 1.., allow_negative_numbers = true)]
    words: Option<Vec<String>>,
}

/// Set the sensor values that a cell in test mode uses: force, proximity and others
///
/// The cell must be in test mode: `skinbus frame configure --cell N --write mode 1`. A stimulus takes effect with the
/// next joints message and holds until another one replaces it. Without --force the force is 0.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus frame stimulus --cell 12 --force 3.0
  skinbus frame stimulus --cell everyone --epoch 7 --force 0.5 --proximity 0.9
  skinbus frame stimulus --cell 12 --acceleration 0 0 1")]
pub(super) struct StimulusCommand {
    /// Cell that receives the packet; `everyone` for all cells
    #[arg(long, value_name = "[BUS:]NODE", value_parser = addressee)]
    cell: NodeSelector,
    /// Force of the touch, -96 to 95.997 N, divided among the cell's three contact sensors
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    force: Option<String>,
    /// Proximity from 0 (nothing near) to 1
    #[arg(long, value_name = "P", allow_negative_numbers = true)]
    proximity: Option<String>,
    /// Readings of the cell's two temperature sensors in degrees Celsius
    #[arg(long, num_args = 2, value_names = ["T1", "T2"], allow_negative_numbers = true)]
    temperature: Option<Vec<String>>,
    #[command(flatten)]
    others: OtherPageOptions,
    /// Epoch of the joints message from which the stimulus takes effect [default: that of the next one]
    #[arg(long, value_name = "E")]
    epoch: Option<u8>,
}

/// Read or write a parameter of a cell
///
/// A parameter written by name takes values in its units:
///
///   mount JOINT JOINTS
///   pose X Y Z NORMAL_X NORMAL_Y NORMAL_Z   (m, in the frame of the joint)
///   contact ALPHA_C ALPHA_P CONTACT_THRESHOLD PROXIMITY_THRESHOLD FORCE_THRESHOLD   (N)
///   timing PERIOD   (us)
///   mode 0|1   (1 obeys stimuli)
///   reply torque | sum SLOT DEEPEST 0|1   (us; 1 carries the remainder of rounding)
///   sensing off | continuous PERIOD | event   (ms)
///   events CONTACT PROXIMITY TEMPERATURE ACCELERATION HYSTERESIS   (N, °C, g; 0 to 1 of each)
///   links_down none | 0+2   (ports that receive nothing, in test mode only)
///   baseline off | hold|follow THRESHOLD HYSTERESIS RATE LIMIT SLOPE   (N; 0 to 1 of it; uN/s; N; N/°C)
///   tare none | tared | forced   (forget the zero, find it unless touched, find it in any case)
///   row1 to row6  A D ALPHA THETA_OFFSET   (m, m, rad, rad)
///   commit HASH   (hexadecimal)
///
/// A parameter given by number takes raw words.
#[derive(Args, Debug)]
#[command(
    verbatim_doc_comment,
    after_help = "Examples:
  skinbus frame configure --cell 12 --read pose
  skinbus frame configure --cell 12 --write mode 1
  skinbus frame configure --cell everyone --write row2 -0.425 0 0 0
  skinbus frame configure --cell 12 --write 99 1 -1 0x7FFF"
)]
pub(super) struct ConfigureCommand {
    /// Cell that receives the packet; `everyone` for all cells
    #[arg(long, value_name = "[BUS:]NODE", value_parser = addressee)]
    cell: NodeSelector,
    #[command(flatten)]
    request: ParameterRequest,
    /// Tag that the cell copies into its answer, 0 to 255
    #[arg(long, value_name = "T", default_value_t = 0)]
    tag: u8,
}

#[derive(Args, Debug)]
#[group(required = true, multiple = false)]
struct ParameterRequest {
    /// Read a parameter, by name or number
    #[arg(long, value_name = "PARAMETER")]
    read: Option<String>,
    /// Write a parameter, by name or number
    #[arg(long, num_args = 1.., value_names = ["PARAMETER", "VALUE"], allow_negative_numbers = true)]
    write: Option<Vec<String>>,
}

impl PacketCommand {
    pub(super) fn message(&self) -> Result<Message, String> {
        match self {
            Self::Halt => Ok(Message::Halt),
            Self::Resume => Ok(Message::Resume),
            Self::Sync => Ok(Message::Sync),
            Self::Report => Ok(Message::Report),
            Self::Joints(joints) => joints.message(),
            Self::Stimulus(stimulus) => stimulus.message(),
            Self::Configure(configure) => configure.message(),
            Self::Sensing(switch) => switch.message(),
        }
    }

    /// Returns the addressee of the packet, or `None` if the packet is for all receivers.
    pub(super) const fn addressee(&self) -> Option<&NodeSelector> {
        match self {
            Self::Halt | Self::Resume | Self::Sync | Self::Report | Self::Joints(_) => None,
            Self::Stimulus(StimulusCommand { cell, .. }) | Self::Configure(ConfigureCommand { cell, .. }) => {
                Some(cell)
            }
            Self::Sensing(switch) => Some(&switch.cell),
        }
    }
}

impl JointsCommand {
    fn message(&self) -> Result<Message, String> {
        let Angles { rad, words } = &self.positions;
        let (name, texts, read): (_, _, fn(&str) -> _) = match (rad, words) {
            (Some(rad), _) => ("--rad", rad, parameter::parse_angle),
            (None, words) => {
                ("--words", words.as_ref().ok_or("use --rad or --words")?, parameter::parse_raw_word)
            }
        };
        if texts.len() > MAX_JOINTS {
            let got = texts.len();
            return Err(format!("{name} has {got} positions: a chain has at most {MAX_JOINTS} joints"));
        }
        let mut positions = [Q1_14::ZERO; MAX_JOINTS];
        for (position, text) in positions.iter_mut().zip(texts) {
            *position = Q1_14::from_bits(parse_option_value(name, text, read)?);
        }
        let in_use = u8::try_from(texts.len()).map_err(|error| error.to_string())?;
        Ok(Message::Joints { epoch: Epoch(self.epoch), joints: Joints { positions, in_use } })
    }
}

impl StimulusCommand {
    fn message(&self) -> Result<Message, String> {
        let (to, from) = (
            self.cell.node,
            self.epoch.map_or(StimulusStart::Next, |epoch| StimulusStart::Epoch(Epoch(epoch))),
        );
        if let Some((number, words)) = self.others.given_page()? {
            let page = SensorPage::from_stimulus(number, words).map_err(|error| error.to_string())?;
            return Ok(Message::Stimulus { to, from, page });
        }
        let page = SensorPage::Skin(SkinSensors {
            contact: self.force.as_deref().map_or(Ok([Q5_10::ZERO; 3]), parse_force_words)?,
            proximity: self
                .proximity
                .as_deref()
                .map_or(Ok(Q1_14::ZERO), |text| parse_sensor_value("--proximity", "proximity", text))?,
            temperature: sensor_values(
                "--temperature",
                "temperature_c",
                self.temperature.as_deref().unwrap_or_default(),
            )?,
        });
        Ok(Message::Stimulus { to, from, page })
    }
}

impl ConfigureCommand {
    fn message(&self) -> Result<Message, String> {
        let wrong = |error: parameter::ParameterTextError| error.to_string();
        let request = match (&self.request.read, self.request.write.as_deref()) {
            (Some(name), _) => Request::Read { number: parameter::parse_number(name).map_err(wrong)? },
            (None, Some([name, values @ ..])) => {
                let (number, words) = parameter::parse_write(name, values).map_err(wrong)?;
                Request::Write { number, words }
            }
            (None, None | Some([])) => return Err("use --read or --write".to_owned()),
        };
        Ok(Message::Configure { to: self.cell.node, tag: self.tag, request })
    }
}

/// Parses the value of an option. An error names the option, the value and the allowed values.
fn parse_option_value<T>(
    option: &str,
    text: &str,
    read: impl Fn(&str) -> Result<T, String>,
) -> Result<T, String> {
    read(text).map_err(|allowed| format!("{option} {text}: {allowed}"))
}

/// Parses a value of a sensor field.
fn parse_sensor_value<const F: u32>(option: &str, name: &str, text: &str) -> Result<Q<F>, String> {
    let field = stimulus_layouts().flat_map(|layout| &layout.fields).find(|field| field.name == name);
    let field = field.ok_or_else(|| format!("{option}: cells have no sensor for {name}"))?;
    let word = parse_option_value(option, text, |text| {
        parameter::parse_finite(text).and_then(|_| parameter::parse_value(field, text))
    })?;
    Ok(Q::from_bits(word))
}

/// Parses `N` numbers, or returns zeros if none are given.
fn sensor_values<const F: u32, const N: usize>(
    option: &str,
    name: &str,
    texts: &[String],
) -> Result<[Q<F>; N], String> {
    let mut all = [Q::ZERO; N];
    for (one, text) in all.iter_mut().zip(texts) {
        *one = parse_sensor_value(option, name, text)?;
    }
    Ok(all)
}

/// Parses a force in N, and divides it among the three contact words.
fn parse_force_words(text: &str) -> Result<[Q5_10; 3], String> {
    let force = parse_option_value("--force", text, parameter::parse_finite)?;
    let words = contact_words(force);
    let sum: f64 = words.into_iter().map(Q::to_f64).sum();
    if (sum - force).abs() > 1.0 / 1_024.0 {
        let [min, max] = [Q5_10::MIN, Q5_10::MAX].map(|word| 3.0 * word.to_f64());
        return Err(format!(
            "--force {text}: use {min} to {max:.3} N, the most that a cell's three contact sensors can report"
        ));
    }
    Ok(words)
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use protocol::id::Node;

    #[derive(Parser)]
    struct Line {
        #[command(subcommand)]
        what: PacketCommand,
    }

    fn message(line: &str) -> Result<Message, String> {
        let words = std::iter::once("frame").chain(line.split(' '));
        Line::try_parse_from(words).unwrap_or_else(|error| panic!("{error}")).what.message()
    }

    fn says(line: &str) -> String {
        message(line).unwrap_err()
    }

    #[test]
    fn what_cannot_be_is_said_with_what_can() {
        assert_eq!(says("joints --epoch 7 --rad 0 x"), "--rad x: it must be a number");
        assert_eq!(
            says("joints --epoch 7 --words 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15"),
            "--words has 15 positions: a chain has at most 14 joints"
        );
        assert_eq!(
            says("stimulus --cell 12 --force 96"),
            "--force 96: use -96 to 95.997 N, the most that a cell's three contact sensors can report"
        );
        assert_eq!(says("stimulus --cell 12 --force nan"), "--force nan: it must be a number");
        assert_eq!(says("stimulus --cell 12 --proximity -0.1"), "--proximity -0.1: proximity is 0 to 1");
        assert_eq!(
            says("stimulus --cell 12 --temperature 20 512"),
            "--temperature 512: it must be in [-512, 512)"
        );
        for wrong in ["0", "255", "gateway", "-1", "x", "vcan0:0", ":3", ""] {
            assert_eq!(addressee(wrong).unwrap_err(), "use a node id from 1 to 254, BUS:NODE, or everyone");
        }
        assert_eq!(says("configure --cell 12 --write mode 2"), "mode = 2: 0 measures, 1 obeys stimuli");
    }

    #[test]
    fn a_force_is_shared_and_adds_up_to_its_nearest_word() {
        for (force, steps) in
            [("3.0", 3_072), ("-96", -98_304), ("95.997", 98_301), ("0.0005", 1), ("1", 1_024)]
        {
            let Ok(Message::Stimulus {
                page: SensorPage::Skin(skin),
                from: StimulusStart::Next,
                to: Node::Everyone,
            }) = message(&format!("stimulus --cell everyone --force {force}"))
            else {
                panic!("{force}");
            };
            assert_eq!(
                skin.contact.map(|word| i32::from(word.to_bits())).iter().sum::<i32>(),
                steps,
                "{force}"
            );
        }
    }

    #[test]
    fn radians_are_wrapped_and_words_are_taken_as_they_are() {
        let rad = message("joints --epoch 7 --rad 0 -1.2 1.0 -1.4 -1.57 6.283185307179586").unwrap();
        let words = message("joints --epoch 7 --words 0 0xCF1C 10430 -14603 0xc008 0").unwrap();
        assert_eq!(rad, words);
    }
}
