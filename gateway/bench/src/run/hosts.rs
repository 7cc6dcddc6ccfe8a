//! A bus that `vcan-setup link` joins with buses of other hosts: the losses between the hosts, and the unreachable
//! hosts.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use protocol::id::CellId;
use vcan_setup::hosts::report::{HostReport, LinkReport, ReportReader};

use crate::bus::link::{Outages, SharedBus};
use crate::setup::format_as_subject;
use crate::summary::HostSummary;

/// Interval between attempts to connect to a link.
const RECONNECT_INTERVAL: Duration = Duration::from_millis(500);

/// The other hosts of a bus, and the connection to its link.
#[derive(Debug)]
pub(super) struct OtherHosts {
    reports: Option<ReportReader>,
    reconnect_at: Instant,
    known: KnownHosts,
}

/// The differences between two reports of a link to other hosts.
#[derive(Debug, Default, Eq, PartialEq)]
pub(super) struct HostChanges {
    /// Messages for the user.
    pub(super) notes: Vec<String>,
    /// Cells whose packets or stimuli may be lost.
    pub(super) possibly_missed: BTreeSet<CellId>,
    /// Cells in doubt whose hosts are reachable.
    pub(super) reached: BTreeSet<CellId>,
}

/// State of the other hosts, over the whole run.
#[derive(Debug, Default)]
struct KnownHosts {
    hosts: BTreeMap<String, HostState>,
    /// True if a link has reported since the start of the run.
    is_linked: bool,
}

/// State of a host.
#[derive(Debug, Default)]
struct HostState {
    newest: HostReport,
    outages: Outages,
    /// Numbers of frames lost from the host, and to the host.
    lost: [u64; 2],
}

impl OtherHosts {
    pub(super) fn new() -> Self {
        Self { reports: None, reconnect_at: Instant::now(), known: KnownHosts::default() }
    }

    /// Reads the reports of the bus's link without waiting for them.
    pub(super) fn read_reports(&mut self, link: &SharedBus) -> HostChanges {
        let (now, mut changes) = (Instant::now(), HostChanges::default());
        if self.reports.is_none() && self.reconnect_at <= now {
            self.reconnect_at = now + RECONNECT_INTERVAL;
            self.reports = link.connect_reports().ok();
        }
        match self.reports.as_mut().map(ReportReader::read_reports) {
            Some(Ok(reports)) => {
                for report in reports {
                    self.known.add_report(&link.name, report, now, &mut changes);
                }
            }
            Some(Err(error)) => {
                self.reports = None;
                self.known.end_link(&link.name, &error.to_string(), now, &mut changes);
            }
            None => {}
        }
        changes
    }

    /// Returns true if a cell is on an unreachable host. Frames that still arrive from it were under way when the host
    /// was lost.
    pub(super) fn is_host_unreachable(&self, cell: CellId) -> bool {
        let mut away = self.known.hosts.values().filter(|of| !of.newest.is_there);
        away.any(|of| of.newest.nodes.contains(&cell.get()))
    }

    /// Number of frames lost between the hosts.
    pub(super) fn lost_frames(&self) -> u64 {
        self.known.hosts.values().flat_map(|of| of.lost).fold(0, u64::saturating_add)
    }

    /// Summary of each host; empty if no link joined the bus.
    pub(super) fn host_summaries(&self) -> Vec<HostSummary> {
        let summary = |(name, of): (&String, &HostState)| HostSummary {
            name: name.clone(),
            cells: of.newest.nodes.len(),
            gone: of.outages.count,
            gone_s: of.outages.total_lost_time(Instant::now()).as_secs_f64(),
            at_end: of.newest.is_there,
            lost_from: of.lost[0],
            lost_to: of.lost[1],
        };
        self.known.hosts.iter().map(summary).collect()
    }
}

impl KnownHosts {
    fn add_report(&mut self, bus: &str, report: LinkReport, now: Instant, changes: &mut HostChanges) {
        let is_first = !std::mem::replace(&mut self.is_linked, true);
        for (host, newest) in report.hosts {
            let known = self.hosts.entry(host.clone()).or_default();
            let before = std::mem::replace(&mut known.newest, newest);
            let newest = &known.newest;
            let missing = |host: &HostReport| {
                [host.heard.missing_frame_count(), host.ours.map_or(0, |ours| ours.missing_frame_count())]
            };
            let (was, is) = (missing(&before), missing(newest));
            if is_first {
                // Losses from before the run do not belong to the run.
                known.outages = Outages::default();
            } else {
                for (lost, (was, is)) in known.lost.iter_mut().zip(was.into_iter().zip(is)) {
                    *lost = lost.saturating_add(is.saturating_sub(was));
                }
            }
            let cells: Vec<_> =
                newest.nodes.iter().filter_map(|&node| CellId::new(node.into()).ok()).collect();
            if before.is_there != newest.is_there {
                let how = if newest.is_there {
                    known.outages.end_outage(now);
                    if is_first || known.outages.count == 0 { "is connected" } else { "is reachable again" }
                } else {
                    known.outages.begin_outage(now);
                    "is gone or unreachable"
                };
                let cells = if cells.is_empty() {
                    String::new()
                } else {
                    format!(", with {}", format_as_subject(&cells, ""))
                };
                changes.notes.push(format!("host '{host}' of {bus} {how}{cells}"));
            }
            let is_disturbed = !is_first
                && (before.is_there != newest.is_there
                    || before.heard.lives != newest.heard.lives
                    || was[1] != is[1]);
            if is_disturbed {
                changes.possibly_missed.extend(&cells);
                if newest.is_there {
                    changes.reached.extend(&cells);
                }
            }
        }
    }

    /// Handles the end of the link process on this machine. The next link process counts from zero.
    fn end_link(&mut self, bus: &str, why: &str, now: Instant, changes: &mut HostChanges) {
        changes.notes.push(format!("the link of {bus} to other hosts has ended ({why})"));
        for known in self.hosts.values_mut() {
            let nodes = std::mem::take(&mut known.newest).nodes;
            changes.possibly_missed.extend(nodes.iter().filter_map(|&node| CellId::new(node.into()).ok()));
            known.newest.nodes = nodes;
            known.outages.begin_outage(now);
        }
    }
}

#[cfg(test)]
mod tests {
    use vcan_setup::hosts::incoming::SourceAccount;

    use super::*;

    fn report(hosts: &[(&str, bool, u64, u64, u64)]) -> LinkReport {
        let host = |&(name, is_there, lives, from, to): &(&str, bool, u64, u64, u64)| {
            let heard = SourceAccount { lives, lost: from, ..SourceAccount::default() };
            let ours = Some(SourceAccount { dropped_here: to, ..SourceAccount::default() });
            (name.to_owned(), HostReport { is_there, nodes: vec![7, 9], heard, ours })
        };
        LinkReport { host: "a".to_owned(), hosts: hosts.iter().map(host).collect(), ..LinkReport::default() }
    }

    struct Fixture(OtherHosts, Instant, u64);

    impl Fixture {
        fn new() -> Self {
            Self(OtherHosts::new(), Instant::now(), 0)
        }

        /// Handles a report one second after the last one. Returns the notes, and the numbers of cells in doubt and
        /// reached.
        fn take(&mut self, hosts: &[(&str, bool, u64, u64, u64)]) -> (Vec<String>, usize, usize) {
            self.2 += 1;
            let mut changes = HostChanges::default();
            self.0.known.add_report(
                "vcan0",
                report(hosts),
                self.1 + Duration::from_secs(self.2),
                &mut changes,
            );
            (changes.notes, changes.possibly_missed.len(), changes.reached.len())
        }
    }

    #[test]
    fn what_was_lost_before_the_run_is_not_the_runs() {
        let mut of = Fixture::new();
        let (notes, in_doubt, _) = of.take(&[("b", true, 1, 50, 60)]);
        assert_eq!(
            (notes, in_doubt),
            (vec!["host 'b' of vcan0 is connected, with cells 7, 9".to_owned()], 0)
        );
        assert_eq!(of.0.lost_frames(), 0);
        assert_eq!(of.take(&[("b", true, 1, 53, 60)]), (vec![], 0, 0), "their own counts show it");
        assert_eq!(of.take(&[("b", true, 1, 53, 64)]), (vec![], 2, 2), "stimuli may be among them");
        assert_eq!(
            (of.0.lost_frames(), of.0.host_summaries()[0].lost_from, of.0.host_summaries()[0].lost_to),
            (7, 3, 4)
        );
    }

    #[test]
    fn cells_of_a_host_that_is_gone_are_in_doubt_and_told_again_when_it_is_reached() {
        let mut of = Fixture::new();
        of.take(&[("b", true, 1, 0, 0), ("c", true, 1, 0, 0)]);
        let (notes, in_doubt, reached) = of.take(&[("b", false, 1, 0, 0), ("c", true, 1, 0, 0)]);
        assert_eq!(notes, ["host 'b' of vcan0 is gone or unreachable, with cells 7, 9"]);
        assert_eq!((in_doubt, reached), (2, 0));
        assert!(
            of.0.is_host_unreachable(CellId::new(7).unwrap())
                && !of.0.is_host_unreachable(CellId::new(8).unwrap())
        );
        let (notes, in_doubt, reached) = of.take(&[("b", true, 2, 0, 0), ("c", true, 1, 0, 0)]);
        assert!(!of.0.is_host_unreachable(CellId::new(7).unwrap()));
        assert_eq!(notes, ["host 'b' of vcan0 is reachable again, with cells 7, 9"]);
        assert_eq!((in_doubt, reached), (2, 2));
        assert_eq!(
            of.take(&[("b", true, 3, 0, 0), ("c", true, 1, 0, 0)]).1,
            2,
            "its link was killed and is back"
        );
        let b = &of.0.host_summaries()[0];
        assert_eq!((b.gone, b.gone_s, b.at_end, b.cells), (1, 1.0, true, 2));
    }

    #[test]
    fn a_link_that_ends_here_and_counts_from_zero_loses_no_account() {
        let mut of = Fixture::new();
        of.take(&[("b", true, 1, 10, 0)]);
        of.take(&[("b", true, 1, 15, 0)]);
        let mut changes = HostChanges::default();
        of.0.known.end_link("vcan0", "end of file", of.1 + Duration::from_secs(3), &mut changes);
        assert_eq!((changes.possibly_missed.len(), changes.reached.len()), (2, 0));
        assert!(
            of.0.is_host_unreachable(CellId::new(9).unwrap()),
            "its heartbeats may still be on their way"
        );
        let (notes, _, reached) = of.take(&[("b", true, 1, 2, 0)]);
        assert_eq!((notes.len(), reached), (1, 2));
        assert_eq!(of.0.lost_frames(), 7);
    }
}
