//! Text of ports and of the neighbours at them.

use core::fmt::{self, Display, Formatter};

use protocol::port::UPLINK;
use protocol::schema::Field;

/// A port of a cell by its number; the number after the last port stands for the uplink to the gateway.
pub(super) struct PortName(pub(super) i64);

impl Display for PortName {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match usize::try_from(self.0) {
            Ok(UPLINK) => f.write_str("uplink"),
            Ok(_) | Err(_) => write!(f, "port {}", self.0),
        }
    }
}

/// Writes the neighbour at each of `ports` ports.
pub(super) fn write_neighbors(
    f: &mut Formatter<'_>,
    parts: &[Field],
    bytes: &[u8],
    ports: usize,
) -> fmt::Result {
    for index in 0..ports {
        let word = bytes.get(2 * index..).unwrap_or_default();
        let part = |name: &str| {
            parts.iter().find(|part| part.name == name).map_or(0, |part| part.raw_value(word, 0))
        };
        write!(f, "{}{index} ", if index == 0 { "" } else { ", " })?;
        if part("hears") == 0 {
            f.write_str("silent")?;
            continue;
        }
        write!(f, "leads to {} of ", PortName(part("port")))?;
        match part("node") {
            0 => f.write_str("a cell without a node id")?,
            number => write!(f, "{number}")?,
        }
        f.write_str(match (part("other_version"), part("works")) {
            (1, _) => " (other version)",
            (_, 0) => " (one direction only)",
            _ => "",
        })?;
    }
    Ok(())
}

/// A set of ports, one bit each, formatted as `0+2` or `none`.
pub(super) struct PortSet(pub(super) i64);

impl PortSet {
    /// Returns the numbers of the ports in the set.
    pub(super) fn ports(&self) -> impl Iterator<Item = u8> + use<> {
        let bits = self.0;
        (0..8).filter(move |port| bits >> port & 1 == 1)
    }
}

impl Display for PortSet {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write_joined(f, self.ports())
    }
}

/// Writes items joined with plus signs, or `none`.
pub(super) fn write_joined(f: &mut Formatter<'_>, all: impl Iterator<Item = impl Display>) -> fmt::Result {
    let mut any = false;
    for one in all {
        write!(f, "{}{one}", if any { "+" } else { "" })?;
        any = true;
    }
    if any { Ok(()) } else { f.write_str("none") }
}
