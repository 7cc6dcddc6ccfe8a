//! Time on embedded buses: with bit rates, frames take time as on a real bus.

use std::fmt;
use std::str::FromStr;

use bus_model::{TransmitQueue, TransmitQueueError};
use protocol::bus::Bus;
use protocol::skin::{BusTime, SkinBus};
use protocol::wire_time::BitRates;
use thiserror::Error;

/// The user's choice whether frames take time on the buses that a program serves.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum BusTimeChoice {
    /// As the skin says.
    #[default]
    Described,
    /// Frames take no time on any bus.
    None,
    /// Frames take time on all buses, and programs have this transmit queue.
    Real(TransmitQueue),
}

/// The error for a text that is not a choice of time.
#[derive(Clone, Debug, Error)]
pub enum BusTimeChoiceError {
    /// The text begins with another word.
    #[error("use none or real, or real with a transmit queue, such as real:fifo:10")]
    Word,
    /// The transmit queue is not valid.
    #[error(transparent)]
    Queue(#[from] TransmitQueueError),
}

impl FromStr for BusTimeChoice {
    type Err = BusTimeChoiceError;

    fn from_str(text: &str) -> Result<Self, BusTimeChoiceError> {
        match text.split_once(':').unwrap_or((text, "")) {
            ("none", "") if text == "none" => Ok(Self::None),
            ("real", "") if text == "real" => Ok(Self::Real(TransmitQueue::default())),
            ("real", queue) => Ok(Self::Real(queue.parse()?)),
            _ => Err(BusTimeChoiceError::Word),
        }
    }
}

/// The time that frames take on a served bus.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct ServedTime {
    /// Bit rates of the bus.
    pub rates: BitRates,
    /// Transmit queue of each program.
    pub queue: TransmitQueue,
}

impl fmt::Display for ServedTime {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}, {}", self.rates, self.queue)
    }
}

impl BusTimeChoice {
    /// Returns the time that frames take on a bus; `None` if they take none. The bit rates are those of the skin, else
    /// 1 Mbit/s with data at 5 Mbit/s.
    #[must_use]
    pub fn served_time(self, bus: &SkinBus) -> Option<ServedTime> {
        let queue = match (self, bus.time) {
            (Self::None, _) | (Self::Described, BusTime::None) => return None,
            (Self::Described, BusTime::Real) => TransmitQueue::default(),
            (Self::Real(queue), _) => queue,
        };
        Some(ServedTime { rates: bus.rates_or_default(), queue })
    }
}

/// A bus on which frames must take time, and do not.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
pub enum BusTimeError {
    /// The bus is a SocketCAN interface.
    #[error(
        "{0} is a SocketCAN interface, on which the kernel decides how long frames take: add --bus-kind embedded, or \
         --bus-time none"
    )]
    Interface(String),
    /// Another program serves the bus without bit rates.
    #[error(
        "{bus} is served by another program without bit rates: end it, or start it as `vcan-setup serve {bus} --rates \
         {rates}`, or add --bus-time none"
    )]
    Untimed {
        /// Name of the bus.
        bus: String,
        /// The bit rates that it should have.
        rates: BitRates,
    },
}

/// Checks that frames take time on an open bus, if they must.
///
/// # Errors
/// Returns [`BusTimeError`] if they must and do not.
pub fn check_bus_time(bus: &Bus, time: Option<ServedTime>) -> Result<(), BusTimeError> {
    match time {
        Some(_) if bus.kind().is_interface() => Err(BusTimeError::Interface(bus.name().to_owned())),
        Some(ServedTime { rates, .. }) if !bus.is_timed() => {
            Err(BusTimeError::Untimed { bus: bus.name().to_owned(), rates })
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_choice_is_a_word_with_a_queue() {
        let parse = |text: &str| text.parse::<BusTimeChoice>().map_err(|error| error.to_string());
        assert_eq!(parse("none"), Ok(BusTimeChoice::None));
        assert_eq!(parse("real"), Ok(BusTimeChoice::Real(TransmitQueue::default())));
        assert_eq!(parse("real:fifo:10"), Ok(BusTimeChoice::Real("fifo:10".parse().unwrap())));
        for wrong in ["", "Real", "none:", "real:", "real:lifo", "no"] {
            assert!(parse(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn the_option_goes_before_the_skin() {
        let skin = |bus: &str| {
            let text = model::generate::generate(&model::generate::SkinRequest::default()).unwrap();
            let text = text.replace("format = \"fd\"", bus);
            protocol::skin::Skin::parse("skin.toml", &text).unwrap().buses.remove(0)
        };
        let plain = skin("format = \"fd\"");
        let real = skin("format = \"fd\"\nbitrate = 500000\ndata_bitrate = 2000000\ntime = \"real\"");
        let served = |choice: BusTimeChoice, bus: &SkinBus| choice.served_time(bus).map(|it| it.to_string());
        let fifo = BusTimeChoice::Real("fifo:3".parse().unwrap());
        assert_eq!(served(BusTimeChoice::Described, &plain), None);
        assert_eq!(served(BusTimeChoice::Described, &real).unwrap(), "500k/2M, priority:32");
        assert_eq!(served(BusTimeChoice::None, &real), None);
        assert_eq!(served(fifo, &plain).unwrap(), "1M/5M, fifo:3");
        assert_eq!(served(fifo, &real).unwrap(), "500k/2M, fifo:3");
        assert_eq!(served(fifo, &skin("format = \"classic\"")).unwrap(), "1M, fifo:3");
    }
}
