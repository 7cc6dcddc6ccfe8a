//! An open bus on which others send: receives their frames and sends single packets.

use std::time::Duration;

use model::decode::{Decoded, Decoder};
use protocol::bus::{Bus, BusError, BusOptions, Inbox, KindChoice, ReceivedFrame};
use protocol::can::{Format, Frame};
use protocol::message::Message;
use protocol::time::Micros;

use super::follow::receive_batch;
use super::realtime::wall_clock_ns;

/// Opens a bus for frames of this format. `None` means FD frames, or classic frames if the interface carries only
/// those.
///
/// # Errors
/// Returns [`BusError`] if the bus cannot be opened.
pub fn open_bus(
    name: &str,
    kind: KindChoice,
    format: Option<Format>,
    options: BusOptions,
) -> Result<Bus, BusError> {
    let options = BusOptions { fd: format != Some(Format::Classic), ..options };
    match Bus::open(name, kind, &options) {
        Err(BusError::ClassicOnly { .. }) if format.is_none() => {
            Bus::open(name, kind, &BusOptions { fd: false, ..options })
        }
        opened => opened,
    }
}

/// Returns the present time on the clock that stamps received frames.
#[must_use]
pub fn now() -> Micros {
    Micros(wall_clock_ns() / 1_000)
}

/// Sends one packet in frames of this format.
///
/// # Errors
/// Returns [`BusError`] if the bus refuses the frames.
pub fn send_message(bus: &Bus, message: &Message, format: Format) -> Result<(), BusError> {
    let frames: Vec<Frame> = message.encode().frames(format).collect();
    bus.send(&frames).map_err(BusError::from)
}

/// Receives and decodes the frames of a bus.
#[derive(Debug)]
pub struct Listener {
    bus: Bus,
    inbox: Inbox,
    decoder: Decoder,
}

impl Listener {
    /// Receives on a bus whose packets have this format; with `None`, each frame has its own format.
    #[must_use]
    pub fn new(bus: Bus, format: Option<Format>) -> Self {
        Self { bus, inbox: Inbox::new(), decoder: Decoder::new(format) }
    }

    /// The open bus.
    #[must_use]
    pub const fn bus(&self) -> &Bus {
        &self.bus
    }

    /// Number of frames lost because they arrived faster than this program read them.
    #[must_use]
    pub const fn dropped_frames(&self) -> u32 {
        self.inbox.dropped_count()
    }

    /// Receives the frames that are waiting or arrive within `wait`. Returns true if there are any.
    ///
    /// # Errors
    /// Returns [`BusError`] if the bus is down, gone or closed.
    pub fn receive(&mut self, wait: Duration) -> Result<bool, BusError> {
        receive_batch(&self.bus, &mut self.inbox, wait).map(|count| count > 0)
    }

    /// The frames received last.
    pub fn frames(&self) -> impl Iterator<Item = ReceivedFrame> + '_ {
        self.inbox.frames()
    }

    /// The frames received last, decoded.
    pub fn decoded_frames(&mut self) -> impl Iterator<Item = (ReceivedFrame, Decoded)> + '_ {
        let Self { bus, inbox, decoder } = self;
        inbox.frames().map(|received| {
            let at = Micros(received.at_nanos / 1_000);
            (received, decoder.decode(at, bus.name(), &received.frame))
        })
    }
}

/// Turns the error of a bus that is down or full into `None` after a pause of `pause`, because the bus may soon be
/// usable again.
///
/// # Errors
/// Returns all other errors.
pub fn tolerate_transient_error<T>(
    done: Result<T, BusError>,
    pause: Duration,
) -> Result<Option<T>, BusError> {
    match done {
        Ok(done) => Ok(Some(done)),
        Err(error) if error.is_temporary() => {
            std::thread::sleep(pause);
            Ok(None)
        }
        Err(error) => Err(error),
    }
}
