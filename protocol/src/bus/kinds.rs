//! Which kind each of several buses is: `--bus-kind embedded --bus-kind can0=socketcan`.

use std::collections::BTreeMap;
use std::str::FromStr;

use thiserror::Error;

use super::{BusKind, Choice, UnknownKind, check_name};

/// One `--bus-kind`: of a bus that is named, or of all that are not.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct OneKind {
    /// The bus, if one is named.
    pub bus: Option<String>,
    /// Its kind.
    pub kind: Choice,
}

impl FromStr for OneKind {
    type Err = UnknownKind;

    fn from_str(word: &str) -> Result<Self, UnknownKind> {
        let (bus, kind) = word.split_once('=').map_or((None, word), |(bus, kind)| (Some(bus), kind));
        let wrong = |_| UnknownKind { got: word.to_owned() };
        if bus.is_some_and(|bus| check_name(bus).is_err()) {
            return Err(UnknownKind { got: word.to_owned() });
        }
        Ok(Self { bus: bus.map(str::to_owned), kind: kind.parse().map_err(wrong)? })
    }
}

/// Which kind each bus is.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct Kinds {
    named: BTreeMap<String, Choice>,
    others: Choice,
}

/// Kinds that contradict each other, or name what is not there.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum KindsError {
    /// Two words about the same.
    #[error("--bus-kind is given twice for {what}: {first} and {second}; leave out one")]
    Twice {
        /// A bus, or all others.
        what: String,
        /// The first.
        first: Choice,
        /// The second.
        second: Choice,
    },
    /// A bus that nobody else speaks of.
    #[error("--bus-kind {bus}={kind}: there is no bus {bus} here, but {}", known.join(", "))]
    Unknown {
        /// The bus.
        bus: String,
        /// What it was to be.
        kind: Choice,
        /// The buses that are there.
        known: Vec<String>,
    },
}

impl Kinds {
    /// Every bus is of this kind.
    #[must_use]
    pub const fn all(kind: Choice) -> Self {
        Self { named: BTreeMap::new(), others: kind }
    }

    /// These buses are what they are.
    #[must_use]
    pub fn exactly<'a>(buses: impl IntoIterator<Item = (&'a str, BusKind)>) -> Self {
        let named = buses.into_iter().map(|(name, kind)| (name.to_owned(), Choice::Only(kind)));
        Self { named: named.collect(), others: Choice::Auto }
    }

    /// What the words say; buses that none of them speaks of are as `otherwise` says.
    ///
    /// # Errors
    /// When two of them speak of the same.
    pub fn of_words(words: &[OneKind], otherwise: Choice) -> Result<Self, KindsError> {
        let (mut named, mut others) = (BTreeMap::new(), None);
        for OneKind { bus, kind } in words {
            let first = match bus {
                Some(bus) => named.insert(bus.clone(), *kind),
                None => others.replace(*kind),
            };
            if let Some(first) = first {
                let what = bus.clone().unwrap_or_else(|| "all other buses".to_owned());
                return Err(KindsError::Twice { what, first, second: *kind });
            }
        }
        Ok(Self { named, others: others.unwrap_or(otherwise) })
    }

    /// Sees that every bus that is named is one of these.
    ///
    /// # Errors
    /// When one is not.
    pub fn only<'a>(self, known: impl IntoIterator<Item = &'a str>) -> Result<Self, KindsError> {
        let known: Vec<_> = known.into_iter().map(str::to_owned).collect();
        match self.named.iter().find(|(bus, _)| !known.contains(bus)) {
            Some((bus, &kind)) => Err(KindsError::Unknown { bus: bus.clone(), kind, known }),
            None => Ok(self),
        }
    }

    /// The kind of this bus.
    #[must_use]
    pub fn of(&self, bus: &str) -> Choice {
        self.named.get(bus).copied().unwrap_or(self.others)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EMBEDDED: Choice = Choice::Only(BusKind::Embedded);
    const SOCKETCAN: Choice = Choice::Only(BusKind::SocketCan);

    fn kinds(words: &[&str]) -> Result<Kinds, KindsError> {
        let words: Vec<_> = words.iter().map(|word| word.parse().unwrap()).collect();
        Kinds::of_words(&words, Choice::Auto)
    }

    #[test]
    fn a_bus_that_is_named_is_what_is_said_of_it_and_the_others_are_what_is_said_without_a_name() {
        let mixed = kinds(&["vcan1=embedded", "socketcan"]).unwrap();
        assert_eq!(["vcan0", "vcan1"].map(|bus| mixed.of(bus)), [SOCKETCAN, EMBEDDED]);
        let rest = kinds(&["vcan1=socketcan"]).unwrap();
        assert_eq!(["vcan0", "vcan1"].map(|bus| rest.of(bus)), [Choice::Auto, SOCKETCAN]);
        assert_eq!(Kinds::all(EMBEDDED).of("vcan9"), EMBEDDED);
        assert_eq!(Kinds::exactly([("can0", BusKind::SocketCan)]).of("can0"), SOCKETCAN);
    }

    #[test]
    fn what_cannot_be_is_said_with_what_can() {
        let wrong =
            |words: &[&str]| kinds(words).and_then(|kinds| kinds.only(["vcan0", "vcan1"])).unwrap_err();
        assert_eq!(
            wrong(&["vcan1=embedded", "vcan1=auto"]).to_string(),
            "--bus-kind is given twice for vcan1: embedded and auto; leave out one"
        );
        assert_eq!(
            wrong(&["embedded", "socketcan"]).to_string(),
            "--bus-kind is given twice for all other buses: embedded and socketcan; leave out one"
        );
        assert_eq!(
            wrong(&["vcan7=embedded"]).to_string(),
            "--bus-kind vcan7=embedded: there is no bus vcan7 here, but vcan0, vcan1"
        );
        for word in ["vcan", "vcan1=vcan", "=embedded", "a/b=embedded", "vcan1=embedded=x"] {
            assert!(
                word.parse::<OneKind>().unwrap_err().to_string().starts_with(&format!("{word:?} is no kind"))
            );
        }
    }
}
