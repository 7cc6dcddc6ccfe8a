//! The names of buses and cells in a scenario's file.

use std::collections::HashMap;

use protocol::document::{Checked, KeyPath};
use protocol::port::PORTS;
use protocol::skin::{CellName, Skin, SkinReply};

use super::raw;
use crate::listing::node_id_ranges;

/// Maximum number of node id ranges in an error.
const MAX_LISTED_RANGES: usize = 8;

/// The buses and cells of a skin, by their names.
pub(super) struct NameTable<'a> {
    skin: &'a Skin,
    index: HashMap<(usize, i64), usize>,
}

/// The keys with which a table of a scenario's file selects cells.
#[derive(Clone, Copy)]
pub(super) struct CellSelection<'a> {
    /// The position of the table in the file, for errors.
    pub(super) at: &'a KeyPath,
    /// The key `bus`: the bus of cells that are given by node id alone.
    pub(super) bus: Option<&'a str>,
    /// The key `cells`: node ids, or cells with their buses.
    pub(super) cells: Option<&'a [raw::CellReference]>,
    /// The key `all`: true selects every cell, of the bus if `bus` is given.
    pub(super) all: bool,
}

impl<'a> NameTable<'a> {
    pub(super) fn new(skin: &'a Skin) -> Self {
        let cells = skin.cells.iter().enumerate();
        let index = cells.map(|(index, cell)| ((cell.bus, cell.node.get().into()), index)).collect();
        Self { skin, index }
    }

    pub(super) fn name(&self, cell: usize) -> String {
        let found = self.skin.cells.get(cell).and_then(|cell| Some((cell, self.skin.buses.get(cell.bus)?)));
        found.map_or_else(String::new, |(cell, bus)| format!("cell {} of {:?}", cell.node, bus.name))
    }

    fn bus_name(&self, bus: usize) -> &str {
        self.skin.buses.get(bus).map_or("", |bus| &bus.name)
    }

    /// Returns the index of the bus with this name. Errors show `at` and `value` as the key and its value.
    fn bus_named(&self, at: &KeyPath, value: &dyn core::fmt::Display, name: &str) -> Checked<usize> {
        let wrong =
            || at.fault(value, format_args!("the skin has no such bus, only {}", self.bus_names_text()));
        self.skin.bus_index(name).ok_or_else(wrong)
    }

    fn bus_names_text(&self) -> String {
        let names = self.skin.buses.iter().map(|bus| format!("{:?}", bus.name));
        names.collect::<Vec<_>>().join(", ")
    }

    /// Returns the index of the bus that the key `bus` names. The key may be omitted if the skin has only one bus.
    fn bus_of_key(&self, given: CellSelection<'_>) -> Checked<usize> {
        let at = given.at.with_key("bus");
        match given.bus {
            Some(name) => self.bus_named(&at, &format_args!("{name:?}"), name),
            None if self.skin.buses.len() == 1 => Ok(0),
            None => {
                let first = self.bus_name(0);
                let why = format_args!(
                    "missing: give the bus ({}), or name each cell with its bus, as in \"{first}:1\"",
                    self.bus_names_text()
                );
                Err(at.fault("", why))
            }
        }
    }

    /// Returns the index of the bus of a table: the bus of its key `bus`, or else of its first cell.
    pub(super) fn bus(&self, given: CellSelection<'_>) -> Checked<usize> {
        match given.cells {
            Some([first, ..]) if given.bus.is_none() => {
                let cell = self.cell(&given.at.with_key("cells").with_index(0), first, given)?;
                Ok(self.skin.cells.get(cell).map_or(0, |cell| cell.bus))
            }
            _ => self.bus_of_key(given),
        }
    }

    /// Returns the index of the cell that the file names at `at`.
    fn cell(&self, at: &KeyPath, named: &raw::CellReference, given: CellSelection<'_>) -> Checked<usize> {
        let (bus, node) = match named {
            raw::CellReference::Node(node) => (self.bus_of_key(given)?, *node),
            raw::CellReference::Text(text) => {
                let name: CellName = text.parse().map_err(|why: String| at.fault(named, why))?;
                let bus = match &name.bus {
                    Some(bus) => self.bus_named(at, named, bus)?,
                    None => self.bus_of_key(given)?,
                };
                (bus, name.node.get().into())
            }
        };
        self.index.get(&(bus, node)).copied().ok_or_else(|| {
            let (name, ids) = (self.bus_name(bus), self.node_ids_text(bus));
            let why = format!("no cell of {name:?} has node id {node}: {ids}");
            at.fault(named, why)
        })
    }

    /// Formats the node ids of a bus as a list for an error.
    fn node_ids_text(&self, bus: usize) -> String {
        let mut nodes: Vec<_> = self.skin.cells_on_bus(bus).map(|cell| cell.node.get()).collect();
        nodes.sort_unstable();
        let all = node_id_ranges(&nodes);
        match all.get(..MAX_LISTED_RANGES) {
            _ if all.is_empty() => "it has no cells".to_owned(),
            Some(few) if all.len() > MAX_LISTED_RANGES => format!("it has {}, ...", few.join(", ")),
            _ => format!("it has {}", all.join(", ")),
        }
    }

    /// Returns the indices of the cells that a table lists, in the file's order. A cell must not occur twice.
    fn listed_cells(&self, given: CellSelection<'_>, named: &[raw::CellReference]) -> Checked<Vec<usize>> {
        if given.bus.is_some() {
            self.bus_of_key(given)?;
        }
        let path = given.at.with_key("cells");
        let mut cells = Vec::with_capacity(named.len());
        for (index, named) in named.iter().enumerate() {
            let at = path.with_index(index);
            let cell = self.cell(&at, named, given)?;
            if let Some(first) = cells.iter().position(|&before| before == cell) {
                return Err(at.fault(named, format_args!("cells[{first}] is the same cell")));
            }
            cells.push(cell);
        }
        Ok(cells)
    }

    /// Returns the indices of the cells that a table lists, or of all cells; sorted.
    pub(super) fn cells(&self, given: CellSelection<'_>) -> Checked<Vec<usize>> {
        let path = given.at.with_key("cells");
        match given.cells {
            Some(_) if given.all => Err(path.fault("", "give either cells or all = true, not both")),
            None if !given.all => Err(path.fault("", "give the node ids of the cells, or all = true")),
            None => {
                let bus = given.bus.map(|_| self.bus_of_key(given)).transpose()?;
                let cells = self.skin.cells.iter().enumerate();
                let target = cells.filter(|(_, cell)| bus.is_none_or(|bus| cell.bus == bus));
                Ok(target.map(|(index, _)| index).collect())
            }
            Some([]) => Err(path.fault("[]", "at least one cell is needed")),
            Some(named) => {
                let mut cells = self.listed_cells(given, named)?;
                cells.sort_unstable();
                Ok(cells)
            }
        }
    }

    /// Returns the indices of the cells that a table lists, sorted. All of them must be on the given bus.
    pub(super) fn listed_cells_on_bus(&self, given: CellSelection<'_>, bus: usize) -> Checked<Vec<usize>> {
        let cells = self.cells(given)?;
        let is_here = |cell: usize| self.skin.cells.get(cell).is_some_and(|cell| cell.bus == bus);
        let path = given.at.with_key("cells");
        for (index, named) in given.cells.unwrap_or_default().iter().enumerate() {
            let at = path.with_index(index);
            if !is_here(self.cell(&at, named, given)?) {
                let why = format_args!(
                    "this fault is on the bus {:?} only: use another [[fault]] table for this cell",
                    self.bus_name(bus)
                );
                return Err(at.fault(named, why));
            }
        }
        Ok(cells)
    }

    /// Returns the indices of the two cells that a table lists, in the file's order. Both must be on one bus, and a
    /// wire must connect them.
    pub(super) fn wired_pair(&self, given: CellSelection<'_>) -> Checked<(usize, usize)> {
        let path = given.at.with_key("cells");
        self.cells(given)?;
        let named = given.cells.unwrap_or_default();
        let [one, other] = named else {
            let got = format!("{} cells", named.len());
            return Err(path.fault(got, "name the two cells that the wire connects"));
        };
        let bus = self.bus(given)?;
        self.listed_cells_on_bus(given, bus)?;
        let described = self.skin.buses.get(bus);
        if described.is_some_and(|bus| bus.reply == SkinReply::Torque) {
            return Err(path.fault("", "only a bus with reply = \"sum\" uses wires"));
        }
        let wires = self.skin.wires(bus);
        let node = |cell: usize| self.skin.cells.get(cell).map(|cell| cell.node);
        let leads = |&(from, to): &(usize, usize)| {
            let (Some(from), Some(to)) = (node(from), node(to)) else { return false };
            (0..PORTS).any(|port| wires.other_end(from, port).is_some_and(|(other, _)| other == to))
        };
        let pair =
            (self.cell(&path.with_index(0), one, given)?, self.cell(&path.with_index(1), other, given)?);
        let wrong = || path.fault(format_args!("[{one}, {other}]"), "no wire connects these two cells");
        Some(pair).filter(leads).ok_or_else(wrong)
    }
}

#[cfg(test)]
mod tests {
    use crate::scenario::{FaultKind, Scenario};
    use crate::testing::ONE_CELL_SKIN_TOML;
    use protocol::skin::Skin;

    /// Cells 1 to 3 of `vcan0`, and 1 and 5 of `vcan1`: indices 0 to 4.
    fn two_buses() -> Skin {
        let second = "[[bus]]\nname = \"vcan1\"\nreply = \"torque\"\nformat = \"fd\"\n\n[controller]";
        let (head, cell) = ONE_CELL_SKIN_TOML.split_at(ONE_CELL_SKIN_TOML.find("[[cell]]").unwrap());
        let cells =
            [("vcan0", 1), ("vcan0", 2), ("vcan0", 3), ("vcan1", 1), ("vcan1", 5)].map(|(bus, node)| {
                cell.replace("node = 1", &format!("node = {node}")).replace("\"vcan0\"", &format!("{bus:?}"))
            });
        let text = format!("{}{}", head.replacen("[controller]", second, 1), cells.join("\n"));
        Skin::parse("skin.toml", &text).unwrap()
    }

    fn read(text: &str) -> Result<Scenario, String> {
        let text = format!("duration_s = 9.0\n{text}\n");
        Scenario::parse("s.toml", &text, &two_buses()).map_err(|error| error.to_string())
    }

    fn touched(keys: &str) -> Result<Vec<usize>, String> {
        read(&format!("[[touch]]\nforce_n = 1.0\n{keys}")).map(|it| it.touches[0].cells.clone())
    }

    fn fault(keys: &str) -> Result<FaultKind, String> {
        read(&format!("[[fault]]\nat_s = 1.0\n{keys}")).map(|it| it.faults[0].kind.clone())
    }

    #[test]
    fn cells_are_named_with_their_bus_or_by_the_key_of_the_table() {
        for (keys, cells) in [
            ("cells = [\"vcan1:5\", \"vcan0:3\"]", vec![2, 4]),
            ("bus = \"vcan0\"\ncells = [1, \"vcan1:1\", \"2\"]", vec![0, 1, 3]),
            ("bus = \"vcan1\"\ncells = [1, \"vcan0:1\"]", vec![0, 3]),
            ("bus = \"vcan1\"\nall = true", vec![3, 4]),
        ] {
            assert_eq!(touched(keys), Ok(cells), "{keys}");
        }
        let FaultKind::Process { cells, .. } = fault("kind = \"kill\"\ncells = [\"vcan1:5\"]").unwrap()
        else {
            panic!()
        };
        assert_eq!(cells, [4]);
        for keys in ["bus = \"vcan1\"\ncells = [5]", "cells = [\"vcan1:5\"]"] {
            let kind = fault(&format!("kind = \"drop\"\nprobability = 0.5\n{keys}")).unwrap();
            assert!(matches!(&kind, FaultKind::Bus { bus: 1, cells, .. } if *cells == [4]), "{kind:?}");
        }
    }

    #[test]
    fn a_cell_that_is_not_there_is_named_beside_those_that_are() {
        let which =
            "missing: give the bus (\"vcan0\", \"vcan1\"), or name each cell with its bus, as in \"vcan0:1\"";
        for (keys, said) in [
            (
                "cells = [\"vcan0:9\"]",
                "s.toml:4:10: touch[0].cells[0] = \"vcan0:9\": no cell of \"vcan0\" has node id 9: it has 1-3",
            ),
            (
                "bus = \"vcan1\"\ncells = [1, 2]",
                "touch[0].cells[1] = 2: no cell of \"vcan1\" has node id 2: it has 1, 5",
            ),
            (
                "cells = [\"can0:1\"]",
                "touch[0].cells[0] = \"can0:1\": the skin has no such bus, only \"vcan0\", \"vcan1\"",
            ),
            ("cells = [\"vcan0:1\", 2]", &format!("touch[0].bus: {which}")),
            (
                "cells = [\"vcan0:x\"]",
                "touch[0].cells[0] = \"vcan0:x\": \"x\" is not a node id: use 1 to 254",
            ),
            ("cells = [2.5]", "touch[0].cells[0] = 2.5: must be either a node id or \"BUS:NODE\""),
            ("cells = [99999999999999999999]", "touch[0].cells[0] = 99999999999999999999: "),
            ("bus = \"can9\"\ncells = [\"vcan0:1\"]", "touch[0].bus = \"can9\": the skin has no such bus"),
            (
                "bus = \"vcan0\"\ncells = [1, \"vcan0:1\"]",
                "touch[0].cells[1] = \"vcan0:1\": cells[0] is the same cell",
            ),
        ] {
            let got = touched(keys).unwrap_err();
            assert!(got.contains(said), "{keys}\n{got}");
        }
        let two = "kind = \"drop\"\nprobability = 0.5\ncells = [\"vcan0:1\", \"vcan1:5\"]";
        let said = "fault[0].cells[1] = \"vcan1:5\": this fault is on the bus \"vcan0\" only: use another \
                    [[fault]] table for this cell";
        assert!(fault(two).unwrap_err().contains(said));
        let wire = fault("kind = \"link_down\"\ncells = [\"vcan0:1\", \"vcan1:5\"]").unwrap_err();
        assert!(wire.contains("this fault is on the bus \"vcan0\" only"), "{wire}");
    }
}
