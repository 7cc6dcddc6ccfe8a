//! Faults of a bus: seeded, for all receivers or one, by sender, kind and time.

use std::ops::Range;

use protocol::can::Frame;
use protocol::id::{Id, Kind};
use protocol::time::{Micros, Span};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// Who sends or receives.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub enum Party {
    /// The gateway; it also reads its own frames back.
    Gateway,
    /// The cell in this slot, see [`crate::bench::Bench`].
    CellSlot(usize),
    /// A test client, another gateway, a babbling idiot: sends and does not receive.
    UnknownNode,
}

/// What happens to a frame.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Harm {
    /// It does not come.
    Lose,
    /// It comes later by up to so much, and others overtake it.
    Delay(Span),
    /// It comes twice.
    Duplicate,
    /// It comes after the next one.
    Reorder,
    /// One to three of its bits are turned, in the identifier, the data or the CRC.
    Flip,
    /// Its last bytes are missing.
    Truncate,
}

impl Harm {
    /// One of each.
    pub const ALL: [Self; 6] = [
        Self::Lose,
        Self::Delay(Span::from_millis(20)),
        Self::Duplicate,
        Self::Reorder,
        Self::Flip,
        Self::Truncate,
    ];
}

/// Which receivers a fault affects.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Hits {
    /// The frame as it stands on the wire: everybody gets the same.
    Wire,
    /// Each receiver by its own chance.
    Each,
    /// This receiver alone.
    Only(Party),
}

/// One thing that goes wrong: first of each receiver by its own chance, of all frames, all the time.
#[derive(Clone, Debug)]
pub struct Fault {
    harm: Harm,
    probability: f64,
    hits: Hits,
    from: Option<Party>,
    kind: Option<Kind>,
    during: Range<Micros>,
}

impl Fault {
    /// A frame is hit with this probability, 0 to 1.
    #[must_use]
    pub const fn new(harm: Harm, probability: f64) -> Self {
        let during = Micros(0)..Micros(u64::MAX);
        Self { harm, probability, hits: Hits::Each, from: None, kind: None, during }
    }

    /// It happens on the wire: all receivers get the same.
    #[must_use]
    pub fn on_the_wire(self) -> Self {
        Self { hits: Hits::Wire, ..self }
    }

    /// It happens to this receiver alone.
    #[must_use]
    pub fn at(self, receiver: Party) -> Self {
        Self { hits: Hits::Only(receiver), ..self }
    }

    /// It happens to frames of this sender only.
    #[must_use]
    pub fn from(self, sender: Party) -> Self {
        Self { from: Some(sender), ..self }
    }

    /// It happens to frames of this kind only.
    #[must_use]
    pub fn of(self, kind: Kind) -> Self {
        Self { kind: Some(kind), ..self }
    }

    /// It happens at these times only.
    #[must_use]
    pub fn during(self, times: Range<Micros>) -> Self {
        Self { during: times, ..self }
    }

    fn may_hit(&self, now: Micros, from: Party, to: Option<Party>, kind: Kind) -> bool {
        let hits = match self.hits {
            Hits::Wire => to.is_none(),
            Hits::Each => to.is_some(),
            Hits::Only(party) => to == Some(party),
        };
        let of_kind = self.kind.is_none_or(|expected| expected == kind);
        hits && of_kind && self.from.is_none_or(|expected| expected == from) && self.during.contains(&now)
    }
}

/// The effect of faults on a frame.
#[derive(Clone, Copy, Debug)]
pub struct Effect {
    /// The frame that comes.
    pub frame: Frame,
    /// How often it comes.
    pub times: u8,
    /// By how much later.
    pub delay: Span,
    /// Whether it comes after the next one.
    pub after_next: bool,
    /// Whether it was damaged, and how.
    pub damage: Option<Harm>,
}

/// All that goes wrong on a bus, and the dice.
#[derive(Debug)]
pub struct Faults {
    all: Vec<Fault>,
    dice: Pcg64Mcg,
}

impl Faults {
    /// Nothing goes wrong yet.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        Self { all: Vec::new(), dice: Pcg64Mcg::seed_from_u64(seed) }
    }

    /// One more thing goes wrong.
    pub fn add(&mut self, fault: Fault) {
        self.all.push(fault);
    }

    /// Nothing goes wrong any more.
    pub fn clear(&mut self) {
        self.all.clear();
    }

    /// The effect on a frame on the wire (`to` is `None`), or on its way from there to a receiver.
    pub fn effect(&mut self, now: Micros, from: Party, to: Option<Party>, frame: Frame) -> Effect {
        let mut effect = Effect { frame, times: 1, delay: Span(0), after_next: false, damage: None };
        let kind = Id::from_bits(u16::try_from(frame.id()).unwrap_or(u16::MAX)).kind;
        for fault in &self.all {
            if !fault.may_hit(now, from, to, kind) || !self.dice.random_bool(fault.probability) {
                continue;
            }
            match fault.harm {
                Harm::Lose => effect.times = 0,
                Harm::Delay(most) => effect.delay = Span(self.dice.random_range(0..=most.0)),
                Harm::Duplicate => effect.times *= 2,
                Harm::Reorder => effect.after_next = true,
                Harm::Flip => effect.frame = flipped(effect.frame, &mut self.dice),
                Harm::Truncate => effect.frame = truncated(effect.frame, &mut self.dice),
            }
            match fault.harm {
                Harm::Truncate => effect.damage = Some(Harm::Truncate),
                Harm::Flip => effect.damage = effect.damage.or(Some(Harm::Flip)),
                Harm::Lose | Harm::Delay(_) | Harm::Duplicate | Harm::Reorder => {}
            }
        }
        effect
    }
}

/// One to three different bits are turned; the CRC notices any three.
fn flipped(frame: Frame, dice: &mut Pcg64Mcg) -> Frame {
    const ID_BITS: usize = 11;
    let (mut id, mut data) = (frame.raw_id(), frame.data().to_vec());
    let bits = ID_BITS + 8 * data.len();
    let (first, step) = (dice.random_range(0..bits), dice.random_range(1..bits / 3));
    for turn in 0..dice.random_range(1..=3) {
        let bit = (first + turn * step) % bits;
        match bit.checked_sub(ID_BITS) {
            None => id ^= 1 << bit,
            Some(bit) => {
                if let Some(byte) = data.get_mut(bit / 8) {
                    *byte ^= 1 << (bit % 8);
                }
            }
        }
    }
    Frame::with_data(id, frame.format(), frame.flags(), &data).unwrap_or(frame)
}

fn truncated(frame: Frame, dice: &mut Pcg64Mcg) -> Frame {
    let keep = dice.random_range(0..frame.data().len().max(1));
    let data = frame.data().get(..keep).unwrap_or_default();
    Frame::with_data(frame.raw_id(), frame.format(), frame.flags(), data).unwrap_or(frame)
}
