//! A recording, as its buses said it up to a moment.
//!
//! ```text
//!   entries of the capture ──> push ──> Order, by time ──> advance(until) ──> Live
//! ```
//!
//! What is known at a moment is what all frames up to it say, whatever was read on the way: the same entries and the same
//! moment give the same [`Live`].

mod events;

use std::collections::VecDeque;

use protocol::can::Frame;
use protocol::skin::Skin;
use protocol::time::Micros;
use trace::capture::{CaptureError, Entry, Extras, NoteKind, Reader};
use trace::order::{Order, Ordered};

pub use self::events::{Event, EventKind, Watcher};
use crate::live::Live;

/// From one look at the time to the next, in ns: silent cells, loads.
const LOOK_NS: u64 = 20_000_000;
/// Of a longer pause without a frame, the rest is passed over.
const PAUSE_NS: u64 = 60_000_000_000;
/// Epochs whose times are kept.
const EPOCHS: usize = 256;

/// What comes next.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Step {
    /// A frame was applied; `epoch` if it is joints, and the first ones of their epoch.
    Applied {
        /// Whether an epoch begins with it.
        epoch: bool,
    },
    /// A look at the time.
    Looked,
    /// More entries are needed.
    Hungry,
    /// All up to the requested time is applied.
    There,
    /// There is nothing more.
    Over,
}

/// A recording up to a moment.
#[derive(Clone, Debug)]
pub struct Tape {
    live: Live,
    names: Vec<String>,
    order: Order<Item>,
    next: Option<Ordered<Item>>,
    /// No more entries come.
    ended: bool,
    /// What was latched when the recording began, until its first frame.
    latched: Vec<Item>,
    /// The time of the first frame, in ns since 1970.
    first: Option<u64>,
    /// Up to here all is applied.
    at: u64,
    /// The next look at the time.
    look: u64,
    epochs: VecDeque<u64>,
    /// Frames that the recorder lost, by bus.
    dropped: Vec<u64>,
    /// Frames of buses that are not the skin's.
    others: u64,
}

#[derive(Clone, Copy, Debug)]
struct Item {
    bus: usize,
    frame: Frame,
}

impl Tape {
    /// Before any entry. Times are said since `zero`, in ns since 1970.
    #[must_use]
    pub fn new(skin: Skin, zero: u64) -> Self {
        let names: Vec<_> = skin.buses.iter().map(|bus| bus.name.clone()).collect();
        let mut live = Live::since(skin, Micros(zero / 1_000));
        (0..names.len()).for_each(|bus| live.set_bus(bus, true, 0));
        Self {
            live,
            dropped: vec![0; names.len()],
            names,
            order: Order::default(),
            next: None,
            ended: false,
            latched: Vec::new(),
            first: None,
            at: 0,
            look: 0,
            epochs: VecDeque::new(),
            others: 0,
        }
    }

    /// Takes what the reader gives next; without it, nothing more comes.
    ///
    /// # Errors
    /// When the capture cannot be read, or is damaged: then it is over too.
    pub fn feed(&mut self, reader: &mut Reader) -> Result<(), CaptureError> {
        match reader.next() {
            Ok(Some(entry)) => self.push(&entry),
            Ok(None) => self.ended = true,
            Err(error) => {
                self.ended = true;
                return Err(error);
            }
        }
        Ok(())
    }

    /// Takes what was latched when the recording began, before its first entry.
    pub fn begin(&mut self, extras: &Extras) {
        let latched = extras.latched.iter();
        self.latched =
            latched.filter_map(|it| Some(Item { bus: self.bus(&it.bus)?, frame: it.frame })).collect();
    }

    /// Takes the next entry of the capture.
    pub fn push(&mut self, entry: &Entry<'_>) {
        match entry {
            Entry::Frame(record) => {
                let nanos = record.time.nanos;
                match self.bus(record.interface) {
                    Some(bus) => self.order.push(bus, nanos, Item { bus, frame: record.frame }),
                    None => self.others += 1,
                }
            }
            Entry::Note(note) => {
                if let NoteKind::Dropped(frames) = note.kind {
                    for (bus, dropped) in self.dropped.iter_mut().enumerate() {
                        let of_it = self.names.get(bus).is_some_and(|name| name == note.interface);
                        if of_it || (note.interface.is_empty() && bus == 0) {
                            *dropped = dropped.saturating_add(frames);
                            self.live.set_bus(bus, true, *dropped);
                        }
                    }
                }
            }
        }
    }

    /// Goes on by one frame, or one look at the time, but not beyond `until`, in ns since 1970.
    pub fn step(&mut self, until: u64) -> Step {
        if self.next.is_none() {
            self.next = if self.ended { self.order.pop_last() } else { self.order.pop() };
        }
        let Some(next) = self.next else {
            return match self.ended {
                false => Step::Hungry,
                true if self.first.is_none() => Step::Over,
                true => self.look_until(until).unwrap_or(Step::Over),
            };
        };
        if self.first.is_none() {
            self.first = Some(next.at);
            (self.at, self.look) = (next.at, next.at.saturating_add(LOOK_NS));
            let latched = std::mem::take(&mut self.latched);
            self.live.begin(Micros(next.at / 1_000), latched.iter().map(|it| (it.bus, &it.frame)));
        }
        if let Some(looked) = self.look_until(until.min(next.at.saturating_sub(1))) {
            return looked;
        }
        if next.at > until {
            self.at = self.at.max(until);
            return Step::There;
        }
        self.next = None;
        self.at = next.at;
        let Item { bus, frame } = next.item;
        let epoch = self.live.frame(bus, Micros(next.at / 1_000), &frame);
        if epoch {
            if self.epochs.len() == EPOCHS {
                self.epochs.pop_front();
            }
            self.epochs.push_back(next.at);
        }
        Step::Applied { epoch }
    }

    /// A look at the time, if one is due up to this time.
    fn look_until(&mut self, until: u64) -> Option<Step> {
        // At the end of what 64 bits of ns can say, in 2554, there is nothing more to look at.
        if self.look > until || self.look == u64::MAX {
            return None;
        }
        self.live.handle_time(Micros(self.look / 1_000));
        self.at = self.look;
        self.look = self.look.saturating_add(LOOK_NS);
        // Nothing changes any more.
        if until.saturating_sub(self.look) > PAUSE_NS {
            self.look = until - PAUSE_NS;
        }
        Some(Step::Looked)
    }

    /// What is known.
    #[must_use]
    pub const fn live(&self) -> &Live {
        &self.live
    }

    /// The same, to draw snapshots of.
    pub const fn live_mut(&mut self) -> &mut Live {
        &mut self.live
    }

    /// Up to when all is applied, in ns since 1970.
    #[must_use]
    pub const fn at(&self) -> u64 {
        self.at
    }

    /// Whether all that the capture has is applied.
    #[must_use]
    pub fn is_over(&self) -> bool {
        self.ended && self.next.is_none() && self.order.is_empty()
    }

    /// When the last epoch before this moment began, as far as it is known.
    #[must_use]
    pub fn epoch_before(&self, moment: u64) -> Option<u64> {
        self.epochs.iter().rev().copied().find(|&at| at < moment)
    }

    /// Forgets the frames of the last seconds: to be kept, and gone on from later.
    pub fn forget_recent(&mut self) {
        self.live.forget_recent();
    }

    /// Frames of buses that are not the skin's.
    #[must_use]
    pub const fn others(&self) -> u64 {
        self.others
    }

    fn bus(&self, name: &str) -> Option<usize> {
        self.names.iter().position(|bus| bus == name)
    }
}
