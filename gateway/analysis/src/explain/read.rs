//! Reads a capture up to the requested joints.

use model::decode::{Decoded, Decoder};
use protocol::skin::Skin;
use protocol::time::Micros;
use trace::capture::{CaptureError, Entry, NoteKind, Reader};

use super::NotFound;
use super::watch::{Moment, Requested, Watch};

/// What a capture contains up to some joints.
#[derive(Debug)]
pub struct Found {
    /// What was sent on each bus until then.
    pub moments: Result<Vec<Option<Moment>>, NotFound>,
    /// When its first frame came, in ns since 1970.
    pub first_ns: u64,
    /// Frames before that which the recorder lost.
    pub dropped: u64,
    /// Lines before that which cannot be read.
    pub unreadable: u64,
    /// Whether there is no frame at all.
    pub is_empty: bool,
}

/// Reads a capture from its beginning up to the requested joints.
///
/// # Errors
/// When it cannot be read, or is damaged.
pub fn find(reader: &mut Reader, skin: &Skin, requested: Requested) -> Result<Found, CaptureError> {
    let mut watch = Watch::new(skin, requested);
    let mut decoder = Decoder::new(None);
    for before in &reader.extras().latched {
        let at = Micros(before.nanos / 1_000);
        if let Decoded::Message(message) = decoder.decode(at, &before.bus, &before.frame) {
            watch.begin(before.nanos, &before.bus, &message);
        }
    }
    let (mut first, mut dropped, mut unreadable) = (None, 0_u64, 0_u64);
    while let Some(entry) = reader.next()? {
        match entry {
            Entry::Frame(record) => {
                let nanos = record.time.nanos;
                first.get_or_insert(nanos);
                let decoded = decoder.decode(Micros(nanos / 1_000), record.interface, &record.frame);
                let message = if let Decoded::Message(message) = &decoded { Some(message) } else { None };
                if watch.take(nanos, record.interface, message) {
                    break;
                }
            }
            Entry::Note(note) => match note.kind {
                NoteKind::Dropped(frames) => dropped = dropped.saturating_add(frames),
                NoteKind::Unreadable(_) => unreadable += 1,
                NoteKind::Text | NoteKind::CanXl => {}
            },
        }
    }
    let is_empty = first.is_none();
    Ok(Found { moments: watch.moments(), is_empty, first_ns: first.unwrap_or_default(), dropped, unreadable })
}
