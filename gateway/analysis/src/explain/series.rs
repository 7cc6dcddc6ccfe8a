//! The torques of every epoch of a capture, each computed as in [`explain`](super::explain).
//!
//! Buses carry the joints of an epoch one after the other. They are joined by epoch number, which is continued beyond
//! 255; after a gap, by the time that has passed.

use std::collections::BTreeMap;

use model::decode::{Decoded, Decoder};
use protocol::candump::Record;
use protocol::message::Message;
use protocol::packet::Epoch;
use protocol::skin::{Skin, SkinReply};
use protocol::time::Micros;
use thiserror::Error;
use trace::capture::{CaptureEntry, CaptureError, CaptureNote, Reader};

use super::observed::ObservedJoints;
use super::watch::JointsWatcher;
use super::{Explainer, JointTorqueTotal, JointsNotFound, TorqueExplanation};

/// Number of epochs that wait for a bus which is behind the others, besides the oldest.
const MAX_BUS_LAG_EPOCHS: usize = 64;

/// The torques of one epoch.
#[derive(Clone, Debug, PartialEq)]
pub struct EpochTorque {
    /// Time of the first joints of the epoch, in ns since 1970.
    pub at_ns: u64,
    /// The epoch, modulo 256.
    pub epoch: u8,
    /// The epoch, continued beyond 255; 0 is the epoch of the first joints.
    pub number: i64,
    /// The position of each joint of the robot in rad or m; `None` for a joint whose bus sent no joints in this epoch.
    pub positions: Vec<Option<f64>>,
    /// The torques on each joint of the robot. They are unknown for a joint without a position, and if another bus with
    /// cells on the joint had joints before and sent none in this epoch.
    pub torques: Vec<KnownTorque>,
    /// The derivation of the torques.
    pub explanation: TorqueExplanation,
}

/// The torque of the skin on one joint in Nm or N, as far as it is known.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct KnownTorque {
    /// The sum of the cells' words; `None` also if they answer with sums.
    pub distributed: Option<f64>,
    /// The central computation.
    pub central: Option<f64>,
    /// `distributed` less `central`.
    pub error: Option<f64>,
}

/// The error of reading a capture epoch by epoch.
#[derive(Debug, Error)]
pub enum EpochSeriesError<E> {
    /// The capture cannot be read, or is damaged.
    #[error(transparent)]
    Capture(#[from] CaptureError),
    /// The capture has no joints of this skin.
    #[error("{name}: {source}")]
    NotFound {
        /// Name of the capture.
        name: String,
        /// The reason.
        source: JointsNotFound,
    },
    /// The function that receives the epochs has failed.
    #[error("{0}")]
    Consumer(E),
}

/// The extent of a capture that was read epoch by epoch.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct CaptureExtent {
    /// Number of epochs that were passed on.
    pub epochs: u64,
    /// Time that counts as 0 s, in ns since 1970: the first tick of the run, or else the first frame.
    pub zero_ns: u64,
}

/// A receiver of the content of a capture that is read epoch by epoch.
pub trait SeriesObserver {
    /// The error that ends the reading.
    type Error;

    /// Receives a frame, with the message that it completes. `answered` are the joints that this message answers as a
    /// torque which is used: their index among the joints of the bus that begin epochs.
    ///
    /// # Errors
    /// Returns an error to end the reading.
    fn receive_frame(
        &mut self,
        record: &Record<'_>,
        message: Option<&Message>,
        answered: Option<u64>,
    ) -> Result<(), Self::Error>;

    /// Receives an entry that is not a frame.
    ///
    /// # Errors
    /// Returns an error to end the reading.
    fn receive_note(&mut self, note: &CaptureNote<'_>) -> Result<(), Self::Error>;

    /// Receives a complete epoch, with the time that counts as 0 s in ns since 1970.
    ///
    /// # Errors
    /// Returns an error to end the reading.
    fn receive_epoch(&mut self, zero: u64, epoch: &EpochTorque) -> Result<(), Self::Error>;
}

/// Reads a capture to its end. Each complete epoch is passed to `take`, with the time that counts as 0 s in ns since
/// 1970. Memory is bounded.
///
/// # Errors
/// Returns [`EpochSeriesError`] if the capture cannot be read or has no joints of the skin, or with the first error
/// that `take` returns.
pub fn for_each_epoch<E>(
    reader: &mut Reader,
    skin: &Skin,
    note: impl FnMut(&CaptureNote<'_>),
    take: impl FnMut(u64, &EpochTorque) -> Result<(), E>,
) -> Result<CaptureExtent, EpochSeriesError<E>> {
    observe_epochs(reader, skin, &mut EpochFunctions { note, take })
}

/// Two functions as an observer that does not need the frames.
struct EpochFunctions<N, T> {
    note: N,
    take: T,
}

impl<E, N: FnMut(&CaptureNote<'_>), T: FnMut(u64, &EpochTorque) -> Result<(), E>> SeriesObserver
    for EpochFunctions<N, T>
{
    type Error = E;

    fn receive_frame(&mut self, _: &Record<'_>, _: Option<&Message>, _: Option<u64>) -> Result<(), E> {
        Ok(())
    }

    fn receive_note(&mut self, note: &CaptureNote<'_>) -> Result<(), E> {
        (self.note)(note);
        Ok(())
    }

    fn receive_epoch(&mut self, zero: u64, epoch: &EpochTorque) -> Result<(), E> {
        (self.take)(zero, epoch)
    }
}

/// Reads a capture to its end, and passes its frames, notes and complete epochs to an observer. Memory is bounded.
///
/// # Errors
/// Returns [`EpochSeriesError`] if the capture cannot be read or has no joints of the skin, or with the first error of
/// the observer.
pub fn observe_epochs<O: SeriesObserver>(
    reader: &mut Reader,
    skin: &Skin,
    observer: &mut O,
) -> Result<CaptureExtent, EpochSeriesError<O::Error>> {
    let mut series = EpochJoiner::new(skin);
    let mut decoder = Decoder::new(None);
    for before in &reader.extras().latched {
        let at = Micros(before.nanos / 1_000);
        if let Decoded::Message(message) = decoder.decode(at, &before.bus, &before.frame) {
            series.watch.receive_latched(before.nanos, &before.bus, &message);
        }
    }
    let mut counted = CaptureExtent::default();
    let mut zero = reader.extras().run_began();
    while let Some(entry) = reader.next()? {
        let record = match entry {
            CaptureEntry::Frame(record) => record,
            CaptureEntry::Note(note) => {
                observer.receive_note(&note).map_err(EpochSeriesError::Consumer)?;
                continue;
            }
        };
        let nanos = record.time.nanos;
        counted.zero_ns = *zero.get_or_insert(nanos);
        let decoded = decoder.decode(Micros(nanos / 1_000), record.interface, &record.frame);
        let message = decoded.message();
        series.watch.receive(nanos, record.interface, message);
        observer
            .receive_frame(&record, message, series.watch.answered_joints())
            .map_err(EpochSeriesError::Consumer)?;
        series.collect_complete_joints(false);
        while let Some(epoch) = series.pop_oldest_epoch(false) {
            counted.epochs += 1;
            observer.receive_epoch(counted.zero_ns, &epoch).map_err(EpochSeriesError::Consumer)?;
        }
    }
    series.collect_complete_joints(true);
    while let Some(epoch) = series.pop_oldest_epoch(true) {
        counted.epochs += 1;
        observer.receive_epoch(counted.zero_ns, &epoch).map_err(EpochSeriesError::Consumer)?;
    }
    if counted.epochs == 0
        && let Err(source) = series.watch.into_joints()
    {
        return Err(EpochSeriesError::NotFound { name: reader.name().to_owned(), source });
    }
    Ok(counted)
}

/// Returns true if the torques on a joint arrive in sums, so that the torques of single cells are not in the capture.
#[must_use]
pub(crate) fn is_summed(skin: &Skin, joint: usize) -> bool {
    let mut buses = skin.buses.iter().enumerate();
    buses.any(|(at, bus)| {
        bus.reply != SkinReply::Torque && skin.joints_on_bus(at).any(|(of_bus, _)| of_bus == joint)
    })
}

/// An epoch whose number is known.
#[derive(Clone, Copy, Debug)]
struct NumberedEpoch {
    number: i64,
    epoch: Epoch,
    /// Time of its joints in ns since 1970.
    at_ns: u64,
}

/// Returns the number of a bus' next joints: of the numbers that fit the epoch, the nearest to what is expected at
/// their time, but above that of the bus' `last` joints. `newest` is the newest epoch of all buses.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_precision_loss,
    reason = "at most 2^64 ns: fewer than 2^53 epochs at any rate of a skin"
)]
fn next_number(
    newest: &NumberedEpoch,
    last: Option<&NumberedEpoch>,
    epoch: Epoch,
    at_ns: u64,
    broadcast_hz: f64,
) -> i64 {
    // The newest joints are not older than the bus' last ones, unless the clock was set back meanwhile.
    let newest_ns = last.map_or(newest.at_ns, |last| newest.at_ns.max(last.at_ns));
    let expected = (i128::from(at_ns) - i128::from(newest_ns)) as f64 * 1e-9 * broadcast_hz;
    let since = i64::from(epoch.epochs_since(newest.epoch));
    let wraps = ((expected - since as f64) / 256.0).round() as i64;
    let number = newest.number + since + 256 * wraps;
    match last {
        Some(last) if number <= last.number => {
            let first = last.number + 1;
            first + (number - first).rem_euclid(256)
        }
        _ => number,
    }
}

/// Joins the joints of several buses into epochs.
struct EpochJoiner<'a> {
    skin: &'a Skin,
    watch: JointsWatcher<'a>,
    explainer: Explainer<'a>,
    /// True for each joint of the robot whose torques arrive in sums.
    summed: Vec<bool>,
    /// Epochs for which joints of some buses are still missing, by their number and then by bus.
    waiting: BTreeMap<i64, (Epoch, Vec<Option<ObservedJoints>>)>,
    /// The newest epoch of each bus that has cells.
    last: Vec<(usize, Option<NumberedEpoch>)>,
    /// The newest epoch of all buses.
    newest: Option<NumberedEpoch>,
}

impl<'a> EpochJoiner<'a> {
    fn new(skin: &'a Skin) -> Self {
        let with_cells = (0..skin.buses.len()).filter(|bus| skin.cells_on_bus(*bus).next().is_some());
        Self {
            skin,
            watch: JointsWatcher::for_all_joints(skin),
            explainer: Explainer::new(skin),
            summed: (0..skin.robot.joints.len()).map(|joint| is_summed(skin, joint)).collect(),
            waiting: BTreeMap::new(),
            last: with_cells.map(|bus| (bus, None)).collect(),
            newest: None,
        }
    }

    /// Collects the joints of each bus whose answers are complete; at the end of the capture, all joints.
    fn collect_complete_joints(&mut self, is_end: bool) {
        let broadcast_hz = self.skin.timing.broadcast_hz();
        for (bus, last) in &mut self.last {
            while let Some((epoch, moment)) = self.watch.pop_joints(*bus, is_end) {
                let at_ns = moment.at_ns;
                let newest = self.newest.get_or_insert(NumberedEpoch { number: 0, epoch, at_ns });
                let number = next_number(newest, last.as_ref(), epoch, at_ns, broadcast_hz);
                let numbered = NumberedEpoch { number, epoch, at_ns };
                *last = Some(numbered);
                if number >= newest.number {
                    *newest = numbered;
                }
                let buses = self.skin.buses.len();
                let (_, moments) = self.waiting.entry(number).or_insert_with(|| (epoch, vec![None; buses]));
                if let Some(place) = moments.get_mut(*bus) {
                    *place = Some(moment);
                }
            }
        }
    }

    /// Removes and returns the oldest epoch, once no bus can add joints to it.
    fn pop_oldest_epoch(&mut self, is_end: bool) -> Option<EpochTorque> {
        let (number, _) = self.waiting.first_key_value()?;
        let is_passed = self.last.iter().all(|(_, last)| last.is_some_and(|last| last.number >= *number));
        if !is_end && !is_passed && self.waiting.len() <= 1 + MAX_BUS_LAG_EPOCHS {
            return None;
        }
        let (number, (epoch, moments)) = self.waiting.pop_first()?;
        let explanation = self.explainer.explain(&moments);
        let mut positions = vec![None; self.skin.robot.joints.len()];
        for bus in &explanation.buses {
            for (joint, position) in bus.joints.iter().zip(&bus.position_rad) {
                if let Some(place) = positions.get_mut(usize::from(*joint).saturating_sub(1)) {
                    place.get_or_insert(*position);
                }
            }
        }
        let torques = self.known_torques(&positions, &moments, &explanation.total);
        let at_ns = moments.iter().flatten().map(|moment| moment.at_ns).min().unwrap_or_default();
        Some(EpochTorque { at_ns, epoch: epoch.0, number, positions, torques, explanation })
    }

    /// Returns the torques that are known in an epoch, given the joints of each bus.
    fn known_torques(
        &self,
        positions: &[Option<f64>],
        moments: &[Option<ObservedJoints>],
        total: &[JointTorqueTotal],
    ) -> Vec<KnownTorque> {
        let mut is_known: Vec<_> = positions.iter().map(Option::is_some).collect();
        let buses = self.last.iter().filter(|(_, last)| last.is_some());
        let without = buses.filter(|(bus, _)| moments.get(*bus).is_none_or(Option::is_none));
        for (joint, _) in without.flat_map(|(bus, _)| self.skin.joints_on_bus(*bus)) {
            if let Some(is_known) = is_known.get_mut(joint) {
                *is_known = false;
            }
        }
        let joints = total.iter().zip(&self.summed).zip(is_known);
        let torques = joints.map(|((total, summed), is_known)| KnownTorque {
            distributed: (is_known && !summed).then_some(total.words_nm),
            central: is_known.then_some(total.central_nm),
            error: (is_known && !summed).then_some(total.difference_nm),
        });
        torques.collect()
    }
}
