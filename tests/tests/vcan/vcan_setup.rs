//! `up`, `down`, `status` and `doctor` on a real kernel, checked with `ip`.
//!
//! Needs root, and `vcan0` with MTU 72, up, which is left unchanged.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process::program;
use skinbus_tests::process::setup::{CommandOutput, while_sending};

use std::fs::File;
use std::os::fd::AsFd;
use std::os::unix::process::CommandExt;
use std::process::Command;
use std::time::Duration;

use protocol::bus::{Bus, BusKind, BusOptions, Inbox, KindChoice};
use protocol::can::Frame;
use protocol::id::{CellId, Id, Kind, Node};
use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};
use serde_json::Value;
use skinbus_tests::process::vcan::own_network;
use tempfile::TempDir;

/// Returns the id of this thread, whose network may differ from that of the process.
fn thread_id() -> u32 {
    rustix::thread::gettid().as_raw_nonzero().get().cast_unsigned()
}

fn run_as(user: u32, arguments: &str) -> CommandOutput {
    let mut command = Command::new(program("vcan-setup"));
    command.args(arguments.split_whitespace());
    if user != 0 {
        command.uid(user).gid(user);
    }
    CommandOutput::run(&mut command)
}

/// Runs a command that must succeed.
fn done(arguments: &str) -> String {
    let said = run_as(0, arguments);
    assert_eq!((said.code, said.err.as_str()), (0, ""), "{arguments}: {said:?}");
    said.out
}

/// Runs a command that must fail, and returns its message.
fn fails(arguments: &str, code: i32) -> String {
    let said = run_as(0, arguments);
    assert_eq!((said.code, said.out.as_str()), (code, ""), "{arguments}: {said:?}");
    let line = said.err.strip_prefix("vcan-setup: ").and_then(|line| line.strip_suffix('\n')).unwrap();
    assert!(!line.contains('\n'), "{line}");
    line.to_owned()
}

fn ip(arguments: &str) -> String {
    let output = Command::new("ip").args(arguments.split_whitespace()).output().unwrap();
    assert!(output.status.success(), "ip {arguments}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Returns all interfaces by `ip`, of a namespace or, for "", of this one.
fn links(namespace: &str) -> Vec<Value> {
    let within = if namespace.is_empty() { String::new() } else { format!("-n {namespace} ") };
    serde_json::from_str(&ip(&format!("{within}-json -details -statistics link show"))).unwrap()
}

fn link_in(namespace: &str, name: &str) -> Option<Value> {
    links(namespace).into_iter().find(|link| link["ifname"] == name)
}

fn link(name: &str) -> Option<Value> {
    link_in("", name)
}

fn flag(link: &Value, flag: &str) -> bool {
    link["flags"].as_array().unwrap().iter().any(|it| it == flag)
}

/// Checks that an interface is up, of MTU 72, of this kind, and marked.
fn assert_ours(link: &Value, kind: &str) {
    assert_eq!(link["linkinfo"]["info_kind"], kind, "{link}");
    assert_eq!((&link["mtu"], &link["ifalias"]), (&72.into(), &"skinbus".into()), "{link}");
    assert!(flag(link, "UP"), "{link}");
}

fn open(name: &str) -> Bus {
    Bus::open(name, KindChoice::Only(BusKind::SocketCan), &BusOptions::default()).unwrap()
}

/// Checks that a frame sent on one bus arrives on the other.
fn passes(from: &Bus, to: &Bus) {
    let frame = Frame::fd(0x123, 1, &[7; 16]).unwrap();
    from.send(&[frame]).unwrap();
    let mut inbox = Inbox::new();
    assert!(to.wait(Some(Duration::from_secs(60))).unwrap(), "a frame comes");
    to.receive(&mut inbox).unwrap();
    assert_eq!(inbox.frames().next().unwrap().frame.data(), frame.data());
}

#[test]
#[ignore = "needs vcan"]
fn a_vcan_is_made_once_carries_fd_frames_and_is_removed() {
    own_network();
    let before = links("").len();
    let planned = done("up --dry-run vcan20 vcan21");
    assert!(planned.starts_with("would make vcan20, a vcan with MTU 72, and bring it up\n"), "{planned}");
    assert_eq!(links("").len(), before, "a plan is nothing but words");

    assert_eq!(
        done("up vcan20 vcan21"),
        "made vcan20, a vcan with MTU 72, and brought it up\nmade vcan21, a vcan with MTU 72, and brought it up\n"
    );
    let first = link("vcan20").unwrap();
    assert_ours(&first, "vcan");
    assert_ours(&link("vcan21").unwrap(), "vcan");
    passes(&open("vcan20"), &open("vcan20"));

    assert_eq!(done("up vcan20"), "vcan20 already exists and is suitable (a vcan)\n");
    assert_eq!(link("vcan20").unwrap()["ifindex"], first["ifindex"], "the same one");
    assert_eq!(done("down vcan20 vcan21"), "vcan20 is removed\nvcan21 is removed\n");
    assert_eq!(links("").len(), before);
    assert_eq!(done("down vcan20"), "vcan20 does not exist\n");
}

#[test]
#[ignore = "needs vcan"]
fn the_commands_of_a_plan_do_the_same() {
    own_network();
    done("up vcan20");
    let of = |mut link: Value| {
        // The index and the statistics differ after an interface is made again.
        for key in ["ifindex", "stats64"] {
            link.as_object_mut().unwrap().remove(key);
        }
        link
    };
    let by_us = of(link("vcan20").unwrap());
    done("down vcan20");
    let plan = done("up --dry-run vcan20");
    let command = plan.lines().nth(1).unwrap().trim();
    assert!(Command::new("sh").args(["-c", command]).status().unwrap().success(), "{command}");
    assert_eq!(of(link("vcan20").unwrap()), by_us);
    assert_eq!(done("up vcan20"), "vcan20 already exists and is suitable (a vcan)\n");
}

#[test]
#[ignore = "needs vcan"]
fn what_is_ours_and_was_spoilt_is_repaired() {
    own_network();
    done("up vcan20");
    let index = link("vcan20").unwrap()["ifindex"].clone();
    ip("link set vcan20 down");
    assert_eq!(done("up vcan20"), "vcan20 is up\n");
    assert_ours(&link("vcan20").unwrap(), "vcan");
    ip("link set vcan20 down");
    ip("link set vcan20 mtu 16");
    ip("link set vcan20 up");
    assert_eq!(done("up vcan20"), "vcan20 has MTU 72, and is up\n");
    let repaired = link("vcan20").unwrap();
    assert_ours(&repaired, "vcan");
    assert_eq!(repaired["ifindex"], index, "the same interface");
}

#[test]
#[ignore = "needs vcan"]
fn what_is_not_ours_is_never_touched() {
    own_network();
    ip("link add vcan20 type vcan");
    ip("link set vcan20 mtu 16");
    ip("link set vcan20 up");
    let before = links("");
    let why = "vcan-setup did not make it and does not change it";
    let repairs = "sudo sh -c 'ip link set vcan20 down && ip link set vcan20 mtu 72 up'";
    assert_eq!(
        fails("up vcan21 vcan20", 1),
        format!("vcan20 has MTU 16, but CAN FD needs 72; {why}: `{repairs}` fixes it")
    );
    assert_eq!(
        fails("down vcan20", 2),
        "vcan20 is a vcan that vcan-setup did not make, so it stays unchanged: if it is yours, `sudo ip link \
         del vcan20` removes it"
    );
    let lo = fails("up vcan21 lo", 2);
    assert!(lo.starts_with("lo is the loopback interface, which vcan-setup does not change"), "{lo}");
    assert_eq!(done("up vcan0"), "vcan0 already exists and is suitable (a vcan, made by another program)\n");
    let same = |links: Vec<Value>| -> Vec<_> {
        links
            .into_iter()
            .map(|it| {
                (
                    it["ifname"].clone(),
                    it["ifindex"].clone(),
                    it["mtu"].clone(),
                    it["flags"].clone(),
                    it["ifalias"].clone(),
                )
            })
            .collect()
    };
    assert_eq!(same(links("")), same(before));

    // The hint works.
    assert!(Command::new("sh").args(["-c", &repairs["sudo ".len()..]]).status().unwrap().success());
    assert_eq!(
        done("up vcan20"),
        "vcan20 already exists and is suitable (a vcan, made by another program)\n"
    );
}

#[test]
#[ignore = "needs vcan"]
fn a_skins_buses_are_made_and_removed_and_what_others_made_stays() {
    own_network();
    let folder = TempDir::new().unwrap();
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let text = std::fs::read_to_string(root.join("gateway/examples/ur5-253.toml")).unwrap();
    let bus = "[[bus]]\nname = \"vcan20\"\nreply = \"torque\"\nformat = \"classic\"\n\n[controller]";
    let path = folder.path().join("two.toml");
    std::fs::write(&path, text.replacen("[controller]", bus, 1)).unwrap();
    let path = path.display();

    let said = done(&format!("up {path}"));
    assert_eq!(
        said,
        "vcan0 already exists and is suitable (a vcan, made by another program)\nmade vcan20, a vcan with MTU 72, and brought it up\n"
    );
    let doctor = run_as(0, &format!("doctor {path} --json"));
    let json: Value = serde_json::from_str(&doctor.out).unwrap();
    let about_buses: Vec<_> =
        json["findings"].as_array().unwrap().iter().map(|it| it["text"].as_str().unwrap()).collect();
    for name in ["vcan0", "vcan20"] {
        let fine = format!("{name} is a vcan, up, and carries CAN FD");
        assert!(about_buses.contains(&fine.as_str()), "{doctor:?}");
    }
    let said = done(&format!("down {path}"));
    let kept = "vcan0 is a vcan that vcan-setup did not make, so it stays unchanged";
    assert_eq!(said, format!("{kept}\nvcan20 is removed\n"));
    assert!(link("vcan0").is_some() && link("vcan20").is_none());
}

#[test]
#[ignore = "needs vcan"]
fn who_makes_interfaces_at_the_same_time_as_others_makes_them() {
    own_network();
    const NAMES: [&str; 8] = ["vcan20", "vcan21", "vcan22", "vcan23", "vcan24", "vcan25", "vcan26", "vcan27"];
    for _ in 0..4 {
        // Each tries the first free number, and only one of them can get it; the others try again.
        let said = std::thread::scope(|scope| {
            let all = NAMES.map(|name| scope.spawn(move || done(&format!("up {name}"))));
            all.map(|one| one.join().unwrap())
        });
        for (name, said) in NAMES.iter().zip(said) {
            assert_eq!(said, format!("made {name}, a vcan with MTU 72, and brought it up\n"));
            assert_ours(&link(name).unwrap(), "vcan");
        }
        done(&format!("down {}", NAMES.join(" ")));
    }
}

/// A network namespace that ends with the test.
struct Namespace(&'static str);

impl Namespace {
    fn new(name: &'static str) -> Self {
        // One that an earlier test left behind.
        let _ = Command::new("ip").args(["netns", "del", name]).output();
        ip(&format!("netns add {name}"));
        Self(name)
    }

    /// Opens a bus in the namespace.
    fn open(&self, name: &str) -> Bus {
        let file = File::open(format!("/run/netns/{}", self.0)).unwrap();
        let inside = || {
            move_into_link_name_space(file.as_fd(), Some(LinkNameSpaceType::Network)).unwrap();
            open(name)
        };
        std::thread::scope(|scope| scope.spawn(inside).join().unwrap())
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        let _ = Command::new("ip").args(["netns", "del", self.0]).output();
    }
}

#[test]
#[ignore = "needs vcan"]
fn a_pair_leads_into_another_namespace() {
    own_network();
    let blue = Namespace::new("blue");
    let up = "up vcan20 --peer vcan0 --namespace blue";
    done(&format!("{up} --dry-run"));
    assert_eq!((link("vcan20"), link_in("blue", "vcan0")), (None, None));
    assert_eq!(
        done(up),
        "made vcan20 and its other end vcan0 in blue, a vxcan pair with MTU 72, and brought both up\n"
    );
    assert_ours(&link("vcan20").unwrap(), "vxcan");
    assert_ours(&link_in("blue", "vcan0").unwrap(), "vxcan");
    let (here, there) = (open("vcan20"), blue.open("vcan0"));
    passes(&here, &there);
    passes(&there, &here);

    assert_eq!(done(up), "vcan20 already exists and is suitable (a vxcan)\n");
    assert_eq!(
        done("up vcan20 --peer vcan0 --namespace /run/netns/blue"),
        "vcan20 already exists and is suitable (a vxcan)\n"
    );
    let status: Value = serde_json::from_str(&done("status vcan20 --json")).unwrap();
    let peer = &status["interfaces"][0]["peer"];
    assert_eq!((&peer["name"], &peer["namespace"]), (&"vcan0".into(), &"blue".into()), "{status}");
    assert!(done("status").contains("vxcan to vcan0 in blue"));
    let other = "up vcan20 --peer vcan1 --namespace blue";
    assert!(
        fails(other, 1).starts_with("vcan20 already exists and is a vxcan, not one end of a pair with vcan1")
    );
    let taken = "up vcan21 --peer vcan0 --namespace blue";
    assert!(fails(taken, 1).starts_with("vcan0 already exists and is a vxcan in blue"));
    ip("-n blue link set vcan0 down");
    let said = fails(up, 1);
    assert!(
        said.contains("is down") && said.ends_with("`sudo ip -n blue link set vcan0 up` fixes it"),
        "{said}"
    );

    assert_eq!(done("down vcan20"), "vcan20 is removed\n");
    assert_eq!((link("vcan20"), link_in("blue", "vcan0")), (None, None), "both ends go");
}

#[test]
#[ignore = "needs vcan"]
fn a_pair_within_one_namespace_and_into_that_of_a_process() {
    own_network();
    done("up vcan20 --peer vcan21");
    assert_ours(&link("vcan20").unwrap(), "vxcan");
    assert_ours(&link("vcan21").unwrap(), "vxcan");
    passes(&open("vcan20"), &open("vcan21"));
    assert_eq!(done("up vcan21 --peer vcan20").lines().count(), 2, "from either end");
    let own = format!("up vcan20 --peer vcan21 --namespace {}", thread_id());
    assert_eq!(done(&own).lines().count(), 2, "our own namespace is here");
    assert_eq!(done("down vcan20 vcan21"), "vcan20 is removed\n");
    assert_eq!((link("vcan20"), link("vcan21")), (None, None));

    let mut process = Command::new("unshare").args(["--net", "sleep", "600"]).spawn().unwrap();
    let namespace = |pid: u32| std::fs::read_link(format!("/proc/{pid}/ns/net")).unwrap();
    while namespace(process.id()) == namespace(thread_id()) {
        assert!(process.try_wait().unwrap().is_none(), "unshare works");
        std::thread::sleep(Duration::from_millis(5));
    }
    done(&format!("up vcan22 --peer vcan22 --namespace {}", process.id()));
    assert_ours(&link("vcan22").unwrap(), "vxcan");
    process.kill().unwrap();
    process.wait().unwrap();
}

#[test]
#[ignore = "needs vcan"]
fn what_was_made_is_taken_back_when_a_later_step_fails() {
    own_network();
    // An altname is taken, and only the kernel reports it.
    ip("link add vcan20 type vcan");
    ip("link set vcan20 mtu 16");
    ip("link set vcan20 alias skinbus");
    ip("link property add dev vcan20 altname vcan22");
    let said = run_as(0, "up vcan20 vcan21 vcan22");
    assert_eq!((said.code, said.out.as_str()), (1, ""), "{said:?}");
    assert!(
        said.err.starts_with("vcan-setup: cannot make vcan22: another interface now has this name"),
        "{said:?}"
    );
    assert!(links("").iter().all(|link| link["ifname"] != "vcan21"), "taken back");
    let vcan20 = link("vcan20").unwrap();
    assert!(vcan20["mtu"] == 16 && !flag(&vcan20, "UP"), "as it was: {vcan20}");
}

#[test]
#[ignore = "needs vcan"]
fn who_is_not_root_is_told_so_and_may_look() {
    own_network();
    let said = run_as(65_534, "up vcan20");
    let program = program("vcan-setup").display().to_string();
    let expected =
        format!("vcan-setup: not allowed to make vcan20, which needs root: `sudo {program} up vcan20`\n");
    assert_eq!((said.code, said.err), (1, expected));
    assert_eq!(link("vcan20"), None);
    assert_eq!(run_as(65_534, "up vcan0").code, 0, "nothing to do needs nobody's leave");
    done("up vcan20");
    let said = run_as(65_534, "down vcan20");
    assert!(said.code == 1 && said.err.starts_with("vcan-setup: not allowed to remove vcan20"), "{said:?}");
    let said = run_as(65_534, "status vcan20");
    assert!(said.code == 0 && said.out.contains("vcan20"), "{said:?}");
    let said = run_as(65_534, "doctor vcan77 --bus-kind socketcan");
    assert!(said.out.contains("fault there is no interface vcan77\n        sudo "), "{said:?}");
    let namespace = run_as(65_534, "up vcan21 --peer vcan22 --namespace /proc/1/ns/net");
    assert!(
        namespace.err.starts_with("vcan-setup: not allowed to enter the network namespace"),
        "{namespace:?}"
    );
}

#[test]
#[ignore = "needs vcan"]
fn status_agrees_with_ip() {
    own_network();
    done("up vcan20");
    ip("link add vcan21 type vcan");
    let (from, to) = (open("vcan20"), open("vcan20"));
    for _ in 0..3 {
        passes(&from, &to);
    }
    let status: Value = serde_json::from_str(&done("status --json")).unwrap();
    let ours = status["interfaces"].as_array().unwrap();
    let theirs: Vec<_> = links("").into_iter().filter(|link| link["link_type"] == "can").collect();
    assert_eq!(ours.len(), theirs.len());
    for (ours, theirs) in ours.iter().zip(theirs) {
        for (key, value) in [
            ("name", &theirs["ifname"]),
            ("index", &theirs["ifindex"]),
            ("kind", &theirs["linkinfo"]["info_kind"]),
            ("mtu", &theirs["mtu"]),
            ("up", &Value::from(flag(&theirs, "UP"))),
            ("made_by_skinbus", &Value::from(theirs["ifalias"] == "skinbus")),
            ("received", &theirs["stats64"]["rx"]["packets"]),
            ("sent", &theirs["stats64"]["tx"]["packets"]),
        ] {
            assert_eq!(&ours[key], value, "{key} of {theirs}");
        }
    }
    let vcan20 = ours.iter().find(|it| it["name"] == "vcan20").unwrap();
    assert_eq!((&vcan20["sent"], &vcan20["received"]), (&3.into(), &3.into()));
    assert_eq!(done("status vcan21").lines().count(), 2, "a head and the one that was named");
    let said = run_as(0, "status vcan20 vcan77");
    assert!(said.code == 1 && said.err.starts_with("vcan-setup: not found: vcan77;"), "{said:?}");
    assert_eq!(run_as(0, "status vcan77").out, "", "nothing that is untrue of the others");
}

fn doctor(arguments: &str) -> (i32, Vec<String>) {
    let said = run_as(0, &format!("doctor {arguments} --bus-kind socketcan --no-spawn --json"));
    let json: Value = serde_json::from_str(&said.out).unwrap();
    assert_eq!(
        (json["bus_kind"].as_str(), json["would_run"].as_bool()),
        (Some("socketcan"), Some(said.code == 0))
    );
    let faults = json["findings"].as_array().unwrap().iter().filter(|it| it["level"] == "fault");
    let said_of = |it: &Value| {
        let hints = it["hints"].as_array().unwrap().iter().map(|it| it.as_str().unwrap());
        std::iter::once(it["text"].as_str().unwrap()).chain(hints).collect::<Vec<_>>().join(" | ")
    };
    (said.code, faults.map(said_of).collect())
}

#[test]
#[ignore = "needs vcan"]
fn the_doctor_finds_what_is_wrong_and_its_hints_repair_it() {
    own_network();
    let program = program("vcan-setup").display().to_string();
    let repair = |fault: &str| {
        let command = fault.split(" | ").nth(1).unwrap();
        assert!(Command::new("sh").args(["-c", command]).output().unwrap().status.success(), "{command}");
    };
    let heartbeat = Id::new(Kind::Network, Node::Cell(CellId::new(3).unwrap()));
    let joints = Id::command(protocol::id::Command::Joints);

    let (code, faults) = doctor("vcan20");
    assert_eq!(
        (code, faults.as_slice()),
        (1, [format!("there is no interface vcan20 | {program} up vcan20")].as_slice())
    );
    repair(&faults[0]);
    assert_eq!(while_sending(&open("vcan20"), &[heartbeat], || doctor("vcan20")), (0, vec![]));
    let other_gateway = while_sending(&open("vcan20"), &[heartbeat, joints], || doctor("vcan20"));
    assert!(
        other_gateway.0 == 1 && other_gateway.1[0].starts_with("another gateway sends joints messages on"),
        "{other_gateway:?}"
    );
    assert!(doctor("vcan20").1[0].starts_with("no cell sends on vcan20"));

    for (narrow, alias, hint) in [
        (false, "skinbus", format!(" | {program} up vcan20")),
        (true, "skinbus", format!(" | {program} up vcan20")),
        (false, "somebody", " | ip link set vcan20 up".to_owned()),
        (true, "somebody", " | ip link set vcan20 down && ip link set vcan20 mtu 72 up".to_owned()),
    ] {
        ip(&format!("link set vcan20 alias {alias}"));
        ip("link set vcan20 down");
        if narrow {
            ip("link set vcan20 mtu 16");
        }
        let (code, faults) = doctor("vcan20");
        assert!(code == 1 && faults[0].ends_with(&hint), "{faults:?}");
        repair(&faults[0]);
        assert_eq!(while_sending(&open("vcan20"), &[heartbeat], || doctor("vcan20")), (0, vec![]));
    }
    let (code, faults) = doctor("lo");
    assert!(
        code == 1 && faults[0].starts_with("lo is the loopback interface, which does not carry CAN"),
        "{faults:?}"
    );
}
