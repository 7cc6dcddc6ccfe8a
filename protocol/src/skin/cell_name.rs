//! Names of cells, as people write them.

use core::fmt;
use core::str::FromStr;

use crate::id::CellId;

/// The name of a cell: `NODE`, or `BUS:NODE` where several buses may have that node id.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct CellName {
    /// Its bus, if that is named.
    pub bus: Option<String>,
    /// Its node id there.
    pub node: CellId,
}

impl FromStr for CellName {
    type Err = String;

    /// Parses a name.
    ///
    /// # Errors
    /// When there is no node id from 1 to 254 at its end, or nothing before the colon.
    fn from_str(text: &str) -> Result<Self, String> {
        let (bus, number) = match text.rsplit_once(':') {
            Some(("", _)) => {
                return Err("no bus stands before the colon: a cell is NODE or BUS:NODE".to_owned());
            }
            Some((bus, number)) => (Some(bus.to_owned()), number),
            None => (None, text),
        };
        let node = number.parse().ok().and_then(|number| CellId::new(number).ok());
        let node = node.ok_or_else(|| format!("{number:?} is no node id: 1 to 254 are"))?;
        Ok(Self { bus, node })
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
            ("", "\"\" is no node id"),
            ("vcan0", "\"vcan0\" is no node id"),
            ("vcan0:", "\"\" is no node id"),
            ("vcan0:255", "\"255\" is no node id: 1 to 254 are"),
            (":3", "no bus stands before the colon"),
        ] {
            assert!(text.parse::<CellName>().unwrap_err().contains(why), "{text}");
        }
    }
}
