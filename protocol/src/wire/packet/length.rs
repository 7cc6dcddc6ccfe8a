//! How many words a packet has.

use core::fmt;

use super::{MAX_WORDS, SEGMENT_BYTES, WORDS};
use crate::fixed::is_saturated;
use crate::id::{Command, Id, Kind};

/// The length of a packet, by its words.
#[derive(Clone, Copy, Debug, Default, Eq, Hash, Ord, PartialEq, PartialOrd)]
pub enum Length {
    /// 6 words in 16 bytes: chains of up to 6 joints, and all that is not about joints.
    #[default]
    Six,
    /// 8 words in 20 bytes.
    Eight,
    /// 10 words in 24 bytes.
    Ten,
    /// 14 words in 32 bytes.
    Fourteen,
}

impl Length {
    /// Every length, the shortest first.
    pub const ALL: [Self; 4] = [Self::Six, Self::Eight, Self::Ten, Self::Fourteen];

    /// The words.
    #[must_use]
    pub const fn words(self) -> usize {
        match self {
            Self::Six => WORDS,
            Self::Eight => 8,
            Self::Ten => 10,
            Self::Fourteen => MAX_WORDS,
        }
    }

    /// The bytes: the words, epoch, count and CRC.
    #[must_use]
    pub const fn bytes(self) -> usize {
        2 * self.words() + 4
    }

    /// Classic frames of the longest packet.
    pub const MAX_SEGMENTS: usize = Self::Fourteen.segments();

    /// Classic frames of a packet.
    #[must_use]
    pub const fn segments(self) -> usize {
        self.bytes().div_ceil(SEGMENT_BYTES)
    }

    /// Bytes of the last of them; the others have 8.
    #[must_use]
    pub const fn last_segment(self) -> usize {
        self.bytes() - (self.segments() - 1) * SEGMENT_BYTES
    }

    /// That of joints, torques and sums on the bus of a chain; the longest for more joints than a chain can have.
    #[must_use]
    pub const fn for_joints(joints: usize) -> Self {
        match joints {
            0..=6 => Self::Six,
            7 | 8 => Self::Eight,
            9 | 10 => Self::Ten,
            _ => Self::Fourteen,
        }
    }

    /// The length of so many bytes.
    #[must_use]
    pub fn of_bytes(bytes: usize) -> Option<Self> {
        Self::ALL.into_iter().find(|length| length.bytes() == bytes)
    }
}

/// A set of lengths: those that packets may have.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Lengths(u8);

impl Lengths {
    /// All of them: where the chain is not known.
    pub const ALL: Self = Self(0b1111);

    /// One of them: where the chain is known.
    #[must_use]
    pub const fn only(length: Length) -> Self {
        Self(1 << length as u8)
    }

    /// Those of a chain, if it is known.
    #[must_use]
    pub fn of_chain(length: Option<Length>) -> Self {
        length.map_or(Self::ALL, Self::only)
    }

    /// Those that the packets of an identifier may have, whatever the chain: only joints, torques and sums grow.
    #[must_use]
    pub fn of(id: Id) -> Self {
        let grows = matches!(id.kind, Kind::Torque | Kind::Sum) || id == Id::command(Command::Joints);
        if grows { Self::ALL } else { Self::only(Length::Six) }
    }

    /// Those of these that the packets of an identifier may have: six words where they do not grow.
    #[must_use]
    pub fn of_these(self, id: Id) -> Self {
        let own = Self::of(id);
        if own == Self::ALL { self } else { own }
    }

    /// Whether this is one of them.
    #[must_use]
    pub const fn has(self, length: Length) -> bool {
        self.0 & 1 << length as u8 != 0
    }

    /// Each of them, the shortest first.
    pub fn iter(self) -> impl Iterator<Item = Length> {
        Length::ALL.into_iter().filter(move |&length| self.has(length))
    }

    /// The shortest.
    pub(super) fn first(self) -> Length {
        self.iter().next().unwrap_or_default()
    }

    /// The longest.
    pub(super) fn longest(self) -> Length {
        self.iter().last().unwrap_or_default()
    }
}

/// The words of a packet, as many as its length says.
// Aligned, or else a Cortex-M0 copies them byte by byte.
#[derive(Clone, Copy, Default, Eq, Hash, PartialEq)]
#[repr(align(4))]
pub struct Words {
    length: Length,
    /// Those beyond the length are zero.
    words: [i16; MAX_WORDS],
}

impl Words {
    /// Zeros.
    #[must_use]
    pub const fn zeros(length: Length) -> Self {
        Self { length, words: [0; MAX_WORDS] }
    }

    /// The first of these, as many as the length says.
    #[must_use]
    pub fn new(length: Length, words: [i16; MAX_WORDS]) -> Self {
        let mut it = Self { length, words };
        it.words.iter_mut().skip(length.words()).for_each(|word| *word = 0);
        it
    }

    /// How many there are.
    #[must_use]
    pub const fn length(&self) -> Length {
        self.length
    }

    /// The words.
    #[must_use]
    pub fn as_slice(&self) -> &[i16] {
        self.words.get(..self.length.words()).unwrap_or_default()
    }

    /// The words, and zeros after them.
    #[must_use]
    pub const fn padded(&self) -> [i16; MAX_WORDS] {
        self.words
    }

    /// The same with another word at a place; none changes at a place beyond them.
    #[must_use]
    pub fn with(mut self, place: usize, word: i16) -> Self {
        if let Some(there) = self.words.get_mut(..self.length.words()).and_then(|words| words.get_mut(place))
        {
            *there = word;
        }
        self
    }

    /// The first six: all of them in a packet that is not about joints.
    #[must_use]
    pub const fn six(&self) -> [i16; WORDS] {
        let [a, b, c, d, e, f, ..] = self.words;
        [a, b, c, d, e, f]
    }

    /// Whether each is zero.
    #[must_use]
    pub fn is_zero(&self) -> bool {
        self.words == [0; MAX_WORDS]
    }

    /// Whether one is at an end of its range, which in torques and sums means *saturated*.
    #[must_use]
    pub fn is_saturated(&self) -> bool {
        self.words.iter().any(|&word| is_saturated(word))
    }
}

impl fmt::Debug for Words {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.as_slice().fmt(f)
    }
}

impl From<[i16; WORDS]> for Words {
    fn from(words: [i16; WORDS]) -> Self {
        let mut words = words.into_iter();
        Self { length: Length::Six, words: core::array::from_fn(|_| words.next().unwrap_or(0)) }
    }
}

impl PartialEq<[i16; WORDS]> for Words {
    fn eq(&self, other: &[i16; WORDS]) -> bool {
        *self == Self::from(*other)
    }
}
