//! The options of a line on the command line: its address, the frames it gets, and the setup of its adapter.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use protocol::bus::Filter;
use protocol::can::{EXTENDED, EXTENDED_MASK, REMOTE, STANDARD_MASK};
use protocol::id::{CellId, Id};
use protocol::slcan::SlcanCommand;
use protocol::wire_time::BitRates;
use thiserror::Error;

/// The address of a line.
#[derive(Clone, Debug, Eq, Hash, PartialEq)]
pub enum LineAddress {
    /// A terminal: the device of an adapter, or a pseudoterminal.
    Tty(PathBuf),
    /// A Unix socket on which a program listens.
    Unix(PathBuf),
    /// A TCP socket on which a program listens.
    Tcp {
        /// The name or address of the host.
        host: String,
        /// The port.
        port: u16,
    },
}

/// The address of a line, the frames it gets, and the setup of its adapter.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct LineOptions {
    /// The address.
    pub address: LineAddress,
    /// Filters for frames from the bus to the line. A frame passes if it matches any of them, or if there are none.
    pub filters: Vec<Filter>,
    /// The bit rates to set in the adapter; `None` leaves them as they are.
    pub bit_rates: Option<BitRates>,
    /// The speed to set for the terminal in bit/s; `None` leaves it as it is.
    pub baud: Option<u32>,
    /// True if the adapter does not support CAN FD. FD frames for it are dropped.
    pub classic: bool,
    /// The time from opening the line until the adapter accepts commands. Some boards are reset when the line is
    /// opened.
    pub settle: Duration,
}

/// The reason why a line argument is invalid.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum LineError {
    /// The address has none of the supported forms.
    #[error(
        "{0:?} is not a line: use a form such as /dev/ttyACM0, unix:/path/to/socket or tcp:localhost:3333"
    )]
    Address(String),
    /// The option is unknown.
    #[error(
        "{line}: {got:?} is not an option of a line: use cell=12, cell=1-8, filter=100:700, rates=1M/5M, baud=115200, settle=2 or classic"
    )]
    Unknown {
        /// The address of the line.
        line: String,
        /// The unknown option.
        got: String,
    },
    /// The value of an option is invalid.
    #[error("{line}: {got:?}: {expected}")]
    Value {
        /// The address of the line.
        line: String,
        /// The option with the invalid value.
        got: String,
        /// A description of the allowed values.
        expected: String,
    },
}

/// The maximum value of [`LineOptions::settle`], in s.
const MAX_SETTLE_S: f64 = 60.0;
/// The time between two commands that open an adapter. Adapters process one command per USB packet, and answer within
/// this time.
const COMMAND_GAP: Duration = Duration::from_millis(10);
/// The time after the command that closes the adapter. Its answer, which is a refusal if the adapter was already
/// closed, must arrive before the next command is sent.
const CLOSE_GAP: Duration = Duration::from_millis(30);

/// One of the commands that open an adapter.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct OpeningStep {
    /// The bytes of the command.
    pub bytes: Vec<u8>,
    /// The minimum time from this command to the next one.
    pub gap: Duration,
    /// The stage of opening that begins with the command.
    pub stage: OpeningStage,
}

/// The stage that the opening of an adapter has reached.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum OpeningStage {
    /// No command was sent yet.
    #[default]
    Away,
    /// The command to close the adapter was sent. The adapter refuses it if it was already closed.
    Closed,
    /// Commands to set the bit rates were sent.
    Setting,
    /// The command to open the adapter was sent: it takes part in its bus.
    Open,
}

/// A description of the bit rates that slcan supports, for an error.
const ALLOWED_RATES: &str = "slcan has the bit rates 10k, 20k, 50k, 83.3k, 100k, 125k, 250k, 500k, 750k or 800k, and 1M; \
                     for data 500k and whole Mbit/s up to 8M";

/// A description of the allowed values of [`LineOptions::settle`], for an error.
pub const ALLOWED_SETTLE_TIMES: &str = "use 0 to 60 seconds, such as 2 or 0.5";

/// Parses a value of [`LineOptions::settle`], given in s.
#[must_use]
pub fn parse_settle_time(word: &str) -> Option<Duration> {
    let seconds = word.parse().ok().filter(|seconds| (0.0..=MAX_SETTLE_S).contains(seconds))?;
    Duration::try_from_secs_f64(seconds).ok()
}

impl LineOptions {
    /// Returns the options of a line that gets all frames and whose speed and bit rates are left as they are.
    #[must_use]
    pub const fn new(address: LineAddress) -> Self {
        Self {
            address,
            filters: Vec::new(),
            bit_rates: None,
            baud: None,
            classic: false,
            settle: Duration::ZERO,
        }
    }

    /// Adds filters for the frames that a cell receives. The line then gets only these frames and those of its other
    /// filters.
    pub fn add_cell(&mut self, cell: CellId) {
        for filter in Id::ids_received_by_cell(cell).map(Filter::exact) {
            if !self.filters.contains(&filter) {
                self.filters.push(filter);
            }
        }
    }

    /// Sets the bit rates that the adapter is to use.
    ///
    /// # Errors
    /// Returns an error text if slcan has no command for one of the bit rates.
    pub fn set_bit_rates(&mut self, rates: BitRates) -> Result<(), String> {
        let data = rates.data_rate();
        if SlcanCommand::nominal_bit_rate(rates.nominal_rate()).is_none()
            || (data != rates.nominal_rate() && SlcanCommand::data_bit_rate(data).is_none())
        {
            return Err(ALLOWED_RATES.to_owned());
        }
        self.bit_rates = Some(rates);
        Ok(())
    }

    /// Returns the commands that open the adapter: they end an incomplete line, close the adapter, set the bit rates,
    /// and open the adapter again. The data bit rate is set even if it equals the nominal one, because adapters have
    /// other defaults.
    #[must_use]
    pub fn opening_steps(&self) -> Vec<OpeningStep> {
        let rates = self.bit_rates;
        let data =
            rates.filter(|_| !self.classic).map(BitRates::data_rate).and_then(SlcanCommand::data_bit_rate);
        let line = |command: SlcanCommand| command.encode().as_bytes().to_vec();
        let settings = [rates.and_then(|rates| SlcanCommand::nominal_bit_rate(rates.nominal_rate())), data];
        let settings =
            settings.into_iter().flatten().map(|command| (line(command), COMMAND_GAP, OpeningStage::Setting));
        [
            (vec![protocol::slcan::CR], COMMAND_GAP, OpeningStage::Away),
            (line(SlcanCommand::Close), CLOSE_GAP, OpeningStage::Closed),
        ]
        .into_iter()
        .chain(settings)
        .chain([(line(SlcanCommand::Open), COMMAND_GAP, OpeningStage::Open)])
        .map(|(bytes, gap, stage)| OpeningStep { bytes, gap, stage })
        .collect()
    }

    /// Returns true if FD frames may use the data bit rate. If the data bit rate equals the nominal one, switching has
    /// no benefit, and it fails on adapters without a command for the data bit rate.
    #[must_use]
    pub fn switches_bit_rate(&self) -> bool {
        self.bit_rates.is_none_or(|rates| rates.data_rate() != rates.nominal_rate())
    }

    fn apply_option(&mut self, option: &str) -> Result<(), LineError> {
        let line = self.address.to_string();
        let wrong = |expected: &dyn fmt::Display| LineError::Value {
            line: line.clone(),
            got: option.to_owned(),
            expected: expected.to_string(),
        };
        let (key, value) = option.split_once('=').unwrap_or((option, ""));
        match key {
            "cell" => {
                let (first, last) = value.split_once('-').unwrap_or((value, value));
                let cell = |text: &str| text.parse::<CellId>().ok();
                let expected = "use node ids from 1 to 254, as in cell=12 or cell=1-8";
                let (first, last) = cell(first).zip(cell(last)).ok_or_else(|| wrong(&expected))?;
                if first > last {
                    return Err(wrong(&expected));
                }
                CellId::all()
                    .filter(|cell| (first..=last).contains(cell))
                    .for_each(|cell| self.add_cell(cell));
                if self.filters.len() > Filter::MAX_COUNT {
                    return Err(wrong(&format!(
                        "these cells need {} filters, but a line can have at most {}: name fewer cells, or \
                         leave out cell=",
                        self.filters.len(),
                        Filter::MAX_COUNT
                    )));
                }
            }
            "filter" => {
                let filter = parse_filter(value).ok_or_else(|| {
                    let forms = "filter=100:700, or 8 digits each for 29 bits";
                    wrong(&format!("use an identifier and a mask, as in candump: {forms}"))
                })?;
                self.filters.push(filter);
            }
            "rates" => {
                let rates: BitRates = value.parse().map_err(|error| wrong(&error))?;
                let mut with = self.clone();
                with.set_bit_rates(rates).map_err(|expected| wrong(&expected))?;
                *self = with;
            }
            "baud" => {
                let baud = value.parse().ok().filter(|baud| *baud > 0);
                self.baud = Some(baud.ok_or_else(|| wrong(&"use a speed in bit/s, as in baud=115200"))?);
            }
            "settle" => {
                self.settle = parse_settle_time(value).ok_or_else(|| wrong(&ALLOWED_SETTLE_TIMES))?;
            }
            "classic" if option == "classic" => self.classic = true,
            _ => {
                return Err(LineError::Unknown { line: self.address.to_string(), got: option.to_owned() });
            }
        }
        Ok(())
    }
}

/// Parses a filter: identifier and mask, with 3 digits for frames of 11 bits and 8 digits for frames of 29 bits.
fn parse_filter(text: &str) -> Option<Filter> {
    let (id, mask) = text.split_once(':')?;
    let (max, flag) = match id.len() {
        3 => (STANDARD_MASK, 0),
        8 => (EXTENDED_MASK, EXTENDED),
        _ => return None,
    };
    let number = |text: &str| {
        let is_hex = text.bytes().all(|byte| byte.is_ascii_hexdigit());
        u32::from_str_radix(text, 16).ok().filter(|number| is_hex && *number <= max)
    };
    Some(Filter { id: number(id)? | flag, mask: number(mask)? | EXTENDED | REMOTE })
}

impl FromStr for LineOptions {
    type Err = LineError;

    fn from_str(text: &str) -> Result<Self, LineError> {
        let mut words = text.split(',');
        let mut options = Self::new(words.next().unwrap_or_default().parse()?);
        for word in words {
            options.apply_option(word)?;
        }
        Ok(options)
    }
}

impl FromStr for LineAddress {
    type Err = LineError;

    fn from_str(text: &str) -> Result<Self, LineError> {
        let wrong = || LineError::Address(text.to_owned());
        match text.split_once(':') {
            Some(("unix", path)) if !path.is_empty() => Ok(Self::Unix(path.into())),
            Some(("tcp", rest)) => {
                let (host, port) = rest.rsplit_once(':').ok_or_else(wrong)?;
                let host = host.strip_prefix('[').and_then(|host| host.strip_suffix(']')).unwrap_or(host);
                let port = port.parse().ok().filter(|port| *port > 0 && !host.is_empty());
                Ok(Self::Tcp { host: host.to_owned(), port: port.ok_or_else(wrong)? })
            }
            _ if text.contains('/') && !text.starts_with("unix:") => Ok(Self::Tty(text.into())),
            _ => Err(wrong()),
        }
    }
}

impl fmt::Display for LineAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tty(path) => path.display().fmt(f),
            Self::Unix(path) => write!(f, "unix:{}", path.display()),
            Self::Tcp { host, port } if host.contains(':') => write!(f, "tcp:[{host}]:{port}"),
            Self::Tcp { host, port } => write!(f, "tcp:{host}:{port}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(text: &str) -> LineOptions {
        text.parse().unwrap_or_else(|error| panic!("{error}"))
    }

    fn wrong(text: &str) -> String {
        text.parse::<LineOptions>().unwrap_err().to_string()
    }

    #[test]
    fn addresses_are_written_as_they_are_read() {
        for text in
            ["/dev/ttyACM0", "./pty", "unix:/run/cell.sock", "unix:a", "tcp:localhost:3333", "tcp:[::1]:1"]
        {
            assert_eq!(line(text).address.to_string(), text);
        }
        for text in
            ["", "ttyACM0", "unix:", "tcp:", "tcp:host", "tcp::1", "tcp:host:0", "tcp:host:70000", "unix"]
        {
            assert_eq!(
                wrong(text),
                format!(
                    "{text:?} is not a line: use a form such as /dev/ttyACM0, unix:/path/to/socket or tcp:localhost:3333"
                )
            );
        }
    }

    #[test]
    fn a_cells_filters_are_what_a_cell_receives() {
        let one = line("/dev/ttyACM0,cell=12");
        let passes =
            |line: &LineOptions, id: u32| line.filters.iter().any(|it| id & it.mask == it.id & it.mask);
        for id in [0, 1, 2, 3, 4, 0x40C, 0x50C, 0x5FF, 0x70C, 0x7FF] {
            assert!(passes(&one, id), "{id:X}");
        }
        for id in [5, 0x10C, 0x20C, 0x30C, 0x60C, 0x40D, 0x50D, 0x70D, EXTENDED | 1, REMOTE | 1] {
            assert!(!passes(&one, id), "{id:X}");
        }
        assert_eq!(one.filters.len(), 10);
        // Some filters are the same for all cells. They are added once.
        let three = line("/dev/ttyACM0,cell=12-13,cell=40");
        assert_eq!(three.filters.len(), 7 + 3 * 3);
        assert!(passes(&three, 0x50D) && passes(&three, 0x728));
        let with_sums = line("/dev/ttyACM0,cell=12,filter=100:700");
        assert!(
            passes(&with_sums, 0x1AB) && !passes(&with_sums, 0x2AB) && !passes(&with_sums, EXTENDED | 0x1AB)
        );
        let extended = line("/dev/ttyACM0,filter=00000100:1FFFFF00");
        assert!(passes(&extended, EXTENDED | 0x1FF) && !passes(&extended, 0x1FF));
    }

    fn opening(text: &str) -> Vec<u8> {
        line(text).opening_steps().into_iter().flat_map(|step| step.bytes).collect()
    }

    #[test]
    fn an_adapter_is_opened_with_what_is_given() {
        assert_eq!(opening("/dev/x"), b"\rC\rO\r");
        assert_eq!(opening("/dev/x,rates=1M/5M"), b"\rC\rS8\rY5\rO\r");
        assert_eq!(opening("/dev/x,rates=1M/5M,classic"), b"\rC\rS8\rO\r");
        assert_eq!(opening("/dev/x,rates=500k,classic"), b"\rC\rS6\rO\r");
        assert_eq!(line("/dev/x,baud=57600").baud, Some(57_600));
        assert_eq!(line("/dev/x,settle=2.5").settle, Duration::from_millis(2_500));
        assert_eq!(line("/dev/x").settle, Duration::ZERO);
    }

    #[test]
    fn a_data_bit_rate_is_stated_wherever_a_frame_may_switch_to_it() {
        for (rates, expected) in [
            ("1M/1M", "\rC\rS8\rY1\rO\r"),
            ("1M", "\rC\rS8\rY1\rO\r"),
            ("500k/500k", "\rC\rS6\rY0\rO\r"),
            ("500k", "\rC\rS6\rY0\rO\r"),
            ("500k/2M", "\rC\rS6\rY2\rO\r"),
            ("250k", "\rC\rS5\rO\r"),
            ("125k/500k", "\rC\rS4\rY0\rO\r"),
        ] {
            let with = format!("/dev/x,rates={rates}");
            assert_eq!(opening(&with), expected.as_bytes(), "{rates}");
            let line = line(&with);
            let is_stated = line.opening_steps().iter().any(|step| step.bytes.starts_with(b"Y"));
            assert!(is_stated || !line.switches_bit_rate(), "{rates}");
            let [nominal, data] =
                line.bit_rates.map(|rates| [rates.nominal_rate(), rates.data_rate()]).unwrap();
            assert_eq!(line.switches_bit_rate(), nominal != data, "{rates}");
        }
        assert!(line("/dev/x").switches_bit_rate(), "the adapter has its own rates, which somebody has set");
    }

    #[test]
    fn what_no_line_has_is_refused_with_what_it_has() {
        for (text, expected) in [
            ("/dev/x,cell=0", "/dev/x: \"cell=0\": use node ids from 1 to 254, as in cell=12 or cell=1-8"),
            (
                "/dev/x,cell=8-1",
                "/dev/x: \"cell=8-1\": use node ids from 1 to 254, as in cell=12 or cell=1-8",
            ),
            (
                "/dev/x,cell=1-254",
                "/dev/x: \"cell=1-254\": these cells need 769 filters, but a line can have at most 512: name \
                 fewer cells, or leave out cell=",
            ),
            (
                "/dev/x,filter=100",
                "/dev/x: \"filter=100\": use an identifier and a mask, as in candump: filter=100:700, or 8 \
                 digits each for 29 bits",
            ),
            ("/dev/x,settle=-1", "/dev/x: \"settle=-1\": use 0 to 60 seconds, such as 2 or 0.5"),
            ("/dev/x,settle=NaN", "/dev/x: \"settle=NaN\": use 0 to 60 seconds, such as 2 or 0.5"),
            ("/dev/x,baud=fast", "/dev/x: \"baud=fast\": use a speed in bit/s, as in baud=115200"),
            (
                "/dev/x,rates=2M",
                "/dev/x: \"rates=2M\": nominal bit rate 2000000 bit/s: CAN allows 10000 to 1000000 (10k to 1M)",
            ),
        ] {
            assert_eq!(wrong(text), expected);
        }
        assert!(
            wrong("/dev/x,rates=300k")
                .starts_with("/dev/x: \"rates=300k\": slcan has the bit rates 10k, 20k")
        );
        assert!(wrong("/dev/x,rates=500k/2500k").contains("for data 500k and whole Mbit/s up to 8M"));
        for option in ["", "cel=1", "classic=yes", "listen"] {
            let expected = format!("/dev/x: {option:?} is not an option of a line: use cell=12, cell=1-8, ");
            assert!(wrong(&format!("/dev/x,{option}")).starts_with(&expected), "{option}");
        }
    }
}
