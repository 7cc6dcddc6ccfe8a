//! The command `vcan-setup status`.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::time::Duration;

use clap::Args;
use comfy_table::{CellAlignment, ContentArrangement, Table, presets};
use protocol::bus::BusKind;
use protocol::usage::{Failure, print_text};
use serde::Serialize;
use vcan_setup::embedded::TimedReport;
use vcan_setup::hosts::report as hosts;
use vcan_setup::link::{
    CLASSIC_MTU, CanHardware, FD_MTU, HardwareRates, Interface, InterfaceCounters, InterfaceKind, Peer,
};
use vcan_setup::look::{EmbeddedBus, embedded_buses};

use super::{query_interfaces, targets_from_arguments, to_json};

/// The time within which a link must answer.
const ANSWER_TIMEOUT: Duration = Duration::from_millis(500);

/// Show the CAN interfaces of this machine, and this user's embedded buses (without a kernel interface)
///
/// Shows the bit rates and the error state of hardware too. Exit code 1 if a named bus does not exist.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vcan-setup status
  vcan-setup status skin.toml --json")]
pub(crate) struct StatusOptions {
    /// Show only these buses: names, or skin files (an argument that ends in .toml or contains a '/')
    #[arg(value_name = "SKIN.toml|NAME")]
    what: Vec<OsString>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

impl StatusOptions {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let target = targets_from_arguments(&self.what)?;
        let (_, present) = query_interfaces()?;
        let is_requested = |name: &str| target.is_empty() || target.iter().any(|target| target.name == name);
        let named = |interface: &&Interface| {
            if target.is_empty() { interface.is_can() } else { is_requested(&interface.name) }
        };
        let interfaces: Vec<_> = present.iter().filter(named).collect();
        let embedded: Vec<_> = embedded_buses().into_iter().filter(|bus| is_requested(&bus.name)).collect();
        let kernel = interfaces.iter().map(|interface| (interface.name.as_str(), BusKind::SocketCan));
        let user = embedded.iter().filter(|bus| bus.served).map(|bus| (bus.name.as_str(), BusKind::Embedded));
        let links = query_link_reports(kernel.chain(user));
        let timed = query_timed_figures(&embedded);
        let text = match (self.json, interfaces.is_empty() && embedded.is_empty()) {
            (true, _) => {
                let interfaces = interfaces.iter().map(|interface| interface_report(interface)).collect();
                to_json(&StatusReport { interfaces, embedded: &embedded, timed: &timed, links: &links })?
            }
            (false, false) => {
                format_table(&interfaces, &embedded, &timed)
                    + &format_timed_figures(&timed)
                    + &format_link_reports(&links)
            }
            (false, true) if target.is_empty() => {
                "there is no CAN interface and no embedded bus\n".to_owned()
            }
            // If a named bus does not exist, an error reports it below.
            (false, true) => String::new(),
        };
        print_text(&text)?;
        let there = |name: &str| {
            interfaces.iter().any(|it| it.name == name)
                || embedded.iter().any(|it| it.name == name && it.served)
        };
        let absent: Vec<_> = target.iter().map(|it| it.name.as_str()).filter(|name| !there(name)).collect();
        if absent.is_empty() {
            return Ok(());
        }
        let (names, words) = (absent.join(", "), absent.join(" "));
        let first = absent.first().unwrap_or(&"vcan0");
        Err(Failure::run_error(format!(
            "not found: {names}; `vcan-setup serve {first}` serves an embedded bus, `vcan-setup doctor {words}` shows what \
             an interface needs"
        )))
    }
}

/// Returns the reports of the links of these buses. A link that does not answer in time is left out.
fn query_link_reports<'a>(
    buses: impl Iterator<Item = (&'a str, BusKind)>,
) -> BTreeMap<&'a str, hosts::LinkReport> {
    let report = |(bus, kind)| {
        let report = hosts::ReportReader::connect(bus, kind, None)
            .and_then(|mut it| it.wait_for_report(ANSWER_TIMEOUT));
        Some((bus, report.ok()?))
    };
    buses.filter_map(report).collect()
}

/// Returns the figures of the timed buses among these. A server that does not answer in time is left out.
fn query_timed_figures(embedded: &[EmbeddedBus]) -> BTreeMap<&str, TimedReport> {
    let names = embedded.iter().filter(|bus| bus.served).map(|bus| bus.name.as_str());
    names.filter_map(|name| Some((name, TimedReport::request(name, None, ANSWER_TIMEOUT)?))).collect()
}

fn format_timed_figures(timed: &BTreeMap<&str, TimedReport>) -> String {
    let line = |(bus, figures): (&&str, &TimedReport)| {
        let load = figures.load.map_or_else(String::new, |load| format!("load {:.1} %, ", load * 100.0));
        let TimedReport { rates, queue, waiting, refused, .. } = figures;
        format!("frames on {bus} take time: {rates}, {queue}, {load}{waiting} waiting, {refused} refused\n")
    };
    timed.iter().map(line).collect()
}

fn format_link_reports(links: &BTreeMap<&str, hosts::LinkReport>) -> String {
    let host = |(name, host): (&String, &hosts::HostReport)| {
        let cells = host.nodes.len();
        let gone = if host.is_there { "" } else { ", unreachable" };
        format!("'{name}' ({cells} cell{}{gone})", if cells == 1 { "" } else { "s" })
    };
    let line = |(bus, report): (&&str, &hosts::LinkReport)| {
        let hosts: Vec<_> = report.hosts.iter().map(host).collect();
        let with = if hosts.is_empty() { "no host yet".to_owned() } else { hosts.join(", ") };
        format!("{bus} is linked under the name '{}' with {with}\n", report.host)
    };
    links.iter().map(line).collect()
}

fn format_table(
    interfaces: &[&Interface],
    embedded: &[EmbeddedBus],
    timed: &BTreeMap<&str, TimedReport>,
) -> String {
    let mut table = Table::new();
    table.load_style(presets::NOTHING).set_content_arrangement(ContentArrangement::Disabled);
    let right = ["received", "sent", "dropped", "errors"];
    table.set_header(["bus", "kind", "made by", "state", "frames", "bit rates"].into_iter().chain(right));
    for interface in interfaces {
        let InterfaceCounters { received, sent, dropped, errors } = interface.counters;
        let (made_by, frames) = (creator_name(interface).to_owned(), frame_format_text(interface));
        let words = [
            interface.name.clone(),
            kind_text(interface),
            made_by,
            state_text(interface),
            frames,
            bit_rates_text(interface),
        ];
        let counts = [received, sent, dropped, errors].map(|count| count.to_string());
        table.add_row(words.into_iter().chain(counts));
    }
    for EmbeddedBus { name, served, .. } in embedded {
        let state = if *served { "served" } else { "left by a server that was killed" };
        let rates = timed.get(name.as_str()).map_or("", |timed| timed.rates.as_str());
        table.add_row([
            name.as_str(),
            "embedded bus",
            "this user",
            state,
            if *served { "FD" } else { "" },
            rates,
        ]);
    }
    for column in table.column_iter_mut() {
        column.set_padding((0, 2));
        if column.index > 5 {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    let text = table.to_string();
    text.lines().map(|line| format!("{}\n", line.trim_end())).collect()
}

fn kind_text(interface: &Interface) -> String {
    match &interface.kind {
        InterfaceKind::Vxcan(Some(Peer { index, name, namespace, namespace_id })) => {
            let peer = name.clone().unwrap_or_else(|| format!("interface {index}"));
            match (namespace, namespace_id) {
                (Some(space), _) => format!("vxcan to {peer} in {space}"),
                (None, Some(id)) => format!("vxcan to {peer} in namespace {id}"),
                (None, None) => format!("vxcan to {peer}"),
            }
        }
        InterfaceKind::Hardware(CanHardware { driver: Some(driver), .. }) => driver.clone(),
        InterfaceKind::Other(what) => format!("no CAN: {what}"),
        kind @ (InterfaceKind::Vcan | InterfaceKind::Vxcan(None) | InterfaceKind::Hardware(_)) => {
            kind.name().to_owned()
        }
    }
}

const fn creator_name(interface: &Interface) -> &'static str {
    match (interface.ours, interface.is_virtual()) {
        (true, true) => "skinbus",
        (false, true) => "others",
        (_, false) => "",
    }
}

fn state_text(interface: &Interface) -> String {
    let up = if interface.up { "up" } else { "down" };
    match interface.hardware().and_then(|hardware| hardware.state) {
        Some(state) if interface.up => format!("{up}, {}", state.name()),
        Some(_) | None => up.to_owned(),
    }
}

const fn format_name(interface: &Interface) -> &'static str {
    match interface.mtu {
        _ if !interface.is_can() => "",
        CLASSIC_MTU => "classic",
        FD_MTU => "FD",
        _ => "XL",
    }
}

fn frame_format_text(interface: &Interface) -> String {
    let format = format_name(interface);
    if format.is_empty() { String::new() } else { format!("{format}, MTU {}", interface.mtu) }
}

fn bit_rates_text(interface: &Interface) -> String {
    match interface.kind {
        InterfaceKind::Hardware(CanHardware { bitrate: None, .. }) => "not set".to_owned(),
        InterfaceKind::Hardware(CanHardware { bitrate, data_bitrate, .. }) => {
            HardwareRates { bitrate, data_bitrate }.to_string()
        }
        InterfaceKind::Vcan | InterfaceKind::Vxcan(_) | InterfaceKind::Other(_) => String::new(),
    }
}

#[derive(Serialize)]
struct StatusReport<'a> {
    interfaces: Vec<InterfaceReport<'a>>,
    embedded: &'a [EmbeddedBus],
    /// The figures of timed buses.
    timed: &'a BTreeMap<&'a str, TimedReport>,
    /// The reports of links to other hosts, by bus.
    links: &'a BTreeMap<&'a str, hosts::LinkReport>,
}

#[derive(Serialize)]
struct InterfaceReport<'a> {
    name: &'a str,
    index: u32,
    kind: &'static str,
    made_by_skinbus: bool,
    up: bool,
    mtu: u32,
    format: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    peer: Option<&'a Peer>,
    #[serde(skip_serializing_if = "Option::is_none")]
    hardware: Option<&'a CanHardware>,
    #[serde(flatten)]
    counters: InterfaceCounters,
}

fn interface_report(interface: &Interface) -> InterfaceReport<'_> {
    let Interface { index, ref name, ref kind, ours, up, mtu, counters } = *interface;
    InterfaceReport {
        name,
        index,
        kind: kind.name(),
        made_by_skinbus: ours,
        up,
        mtu,
        format: format_name(interface),
        peer: interface.peer(),
        hardware: interface.hardware(),
        counters,
    }
}
