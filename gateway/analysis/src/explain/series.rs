//! The torque of every epoch of a capture, each as [`explain`](super::explain) computes it.
//!
//! Buses carry the joints of an epoch one after the other. They are joined by epoch, with the count continued beyond
//! 255.

use std::collections::BTreeMap;

use model::decode::{Decoded, Decoder};
use protocol::packet::Epoch;
use protocol::skin::{SkinReply, Skin};
use protocol::time::Micros;
use thiserror::Error;
use trace::capture::{CaptureError, Entry, Note, Reader};

use super::watch::{Moment, Watch};
use super::{Explainer, Explanation, NotFound};

/// Maximum number of epochs that a bus may lag before it is no longer waited for.
const MAX_BUS_LAG: i64 = 64;

/// The torques of one epoch.
#[derive(Clone, Debug, PartialEq)]
pub struct EpochTorque {
    /// Time of its first joints, in ns since 1970.
    pub at_ns: u64,
    /// Its number, modulo 256.
    pub epoch: u8,
    /// The position of each joint of the robot in rad or m; `None` if its bus has no such joints.
    pub positions: Vec<Option<f64>>,
    /// Its explanation.
    pub explanation: Explanation,
}

/// The error of a series.
#[derive(Debug, Error)]
pub enum SeriesError<E> {
    /// The capture cannot be read, or is damaged.
    #[error(transparent)]
    Capture(#[from] CaptureError),
    /// The capture has no joints of this skin.
    #[error("{name}: {source}")]
    NotFound {
        /// The capture.
        name: String,
        /// The reason.
        source: NotFound,
    },
    /// The consumer of the epochs has failed.
    #[error("{0}")]
    Taken(E),
}

/// The totals of a series.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct SeriesTotals {
    /// Number of epochs.
    pub epochs: u64,
    /// The origin of times in s, in ns since 1970: the first tick of the run, or else the first frame.
    pub zero_ns: u64,
}

/// Reads a capture to its end, and passes each complete epoch to `take`, with the origin of times. Memory is bounded.
///
/// # Errors
/// Returns [`SeriesError`] if the capture cannot be read or has no joints of the skin, or with the first error of
/// `take`.
pub fn each_epoch<E>(
    reader: &mut Reader,
    skin: &Skin,
    mut note: impl FnMut(&Note<'_>),
    mut take: impl FnMut(u64, &EpochTorque) -> Result<(), E>,
) -> Result<SeriesTotals, SeriesError<E>> {
    let mut series = Series::new(skin);
    let mut decoder = Decoder::new(None);
    for before in &reader.extras().latched {
        let at = Micros(before.nanos / 1_000);
        if let Decoded::Message(message) = decoder.decode(at, &before.bus, &before.frame) {
            series.watch.begin(before.nanos, &before.bus, &message);
        }
    }
    let mut counted = SeriesTotals::default();
    let mut zero = reader.extras().run_began();
    while let Some(entry) = reader.next()? {
        let record = match entry {
            Entry::Frame(record) => record,
            Entry::Note(of_reader) => {
                note(&of_reader);
                continue;
            }
        };
        let nanos = record.time.nanos;
        counted.zero_ns = *zero.get_or_insert(nanos);
        let decoded = decoder.decode(Micros(nanos / 1_000), record.interface, &record.frame);
        let message = if let Decoded::Message(message) = &decoded { Some(message) } else { None };
        series.watch.receive(nanos, record.interface, message);
        series.collect(false);
        while let Some(epoch) = series.next(false) {
            counted.epochs += 1;
            take(counted.zero_ns, &epoch).map_err(SeriesError::Taken)?;
        }
    }
    series.collect(true);
    while let Some(epoch) = series.next(true) {
        counted.epochs += 1;
        take(counted.zero_ns, &epoch).map_err(SeriesError::Taken)?;
    }
    if counted.epochs == 0
        && let Err(source) = series.watch.moments()
    {
        return Err(SeriesError::NotFound { name: reader.name().to_owned(), source });
    }
    Ok(counted)
}

/// Returns true if a joint's torques arrive in sums, which do not contain the torques of single cells.
#[must_use]
pub fn is_summed(skin: &Skin, joint: usize) -> bool {
    let mut buses = skin.buses.iter().enumerate();
    buses.any(|(at, bus)| bus.reply != SkinReply::Torque && skin.joints_on_bus(at).any(|(of_bus, _)| of_bus == joint))
}

/// Joins the joints of several buses into epochs.
struct Series<'a> {
    skin: &'a Skin,
    watch: Watch<'a>,
    explainer: Explainer<'a>,
    /// Incomplete epochs: by number, then by bus.
    waiting: BTreeMap<i64, (Epoch, Vec<Option<Moment>>)>,
    /// The newest number of each bus that has cells.
    last: Vec<(usize, Option<i64>)>,
    newest: Option<(i64, Epoch)>,
}

impl<'a> Series<'a> {
    fn new(skin: &'a Skin) -> Self {
        let with_cells = (0..skin.buses.len()).filter(|bus| skin.cells_on_bus(*bus).next().is_some());
        Self {
            skin,
            watch: Watch::all(skin),
            explainer: Explainer::new(skin),
            waiting: BTreeMap::new(),
            last: with_cells.map(|bus| (bus, None)).collect(),
            newest: None,
        }
    }

    /// Collects the complete joints, or all of them at the end.
    fn collect(&mut self, is_end: bool) {
        for (bus, last) in &mut self.last {
            while let Some((epoch, moment)) = self.watch.pop(*bus, is_end) {
                let (newest, of_newest) = self.newest.unwrap_or((0, epoch));
                let mut number = newest + i64::from(epoch.epochs_since(of_newest));
                while last.is_some_and(|last| number <= last) {
                    number += 256;
                }
                *last = Some(number);
                if number >= newest {
                    self.newest = Some((number, epoch));
                }
                let buses = self.skin.buses.len();
                let (_, moments) = self.waiting.entry(number).or_insert_with(|| (epoch, vec![None; buses]));
                if let Some(place) = moments.get_mut(*bus) {
                    *place = Some(moment);
                }
            }
        }
    }

    /// Returns the next epoch, once no bus can add to it.
    fn next(&mut self, is_end: bool) -> Option<EpochTorque> {
        let (number, _) = self.waiting.first_key_value()?;
        let newest = self.newest.map_or(*number, |(newest, _)| newest);
        let is_passed = self.last.iter().all(|(_, last)| last.is_some_and(|last| last >= *number));
        if !is_end && !is_passed && newest - number <= MAX_BUS_LAG {
            return None;
        }
        let (_, (epoch, moments)) = self.waiting.pop_first()?;
        let explanation = self.explainer.explain(&moments);
        let mut positions = vec![None; self.skin.robot.joints.len()];
        for bus in &explanation.buses {
            for (joint, position) in bus.joints.iter().zip(&bus.position_rad) {
                if let Some(place) = positions.get_mut(usize::from(*joint).saturating_sub(1)) {
                    place.get_or_insert(*position);
                }
            }
        }
        let at_ns = moments.iter().flatten().map(|moment| moment.at_ns).min().unwrap_or_default();
        Some(EpochTorque { at_ns, epoch: epoch.0, positions, explanation })
    }
}
