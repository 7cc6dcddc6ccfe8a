//! The same bench on a real kernel's vcan, beside the stock tools.

#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use gateway::generate::{Wanted, generate};
use protocol::can::Frame;
use protocol::candump::{Line, parse};
use protocol::id::{Id, Kind};
use protocol::packet;

/// A rate that an emulated machine keeps up.
const WANTED: Wanted = Wanted {
    robot: gateway::generate::Robot::Ur5,
    cells: 24,
    buses: 1,
    broadcast_hz: 20.0,
    reply: gateway::generate::Reply::Torque,
    format: gateway::generate::Format::Fd,
};

/// The joints stand still, so that torques depend on nothing but the epoch, also when a slow machine skips
/// ticks.
const SCENARIO: &str = r#"version = 1
duration_s = 6.0

[motion]
kind = "hold"
start_rad = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]

[[touch]]
at_s = 0.0
for_s = 6.0
all = true
force_n = 1.5
profile = "half-sine"
"#;

/// This project's programs, built in the same profile as this test.
fn program(name: &str) -> PathBuf {
    let test = std::env::current_exe().unwrap();
    let path = test.parent().unwrap().parent().unwrap().join(name);
    assert!(path.is_file(), "{} is missing: cargo build --workspace in this profile", path.display());
    path
}

/// The interface that these tests need, with room for FD frames.
fn needs_vcan0() {
    let mtu = fs::read_to_string("/sys/class/net/vcan0/mtu").unwrap_or_default();
    assert_eq!(mtu.trim(), "72", "these tests need vcan0 with MTU 72, up; tests/vcan runs them where it is");
}

/// `candump -L`, with a receive buffer for a whole run.
struct Candump {
    child: Child,
    log: PathBuf,
}

impl Candump {
    fn start(bus: &str, log: &Path) -> Self {
        let mut command = Command::new("candump");
        command.args(["-L", "-r", "8000000", bus]).stdout(File::create(log).unwrap()).stderr(Stdio::null());
        let child = command.spawn().unwrap_or_else(|error| panic!("candump ({error}): install can-utils"));
        // It listens once its socket is there.
        let sockets = format!("/proc/{}/net/can/rcvlist_all", child.id());
        wait_for("candump to listen", || fs::read_to_string(&sockets).is_ok_and(|list| list.contains(bus)));
        Self { child, log: log.to_owned() }
    }

    fn frames(mut self, expected: usize) -> Vec<Frame> {
        wait_for("candump to write everything", || frames_of(&self.log).len() >= expected);
        self.child.kill().unwrap();
        self.child.wait().unwrap();
        frames_of(&self.log)
    }
}

fn frames_of(log: &Path) -> Vec<Frame> {
    let text = fs::read_to_string(log).unwrap();
    let frame = |line: &str| match parse(line) {
        Ok(Line::Frame(record)) => Some(record.frame),
        _ => None,
    };
    text.lines().filter_map(frame).collect()
}

fn wait_for(what: &str, done: impl Fn() -> bool) {
    let give_up = Instant::now() + Duration::from_secs(20);
    while !done() {
        assert!(Instant::now() < give_up, "waited in vain for {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Runs the bench; its summary and all frames that the gateway saw.
fn run(directory: &Path, kind: &str) -> (serde_json::Value, Vec<Frame>) {
    let path = |name: &str| directory.join(format!("{kind}-{name}"));
    fs::write(path("skin.toml"), generate(&WANTED).unwrap()).unwrap();
    fs::write(path("scenario.toml"), SCENARIO).unwrap();
    let mut command = Command::new(program("gateway"));
    command.arg("run").arg(path("skin.toml")).arg("--scenario").arg(path("scenario.toml"));
    command.args(["--bus-kind", kind, "--quiet"]);
    command.arg("--summary").arg(path("run.json")).arg("--candump").arg(path("run.log"));
    let done = command.env("SKINBUS_DIR", directory.join("bus")).output().unwrap();
    let said = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(done.status.success(), "{}: {said}", done.status);
    let summary = serde_json::from_slice(&fs::read(path("run.json")).unwrap()).unwrap();
    (summary, frames_of(&path("run.log")))
}

/// Frames by sender and kind, in the order in which each was sent: what two views of a bus have in common.
fn by_identifier(frames: &[Frame]) -> BTreeMap<u32, Vec<Frame>> {
    let mut all = BTreeMap::<_, Vec<Frame>>::new();
    for frame in frames {
        all.entry(frame.raw_id()).or_default().push(*frame);
    }
    all
}

/// The torques of a run by cell and epoch; the run is shorter than 256 epochs.
fn torques(frames: &[Frame]) -> BTreeMap<(u8, u8), [u8; 12]> {
    let torque = |frame: &Frame| {
        let packet = packet::Packet::from_fd(frame).ok()?;
        let words = *frame.data().first_chunk::<12>()?;
        (packet.id.kind == Kind::Torque).then_some(((packet.id.node, packet.epoch.0), words))
    };
    frames.iter().filter_map(torque).collect()
}

#[test]
#[ignore = "needs vcan"]
fn a_bench_of_processes_runs_on_vcan_and_candump_sees_what_the_gateway_counts() {
    let directory = tempfile::tempdir().unwrap();
    needs_vcan0();
    let candump = Candump::start("vcan0", &directory.path().join("candump.log"));
    let (summary, ours) = run(directory.path(), "socketcan");
    let theirs = candump.frames(ours.len());
    let (ours, theirs) = (by_identifier(&ours), by_identifier(&theirs));
    for (id, theirs) in &theirs {
        let seen = ours.get(id).map_or(&[][..], Vec::as_slice);
        // Cells that are being ended may still say a heartbeat when the gateway no longer listens.
        let kind = Id::from_bits(u16::try_from(*id).unwrap()).kind;
        let later = if kind == Kind::Network { theirs.len().saturating_sub(seen.len()) } else { 0 };
        assert_eq!(theirs.len(), seen.len() + later, "frames of {id:03X}");
        assert!(theirs.starts_with(seen), "{id:03X} comes in another order");
    }
    assert_eq!(ours.len(), theirs.len(), "identifiers");
    let ours = ours.into_values().flatten().collect::<Vec<_>>();

    let bus = &summary["buses"][0];
    assert_eq!(bus["kind"], "socketcan");
    assert_eq!(
        (&bus["uplink"]["unknown"], &bus["replies"]["unknown"]),
        (&0.into(), &0.into()),
        "{summary:#}"
    );
    assert!(bus["replies"]["due"].as_u64().unwrap() > 1_000, "{summary:#}");
    assert!(summary["accuracy"]["single"]["mean_nm"].as_f64().unwrap() < 1.2e-4, "{summary:#}");
    assert!(ours.iter().all(|frame| packet::Packet::from_fd(frame).is_ok()));
}

#[test]
#[ignore = "needs vcan"]
fn torques_are_the_same_bit_for_bit_on_vcan_and_on_the_embedded_bus() {
    let directory = tempfile::tempdir().unwrap();
    needs_vcan0();
    let (on_vcan, vcan) = run(directory.path(), "socketcan");
    let (on_embedded, embedded) = run(directory.path(), "embedded");
    for summary in [&on_vcan, &on_embedded] {
        assert_eq!(summary["buses"][0]["replies"]["unknown"], 0, "{summary:#}");
    }
    let (vcan, embedded) = (torques(&vcan), torques(&embedded));
    // A machine that is away for a while makes a cell skip an epoch: the rest is compared, and has to be most.
    let mut shared = 0;
    for (cell_and_epoch, words) in &vcan {
        if let Some(there) = embedded.get(cell_and_epoch) {
            assert_eq!(words, there, "cell and epoch {cell_and_epoch:?}");
            shared += 1;
        }
    }
    let due = on_vcan["buses"][0]["replies"]["due"].as_u64().unwrap();
    assert!(due > 2_000 && shared * 10 > due * 9, "{shared} of {due} torques are in both runs");
}
