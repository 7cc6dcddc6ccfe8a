//! Kinds of buses, and the choice of a kind for each bus of a bench: `--bus-kind embedded --bus-kind can0=socketcan`.
//!
//! A new kind is added here and implements [`BusBackend`].

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use thiserror::Error;

use super::carrier::BusBackend;
use super::check_name;
use super::embedded::EmbeddedBackend;
use super::kernel::SocketCanBackend;

/// A kind of bus, by the transport of its frames.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub enum BusKind {
    /// A network interface of the kernel: `can0`, `vcan0`.
    SocketCan,
    /// A bus served by another process of this user, through a socket in a private directory.
    Embedded,
}

impl BusKind {
    /// All kinds.
    pub const ALL: [Self; 2] = [Self::SocketCan, Self::Embedded];

    /// Returns the implementation of the kind.
    pub(super) const fn backend(self) -> &'static dyn BusBackend {
        match self {
            Self::SocketCan => &SocketCanBackend,
            Self::Embedded => &EmbeddedBackend,
        }
    }

    /// Returns the names of all kinds as text: `socketcan or embedded`.
    #[must_use]
    pub fn names() -> String {
        let [first @ .., last] = Self::ALL.map(Self::name);
        format!("{} or {last}", first.join(", "))
    }

    /// Returns the values of an option for the kind as text: `socketcan, embedded or auto`.
    #[must_use]
    pub fn choices() -> String {
        format!("{} or auto", Self::ALL.map(Self::name).join(", "))
    }

    /// Returns the help of an option for the kind of one bus.
    #[must_use]
    pub fn help() -> String {
        let choices = Self::choices();
        format!("Bus kind: {choices} (socketcan if the bus has an interface of its name, else embedded)")
    }

    /// Returns true for network interfaces of the kernel; buses of all other kinds are sockets that a process
    /// serves.
    #[must_use]
    pub const fn is_interface(self) -> bool {
        matches!(self, Self::SocketCan)
    }

    /// Returns the name under which a process serves a bus of this kind.
    #[must_use]
    pub fn served_name(self, name: &str) -> String {
        self.backend().served_name(name)
    }

    /// Returns the name of the kind in sentences.
    #[must_use]
    pub const fn display_name(self) -> &'static str {
        match self {
            Self::SocketCan => "SocketCAN",
            Self::Embedded => "the embedded bus",
        }
    }

    /// Returns the name of the kind as used in tables and in `--bus-kind`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::SocketCan => "socketcan",
            Self::Embedded => "embedded",
        }
    }
}

impl fmt::Display for BusKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

/// A requested kind of bus.
#[derive(Clone, Copy, Debug, Default, Eq, Hash, PartialEq)]
pub enum KindChoice {
    /// SocketCAN if there is an interface of the bus's name, else the embedded bus.
    #[default]
    Auto,
    /// This kind only.
    Only(BusKind),
}

impl KindChoice {
    /// Returns the kind of a bus that a process serves for this choice.
    #[must_use]
    pub const fn served_kind(self) -> BusKind {
        match self {
            Self::Only(kind) if !kind.is_interface() => kind,
            Self::Only(_) | Self::Auto => BusKind::Embedded,
        }
    }

    /// Returns the kind of the bus of this name, which for [`KindChoice::Auto`] depends on the interfaces that
    /// exist now.
    #[must_use]
    pub fn resolve(self, name: &str) -> BusKind {
        match self {
            Self::Only(kind) => kind,
            Self::Auto if super::kernel::has_interface(name) => BusKind::SocketCan,
            Self::Auto => BusKind::Embedded,
        }
    }
}

impl fmt::Display for KindChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.pad("auto"),
            Self::Only(kind) => kind.fmt(f),
        }
    }
}

/// The error for a word that does not name a kind of bus.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[error("{got:?} is not a bus kind: use auto, {}", BusKind::names())]
pub struct UnknownKind {
    /// The rejected word.
    pub got: String,
}

impl FromStr for KindChoice {
    type Err = UnknownKind;

    fn from_str(word: &str) -> Result<Self, UnknownKind> {
        let mut all = [Self::Auto].into_iter().chain(BusKind::ALL.map(Self::Only));
        let found = all.find(|choice| choice.to_string() == word);
        found.ok_or_else(|| UnknownKind { got: word.to_owned() })
    }
}

/// The value of one option `--bus-kind`: a kind for one bus, or for all buses without an option of their own.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct KindOption {
    /// The name of the bus; `None` for all buses without an option of their own.
    pub bus: Option<String>,
    /// The requested kind.
    pub kind: KindChoice,
}

impl FromStr for KindOption {
    type Err = UnknownKind;

    fn from_str(word: &str) -> Result<Self, UnknownKind> {
        let (bus, kind) = word.split_once('=').map_or((None, word), |(bus, kind)| (Some(bus), kind));
        let kind = kind.parse().ok().filter(|_| bus.is_none_or(|bus| check_name(bus).is_ok()));
        let kind = kind.ok_or_else(|| UnknownKind { got: word.to_owned() })?;
        Ok(Self { bus: bus.map(str::to_owned), kind })
    }
}

/// The requested kind of each bus of a bench.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct KindChoices {
    named: BTreeMap<String, KindChoice>,
    others: KindChoice,
}

/// The error for options `--bus-kind` that contradict each other or name an unknown bus.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum KindsError {
    /// Two options `--bus-kind` are given for the same buses.
    #[error("--bus-kind is given twice for {what}: {first} and {second}; leave out one")]
    Duplicate {
        /// The name of the bus, or the words for all other buses.
        what: String,
        /// The first kind.
        first: KindChoice,
        /// The second kind.
        second: KindChoice,
    },
    /// `--bus-kind` names a bus that does not exist.
    #[error("--bus-kind {bus}={kind}: there is no bus {bus}; the buses are {}", known.join(", "))]
    Unknown {
        /// The bus.
        bus: String,
        /// The kind requested for that bus.
        kind: KindChoice,
        /// The names of the existing buses.
        known: Vec<String>,
    },
}

impl KindChoices {
    /// Requests the same kind for every bus.
    #[must_use]
    pub const fn same_for_all(kind: KindChoice) -> Self {
        Self { named: BTreeMap::new(), others: kind }
    }

    /// Requests the given kind for each of these buses, and [`KindChoice::Auto`] for others.
    #[must_use]
    pub fn from_kinds<'a>(buses: impl IntoIterator<Item = (&'a str, BusKind)>) -> Self {
        let named = buses.into_iter().map(|(name, kind)| (name.to_owned(), KindChoice::Only(kind)));
        Self { named: named.collect(), others: KindChoice::Auto }
    }

    /// Combines the values of several options `--bus-kind`. Buses without a value get the kind `otherwise`.
    ///
    /// # Errors
    /// Returns an error if two values are for the same bus, or if two values are for all other buses.
    pub fn from_options(words: &[KindOption], otherwise: KindChoice) -> Result<Self, KindsError> {
        let (mut named, mut others) = (BTreeMap::new(), None);
        for KindOption { bus, kind } in words {
            let first = match bus {
                Some(bus) => named.insert(bus.clone(), *kind),
                None => others.replace(*kind),
            };
            if let Some(first) = first {
                let what = bus.clone().unwrap_or_else(|| "all other buses".to_owned());
                return Err(KindsError::Duplicate { what, first, second: *kind });
            }
        }
        Ok(Self { named, others: others.unwrap_or(otherwise) })
    }

    /// Checks that every bus named in an option is in the list `known`.
    ///
    /// # Errors
    /// Returns an error for the first bus that is not in the list.
    pub fn restrict_to<'a>(self, known: impl IntoIterator<Item = &'a str>) -> Result<Self, KindsError> {
        let known: Vec<_> = known.into_iter().map(str::to_owned).collect();
        match self.named.iter().find(|(bus, _)| !known.contains(bus)) {
            Some((bus, &kind)) => Err(KindsError::Unknown { bus: bus.clone(), kind, known }),
            None => Ok(self),
        }
    }

    /// Returns the requested kind of a bus.
    #[must_use]
    pub fn kind_of(&self, bus: &str) -> KindChoice {
        self.named.get(bus).copied().unwrap_or(self.others)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EMBEDDED: KindChoice = KindChoice::Only(BusKind::Embedded);
    const SOCKETCAN: KindChoice = KindChoice::Only(BusKind::SocketCan);

    fn kinds(words: &[&str]) -> Result<KindChoices, KindsError> {
        let words: Vec<_> = words.iter().map(|word| word.parse().unwrap()).collect();
        KindChoices::from_options(&words, KindChoice::Auto)
    }

    #[test]
    fn a_choice_is_read_as_it_is_printed() {
        for word in ["auto", "socketcan", "embedded"] {
            assert_eq!(word.parse::<KindChoice>().unwrap().to_string(), word);
        }
        let error = "vcan".parse::<KindChoice>().unwrap_err().to_string();
        assert_eq!(error, "\"vcan\" is not a bus kind: use auto, socketcan or embedded");
    }

    #[test]
    fn a_bus_that_is_named_is_what_is_said_of_it_and_the_others_are_what_is_said_without_a_name() {
        let mixed = kinds(&["vcan1=embedded", "socketcan"]).unwrap();
        assert_eq!(["vcan0", "vcan1"].map(|bus| mixed.kind_of(bus)), [SOCKETCAN, EMBEDDED]);
        let rest = kinds(&["vcan1=socketcan"]).unwrap();
        assert_eq!(["vcan0", "vcan1"].map(|bus| rest.kind_of(bus)), [KindChoice::Auto, SOCKETCAN]);
        assert_eq!(KindChoices::same_for_all(EMBEDDED).kind_of("vcan9"), EMBEDDED);
        assert_eq!(KindChoices::from_kinds([("can0", BusKind::SocketCan)]).kind_of("can0"), SOCKETCAN);
    }

    #[test]
    fn what_cannot_be_is_said_with_what_can() {
        let wrong = |words: &[&str]| {
            kinds(words).and_then(|kinds| kinds.restrict_to(["vcan0", "vcan1"])).unwrap_err()
        };
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
            "--bus-kind vcan7=embedded: there is no bus vcan7; the buses are vcan0, vcan1"
        );
        for word in ["vcan", "vcan1=vcan", "=embedded", "a/b=embedded", "vcan1=embedded=x"] {
            assert!(
                word.parse::<KindOption>()
                    .unwrap_err()
                    .to_string()
                    .starts_with(&format!("{word:?} is not a bus kind"))
            );
        }
    }
}
