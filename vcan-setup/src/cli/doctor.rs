//! The command `vcan-setup doctor`.

use std::ffi::OsString;

use clap::Args;
use protocol::bus::{BusKind, KindChoice, has_socketcan};
use protocol::usage::{Failure, print_text};
use serde::Serialize;
use vcan_setup::doctor::{BusFacts, Finding, FindingLevel, MachineFacts, assess_machine, would_bench_run};
use vcan_setup::look;

use super::{buses_from_arguments, query_interfaces, to_json};

/// Check whether a bench would run on this machine, with a hint for each fault
///
/// Checks the kernel, interfaces, permissions, buffers, and the nodes that are already on the buses (it listens for
/// 600 ms, and sends nothing), and reports what would prevent `skinbus run`. Changes nothing. Run it as the user
/// who runs the gateway. Exit code 0: a bench would run; 1: it would not; 2: wrong use.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vcan-setup doctor                                the machine
  vcan-setup doctor skin.toml                      all that a skin needs
  vcan-setup doctor skin.toml --no-spawn           its cells are on the bus already
  vcan-setup doctor can0 --bus-kind socketcan")]
pub(crate) struct DoctorOptions {
    /// Names of buses, or skin files (an argument that ends in .toml or contains a '/')
    #[arg(value_name = "SKIN.toml|NAME")]
    what: Vec<OsString>,
    #[arg(long, value_name = "KIND", default_value_t = KindChoice::Auto, help = BusKind::help())]
    bus_kind: KindChoice,
    /// Expect cells that are already on the buses, real or simulated, as `skinbus run --no-spawn` does
    #[arg(long)]
    no_spawn: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

impl DoctorOptions {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let mut buses = buses_from_arguments(&self.what, BusFacts::from_skin, BusFacts::named)?;
        let present = match (query_interfaces(), self.bus_kind) {
            (Ok((_, present)), _) => present,
            // Only SocketCAN needs an interface.
            (Err(_), KindChoice::Only(kind)) if !kind.is_interface() => Vec::new(),
            (Err(_), KindChoice::Auto) if !has_socketcan() => Vec::new(),
            (Err(failure), _) => return Err(failure),
        };
        for BusFacts { target, .. } in buses.iter_mut().filter(|bus| bus.cells.is_none()) {
            target.adopt_hardware_format(&present);
        }
        let facts = look::collect_facts(buses, self.bus_kind, self.no_spawn, &present);
        let findings = assess_machine(&facts);
        let runs = would_bench_run(&findings);
        if self.json {
            let bus_kind = facts.bus_kind().name();
            print_text(&to_json(&DoctorReport { would_run: runs, bus_kind, findings: &findings })?)?;
        } else {
            print_text(&format_findings(&facts, &findings, runs))?;
        }
        if runs { Ok(()) } else { Err(Failure::already_reported()) }
    }
}

fn format_findings(facts: &MachineFacts, findings: &[Finding], runs: bool) -> String {
    let mut text = String::new();
    for Finding { level, text: what, hints } in findings {
        text += &format!("{:<6}{what}\n", level.name());
        for hint in hints {
            text += &format!("        {hint}\n");
        }
    }
    let faults = findings.iter().filter(|finding| finding.level == FindingLevel::Fault).count();
    text + &match (runs, faults) {
        (true, _) => format!("\nA bench would run, on {}.\n", facts.bus_kind().display_name()),
        (false, 1) => "\nNo bench would run: fix the fault first.\n".to_owned(),
        (false, faults) => format!("\nNo bench would run: fix the {faults} faults first.\n"),
    }
}

#[derive(Serialize)]
struct DoctorReport<'a> {
    would_run: bool,
    bus_kind: &'static str,
    findings: &'a [Finding],
}
