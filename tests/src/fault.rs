//! Faults of a simulated bus, drawn at random from a seed: for all receivers or one, and limited by sender, kind of
//! packet and time.

use std::ops::Range;

use protocol::can::Frame;
use protocol::id::{Id, Kind};
use protocol::time::{Micros, Span};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// A sender or receiver of frames.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub enum Party {
    /// The gateway; it also receives its own frames.
    Gateway,
    /// The cell in this slot; see [`crate::bench::Bench`].
    CellSlot(usize),
    /// A test client, another gateway or a babbling idiot, which sends and does not receive.
    UnknownNode,
}

/// The effect of a fault on a frame.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Harm {
    /// The frame is lost.
    Lose,
    /// The frame is late by up to this time, and other frames may overtake it.
    Delay(Span),
    /// The frame arrives twice.
    Duplicate,
    /// The frame arrives after the next one.
    Reorder,
    /// One to three bits of the frame are flipped, in the identifier, the data or the CRC.
    Flip,
    /// The last bytes of the frame are missing.
    Truncate,
}

impl Harm {
    /// The harms of all kinds, one of each.
    pub const ALL: [Self; 6] = [
        Self::Lose,
        Self::Delay(Span::from_millis(20)),
        Self::Duplicate,
        Self::Reorder,
        Self::Flip,
        Self::Truncate,
    ];
}

/// The receivers that a fault affects.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum FaultScope {
    /// The fault hits the frame on the wire, so all receivers get the same.
    Wire,
    /// The fault hits each receiver with its own chance.
    Each,
    /// The fault hits one receiver.
    Only(Party),
}

/// A fault. By default it affects all frames at all times, each receiver with its own chance.
#[derive(Clone, Debug)]
pub struct Fault {
    harm: Harm,
    probability: f64,
    hits: FaultScope,
    from: Option<Party>,
    kind: Option<Kind>,
    during: Range<Micros>,
}

impl Fault {
    /// Creates a fault that hits a frame with this probability, 0 to 1.
    #[must_use]
    pub const fn new(harm: Harm, probability: f64) -> Self {
        let during = Micros(0)..Micros(u64::MAX);
        Self { harm, probability, hits: FaultScope::Each, from: None, kind: None, during }
    }

    /// Moves the fault to the wire: all receivers get the same frame.
    #[must_use]
    pub fn on_the_wire(self) -> Self {
        Self { hits: FaultScope::Wire, ..self }
    }

    /// Limits the fault to one receiver.
    #[must_use]
    pub fn at_receiver(self, receiver: Party) -> Self {
        Self { hits: FaultScope::Only(receiver), ..self }
    }

    /// Limits the fault to frames of one sender.
    #[must_use]
    pub fn from(self, sender: Party) -> Self {
        Self { from: Some(sender), ..self }
    }

    /// Limits the fault to frames of one kind.
    #[must_use]
    pub fn of_kind(self, kind: Kind) -> Self {
        Self { kind: Some(kind), ..self }
    }

    /// Limits the fault to a time range.
    #[must_use]
    pub fn during(self, times: Range<Micros>) -> Self {
        Self { during: times, ..self }
    }

    fn may_hit(&self, now: Micros, from: Party, to: Option<Party>, kind: Kind) -> bool {
        let hits = match self.hits {
            FaultScope::Wire => to.is_none(),
            FaultScope::Each => to.is_some(),
            FaultScope::Only(party) => to == Some(party),
        };
        let of_kind = self.kind.is_none_or(|expected| expected == kind);
        hits && of_kind && self.from.is_none_or(|expected| expected == from) && self.during.contains(&now)
    }
}

/// The effect of faults on a frame.
#[derive(Clone, Copy, Debug)]
pub struct Effect {
    /// The frame that arrives.
    pub frame: Frame,
    /// The number of times that the frame arrives.
    pub times: u8,
    /// The additional delay of the frame.
    pub delay: Span,
    /// True if the frame arrives after the next one.
    pub after_next: bool,
    /// The damage to the frame, if it has any.
    pub damage: Option<Harm>,
}

/// All faults of a bus, and the random generator.
#[derive(Debug)]
pub struct Faults {
    all: Vec<Fault>,
    dice: Pcg64Mcg,
}

impl Faults {
    /// Creates a bus without faults.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        Self { all: Vec::new(), dice: Pcg64Mcg::seed_from_u64(seed) }
    }

    /// Adds a fault.
    pub fn add(&mut self, fault: Fault) {
        self.all.push(fault);
    }

    /// Removes all faults.
    pub fn clear(&mut self) {
        self.all.clear();
    }

    /// Returns the effect of all faults on a frame: on the wire if `to` is `None`, else on its way from the wire to
    /// that receiver.
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

/// Returns the frame with one to three different bits flipped, which the CRC always detects.
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
