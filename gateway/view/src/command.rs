//! The commands that programs and pages send to a run, one JSON object each. Cells are named, and looked up in the skin.

use bench::remote::BenchCommand;
use model::scenario::ProcessAction;
use protocol::message::Message;
use protocol::skin::{CellName, Skin};
use serde::{Deserialize, Deserializer, de};
use serde_json::Value;

use crate::pressed::CellKey;
#[cfg(doc)]
use crate::pressed::MAX_FORCE_N;

/// A cell as a command names it: a node id as a number, or the text `NODE` or `BUS:NODE`.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct CellReference(pub String);

/// A command to a run, of a program or of a page.
#[derive(Clone, Debug, Deserialize, PartialEq)]
#[serde(tag = "do", rename_all = "lowercase", deny_unknown_fields)]
pub enum ControlCommand {
    /// Presses a cell.
    Press {
        /// The cell.
        cell: CellReference,
        /// The force in N, 0 to [`MAX_FORCE_N`].
        force_n: f64,
    },
    /// Releases a cell, or all cells that this program presses.
    Release {
        /// The cell; `None` for all.
        #[serde(default)]
        cell: Option<CellReference>,
    },
    /// Halts all cells.
    Halt {},
    /// Lets all halted cells continue.
    Resume {},
    /// Kills the process of a cell.
    Kill {
        /// The cell.
        cell: CellReference,
    },
    /// Stops the process of a cell.
    Stop {
        /// The cell.
        cell: CellReference,
    },
    /// Lets the stopped process of a cell continue.
    Continue {
        /// The cell.
        cell: CellReference,
    },
    /// Starts the process of a cell again.
    Restart {
        /// The cell.
        cell: CellReference,
    },
    /// Takes a bus down, or brings it up.
    Bus {
        /// The name of the bus.
        bus: String,
        /// True to take it down.
        down: bool,
    },
    /// Takes the link between two cells down, or brings it up.
    Link {
        /// The two cells, of one bus.
        cells: [CellReference; 2],
        /// True to take it down.
        down: bool,
    },
    /// Requests an event for every Nth epoch.
    Epochs {
        /// N; 0 ends the events.
        every: u32,
    },
    /// Requests the state of the bench.
    Report {},
    /// Ends the run in order.
    End {},
}

impl ControlCommand {
    /// Returns the name of the command.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Press { .. } => "press",
            Self::Release { .. } => "release",
            Self::Halt {} => "halt",
            Self::Resume {} => "resume",
            Self::Kill { .. } => "kill",
            Self::Stop { .. } => "stop",
            Self::Continue { .. } => "continue",
            Self::Restart { .. } => "restart",
            Self::Bus { .. } => "bus",
            Self::Link { .. } => "link",
            Self::Epochs { .. } => "epochs",
            Self::Report {} => "report",
            Self::End {} => "end",
        }
    }

    /// Finds the cells and buses of the command in the skin.
    ///
    /// # Errors
    /// Returns the reason if the skin has no such cell or bus, or if a name is ambiguous.
    pub fn resolve(&self, skin: &Skin) -> Result<ResolvedCommand, String> {
        let process = |action, cell: &CellReference| {
            let (bus, node) = cell.find(skin)?;
            Ok::<_, String>(ResolvedCommand::Bench(BenchCommand::Process { action, bus, node: node.get() }))
        };
        Ok(match self {
            Self::Kill { cell } => process(ProcessAction::Kill, cell)?,
            Self::Stop { cell } => process(ProcessAction::Stop, cell)?,
            Self::Continue { cell } => process(ProcessAction::Continue, cell)?,
            Self::Restart { cell } => process(ProcessAction::Restart, cell)?,
            Self::Bus { bus, down } => {
                ResolvedCommand::Bench(BenchCommand::Bus { down: *down, bus: find_bus(skin, bus)? })
            }
            Self::Link { cells: [one, other], down } => {
                let (bus, nodes) = find_cells_of_link(skin, one, other)?;
                ResolvedCommand::Bench(BenchCommand::Link { down: *down, bus, nodes })
            }
            Self::End {} => ResolvedCommand::Bench(BenchCommand::End),
            Self::Press { cell, force_n } => {
                ResolvedCommand::Direct(DirectCommand::Press { cell: cell.find(skin)?, force_n: *force_n })
            }
            Self::Release { cell } => {
                let cell = cell.as_ref().map(|cell| cell.find(skin)).transpose()?;
                ResolvedCommand::Direct(DirectCommand::Release { cell })
            }
            Self::Halt {} => ResolvedCommand::Direct(DirectCommand::Send(Message::Halt)),
            Self::Resume {} => ResolvedCommand::Direct(DirectCommand::Send(Message::Resume)),
            Self::Epochs { every } => ResolvedCommand::Direct(DirectCommand::Epochs { every: *every }),
            Self::Report {} => ResolvedCommand::Direct(DirectCommand::Report),
        })
    }
}

/// A command whose cells and buses were found in the skin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ResolvedCommand {
    /// A command to the main thread of the run.
    Bench(BenchCommand),
    /// A command that the page's server or the control channel carries out itself.
    Direct(DirectCommand),
}

/// A command that the page's server or the control channel carries out itself.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum DirectCommand {
    /// Presses a cell.
    Press {
        /// The cell.
        cell: CellKey,
        /// The force in N.
        force_n: f64,
    },
    /// Releases a cell, or with `None` all that the program or page presses.
    Release {
        /// The cell.
        cell: Option<CellKey>,
    },
    /// Sends a message on all buses.
    Send(Message),
    /// Requests an event for every Nth epoch.
    Epochs {
        /// N; 0 ends the events.
        every: u32,
    },
    /// Requests the state of the bench.
    Report,
}

impl CellReference {
    /// Finds the cell in the skin. Returns the index of its bus, and its node id.
    ///
    /// # Errors
    /// Returns the reason if the text does not name a cell, if the skin has no such cell, or if several buses have one.
    pub fn find(&self, skin: &Skin) -> Result<CellKey, String> {
        let Self(text) = self;
        let name: CellName = text.parse().map_err(|error| format!("cell {text:?}: {error}"))?;
        let mut found = skin.cells_named(&name).map(|(_, cell)| cell);
        match (found.next(), found.next()) {
            (Some(cell), None) => Ok((cell.bus, cell.node)),
            (None, _) => Err(format!("cell {name}: the skin has no such cell")),
            (Some(one), Some(other)) => Err(format!(
                "cell {name} is on several buses: name it with its bus, such as \"{}\" or \"{}\"",
                skin.full_cell_name(one.bus, one.node),
                skin.full_cell_name(other.bus, other.node)
            )),
        }
    }
}

fn find_bus(skin: &Skin, name: &str) -> Result<usize, String> {
    skin.bus_index(name).ok_or_else(|| {
        let names: Vec<_> = skin.buses.iter().map(|bus| bus.name.as_str()).collect();
        format!("bus {name:?}: the skin has no such bus; it has {}", names.join(", "))
    })
}

/// Finds the two cells of a link. Returns the index of their bus, and their node ids.
fn find_cells_of_link(
    skin: &Skin,
    one: &CellReference,
    other: &CellReference,
) -> Result<(usize, [u8; 2]), String> {
    let (one, other) = (one.find(skin)?, other.find(skin)?);
    if one.0 != other.0 {
        return Err("the two cells are on different buses: name two cells of one bus".to_owned());
    }
    Ok((one.0, [one.1.get(), other.1.get()]))
}

impl<'de> Deserialize<'de> for CellReference {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        match Value::deserialize(deserializer)? {
            Value::Number(number) => Ok(Self(number.to_string())),
            Value::String(text) => Ok(Self(text)),
            other @ (Value::Null | Value::Bool(_) | Value::Array(_) | Value::Object(_)) => {
                Err(de::Error::custom(format!("cell {other}: use a node id or \"BUS:NODE\"")))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::skin::{Cell, SkinBus};

    /// A skin with cells 1 to 5 on vcan0, and cell 3 on vcan1.
    fn skin_of_two_buses() -> Skin {
        let mut skin = Skin::parse("ur5", include_str!("../../examples/ur5-253.toml")).unwrap();
        skin.cells.truncate(5);
        skin.cells.push(Cell { bus: 1, ..skin.cells[2].clone() });
        skin.buses.push(SkinBus { name: "vcan1".to_owned(), ..skin.buses[0].clone() });
        skin
    }

    #[test]
    fn buses_and_cells_are_found_by_name() {
        let skin = skin_of_two_buses();
        for (command, expected) in [
            (r#"{"do":"kill","cell":2}"#, Ok(r#"{"on":"process","action":"kill","bus":0,"node":2}"#)),
            (
                r#"{"do":"restart","cell":"vcan1:3"}"#,
                Ok(r#"{"on":"process","action":"restart","bus":1,"node":3}"#),
            ),
            (r#"{"do":"bus","bus":"vcan1","down":true}"#, Ok(r#"{"on":"bus","down":true,"bus":1}"#)),
            (
                r#"{"do":"link","cells":[1,"vcan0:3"],"down":false}"#,
                Ok(r#"{"on":"link","down":false,"bus":0,"nodes":[1,3]}"#),
            ),
            (
                r#"{"do":"kill","cell":3}"#,
                Err("cell 3 is on several buses: name it with its bus, such as \"vcan0:3\" or \"vcan1:3\""),
            ),
            (r#"{"do":"stop","cell":9}"#, Err("cell 9: the skin has no such cell")),
            (r#"{"do":"stop","cell":"x"}"#, Err("cell \"x\": \"x\" is not a node id: use 1 to 254")),
            (
                r#"{"do":"bus","bus":"can9","down":true}"#,
                Err("bus \"can9\": the skin has no such bus; it has vcan0, vcan1"),
            ),
            (
                r#"{"do":"link","cells":[1,"vcan1:3"],"down":true}"#,
                Err("the two cells are on different buses: name two cells of one bus"),
            ),
        ] {
            let command: ControlCommand = serde_json::from_str(command).unwrap();
            let found = command.resolve(&skin).map(|resolved| match resolved {
                ResolvedCommand::Bench(command) => command,
                ResolvedCommand::Direct(command) => panic!("{command:?}"),
            });
            assert_eq!(
                found.map(|it| serde_json::to_string(&it).unwrap()),
                expected.map(str::to_owned).map_err(str::to_owned)
            );
        }
        let halt: ControlCommand = serde_json::from_str(r#"{"do":"halt"}"#).unwrap();
        assert_eq!(halt.resolve(&skin), Ok(ResolvedCommand::Direct(DirectCommand::Send(Message::Halt))));
    }
}
