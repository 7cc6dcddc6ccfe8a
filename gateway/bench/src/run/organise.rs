//! Before the loop begins: cells that answer with sums become a tree, the tree is compared with the description, and
//! everyone is told when to speak.

use std::sync::atomic::Ordering;
use std::thread;
use std::time::{Duration, Instant};

use protocol::bus::BusError;
use protocol::can::Frame;
use protocol::message::Message;

use super::RunError;
use super::launch::STARTING;
use super::link::may_return;
use super::network::Network;
use super::progress::say;
use super::receiver::View;
use super::start::{Bench, SHOWING};
use model::network::check::Difference;

/// Differences that stay for so long are there: a hello and a heartbeat come four times a second.
const SETTLING: Duration = Duration::from_millis(1_500);
/// Between two looks.
const LOOK: Duration = Duration::from_millis(5);

impl Bench<'_> {
    /// Waits until cells that answer with sums are a tree, and tells them when to speak.
    pub(super) fn organise(&mut self) -> Result<(), RunError> {
        if self.networks.iter().all(Option::is_none) {
            return Ok(());
        }
        self.shared.explore.store(true, Ordering::Relaxed);
        let began = Instant::now();
        let patience = if self.options.spawn { STARTING } else { SHOWING };
        let (mut most, mut progress) = (0, began);
        loop {
            let mut have_ways = 0;
            let mut whole = true;
            self.each_network(|network, view| {
                let (count, all) = Network::progress(view);
                have_ways += count;
                if all {
                    network.organised.get_or_insert_with(|| began.elapsed());
                } else {
                    (network.organised, whole) = (None, false);
                }
            });
            if have_ways > most {
                (most, progress) = (have_ways, Instant::now());
            }
            if whole || progress.elapsed() > patience {
                break;
            }
            self.wait_a_little()?;
        }
        self.check_networks()?;
        let mut unfit = None;
        self.each_network(|network, view| {
            if let Err(why) = network.fit(view) {
                unfit.get_or_insert(why);
            }
        });
        if let Some(why) = unfit {
            return Err(RunError::Usage(why));
        }
        self.tell_networks()?;
        if !self.options.quiet {
            for network in self.networks.iter().flatten() {
                let (name, deepest) = (network.name(), network.deepest());
                let organised = network.organised.unwrap_or_default().as_secs_f64();
                say(&format!("the cells of {name} are a tree, {deepest} wires deep, after {organised:.2} s"));
            }
        }
        Ok(())
    }

    /// Names what is different from the description.
    fn check_networks(&mut self) -> Result<(), RunError> {
        // Pages of ports come with heartbeats, if they are not asked for.
        self.say(&Message::Report)?;
        let mut since = Instant::now();
        loop {
            let mut changed = false;
            let mut none = true;
            self.each_network(|network, view| {
                let differences = network.check(view);
                none &= differences.is_empty();
                changed |= differences != network.differences;
                network.differences = differences;
            });
            if changed {
                since = Instant::now();
            }
            if none || since.elapsed() > SETTLING {
                break;
            }
            self.wait_a_little()?;
        }
        let mut broken = None;
        for network in self.networks.iter().flatten() {
            for difference in &network.differences {
                let line = format!("{}: {difference}", network.name());
                if !self.options.quiet {
                    say(&line);
                }
                if difference.breaks_the_tree() {
                    broken.get_or_insert(line);
                }
            }
        }
        match broken.filter(|_| self.options.spawn) {
            Some(line) => Err(RunError::Failed(line)),
            None => Ok(()),
        }
    }

    /// Tells all cells in which slots they speak, and sees that they have heard it.
    fn tell_networks(&mut self) -> Result<(), RunError> {
        let began = Instant::now();
        let messages = self.messages_of_networks(|network, now, view| vec![network.tell_everyone(now, view)]);
        self.say_on(&messages)?;
        loop {
            let mut untold = Vec::new();
            self.each_network(|network, view| {
                untold.extend(
                    network.untold(view).into_iter().map(|cell| format!("{cell} on {}", network.name())),
                );
            });
            if untold.is_empty() {
                return Ok(());
            }
            if began.elapsed() > SHOWING {
                let why = format!(
                    "cells that do not take up sums (parameter 6): {}; give them firmware that does",
                    untold.join(", ")
                );
                if self.options.spawn {
                    return Err(RunError::Failed(why));
                }
                say(&why);
                return Ok(());
            }
            self.wait_a_little()?;
            let messages = self.messages_of_networks(Network::tell_again);
            self.say_on(&messages)?;
        }
    }

    fn wait_a_little(&mut self) -> Result<(), RunError> {
        thread::sleep(LOOK);
        self.hear_while_starting()
    }

    /// Looks at each network with what its receiver shows.
    pub(super) fn each_network(&mut self, mut look: impl FnMut(&mut Network, &View)) {
        for (lane, network) in self.lanes.iter().zip(&mut self.networks) {
            if let (Some(network), Ok(view)) = (network, lane.view.lock()) {
                look(network, &view);
            }
        }
    }

    /// What is to be said on each bus.
    fn messages_of_networks(
        &mut self,
        mut say: impl FnMut(&mut Network, Instant, &View) -> Vec<Message>,
    ) -> Vec<(usize, Message)> {
        let mut messages = Vec::new();
        let now = Instant::now();
        for (bus, (lane, network)) in self.lanes.iter().zip(&mut self.networks).enumerate() {
            if let (Some(network), Ok(view)) = (network, lane.view.lock()) {
                messages.extend(say(network, now, &view).into_iter().map(|message| (bus, message)));
            }
        }
        messages
    }

    /// Says something on some buses; one that is down for a while misses it, and it is said again.
    pub(super) fn say_on(&self, messages: &[(usize, Message)]) -> Result<(), RunError> {
        for (bus, message) in messages {
            let Some((lane, described)) = self.lanes.iter().zip(&self.options.skin.buses).nth(*bus) else {
                continue;
            };
            let frames: Vec<Frame> = message.encode().frames(described.format).collect();
            match lane.link.send(&frames).map_err(BusError::from) {
                Err(error) if may_return(&error) => {
                    let unsent = &self.shared.unsent;
                    unsent.fetch_add(frames.len() as u64, Ordering::Relaxed);
                }
                sent => sent?,
            }
        }
        Ok(())
    }

    /// Looks at all networks while the loop runs: what people are to know.
    pub(super) fn watch_networks(&mut self) -> Result<Vec<String>, RunError> {
        let mut notes = Vec::new();
        let messages = self.messages_of_networks(|network, now, view| {
            let look = network.look(now, view);
            notes.extend(look.notes);
            look.messages
        });
        self.say_on(&messages)?;
        Ok(notes)
    }
}

/// The lines of differences, for a summary.
pub(super) fn lines(differences: &[Difference]) -> Vec<String> {
    differences.iter().map(ToString::to_string).collect()
}
