//! Models the timing of captured traffic on a real bus: the bits of each frame, the time at which the frame is sent,
//! and the loads and delays that result.
//!
//! ```text
//!   capture or live bus ──> receive ──> [ window ] ──> [ NodeBus ]  ──┬──> poll: FrameTiming, in the order of the frames
//!                           for each bus:  sorts,      arbitrates     └──> report: load, delays, late replies, queues
//! ```
//!
//! A frame's time stamp is taken as the time of its sender's request, which is correct on a bus without bit rate (vcan,
//! the embedded bus); on a timed bus it is the end of the frame. Each sender has a transmit buffer for each of its identifiers. Memory is bounded: frames out of
//! order are sorted within [`REORDER_WINDOW_NS`] and [`MAX_WAITING_FRAMES`], and at most 4 194 304 frames
//! wait on a bus.

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
use protocol::wire_time::{BitRates, FrameBits};

use crate::fit;
use crate::fit::verdict::FitSummary;
use bus_model::{BitErrors, BitErrorsError};
use bus_timing::{BusProperties, BusTiming};
use reported::FrameTimings;

pub use phase::OPERATION_PAUSE_NS;
pub use report::{
    AnsweringCounts, BusShadow, BusyStretches, DelayQuantiles, FrameCounts, KindDelays, Loads, Peak,
    ReplyStatistics, ShadowReport, StartUpFigures,
};
pub use reported::FrameTiming;
pub use trace::order::{MAX_WAITING_FRAMES, REORDER_WINDOW_NS};

/// Duration without a pause from which a bus counts as saturated, in ns: the most common period of joints.
pub const SATURATED_NS: u64 = 16_000_000;
/// Length of the longer window in which the load is measured, in ns.
const SECOND_NS: u64 = 1_000_000_000;

/// Maximum number of modelled buses.
pub const MAX_BUSES: usize = 64;

/// Properties of the modelled buses.
#[derive(Clone, Debug)]
pub struct ShadowOptions {
    /// Bit rates of the buses that `of_bus` does not name.
    pub rates: BitRates,
    /// Bit rates of single buses, by name.
    pub rates_by_bus: Vec<(String, BitRates)>,
    /// Share of bits that the model damages, in [0, [`BitErrors::MAX_RATE`]].
    pub bit_errors: f64,
    /// Seed of the random bit errors; each bus derives its own.
    pub seed: u64,
    /// True if [`Shadow::poll`] returns the transmission of each frame.
    pub each_frame: bool,
    /// True to include frames that only a bench sends.
    pub bench_traffic: bool,
    /// The buses whose time stamps are the ends of frames. No queueing is modelled for them.
    pub stamped_at_end: StampedAtEnd,
    /// The skin, from which the worst case is computed for comparison with the capture.
    pub skin: Option<Skin>,
}

/// Buses whose time stamps are the ends of frames, as on a timed or a real bus.
#[derive(Clone, Debug)]
pub enum StampedAtEnd {
    /// These buses.
    Named(Vec<String>),
    /// All buses.
    All,
}

impl Default for StampedAtEnd {
    fn default() -> Self {
        Self::Named(Vec::new())
    }
}

impl ShadowOptions {
    /// Returns options with these bit rates for all buses, and defaults for everything else.
    #[must_use]
    pub const fn new(rates: BitRates) -> Self {
        Self {
            rates,
            rates_by_bus: Vec::new(),
            bit_errors: 0.0,
            seed: 1,
            each_frame: false,
            bench_traffic: false,
            stamped_at_end: StampedAtEnd::Named(Vec::new()),
            skin: None,
        }
    }

    fn bus_properties(&self, bus: &str) -> BusProperties {
        let named = self.rates_by_bus.iter().find(|(name, _)| name == bus);
        let rates = named.map_or(self.rates, |(_, rates)| *rates);
        let described = self.skin.as_ref().and_then(|skin| Some((skin, skin.bus_index(bus)?)));
        let cells =
            described.map(|(skin, bus)| u32::try_from(skin.cells_on_bus(bus).count()).unwrap_or(u32::MAX));
        let worst_case = described.and_then(|(skin, bus)| fit::assess_worst_case(skin, bus, rates));
        let worst_case = worst_case.as_ref().map(FitSummary::worst_case);
        let is_timed = match &self.stamped_at_end {
            StampedAtEnd::All => true,
            StampedAtEnd::Named(buses) => buses.iter().any(|name| name == bus),
        };
        BusProperties { rates, cells, worst_case, bench_traffic: self.bench_traffic, is_timed }
    }
}

/// The latest time of a frame, in ns since 1970.
const MAX_TIME_NS: u64 = u64::MAX / 2;

/// The model of all buses of a capture.
#[derive(Debug)]
pub struct Shadow {
    options: ShadowOptions,
    bus_timings: Vec<BusTiming>,
    reported: Option<FrameTimings>,
    frames: u64,
    further: u64,
    has_times: bool,
}

impl Shadow {
    /// Creates a model before any traffic.
    ///
    /// # Errors
    /// Returns [`BitErrorsError`] if the bit-error rate is outside its range.
    pub fn new(options: ShadowOptions) -> Result<Self, BitErrorsError> {
        BitErrors::new(options.bit_errors, options.seed)?;
        let reported = options.each_frame.then(FrameTimings::default);
        Ok(Self { options, bus_timings: Vec::new(), reported, frames: 0, further: 0, has_times: true })
    }

    /// Handles the next frame of a bus, at a time in ns since 1970. A time after the year 2262 is set to the end of
    /// that year, so that the later time of its transmission can still be represented.
    pub fn receive(&mut self, bus: &str, nanos: u64, frame: &Frame) {
        let nanos = nanos.min(MAX_TIME_NS);
        let place = self.frames;
        self.frames += 1;
        let bus_timing = self.bus_timing(bus);
        let bits = bus_timing.and_then(|_| FrameBits::from_frame(frame));
        if let Some(reported) = &mut self.reported {
            let (id, extended) =
                (frame.id() | frame.raw_id() & ERROR, frame.is_extended() || frame.is_error());
            reported.add_frame(FrameTiming { nanos, bus: bus_timing, id, extended, bits, sent: None });
        }
        let Some(bus_timing) = bus_timing.and_then(|bus_timing| self.bus_timings.get_mut(bus_timing)) else {
            self.further += 1;
            return;
        };
        bus_timing.count_frame(nanos);
        match bits {
            Some(bits) => bus_timing.receive_frame(nanos, frame, bits, place, self.reported.as_mut()),
            None => bus_timing.counts.error_frames += 1,
        }
    }

    /// Handles a packet from before the start of the capture, which still has an effect.
    pub fn receive_latched(&mut self, bus: &str, nanos: u64, frame: &Frame) {
        let bus_timing = self.bus_timing(bus).and_then(|bus_timing| self.bus_timings.get_mut(bus_timing));
        bus_timing.into_iter().for_each(|bus_timing| bus_timing.receive_latched(nanos, frame));
    }

    /// Records a number of frames that the recorder lost on a bus.
    pub fn record_missing(&mut self, bus: &str, frames: u64) {
        if let Some(bus_timing) =
            self.bus_timing(bus).and_then(|bus_timing| self.bus_timings.get_mut(bus_timing))
        {
            bus_timing.counts.missing = bus_timing.counts.missing.saturating_add(frames);
        }
    }

    /// Declares that the times of frames are meaningless and only give the order. Loads and delays are then omitted.
    pub const fn without_times(&mut self) {
        self.has_times = false;
    }

    /// Ends the input: all waiting frames are sent.
    pub fn finish(&mut self) {
        self.bus_timings.iter_mut().for_each(|bus_timing| bus_timing.finish(self.reported.as_mut()));
        self.reported.iter_mut().for_each(FrameTimings::finish);
    }

    /// Returns the next frame in input order, once its transmission is known.
    pub fn poll(&mut self) -> Option<FrameTiming> {
        self.reported.as_mut()?.poll_frame()
    }

    /// Returns the name of a bus, given its number in [`FrameTiming::bus`].
    #[must_use]
    pub fn bus(&self, bus: usize) -> &str {
        self.bus_timings.get(bus).map_or("", |bus_timing| &bus_timing.name)
    }

    /// Returns true if the time stamps of a bus, given as in [`FrameTiming::bus`], are the ends of its frames.
    #[must_use]
    pub fn is_timed(&self, bus: usize) -> bool {
        self.bus_timings.get(bus).is_some_and(BusTiming::is_timed)
    }

    /// Returns the figures of all buses.
    #[must_use]
    pub fn report(&self) -> ShadowReport {
        ShadowReport {
            frames: self.frames,
            frames_of_other_buses: self.further,
            bit_error_rate: self.options.bit_errors,
            has_times: self.has_times,
            buses: self.bus_timings.iter().map(|bus| bus.to_bus_shadow(self.has_times)).collect(),
        }
    }

    fn bus_timing(&mut self, bus: &str) -> Option<usize> {
        // Usually the bus of the previous frame, or one of a few.
        let known = self.bus_timings.iter().position(|bus_timing| bus_timing.name == bus);
        if known.is_some() || self.bus_timings.len() >= MAX_BUSES {
            return known;
        }
        let index = self.bus_timings.len();
        let seed = self.options.seed.wrapping_add(u64::try_from(index).unwrap_or(0));
        let errors = BitErrors::new(self.options.bit_errors, seed).ok();
        let errors = errors.filter(|_| self.options.bit_errors > 0.0);
        self.bus_timings.push(BusTiming::new(bus, self.options.bus_properties(bus), errors));
        Some(index)
    }
}

/// An identifier, and true if it has 29 bits; formatted as by candump.
#[derive(Clone, Copy, Debug)]
pub struct Identifier(pub u32, pub bool);

impl Display for Identifier {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Self(id, extended) = *self;
        if extended { write!(f, "{id:08X}") } else { write!(f, "{id:03X}") }
    }
}
