//! Metadata of a recording: program, machine, clocks and configuration.

use std::collections::BTreeMap;
use std::fs;

use protocol::parameters::Parameter;
use protocol::skin::Skin;
use rustix::system::uname;
use rustix::thread::ClockId;
use rustix::time::{clock_getres, clock_gettime};

use model::decode::parameter::ParameterWords;
use protocol::quantiles::Quantiles;

/// Metadata values by key.
pub type Metadata = BTreeMap<String, String>;

/// Metadata of the program and its command line.
#[must_use]
pub fn program_metadata(command_line: &[String], began_nanos: u64) -> Metadata {
    to_metadata([
        ("program", format!("skinbus {}", env!("CARGO_PKG_VERSION"))),
        ("git_revision", env!("SKINBUS_GIT_REVISION").to_owned()),
        ("command_line", command_line.join(" ")),
        ("began_ns", began_nanos.to_string()),
    ])
}

/// Metadata of the kernel, its clock, and the wake-up lateness of an idle thread.
#[must_use]
pub fn machine_metadata(idle: &Quantiles) -> Metadata {
    let about = uname();
    let text = |text: &std::ffi::CStr| text.to_string_lossy().into_owned();
    let clocks = "/sys/devices/system/clocksource/clocksource0/";
    let read = |name: &str| {
        fs::read_to_string(name).map_or_else(|_| "unknown".to_owned(), |text| text.trim().to_owned())
    };
    to_metadata([
        ("sysname", text(about.sysname())),
        ("release", text(about.release())),
        ("version", text(about.version())),
        ("machine", text(about.machine())),
        ("processors", std::thread::available_parallelism().map_or(0, usize::from).to_string()),
        ("clocksource", read(&format!("{clocks}current_clocksource"))),
        ("clocksources", read(&format!("{clocks}available_clocksource"))),
        ("realtime_minus_monotonic_ns", realtime_minus_monotonic().to_string()),
        ("realtime_resolution_ns", clock_getres(ClockId::Realtime).tv_nsec.to_string()),
        ("idle_late_p50_us", format!("{:.1}", idle.p50)),
        ("idle_late_p99_us", format!("{:.1}", idle.p99)),
        ("idle_late_max_us", format!("{:.1}", idle.max)),
    ])
}

/// Offset from the monotonic clock to the wall clock in ns, from the narrowest of three readings.
#[must_use]
pub fn realtime_minus_monotonic() -> i64 {
    let nanos = |clock| {
        let time = clock_gettime(clock);
        time.tv_sec * 1_000_000_000 + time.tv_nsec
    };
    let reading = |_| {
        let before = nanos(ClockId::Monotonic);
        let wall = nanos(ClockId::Realtime);
        let after = nanos(ClockId::Monotonic);
        (after - before, wall - before - (after - before) / 2)
    };
    (0..3).map(reading).min().map_or(0, |(_, offset)| offset)
}

/// Metadata of the skin and its effective timing, together with the metadata in `run`.
#[must_use]
pub fn configuration_metadata(skin: &Skin, run: impl IntoIterator<Item = (String, String)>) -> Metadata {
    let mut all = to_metadata([
        ("skin", skin.name.clone()),
        ("robot", skin.robot.name.clone()),
        ("joints", skin.robot.joints.len().to_string()),
        ("cells", skin.cells.len().to_string()),
        ("control_hz", skin.timing.control_hz.to_string()),
        ("joint_broadcast_hz", skin.timing.broadcast_hz().to_string()),
        ("hold_epochs", skin.safety.hold_epochs.to_string()),
        ("decay_epochs", skin.safety.decay_epochs.to_string()),
        ("bad_cycles", skin.safety.bad_cycles.to_string()),
        ("lost_bus", skin.safety.lost_bus.name().to_owned()),
        ("events", ParameterWords(Parameter::Events.number(), skin.events.words()).to_string()),
    ]);
    for bus in &skin.buses {
        let sensing = ParameterWords(Parameter::Sensing.number(), bus.sensing.words());
        all.insert(format!("sensing/{}", bus.name), sensing.to_string());
    }
    all.extend(run);
    all
}

/// Expected configuration hash of each cell, by bus and node id.
#[must_use]
pub fn configuration_hashes(skin: &Skin) -> Metadata {
    let of_cell = |cell: &protocol::skin::Cell| {
        let bus = skin.buses.get(cell.bus).map_or("", |bus| bus.name.as_str());
        (format!("{bus}/{}", cell.node), format!("{:04X}", skin.parameters(cell).hash()))
    };
    skin.cells.iter().map(of_cell).collect()
}

fn to_metadata<const N: usize>(facts: [(&str, String); N]) -> Metadata {
    facts.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
}
