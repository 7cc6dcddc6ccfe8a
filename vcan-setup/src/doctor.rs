//! Assesses whether a bench would run on this machine.
//!
//! ```text
//!   skin or names --+
//!                   +--> collect_facts --> MachineFacts --> assess_machine --> findings: ok, note, fault
//!   this machine ---+    (queries)                           (decides)
//! ```

use std::collections::BTreeSet;

use protocol::bus::{BusKind, KindChoice};
use protocol::can::Format;
use protocol::id::CellId;
use serde::Serialize;

use crate::kernel::Kernel;
use crate::plan::InterfaceTarget;

mod facts;
mod interface;

pub use facts::{BusFacts, MachineFacts, ObservedTraffic, Program, User};

/// The size that the kernel counts for one frame in a receive buffer, in bytes.
const FRAME_BUFFER_BYTES: usize = 1_024;
/// The number of replies from every cell that a receive buffer should hold.
const BUFFERED_REPLIES_PER_CELL: usize = 4;

/// The severity of a finding.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum FindingLevel {
    /// Everything is in order.
    Ok,
    /// A bench runs, but the user should know this.
    Note,
    /// A bench does not run, or its measurements would be meaningless.
    Fault,
}

impl FindingLevel {
    /// Returns the printed name of the level.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Note => "note",
            Self::Fault => "fault",
        }
    }
}

/// A result of the assessment, with ways to fix a fault.
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
pub struct Finding {
    /// The severity.
    pub level: FindingLevel,
    /// The text that describes the finding.
    pub text: String,
    /// Shell commands, each of which fixes the fault.
    pub hints: Vec<String>,
}

impl Finding {
    fn ok(text: impl Into<String>) -> Self {
        Self { level: FindingLevel::Ok, text: text.into(), hints: Vec::new() }
    }

    fn note(text: impl Into<String>) -> Self {
        Self { level: FindingLevel::Note, text: text.into(), hints: Vec::new() }
    }

    fn fault(text: impl Into<String>) -> Self {
        Self { level: FindingLevel::Fault, text: text.into(), hints: Vec::new() }
    }

    /// Adds a hint.
    fn with_hint(mut self, hint: impl Into<String>) -> Self {
        self.hints.push(hint.into());
        self
    }

    fn with_hints(mut self, hints: Vec<String>) -> Self {
        self.hints.extend(hints);
        self
    }
}

/// Returns true if none of the findings is a fault, so that a bench would run.
#[must_use]
pub fn would_bench_run(findings: &[Finding]) -> bool {
    findings.iter().all(|finding| finding.level != FindingLevel::Fault)
}

/// Assesses the facts about a machine. The findings are sorted: causes come before their consequences.
#[must_use]
pub fn assess_machine(facts: &MachineFacts) -> Vec<Finding> {
    let mut findings = vec![facts.check_bus_kind()];
    let kind = facts.bus_kind();
    if !kind.is_interface() {
        findings.push(facts.check_embedded_directory());
        findings.extend(facts.buses.iter().filter_map(|bus| facts.check_absent_interface(bus)));
        findings.extend(facts.buses.iter().flat_map(|bus| facts.check_traffic(bus, kind.display_name())));
    } else if facts.kernel.has_can {
        findings.extend(facts.check_creation());
        findings.extend(facts.buses.iter().flat_map(|bus| facts.check_interface(bus)));
        findings.extend(facts.check_any_interface());
        findings.extend(facts.check_receive_buffer());
        findings.extend(facts.check_kernel_backlog());
    }
    // Without CAN in the kernel there are no interfaces to check.
    findings.extend(facts.check_cell_node());
    findings
}

impl MachineFacts {
    /// Returns the kind of bus (SocketCAN or embedded) that a bench would use on this machine.
    #[must_use]
    pub fn bus_kind(&self) -> BusKind {
        match self.choice {
            KindChoice::Only(kind) => kind,
            KindChoice::Auto if self.kernel.has_can && self.has_interface() => BusKind::SocketCan,
            KindChoice::Auto => BusKind::Embedded,
        }
    }

    /// Returns true if one of the named buses is an interface, or if no bus is named.
    fn has_interface(&self) -> bool {
        self.buses.is_empty() || self.buses.iter().any(|bus| bus.interface.is_some())
    }

    /// Returns the text of a `vcan-setup` command that root has to run.
    fn vcan_setup_command(&self, command: &str) -> String {
        self.with_sudo(&format!("{} {command}", self.program))
    }

    fn with_sudo(&self, command: &str) -> String {
        if self.user.admin || self.user.root { command.to_owned() } else { format!("sudo {command}") }
    }

    /// Returns the `vcan-setup up` command that makes a bus, named by its skin or by its own name.
    fn up_command(&self, target: &InterfaceTarget) -> String {
        let what = target.skin.as_ref().map_or(&target.name, |skin| &skin.file);
        self.vcan_setup_command(&format!("up {what}"))
    }

    fn check_bus_kind(&self) -> Finding {
        let Kernel { release, has_can, can_raw, .. } = &self.kernel;
        let hints = || self.kernel.setup_hints(*can_raw);
        match (self.choice, has_can) {
            (KindChoice::Only(kind), _) if !kind.is_interface() => {
                Finding::ok(format!("{} was requested, which needs no kernel support", kind.display_name()))
            }
            (KindChoice::Auto | KindChoice::Only(_), true) => {
                Finding::ok(format!("the kernel ({release}) supports CAN"))
            }
            (KindChoice::Auto, false) => Finding::note(format!(
                "the kernel ({release}) does not support CAN, so the bench uses the embedded bus, without \
                 candump and real cells; to get a kernel with CAN:"
            ))
            .with_hints(hints()),
            (KindChoice::Only(_), false) => Finding::fault(format!(
                "the kernel ({release}) does not support CAN, which --bus-kind socketcan needs"
            ))
            .with_hints(hints())
            .with_hint("# or leave out --bus-kind socketcan: the bench then uses the embedded bus"),
        }
    }

    /// Reports the gateway and the cells that already send on a bus.
    fn check_traffic(&self, bus: &BusFacts, on: &str) -> Vec<Finding> {
        let name = &bus.target.name;
        let heard = match &bus.traffic {
            Ok(Some(heard)) => heard,
            Ok(None) => return Vec::new(),
            Err(why) => return vec![Finding::fault(why)],
        };
        let on = if on == name { name.clone() } else { format!("{on} {name}") };
        let (all, count) = (format_node_ids(&heard.cells), heard.cells.len());
        let gateway = heard.gateway.then(|| {
            Finding::fault(format!("another gateway sends joints messages on {on}"))
                .with_hint("pgrep -a skinbus  # shows the gateway: stop it, or use another bus")
        });
        let absent = || {
            let missing = |cells: &BTreeSet<_>| cells.difference(&heard.cells).copied().collect();
            bus.cells.as_ref().map_or_else(BTreeSet::new, missing)
        };
        let cells = match (self.no_spawn, count) {
            (false, 0) => None,
            (false, 1..) => Some(Finding::fault(format!("cells are already on {on}: {all}")).with_hint(
                "skinbus run ... --no-spawn  # uses these cells (check with doctor ... --no-spawn); or stop \
                 them",
            )),
            (true, 0) => Some(
                Finding::fault(format!("no cell sends on {on}, but --no-spawn needs running cells"))
                    .with_hint(format!(
                        "cell-node --bus {name} --nodes 1-... --skin SKIN.toml &  # or leave out --no-spawn"
                    )),
            ),
            (true, 1..) if absent().is_empty() => Some(Finding::ok(format!("{count} cells are on {on}"))),
            (true, 1..) => {
                let absent = format_node_ids(&absent());
                let text =
                    format!("{count} cells are on {on}; these cells of the skin sent nothing: {absent}");
                Some(Finding::note(text))
            }
        };
        gateway.into_iter().chain(cells).collect()
    }

    /// Checks that the receive buffer of a socket can hold a burst of replies.
    fn check_receive_buffer(&self) -> Option<Finding> {
        let granted = self.receive_buffer?;
        let all = usize::from(CellId::MAX.get());
        let frames =
            |bus: &BusFacts| bus.cells.as_ref().map_or(all, BTreeSet::len) * frames_per_packet(&bus.target);
        let frames = self.buses.iter().map(frames).max().unwrap_or(all);
        let needed = BUFFERED_REPLIES_PER_CELL * frames * FRAME_BUFFER_BYTES;
        let (has, wants) = (granted >> 10, needed >> 10);
        let hint = self.with_sudo(&format!("sysctl -w net.core.rmem_max={needed}"));
        Some(if granted >= needed {
            Finding::ok(format!(
                "receive buffers of {has} KiB can hold the answers of all cells ({frames} frames) \
                 {BUFFERED_REPLIES_PER_CELL} times"
            ))
        } else if granted >= frames * FRAME_BUFFER_BYTES {
            Finding::note(format!(
                "receive buffers are limited to {has} KiB; to hold the answers of all cells ({frames} \
                 frames) {BUFFERED_REPLIES_PER_CELL} times, they need {wants} KiB, otherwise a delayed \
                 gateway loses answers"
            ))
            .with_hint(hint)
        } else {
            Finding::fault(format!(
                "receive buffers are limited to {has} KiB and cannot hold the answers of all cells ({frames} \
                 frames) even once; they need {wants} KiB"
            ))
            .with_hint(hint)
        })
    }

    /// Checks that the kernel's queue between sender and receiver can hold one reply of every cell.
    fn check_kernel_backlog(&self) -> Option<Finding> {
        let frames =
            |bus: &BusFacts| bus.cells.as_ref().map_or(0, BTreeSet::len) * frames_per_packet(&bus.target);
        let frames: usize = self.buses.iter().map(frames).sum();
        if frames == 0 {
            return None;
        }
        Some(match self.backlog {
            None => Finding::note("the kernel's receive backlog cannot be read in this network namespace")
                .with_hint("sysctl net.core.netdev_max_backlog  # in the initial network namespace"),
            Some(backlog) if backlog >= frames => Finding::ok(format!(
                "the kernel's receive backlog of {backlog} can hold the answers of all cells ({frames} \
                 frames)"
            )),
            Some(backlog) => Finding::fault(format!(
                "the kernel's receive backlog of {backlog} cannot hold the answers of all cells ({frames} \
                 frames): some would be lost silently"
            ))
            .with_hint(self.with_sudo(&format!("sysctl -w net.core.netdev_max_backlog={}", 2 * frames))),
        })
    }

    fn check_embedded_directory(&self) -> Finding {
        match &self.embedded {
            Ok(directory) => Finding::ok(format!("embedded buses can be served in {}", directory.display())),
            Err(why) => Finding::fault(why),
        }
    }

    fn check_cell_node(&self) -> Option<Finding> {
        let Program { path, there } = &self.cell_node;
        let absent =
            format!("cell-node is not at {}: the gateway starts it from its own directory", path.display());
        match (self.no_spawn, there) {
            (true, _) => None,
            (false, true) => Some(Finding::ok("cell-node is in the directory of vcan-setup")),
            (false, false) => Some(Finding::fault(absent).with_hint(
                "cargo build --release  # in the project's folder; or set SKINBUS_CELL_NODE to the path of \
                 cell-node",
            )),
        }
    }
}

/// Returns the number of CAN frames that a packet takes on this bus.
const fn frames_per_packet(target: &InterfaceTarget) -> usize {
    match target.format {
        Format::Fd => 1,
        Format::Classic => 2,
    }
}

/// Formats node ids as a list: `1, 2, 5`.
fn format_node_ids(cells: &BTreeSet<CellId>) -> String {
    let first: Vec<_> = cells.iter().take(12).map(ToString::to_string).collect();
    let more = if cells.len() > first.len() {
        format!(" and {} more", cells.len() - first.len())
    } else {
        String::new()
    };
    first.join(", ") + &more
}

#[cfg(test)]
mod tests;
