//! Signals: where they stand in a packet, and what their words are worth.

use core::f64::consts::FRAC_PI_2;

/// Where byte 12 begins.
const EPOCH: u8 = 96;
/// Where byte 13 begins.
const COUNT: u8 = 104;
/// Where the CRC begins.
const CRC: u8 = 112;

/// When a signal is there.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum Page {
    /// In every packet of the message.
    Every,
    /// In every packet; it says which page this is.
    Number,
    /// On one page.
    Only(u8),
}

/// One signal of a message.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Signal {
    pub(super) name: String,
    pub(super) page: Page,
    /// The first bit, counted from the least significant one of byte 0.
    pub(super) start: u8,
    pub(super) bits: u8,
    pub(super) signed: bool,
    /// What one step is worth, in the unit.
    pub(super) factor: f64,
    /// The least and the greatest value that means something.
    pub(super) range: [f64; 2],
    pub(super) unit: &'static str,
    /// Values that have a name.
    pub(super) names: Vec<(i64, String)>,
}

impl Signal {
    /// Some bits as they are, unsigned.
    pub(super) fn bits(name: impl Into<String>, start: u8, bits: u8) -> Self {
        let greatest = f64::from(u32::MAX >> (32 - u32::from(bits.clamp(1, 32))));
        Self {
            name: name.into(),
            page: Page::Every,
            start,
            bits,
            signed: false,
            factor: 1.0,
            range: [0.0, greatest],
            unit: "",
            names: Vec::new(),
        }
    }

    /// One of the six words as it is, unsigned.
    pub(super) fn word(name: impl Into<String>, index: u8) -> Self {
        Self::bits(name, index * 16, 16)
    }

    /// One of the six words with `F` fraction bits.
    pub(super) fn fixed<const F: u32>(name: impl Into<String>, index: u8, unit: &'static str) -> Self {
        Self { unit, ..Self::word(name, index).scaled(1.0 / f64::from(1_u32 << F)) }
    }

    /// One of the six words as an angle: Q1.14 of quarter turns, here in rad.
    pub(super) fn angle(name: impl Into<String>, index: u8) -> Self {
        Self { unit: "rad", ..Self::word(name, index).scaled(FRAC_PI_2 / f64::from(1_u32 << 14)) }
    }

    fn scaled(self, factor: f64) -> Self {
        let range = [i16::MIN, i16::MAX].map(|end| f64::from(end) * factor);
        Self { signed: true, factor, range, ..self }
    }

    /// Byte 12.
    pub(super) fn epoch() -> Self {
        Self::bits("epoch", EPOCH, 8)
    }

    /// Byte 12 of a question and its answer.
    pub(super) fn tag() -> Self {
        Self::bits("tag", EPOCH, 8)
    }

    /// Byte 13 where it counts.
    pub(super) fn count(least: u8, greatest: u8) -> Self {
        Self::bits("count", COUNT, 8).within(f64::from(least), f64::from(greatest))
    }

    /// The part of byte 13 that says which page this is; `bits` is 8, or 7 where the highest is a flag.
    pub(super) fn page_number(name: &'static str, bits: u8) -> Self {
        Self { page: Page::Number, ..Self::bits(name, COUNT, bits) }
    }

    /// The highest bit of byte 13.
    pub(super) fn flag(name: &'static str) -> Self {
        Self::bits(name, COUNT + 7, 1)
    }

    /// Bytes 14 and 15.
    pub(super) fn crc() -> Self {
        Self::bits("crc", CRC, 16)
    }

    pub(super) fn within(self, least: f64, greatest: f64) -> Self {
        Self { range: [least, greatest], ..self }
    }

    /// The same without values below zero.
    pub(super) fn not_negative(self) -> Self {
        let [_, greatest] = self.range;
        self.within(0.0, greatest)
    }

    pub(super) fn in_unit(self, unit: &'static str) -> Self {
        Self { unit, ..self }
    }

    pub(super) fn on(self, page: u8) -> Self {
        Self { page: Page::Only(page), ..self }
    }

    pub(super) fn naming<N: Into<String>>(self, names: impl IntoIterator<Item = (i64, N)>) -> Self {
        Self { names: names.into_iter().map(|(value, name)| (value, name.into())).collect(), ..self }
    }

    /// The same word of a torque or a sum, whose ends mean *saturated*.
    pub(super) fn saturating(self) -> Self {
        self.naming([i16::MAX, i16::MIN].map(|end| (i64::from(end), "saturated")))
    }
}
