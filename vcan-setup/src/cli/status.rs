//! `vcan-setup status`.

use clap::Args;
use comfy_table::{CellAlignment, ContentArrangement, Table, presets};
use protocol::usage::{Failure, print};
use serde::Serialize;
use vcan_setup::link::{CLASSIC_MTU, FD_MTU, Hardware, Interface, Kind, Peer, Place, bit_rate};
use vcan_setup::look::{Embedded, embedded_buses};

use super::{ask, wanted};

/// Show the CAN interfaces of this machine, and the embedded buses of this user
///
/// Of hardware also the bit rates and the error state. Exit code 1 when one that was named is not there.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vcan-setup status
  vcan-setup status skin.toml --json")]
pub(crate) struct Status {
    /// Only these: names, or skins, which end in .toml or hold a '/'
    #[arg(value_name = "SKIN.toml|NAME")]
    what: Vec<String>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

impl Status {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let wanted = wanted(&self.what)?;
        let (_, present) = ask()?;
        let is_wanted = |name: &str| wanted.is_empty() || wanted.iter().any(|wanted| wanted.name == name);
        let named = |interface: &&Interface| {
            if wanted.is_empty() { interface.is_can() } else { is_wanted(&interface.name) }
        };
        let interfaces: Vec<_> = present.iter().filter(named).collect();
        let embedded: Vec<_> = embedded_buses().into_iter().filter(|bus| is_wanted(&bus.name)).collect();
        let text = match (self.json, interfaces.is_empty() && embedded.is_empty()) {
            (true, _) => json(&interfaces, &embedded)?,
            (false, false) => table(&interfaces, &embedded),
            (false, true) if wanted.is_empty() => "no CAN interface, no embedded bus\n".to_owned(),
            // What was named and is not there is said below.
            (false, true) => String::new(),
        };
        print(&text)?;
        let there = |name: &str| {
            interfaces.iter().any(|it| it.name == name)
                || embedded.iter().any(|it| it.name == name && it.served)
        };
        let absent: Vec<_> = wanted.iter().map(|it| it.name.as_str()).filter(|name| !there(name)).collect();
        if absent.is_empty() {
            return Ok(());
        }
        let (names, words) = (absent.join(", "), absent.join(" "));
        Err(Failure::run(format!("not there: {names}; `vcan-setup doctor {words}` says how to get it")))
    }
}

fn table(interfaces: &[&Interface], embedded: &[Embedded]) -> String {
    let mut table = Table::new();
    table.load_style(presets::NOTHING).set_content_arrangement(ContentArrangement::Disabled);
    table.set_header([
        "bus",
        "kind",
        "made by",
        "state",
        "frames",
        "bit rates",
        "received",
        "sent",
        "dropped",
        "errors",
    ]);
    for interface in interfaces {
        let counters = interface.counters;
        table.add_row([
            interface.name.clone(),
            kind(interface),
            made_by(interface).to_owned(),
            state(interface),
            frames(interface),
            rates(interface),
            counters.received.to_string(),
            counters.sent.to_string(),
            counters.dropped.to_string(),
            counters.errors.to_string(),
        ]);
    }
    for Embedded { name, served, .. } in embedded {
        let state = if *served { "served" } else { "left by a server that was killed" };
        table.add_row([name.as_str(), "embedded bus", "this user", state, if *served { "FD" } else { "" }]);
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

fn kind(interface: &Interface) -> String {
    match &interface.kind {
        Kind::Vcan => "vcan".to_owned(),
        Kind::Vxcan(None) => "vxcan".to_owned(),
        Kind::Vxcan(Some(Peer { index, name, place })) => {
            let peer = name.clone().unwrap_or_else(|| format!("interface {index}"));
            match place {
                Place::Here => format!("vxcan to {peer}"),
                Place::Namespace { name: Some(space), .. } => format!("vxcan to {peer} in {space}"),
                Place::Namespace { id, name: None } => format!("vxcan to {peer} in namespace {id}"),
            }
        }
        Kind::Hardware(Hardware { driver, .. }) => driver.clone().unwrap_or_else(|| "hardware".to_owned()),
        Kind::Other(what) => format!("no CAN: {what}"),
    }
}

const fn made_by(interface: &Interface) -> &'static str {
    match (interface.ours, interface.is_virtual()) {
        (true, true) => "skinbus",
        (false, true) => "others",
        (_, false) => "",
    }
}

fn state(interface: &Interface) -> String {
    let up = if interface.up { "up" } else { "down" };
    match &interface.kind {
        Kind::Hardware(Hardware { state: Some(state), .. }) if interface.up => {
            format!("{up}, {}", state.name())
        }
        Kind::Vcan | Kind::Vxcan(_) | Kind::Hardware(_) | Kind::Other(_) => up.to_owned(),
    }
}

const fn format(interface: &Interface) -> &'static str {
    match interface.mtu {
        _ if !interface.is_can() => "",
        CLASSIC_MTU => "classic",
        FD_MTU => "FD",
        _ => "XL",
    }
}

fn frames(interface: &Interface) -> String {
    let format = format(interface);
    if format.is_empty() { String::new() } else { format!("{format}, MTU {}", interface.mtu) }
}

fn rates(interface: &Interface) -> String {
    let Kind::Hardware(Hardware { bitrate, data_bitrate, .. }) = interface.kind else { return String::new() };
    match (bitrate, data_bitrate) {
        (None, _) => "none set".to_owned(),
        (Some(rate), None) => bit_rate(rate),
        (Some(rate), Some(data)) => format!("{}, data {}", bit_rate(rate), bit_rate(data)),
    }
}

#[derive(Serialize)]
struct Report<'a> {
    interfaces: Vec<InterfaceReport<'a>>,
    embedded: Vec<EmbeddedReport<'a>>,
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
    peer: Option<PeerReport<'a>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    hardware: Option<HardwareReport<'a>>,
    received: u64,
    sent: u64,
    dropped: u64,
    errors: u64,
}

#[derive(Serialize)]
struct PeerReport<'a> {
    index: u32,
    name: Option<&'a str>,
    namespace: Option<&'a str>,
    namespace_id: Option<i32>,
}

#[derive(Serialize)]
struct HardwareReport<'a> {
    driver: Option<&'a str>,
    state: Option<&'static str>,
    bitrate: Option<u32>,
    data_bitrate: Option<u32>,
    fd: bool,
    listen_only: bool,
}

#[derive(Serialize)]
struct EmbeddedReport<'a> {
    name: &'a str,
    path: String,
    served: bool,
}

fn json(interfaces: &[&Interface], embedded: &[Embedded]) -> Result<String, Failure> {
    let embedded = embedded.iter().map(|Embedded { name, path, served }| EmbeddedReport {
        name,
        path: path.display().to_string(),
        served: *served,
    });
    let report = Report {
        interfaces: interfaces.iter().map(|interface| report(interface)).collect(),
        embedded: embedded.collect(),
    };
    serde_json::to_string_pretty(&report).map(|text| text + "\n").map_err(Failure::run)
}

fn report(interface: &Interface) -> InterfaceReport<'_> {
    let Interface { index, ref name, ref kind, ours, up, mtu, counters } = *interface;
    let peer = |peer: &'_ Peer| -> (u32, Option<i32>) {
        let id = if let Place::Namespace { id, .. } = peer.place { Some(id) } else { None };
        (peer.index, id)
    };
    let (kind_name, peer, hardware) = match kind {
        Kind::Vcan => ("vcan", None, None),
        Kind::Vxcan(None) => ("vxcan", None, None),
        Kind::Vxcan(Some(end)) => {
            let (index, namespace_id) = peer(end);
            let namespace =
                if let Place::Namespace { name, .. } = &end.place { name.as_deref() } else { None };
            let report = PeerReport { index, name: end.name.as_deref(), namespace, namespace_id };
            ("vxcan", Some(report), None)
        }
        Kind::Hardware(hardware) => {
            let Hardware { driver, bitrate, data_bitrate, fd, listen_only, state } = hardware;
            let report = HardwareReport {
                driver: driver.as_deref(),
                state: state.map(vcan_setup::link::State::name),
                bitrate: *bitrate,
                data_bitrate: *data_bitrate,
                fd: *fd,
                listen_only: *listen_only,
            };
            ("hardware", None, Some(report))
        }
        Kind::Other(_) => ("other", None, None),
    };
    InterfaceReport {
        name,
        index,
        kind: kind_name,
        made_by_skinbus: ours,
        up,
        mtu,
        format: format(interface),
        peer,
        hardware,
        received: counters.received,
        sent: counters.sent,
        dropped: counters.dropped,
        errors: counters.errors,
    }
}
