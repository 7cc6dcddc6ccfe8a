//! Organisation of the trees before the loop starts: cells that answer with sums form a tree, the tree is compared with
//! the description, and all cells get their slots.

use std::sync::atomic::Ordering;
use std::time::Duration;

use protocol::message::Message;
use protocol::time::Micros;
use protocol::usage::eprint_line;

use super::begin::DISCOVERY_TIMEOUT;
use super::bench::Bench;
use super::network::Network;
use crate::error::RunError;
use crate::view::BusView;

/// Time after which a difference from the description counts as real: hellos and heartbeats come four times a second.
const TREE_SETTLING_TIME: Duration = Duration::from_millis(1_500);

impl Bench<'_> {
    /// Waits until the cells that answer with sums form a tree, and sends them their slots.
    pub(super) fn organise_trees(&mut self) -> Result<(), RunError> {
        self.shared.sends_to_roots.store(true, Ordering::Relaxed);
        let began = self.now();
        self.poll_until(self.progress_timeout(), |bench, timeout| {
            let (mut have_ways, mut whole, now) = (0, true, bench.now());
            for (network, view) in bench.networks() {
                let (count, all) = Network::tree_progress(&view);
                have_ways += count;
                whole &= all;
                network.tree_ready =
                    all.then(|| network.tree_ready.unwrap_or_else(|| now.elapsed_since(began)));
            }
            Ok(whole || timeout.has_stalled(have_ways))
        })?;
        self.check_networks()?;
        for (network, view) in self.networks() {
            network.fit_slots(&view)?;
        }
        self.send_sum_slots()?;
        for network in self
            .bus_links
            .iter()
            .filter_map(|bus_link| bus_link.network.as_ref())
            .filter(|_| !self.options.quiet)
        {
            let (name, deepest) = (network.name(), network.max_slot_depth());
            let tree_ready = network.tree_ready.unwrap_or_default().seconds();
            eprint_line(&format!(
                "the cells of {name} formed a tree of depth {deepest} after {tree_ready:.2} s"
            ));
        }
        Ok(())
    }

    /// Reports differences from the description.
    fn check_networks(&mut self) -> Result<(), RunError> {
        // Without a request, pages of ports come with heartbeats only.
        self.send_to_all(&Message::Report)?;
        let mut changes = 0;
        self.poll_until(TREE_SETTLING_TIME, |bench, timeout| {
            let mut none = true;
            for (network, view) in bench.networks() {
                let differences = network.description_differences(&view);
                none &= differences.is_empty();
                changes += usize::from(differences != network.differences);
                network.differences = differences;
            }
            Ok(none || timeout.has_stalled(changes))
        })?;
        let mut broken = None;
        for network in self.bus_links.iter().filter_map(|bus_link| bus_link.network.as_ref()) {
            for difference in &network.differences {
                let line = format!("{}: {difference}", network.name());
                if !self.options.quiet {
                    eprint_line(&line);
                }
                if difference.breaks_the_tree() {
                    broken.get_or_insert(line);
                }
            }
        }
        broken.filter(|_| self.options.spawn).map_or(Ok(()), |line| Err(RunError::BrokenTree(line)))
    }

    /// Sends all cells their slots, and waits for confirmations.
    fn send_sum_slots(&mut self) -> Result<(), RunError> {
        self.send_to_networks(|network, now, _| vec![network.announce_slots(now)])?;
        let mut unconfirmed = Vec::new();
        self.poll_until(DISCOVERY_TIMEOUT, |bench, timeout| {
            unconfirmed.clear();
            for (network, view) in bench.networks() {
                unconfirmed.extend(
                    network
                        .cells_with_unconfirmed_slots(&view)
                        .iter()
                        .map(|cell| format!("{cell} on {}", network.name())),
                );
            }
            let is_last = unconfirmed.is_empty() || timeout.has_stalled(0);
            if !is_last {
                bench.send_to_networks(Network::messages_to_repeat)?;
            }
            Ok(is_last)
        })?;
        if unconfirmed.is_empty() {
            return Ok(());
        }
        let error = RunError::NoSums(unconfirmed.join(", "));
        if self.options.spawn {
            return Err(error);
        }
        eprint_line(&error.to_string());
        Ok(())
    }

    /// Calls `messages` with each network and the view of its receiver, and sends the messages that it returns.
    fn send_to_networks(
        &mut self,
        mut messages: impl FnMut(&mut Network, Micros, &BusView) -> Vec<Message>,
    ) -> Result<(), RunError> {
        let now = self.now();
        for bus_link in &mut self.bus_links {
            let messages = match (&mut bus_link.network, bus_link.view.lock()) {
                (Some(network), Ok(view)) => messages(network, now, &view),
                _ => continue,
            };
            for message in messages {
                bus_link.send(&message)?;
            }
        }
        Ok(())
    }

    /// Checks all networks while the loop runs. Returns messages for the user.
    pub(super) fn watch_networks(&mut self) -> Result<Vec<String>, RunError> {
        let mut notes = Vec::new();
        self.send_to_networks(|network, now, view| {
            let look = network.check_running(now, view);
            notes.extend(look.notes);
            look.messages
        })?;
        Ok(notes)
    }
}
