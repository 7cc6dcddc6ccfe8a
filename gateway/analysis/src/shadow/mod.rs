//! What a real bus would have made of some traffic: each frame's bits, when it would have gone out, and what that adds up to.
//!
//! ```text
//!   capture or live bus ──> frame ──> [ window ] ──> [ BusModel ] ──┬──> poll: Shaded, one a frame, in the file's order
//!                           for each bus:  sorts,   arbitrates       └──> report: load, delays, late replies, queues
//! ```
//!
//! A frame's time stamp is taken as the time at which its sender requested it, which is right on a bus without bit rate (vcan,
//! the embedded bus); each sender has a transmit buffer for each of its identifiers. In bounded memory, however long it lasts: what is out
//! of order is sorted within [`WINDOW_NS`] and [`WINDOW_FRAMES`], and no more than [`MAX_QUEUE`] frames wait on a bus.

mod bus_timing;
mod epochs;
mod load;
mod phase;
mod report;
mod reported;
#[cfg(test)]
mod tests;

use std::fmt::{self, Display, Formatter};

use protocol::can::{ERROR, Frame};
use protocol::skin::Skin;
use protocol::wire_time::{BitRates, Bits};

use crate::fit;
use crate::fit::verdict::Answer;
use bus_model::{BitErrors, BitErrorsError};
use bus_timing::{Known, LinkId};
use reported::Reported;

pub use bus_timing::MAX_QUEUE;
pub use phase::PAUSE_NS;
pub use report::{
    Answering, BusShadow, Counts, Delays, KindDelays, Loads, Most, Replies, Report, StartUp, Stretches,
};
pub use reported::Shaded;
pub use trace::order::{WINDOW_FRAMES, WINDOW_NS};

/// A bus without a pause for so long, in ns, is saturated: from joints to joints, as mostly set.
pub const SATURATED_NS: u64 = 16_000_000;
/// The longer span in which the load is looked at, in ns.
const SECOND_NS: u64 = 1_000_000_000;

/// Buses that are modelled.
pub const BUSES: usize = 64;

/// What the buses are like.
#[derive(Clone, Debug)]
pub struct Options {
    /// Bit rates of every bus that is not named.
    pub rates: BitRates,
    /// Bit rates by the name of the bus.
    pub of_bus: Vec<(String, BitRates)>,
    /// How many bits are damaged, as a share, in [0, [`BitErrors::MAX`]].
    pub bit_errors: f64,
    /// From what errors are drawn; each bus has its own.
    pub seed: u64,
    /// Whether [`Shadow::poll`] returns each frame.
    pub each_frame: bool,
    /// Whether what only a bench sends is counted.
    pub bench_traffic: bool,
    /// The skin, for the worst case beside what there was.
    pub skin: Option<Skin>,
}

impl Options {
    /// All buses at these rates, and nothing else.
    #[must_use]
    pub const fn new(rates: BitRates) -> Self {
        Self {
            rates,
            of_bus: Vec::new(),
            bit_errors: 0.0,
            seed: 1,
            each_frame: false,
            bench_traffic: false,
            skin: None,
        }
    }

    /// What is known of a bus.
    fn of(&self, bus: &str) -> Known {
        let named = self.of_bus.iter().find(|(name, _)| name == bus);
        let rates = named.map_or(self.rates, |(_, rates)| *rates);
        let described = self.skin.as_ref().and_then(|skin| Some((skin, skin.bus_named(bus)?)));
        let cells =
            described.map(|(skin, bus)| u32::try_from(skin.cells_of(bus).count()).unwrap_or(u32::MAX));
        let worst_case = described.and_then(|(skin, bus)| fit::worst_case(skin, bus, rates));
        let worst_case = worst_case.as_ref().map(Answer::worst_case);
        Known { rates, cells, worst_case, bench_traffic: self.bench_traffic }
    }
}

/// The latest time of a frame, in ns since 1970.
const LATEST: u64 = u64::MAX / 2;

/// Traffic on its way through the model.
#[derive(Debug)]
pub struct Shadow {
    options: Options,
    bus_timings: Vec<LinkId>,
    reported: Option<Reported>,
    frames: u64,
    further: u64,
    has_times: bool,
}

impl Shadow {
    /// Nothing seen yet.
    ///
    /// # Errors
    /// When the bit-error rate is outside its range.
    pub fn new(options: Options) -> Result<Self, BitErrorsError> {
        BitErrors::new(options.bit_errors, options.seed)?;
        let reported = options.each_frame.then(Reported::default);
        Ok(Self { options, bus_timings: Vec::new(), reported, frames: 0, further: 0, has_times: true })
    }

    /// Takes the next frame of a bus, with its time in ns. A time after the year 2262 counts as its end: what a bus makes
    /// of a frame comes later still, and has to be a time as well.
    pub fn frame(&mut self, bus: &str, nanos: u64, frame: &Frame) {
        let nanos = nanos.min(LATEST);
        let place = self.frames;
        self.frames += 1;
        let bus_timing = self.bus_timing(bus);
        let bits = bus_timing.and_then(|_| Bits::of(frame));
        if let Some(reported) = &mut self.reported {
            let (id, extended) =
                (frame.id() | frame.raw_id() & ERROR, frame.is_extended() || frame.is_error());
            reported.enter(Shaded { nanos, bus: bus_timing, id, extended, bits, sent: None });
        }
        let Some(bus_timing) = bus_timing.and_then(|bus_timing| self.bus_timings.get_mut(bus_timing)) else {
            self.further += 1;
            return;
        };
        bus_timing.count(nanos);
        match bits {
            Some(bits) => bus_timing.take(nanos, frame, bits, place, self.reported.as_mut()),
            None => bus_timing.counts.error_frames += 1,
        }
    }

    /// A frame from before the capture that is latched when it begins.
    pub fn latched(&mut self, bus: &str, nanos: u64, frame: &Frame) {
        let bus_timing = self.bus_timing(bus).and_then(|bus_timing| self.bus_timings.get_mut(bus_timing));
        bus_timing.into_iter().for_each(|bus_timing| bus_timing.latched(nanos, frame));
    }

    /// Frames that the recorder lost.
    pub fn missing(&mut self, bus: &str, frames: u64) {
        if let Some(bus_timing) =
            self.bus_timing(bus).and_then(|bus_timing| self.bus_timings.get_mut(bus_timing))
        {
            bus_timing.counts.missing = bus_timing.counts.missing.saturating_add(frames);
        }
    }

    /// The times of the frames are none: they stand for the order alone, and say nothing of loads and delays.
    pub const fn without_times(&mut self) {
        self.has_times = false;
    }

    /// There is no more: all that waits goes out.
    pub fn finish(&mut self) {
        self.bus_timings.iter_mut().for_each(|bus_timing| bus_timing.finish(self.reported.as_mut()));
        self.reported.iter_mut().for_each(Reported::finish);
    }

    /// The next frame, in the order in which they came, once it is known what became of it.
    pub fn poll(&mut self) -> Option<Shaded> {
        self.reported.as_mut()?.poll()
    }

    /// The name of a bus, by [`Shaded::bus`].
    #[must_use]
    pub fn bus(&self, bus: usize) -> &str {
        self.bus_timings.get(bus).map_or("", |bus_timing| &bus_timing.name)
    }

    /// What it adds up to.
    #[must_use]
    pub fn report(&self) -> Report {
        Report {
            frames: self.frames,
            frames_of_other_buses: self.further,
            bit_error_rate: self.options.bit_errors,
            has_times: self.has_times,
            buses: self.bus_timings.iter().map(|bus| bus.report(self.has_times)).collect(),
        }
    }

    fn bus_timing(&mut self, bus: &str) -> Option<usize> {
        // Mostly the one of the frame before, or one of a few.
        let known = self.bus_timings.iter().position(|bus_timing| bus_timing.name == bus);
        if known.is_some() || self.bus_timings.len() >= BUSES {
            return known;
        }
        let index = self.bus_timings.len();
        let seed = self.options.seed.wrapping_add(u64::try_from(index).unwrap_or(0));
        let errors = BitErrors::new(self.options.bit_errors, seed).ok();
        let errors = errors.filter(|_| self.options.bit_errors > 0.0);
        self.bus_timings.push(LinkId::new(bus, self.options.of(bus), errors));
        Some(index)
    }
}

/// An identifier as candump prints it; whether it has more than 11 bits.
#[derive(Clone, Copy, Debug)]
pub struct Identifier(pub u32, pub bool);

impl Display for Identifier {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Self(id, extended) = *self;
        if extended { write!(f, "{id:08X}") } else { write!(f, "{id:03X}") }
    }
}
