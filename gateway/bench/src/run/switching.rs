//! Cells are switched to what they forget at each start, and told again until they confirm it.

use std::collections::HashMap;
use std::thread;
use std::time::{Duration, Instant};

use protocol::bus::BusError;
use protocol::can::Frame;
use protocol::id::{CellId, Node};
use protocol::message::{Message, Request};
use protocol::parameters::{Parameter, Sensing};

use super::RunError;
use super::link::may_return;
use super::start::Bench;
use model::table::Switch;

/// From one word to a cell that does not confirm to the next.
const AGAIN: Duration = Duration::from_millis(250);
/// How long a run waits for its cells' answers before it begins; who has not answered by then is told later.
const ANSWERS: Duration = Duration::from_secs(2);
/// The tag of these requests.
const TAG: u8 = 0x5E;

/// When each cell was told last, by bus and number.
pub(super) type Told = HashMap<(usize, u8), Instant>;

impl Bench<'_> {
    /// Switches all cells before the first joints.
    pub(super) fn switch_cells(&mut self) -> Result<(), RunError> {
        let mut told = Told::new();
        for (bus, described) in self.options.skin.buses.iter().enumerate() {
            // Cells that were there before may be in any mode; those that have just started are in none.
            let off = (!self.options.spawn && described.sensing == Sensing::Off)
                .then(|| (Parameter::Sensing.number(), Sensing::Off.words()));
            let lacking: Vec<_> = self.lacking(Some(bus));
            let first = lacking.first().map(|(_, _, switches)| switches.clone()).unwrap_or_default();
            for switch in off.into_iter().chain(first) {
                self.tell(bus, Node::Everyone, switch)?;
            }
            told.extend(lacking.iter().map(|&(bus, cell, _)| ((bus, cell.get()), Instant::now())));
        }
        let give_up = Instant::now() + ANSWERS;
        while !self.lacking(None).is_empty() && Instant::now() < give_up {
            thread::sleep(Duration::from_millis(5));
            self.hear_while_starting()?;
            self.switch_again(&mut told)?;
        }
        Ok(())
    }

    /// Tells those that have not confirmed, for which time has passed: they started anew, or a word was lost.
    pub(super) fn switch_again(&self, told: &mut Told) -> Result<(), RunError> {
        for (bus, cell, switches) in self.lacking(None) {
            let now = Instant::now();
            let is_soon = |at: &Instant| now.duration_since(*at) < AGAIN;
            if told.get(&(bus, cell.get())).is_some_and(is_soon) {
                continue;
            }
            told.insert((bus, cell.get()), now);
            for switch in switches {
                self.tell(bus, Node::Cell(cell), switch)?;
            }
        }
        Ok(())
    }

    /// The cells, of one bus or all, that can hear and have not confirmed something, and what.
    fn lacking(&self, only: Option<usize>) -> Vec<(usize, CellId, Vec<Switch>)> {
        let mut lacking = Vec::new();
        for (bus, lane) in self.lanes.iter().enumerate().filter(|(bus, _)| only.is_none_or(|it| it == *bus)) {
            let Some(view) = lane.view.lock().ok().filter(|_| lane.link.is_there()) else { continue };
            for cell in view.cells.iter().filter(|cell| cell.ready || cell.unconfigured) {
                let switches: Vec<_> = cell.lacks.into_iter().flatten().collect();
                if let (false, Ok(node)) = (switches.is_empty(), CellId::new(cell.node.into())) {
                    lacking.push((bus, node, switches));
                }
            }
        }
        lacking
    }

    fn tell(&self, bus: usize, to: Node, (number, words): Switch) -> Result<(), RunError> {
        let Some((lane, described)) = self.lanes.iter().zip(&self.options.skin.buses).nth(bus) else {
            return Ok(());
        };
        let message = Message::Configure { to, tag: TAG, request: Request::Write { number, words } };
        let frames: Vec<Frame> = message.encode().frames(described.format).collect();
        match lane.link.send(&frames) {
            // A cell that does not confirm is told again.
            Err(error) if may_return(&error.cause) => Ok(()),
            sent => Ok(sent.map_err(BusError::from)?),
        }
    }
}
