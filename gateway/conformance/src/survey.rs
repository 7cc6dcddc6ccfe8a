//! Who is on a bus, before anything is sent.

use std::collections::{BTreeMap, BTreeSet};

use model::decode::{Decoded, Decoder};
use protocol::can::Format;
use protocol::id::CellId;
use protocol::message::{Message, NetworkPage};
use protocol::packet;
use protocol::time::Span;

use crate::bus::{Bus, Stop};

/// Longer than from one heartbeat to the next, twice.
pub const LISTEN: Span = Span::from_millis(600);

/// Who was received.
#[derive(Clone, Debug, Default)]
pub struct Survey {
    /// The serial numbers that sent under a node id, and the format of their frames.
    pub cells: BTreeMap<CellId, Present>,
    /// A frame that only gateways send.
    pub gateway: Option<String>,
}

/// Who sends under a node id.
#[derive(Clone, Debug, Default)]
pub struct Present {
    /// Serial numbers in heartbeats.
    pub serials: BTreeSet<u32>,
    /// The format of the frames.
    pub format: Option<Format>,
}

impl Survey {
    /// Listens for [`LISTEN`].
    ///
    /// # Errors
    /// When the bus fails, or the test is interrupted.
    pub fn take(bus: &mut dyn Bus, name: &str) -> Result<Self, Stop> {
        let until = bus.now() + LISTEN;
        let mut decoder = Decoder::new(None);
        let mut survey = Self::default();
        while bus.now() < until {
            let Some(seen) = bus.receive(until)? else { continue };
            let Ok(id) = packet::data_id(&seen.frame) else { continue };
            let Decoded::Message(message) = decoder.decode(seen.at, name, &seen.frame) else { continue };
            let Some(cell) = id.sender() else {
                survey.gateway.get_or_insert_with(|| seen.frame.to_string());
                continue;
            };
            let present = survey.cells.entry(cell).or_default();
            present.format = Some(seen.frame.format());
            if let Message::Network { page: NetworkPage::Heartbeat(beat), .. } = message {
                present.serials.insert(beat.serial);
            }
        }
        Ok(survey)
    }

    /// Why the cell cannot be tested here, if so; other cells do not matter if they are `tolerated`.
    ///
    /// # Errors
    /// The reason, in one line.
    pub fn check(
        &self,
        cell: CellId,
        name: &str,
        asked: Option<Format>,
        tolerated: bool,
    ) -> Result<Format, String> {
        if let Some(frame) = &self.gateway {
            return Err(format!(
                "a gateway is on {name} ({frame}): stop it, the cell has to be alone with the test"
            ));
        }
        let others: Vec<_> =
            self.cells.keys().filter(|other| **other != cell).map(ToString::to_string).collect();
        let Some(present) = self.cells.get(&cell) else {
            let there = if others.is_empty() {
                "nor any other".to_owned()
            } else {
                format!("only {}", others.join(", "))
            };
            return Err(format!(
                "cell {cell} sends nothing on {name}, {there}: switch it on, or give the node id that it has"
            ));
        };
        if present.serials.len() > 1 {
            let serials: Vec<_> = present.serials.iter().map(ToString::to_string).collect();
            return Err(format!(
                "{} cells send as node {cell} on {name}, with the serial numbers {}: take away all but one",
                serials.len(),
                serials.join(" and ")
            ));
        }
        if !others.is_empty() && !tolerated {
            return Err(format!(
                "other cells are on {name}: {}; joints and halts of the test reach them too: take them away, or say \
                 --others-will-stop",
                others.join(", ")
            ));
        }
        match (present.format, asked) {
            (Some(sent), Some(asked)) if sent != asked => Err(format!(
                "cell {cell} sends {} frames on {name}, not {}: say --format {}",
                sent.name(),
                asked.name(),
                sent.name()
            )),
            (sent, asked) => Ok(asked.or(sent).unwrap_or(Format::Fd)),
        }
    }
}
