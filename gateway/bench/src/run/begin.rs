//! Until the loop begins: the cells start, nobody else is on their buses, and all are ready, switched and organised.

use std::sync::atomic::Ordering;
use std::thread;
use std::time::{Duration, Instant};

use protocol::bus::{BusKind, Kinds};
use protocol::id::{CellId, Node};
use protocol::message::Message;
use protocol::packet::Epoch;
use protocol::parameters::{Parameter, Sensing};
use protocol::time::Span;

use super::RunError;
use super::bench::{Bench, LOOK};
use super::launch::{Ended, LISTEN, Plan, Processes, STARTING, program};
use super::progress::say;
use super::receiver::News;
use crate::setup::Patience;
use crate::view::View;
use model::repeat::Repeats;
use model::table::{Notice, Switch};

/// Cells that were there before are given so long to show up, and all to confirm what they are told.
pub(super) const SHOWING: Duration = Duration::from_secs(2);
/// From one word to a cell that does not confirm to what it is switched to the next.
pub(super) const SWITCH_AGAIN: Span = Span::from_millis(250);

/// Cells that are told what they are to be switched to, by bus and number.
pub(super) type Told = Repeats<(usize, CellId)>;

impl Bench<'_> {
    /// Starts the cells, listens for another gateway, and waits until all cells are ready.
    pub(super) fn begin(&mut self) -> Result<(), RunError> {
        let options = self.options;
        let listened = Instant::now() + LISTEN;
        if options.spawn {
            if self.served.len() < self.lanes.len() {
                self.find_alone(listened)?;
            }
            let program = program("cell-node", options.cell_node.as_deref())?;
            self.processes = Processes::start(&Plan {
                program: &program,
                skin_file: &options.skin_file,
                skin: &options.skin,
                kinds: &Kinds::exactly(
                    self.lanes.iter().map(|lane| (lane.link.name.as_str(), lane.link.kind)),
                ),
                directory: options.directory.as_deref(),
                per_process: options.cells_per_process,
                flash: options.flash.as_deref(),
            })?;
        }
        let cells = options.skin.cells.len();
        self.wait(self.patience(), |bench, patience| {
            // Who has no parameters will not get any by waiting.
            let ready = bench.count(|cell| cell.ready || cell.unconfigured);
            let is_over = patience.is_over(ready);
            // Where the machine was away for a moment, all may look dead that were ready before it: they speak again.
            Ok(Instant::now() >= listened && (ready == cells || is_over))
        })?;
        self.judge_start()?;
        self.wake_up()?;
        self.go_on_after_others();
        self.switch_cells()?;
        // What they have counted and feel, and where they are in their networks.
        self.say(&Message::Report)?;
        if self.lanes.iter().any(|lane| lane.network.is_some()) { self.organise() } else { Ok(()) }
    }

    /// How long cells may make no progress.
    pub(super) const fn patience(&self) -> Duration {
        if self.options.spawn { STARTING } else { SHOWING }
    }

    /// Looks again and again, until a look is the last one.
    pub(super) fn wait(
        &mut self,
        patience: Duration,
        mut is_last: impl FnMut(&mut Self, &mut Patience) -> Result<bool, RunError>,
    ) -> Result<(), RunError> {
        let mut patience = Patience::new(patience);
        while !is_last(self, &mut patience)? {
            thread::sleep(LOOK);
            self.hear_while_starting()?;
        }
        Ok(())
    }

    /// Cells that a gateway before this one has halted go on.
    fn wake_up(&mut self) -> Result<(), RunError> {
        self.say(&Message::Resume)?;
        let halted = |bench: &Self| bench.count(|cell| cell.halted);
        if halted(self) == 0 {
            return Ok(());
        }
        // Their next heartbeats say so.
        self.say(&Message::Sync)?;
        self.wait(SHOWING, |bench, patience| Ok(halted(bench) == 0 || patience.is_over(0)))
    }

    /// A bus that was there before may have a gateway, or cells whose numbers ours would take: nobody is
    /// disturbed by listening first.
    fn find_alone(&mut self, until: Instant) -> Result<(), RunError> {
        self.wait(LISTEN, |_, _| Ok(Instant::now() >= until))?;
        let cells = self.names(|cell| cell.heard);
        if cells.is_empty() {
            return Ok(());
        }
        let embedded = self.lanes.iter().any(|lane| lane.link.kind == BusKind::Embedded);
        Err(RunError::CellsThere { cells, embedded })
    }

    /// Cells that were there before have heard another gateway: its epochs go on.
    fn go_on_after_others(&mut self) {
        if self.options.spawn {
            return;
        }
        let heard = |view: &View| -> Vec<_> {
            view.cells.iter().filter(|cell| cell.ready).map(|cell| cell.last_joints).collect()
        };
        let last = after(&self.views().flat_map(|(_, view)| heard(&view)).collect::<Vec<_>>());
        self.first_epoch = last.next();
        if let Some(cycle) = &mut self.cycle {
            cycle.start_after(last);
        }
    }

    fn judge_start(&self) -> Result<(), RunError> {
        let spawned = self.options.spawn;
        let silent = self.names(|cell| !cell.ready && !cell.unconfigured);
        let unconfigured = self.names(|cell| cell.unconfigured);
        let none = self.count(|cell| cell.ready) == 0;
        if !unconfigured.is_empty() && (none || spawned) {
            return Err(RunError::Unconfigured(unconfigured));
        }
        if none || (spawned && !silent.is_empty()) {
            return Err(RunError::NotReady { cells: silent, spawned });
        }
        let cells = self.names(|cell| cell.ready && cell.other);
        if !cells.is_empty() {
            return Err(RunError::OtherSkin { skin: self.options.skin_file.clone(), cells });
        }
        for (what, who) in [("do not answer", silent), ("have no parameters", unconfigured)] {
            if !who.is_empty() && !self.options.quiet {
                say(&format!("cells that {what}, the run goes on without them: {who}"));
            }
        }
        Ok(())
    }

    /// Another gateway, a process that ends or a bus that is gone end the start.
    fn hear_while_starting(&mut self) -> Result<(), RunError> {
        if self.signalled.load(Ordering::Relaxed) {
            return Err(RunError::Interrupted);
        }
        for (bus, news) in self.news.try_iter() {
            match news {
                News::Notice(Notice::Rival) => return Err(self.rival(bus)),
                News::Down(why) | News::Lost(why) | News::Refused(why) => return Err(RunError::Lost(why)),
                News::Notice(_) | News::Up => {}
            }
        }
        match self.processes.ended().first() {
            None => Ok(()),
            Some(ended) => Err(RunError::Ended { cells: self.cells_of(ended), status: ended.status }),
        }
    }

    /// Another gateway is on a bus.
    pub(super) fn rival(&self, bus: usize) -> RunError {
        let link = self.lanes.get(bus).map(|lane| &lane.link);
        RunError::Rival(link.map(|link| (link.name.clone(), link.kind)))
    }

    /// The cells of a process that has ended, for people.
    pub(super) fn cells_of(&self, ended: &Ended) -> String {
        format!("{ended} on {}", self.name(ended.bus))
    }

    /// Sends a command on every bus.
    pub(super) fn say(&self, message: &Message) -> Result<(), RunError> {
        for lane in &self.lanes {
            if lane.send(message)? {
                lane.link.state.commands.fetch_add(1, Ordering::Relaxed);
            }
        }
        Ok(())
    }

    /// Switches all cells to what they forget at each start, before the first joints.
    fn switch_cells(&mut self) -> Result<(), RunError> {
        let mut told = Told::new(SWITCH_AGAIN);
        let lacking = self.lacking();
        for (bus, (lane, described)) in self.lanes.iter().zip(&self.options.skin.buses).enumerate() {
            // Cells that were there before may be in any mode; those that have just started are in none.
            let off = (!self.options.spawn && described.sensing == Sensing::Off)
                .then(|| (Parameter::Sensing.number(), Sensing::Off.words()));
            let first = lacking.iter().find(|((of, _), _)| *of == bus).map(|(_, switches)| switches.clone());
            for switch in off.into_iter().chain(first.unwrap_or_default()) {
                lane.switch(Node::Everyone, switch)?;
            }
        }
        told.said_to_all(self.now());
        self.wait(SHOWING, |bench, patience| {
            bench.switch_again(&mut told)?;
            // Who has not answered by then is told later.
            Ok(bench.lacking().is_empty() || patience.is_over(0))
        })
    }

    /// Tells those that have not confirmed, for which time has passed: they started anew, or a word was lost.
    pub(super) fn switch_again(&self, told: &mut Told) -> Result<(), RunError> {
        let lacking = self.lacking();
        let due = told.due(self.now(), lacking.iter().map(|(cell, _)| *cell));
        for ((bus, cell), switches) in lacking.into_iter().filter(|(cell, _)| due.contains(cell)) {
            let Some(lane) = self.lanes.get(bus) else { continue };
            for switch in switches {
                lane.switch(Node::Cell(cell), switch)?;
            }
        }
        Ok(())
    }

    /// The cells that can hear and have not confirmed something, and what.
    fn lacking(&self) -> Vec<((usize, CellId), Vec<Switch>)> {
        let mut lacking = Vec::new();
        for (bus, lane) in self.lanes.iter().enumerate().filter(|(_, lane)| lane.link.state.is_there()) {
            let Ok(view) = lane.view.lock() else { continue };
            for cell in view.cells.iter().filter(|cell| cell.ready || cell.unconfigured) {
                let switches: Vec<_> = cell.lacks.into_iter().flatten().collect();
                if !switches.is_empty() {
                    lacking.push(((bus, cell.node), switches));
                }
            }
        }
        lacking
    }
}

/// The epoch after which to begin on cells that have taken these last, the first cell's if that can be: joints of the
/// epoch that a cell has taken last it takes for repeated ones. Buses need not have had the same.
fn after(taken: &[Epoch]) -> Epoch {
    let mut last = taken.first().copied().unwrap_or_default();
    for _ in 0..u8::MAX {
        if !taken.contains(&last.next()) {
            break;
        }
        last = last.next();
    }
    last
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_epoch_is_new_to_the_cells_of_all_buses() {
        let first = |taken: &[u8]| after(&taken.iter().map(|&epoch| Epoch(epoch)).collect::<Vec<_>>()).0;
        assert_eq!(first(&[]), 0);
        assert_eq!(first(&[7, 7, 7]), 7);
        assert_eq!(first(&[7, 7, 200, 200]), 7);
        assert_eq!(first(&[255, 255, 0, 0, 1]), 1, "0 would be repeated on one bus, and 1 on another");
    }
}
