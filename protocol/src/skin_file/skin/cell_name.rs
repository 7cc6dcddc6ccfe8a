//! Names of cells, as users write them on the command line and in files.

use core::fmt;
use core::str::FromStr;

use crate::id::CellId;

/// The name of a cell: `NODE`, or `BUS:NODE` where several buses can have a cell with that node id.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct CellName {
    /// Name of the bus, if given.
    pub bus: Option<String>,
    /// The node id on that bus.
    pub node: CellId,
}

impl FromStr for CellName {
    type Err = String;

    /// Parses a name.
    ///
    /// # Errors
    /// Returns an error if the text does not end with a node id from 1 to 254, or if the bus name before the colon is
    /// empty.
    fn from_str(text: &str) -> Result<Self, String> {
        let (bus, number) = split_bus(text)?;
        let node = number.parse().map_err(|_| format!("{number:?} is not a node id: use 1 to 254"))?;
        Ok(Self { bus: bus.map(str::to_owned), node })
    }
}

/// Splits `BUS:NODE` or `NODE` into bus and node. The bus name may contain colons.
///
/// # Errors
/// Returns an error if the bus name before the colon is empty.
pub fn split_bus(text: &str) -> Result<(Option<&str>, &str), String> {
    match text.rsplit_once(':') {
        Some(("", _)) => {
            Err("the name of the bus before the colon is missing: write NODE or BUS:NODE".to_owned())
        }
        Some((bus, node)) => Ok((Some(bus), node)),
        None => Ok((None, text)),
    }
}

impl CellName {
    /// Returns true if the name denotes the cell with this bus and node id.
    #[must_use]
    pub fn matches_cell(&self, bus: &str, node: CellId) -> bool {
        self.node == node && self.bus.as_deref().is_none_or(|own| own == bus)
    }
}

impl fmt::Display for CellName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(bus) = &self.bus {
            write!(f, "{bus}:")?;
        }
        self.node.fmt(f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_a_node_id_or_one_behind_the_name_of_a_bus() {
        for text in ["3", "vcan0:254", "a:b:1"] {
            let name: CellName = text.parse().unwrap();
            assert_eq!(name.to_string(), text);
        }
        assert_eq!("a:b:1".parse::<CellName>().unwrap().bus.as_deref(), Some("a:b"));
        for (text, why) in [
            ("", "\"\" is not a node id"),
            ("vcan0", "\"vcan0\" is not a node id"),
            ("vcan0:", "\"\" is not a node id"),
            ("vcan0:255", "\"255\" is not a node id: use 1 to 254"),
            (":3", "the name of the bus before the colon is missing"),
        ] {
            assert!(text.parse::<CellName>().unwrap_err().contains(why), "{text}");
        }
    }
}
