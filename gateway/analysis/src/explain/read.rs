//! Reads a capture up to the requested joints.

use model::decode::{Decoded, Decoder};
use protocol::skin::Skin;
use protocol::time::Micros;
use trace::capture::{CaptureEntry, CaptureError, NoteKind, Reader};

use super::JointsNotFound;
use super::observed::{ObservedJoints, RequestedJoints};
use super::watch::JointsWatcher;

/// The content of a capture up to the requested joints.
#[derive(Debug)]
pub struct FoundJoints {
    /// The joints and answers on each bus of the skin, `None` for a bus without these joints; or the reason why no bus
    /// has them.
    pub moments: Result<Vec<Option<ObservedJoints>>, JointsNotFound>,
    /// Time that counts as 0 s, in ns since 1970.
    pub zero_ns: u64,
    /// True if `zero_ns` is the first tick of the run, false if it is the first frame.
    pub counts_from_run: bool,
    /// Number of frames before the joints that the recorder of the capture lost.
    pub dropped: u64,
    /// Number of unreadable lines before the joints.
    pub unreadable: u64,
    /// True if the capture has no frames.
    pub is_empty: bool,
}

/// Reads a capture from its start up to the requested joints.
///
/// # Errors
/// Returns [`CaptureError`] if the capture cannot be read, or is damaged.
pub fn read_to_joints(
    reader: &mut Reader,
    skin: &Skin,
    requested: RequestedJoints,
) -> Result<FoundJoints, CaptureError> {
    let mut watch = JointsWatcher::new(skin, requested);
    let mut decoder = Decoder::new(None);
    for before in &reader.extras().latched {
        let at = Micros(before.nanos / 1_000);
        if let Decoded::Message(message) = decoder.decode(at, &before.bus, &before.frame) {
            watch.receive_latched(before.nanos, &before.bus, &message);
        }
    }
    let mut zero = reader.extras().run_began();
    let is_of_run = zero.is_some();
    zero.into_iter().for_each(|zero| watch.set_zero_time(zero));
    let (mut is_empty, mut dropped, mut unreadable) = (true, 0_u64, 0_u64);
    while let Some(entry) = reader.next()? {
        match entry {
            CaptureEntry::Frame(record) => {
                let nanos = record.time.nanos;
                zero.get_or_insert(nanos);
                is_empty = false;
                let decoded = decoder.decode(Micros(nanos / 1_000), record.interface, &record.frame);
                let message = if let Decoded::Message(message) = &decoded { Some(message) } else { None };
                if watch.receive(nanos, record.interface, message) {
                    break;
                }
            }
            CaptureEntry::Note(note) => match note.kind {
                NoteKind::Dropped(frames) => dropped = dropped.saturating_add(frames),
                NoteKind::Unreadable(_) => unreadable += 1,
                NoteKind::Text | NoteKind::CanXl => {}
            },
        }
    }
    Ok(FoundJoints {
        moments: watch.into_joints(),
        is_empty,
        zero_ns: zero.unwrap_or_default(),
        counts_from_run: is_of_run,
        dropped,
        unreadable,
    })
}
