//! Packet lengths, and the words of a packet.

use core::fmt;

use super::{MAX_WORDS, SEGMENT_BYTES, WORDS};
use crate::fixed::is_saturated;
use crate::id::{Command, Id, Kind};

/// The length of a packet, by its number of words.
#[derive(Clone, Copy, Debug, Default, Eq, Hash, Ord, PartialEq, PartialOrd)]
pub enum Length {
    /// 6 words in 16 bytes: chains of up to 6 joints, and all packets without a word per joint.
    #[default]
    Six,
    /// 8 words in 20 bytes, for chains of 7 or 8 joints.
    Eight,
    /// 10 words in 24 bytes, for chains of 9 or 10 joints.
    Ten,
    /// 14 words in 32 bytes, for chains of 11 to 14 joints.
    Fourteen,
}

impl Length {
    /// All lengths, the shortest first.
    pub const ALL: [Self; 4] = [Self::Six, Self::Eight, Self::Ten, Self::Fourteen];

    /// Returns the number of words.
    #[must_use]
    pub const fn words(self) -> usize {
        match self {
            Self::Six => WORDS,
            Self::Eight => 8,
            Self::Ten => 10,
            Self::Fourteen => MAX_WORDS,
        }
    }

    /// Returns the size of the packet in bytes: words, epoch, count and CRC.
    #[must_use]
    pub const fn bytes(self) -> usize {
        2 * self.words() + 4
    }

    /// Number of classic frames of the longest packet.
    pub const MAX_SEGMENTS: usize = Self::Fourteen.segments();

    /// Returns the number of classic frames that carry a packet of this length.
    #[must_use]
    pub const fn segments(self) -> usize {
        self.bytes().div_ceil(SEGMENT_BYTES)
    }

    /// Returns the size in bytes of the last classic frame of a packet; the frames before it have 8 bytes.
    #[must_use]
    pub const fn last_segment_bytes(self) -> usize {
        self.bytes() - (self.segments() - 1) * SEGMENT_BYTES
    }

    /// Returns the length of joints, torques and sums for a chain of `joints` joints. If there are more than 14 joints,
    /// returns the greatest length.
    #[must_use]
    pub const fn for_joints(joints: usize) -> Self {
        match joints {
            0..=6 => Self::Six,
            7 | 8 => Self::Eight,
            9 | 10 => Self::Ten,
            _ => Self::Fourteen,
        }
    }

    /// Returns the length with this size in bytes, if there is one.
    #[must_use]
    pub fn from_byte_count(bytes: usize) -> Option<Self> {
        Self::ALL.into_iter().find(|length| length.bytes() == bytes)
    }
}

/// A set of possible packet lengths.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Lengths(u8);

impl Lengths {
    /// All lengths; for a bus whose chain is unknown.
    pub const ALL: Self = Self(0b1111);

    /// The set of one length; for a bus whose chain is known.
    #[must_use]
    pub const fn only(length: Length) -> Self {
        Self(1 << length as u8)
    }

    /// Returns the set for a chain: its one length, or all lengths if the chain is unknown.
    #[must_use]
    pub fn from_chain_length(length: Option<Length>) -> Self {
        length.map_or(Self::ALL, Self::only)
    }

    /// Returns the lengths that packets with this identifier can have on any chain. Only the lengths of joints, torques
    /// and sums depend on the chain.
    #[must_use]
    pub fn for_id(id: Id) -> Self {
        let grows = matches!(id.kind, Kind::Torque | Kind::Sum) || id == Id::command(Command::Joints);
        if grows { Self::ALL } else { Self::only(Length::Six) }
    }

    /// Returns the lengths of this set that packets with this identifier can have. A kind with a fixed length always
    /// has six words.
    #[must_use]
    pub fn restricted_to(self, id: Id) -> Self {
        let own = Self::for_id(id);
        if own == Self::ALL { self } else { own }
    }

    /// Returns true if the set contains `length`.
    #[must_use]
    pub const fn contains(self, length: Length) -> bool {
        self.0 & 1 << length as u8 != 0
    }

    /// Returns the lengths in the set, the shortest first.
    pub fn iter(self) -> impl Iterator<Item = Length> {
        Length::ALL.into_iter().filter(move |&length| self.contains(length))
    }

    /// Returns the shortest length.
    pub(super) fn shortest(self) -> Length {
        self.iter().next().unwrap_or_default()
    }

    /// Returns the longest length of the set, by default six words.
    pub(super) fn longest(self) -> Length {
        Length::ALL.into_iter().rfind(|&length| self.contains(length)).unwrap_or_default()
    }
}

/// The words of a packet, with their [`Length`].
// Aligned to words; otherwise a Cortex-M0 copies them byte by byte.
#[derive(Clone, Copy, Default, Eq, Hash, PartialEq)]
#[repr(align(4))]
pub struct Words {
    length: Length,
    /// The words, followed by zeros up to the maximum.
    words: [i16; MAX_WORDS],
}

impl Words {
    /// Returns `length` words, all zero.
    #[must_use]
    pub const fn zeros(length: Length) -> Self {
        Self { length, words: [0; MAX_WORDS] }
    }

    /// Creates words of this length from the first elements of `words`; the others are dropped.
    #[must_use]
    pub fn new(length: Length, words: [i16; MAX_WORDS]) -> Self {
        let mut it = Self { length, words };
        it.words.iter_mut().skip(length.words()).for_each(|word| *word = 0);
        it
    }

    /// Creates words of this length, with zeros from the end of `words` on.
    #[must_use]
    pub(super) fn from_words(length: Length, words: impl Iterator<Item = i16>) -> Self {
        let mut it = Self::zeros(length);
        for (place, word) in it.words.iter_mut().zip(words.take(length.words())) {
            *place = word;
        }
        it
    }

    /// Returns the length.
    #[must_use]
    pub const fn length(&self) -> Length {
        self.length
    }

    /// Returns the words as a slice.
    #[must_use]
    pub fn as_slice(&self) -> &[i16] {
        self.words.get(..self.length.words()).unwrap_or_default()
    }

    /// Returns the words as a mutable slice.
    #[must_use]
    pub fn as_mut_slice(&mut self) -> &mut [i16] {
        self.words.get_mut(..self.length.words()).unwrap_or_default()
    }

    /// Returns the words, padded with zeros.
    #[must_use]
    pub const fn padded(&self) -> [i16; MAX_WORDS] {
        self.words
    }

    /// Returns a copy with one word replaced. An index beyond the length changes nothing.
    #[must_use]
    pub fn with_word(mut self, place: usize, word: i16) -> Self {
        if let Some(there) = self.words.get_mut(..self.length.words()).and_then(|words| words.get_mut(place))
        {
            *there = word;
        }
        self
    }

    /// Returns the first six words, which are all words of a packet whose length does not depend on the chain.
    #[must_use]
    pub const fn first_six(&self) -> [i16; WORDS] {
        let [a, b, c, d, e, f, ..] = self.words;
        [a, b, c, d, e, f]
    }

    /// Returns true if all words are zero.
    #[must_use]
    pub fn is_zero(&self) -> bool {
        self.words == [0; MAX_WORDS]
    }

    /// Returns true if a word has the largest or smallest value, which means *saturated* in a torque or sum.
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
