//! Mutual TLS and access control, with the commands and files of `docs/how-to/several-hosts.md`.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::thread;
use std::time::Duration;

use super::process::{Running, TestDir};
use super::{Host, ended_link, link_program, port};

const GUIDE: &str = include_str!("../../../docs/how-to/several-hosts.md");

/// Returns the text of the code block that contains `mark`.
fn block(mark: &str) -> String {
    let blocks = GUIDE.split("\n```").skip(1).step_by(2);
    let block = blocks
        .into_iter()
        .find(|block| block.contains(mark))
        .unwrap_or_else(|| panic!("no block with {mark}"));
    block.split_once('\n').unwrap().1.replace("robot.local", "localhost")
}

fn shell(folder: &Path, script: &str) {
    let done = Command::new("bash").args(["-euc", script]).current_dir(folder).output().unwrap();
    assert!(done.status.success(), "{script}: {}", String::from_utf8_lossy(&done.stderr));
}

/// Creates the certificates of the guide, and its two configurations at a port of this machine.
fn secured(port: u16) -> TestDir {
    let place = TestDir::new();
    let certificates = block("openssl req -x509").replace("DNS:$host.local", "DNS:localhost");
    shell(&place.path(""), &certificates);
    for (name, mark) in [("robot.json5", "listen: {"), ("cells.json5", "connect: {")] {
        let text = block(mark).replace("localhost:7447", &format!("localhost:{port}"));
        let folder = place.path("").display().to_string();
        let text = ["ca.pem", "robot.key", "robot.pem", "cells.key", "cells.pem"]
            .iter()
            .fold(text, |text, file| text.replace(&format!("\"{file}\""), &format!("\"{folder}{file}\"")));
        place.write(name, &text);
    }
    place
}

fn link(host: &Host, config: &Path) -> Running {
    host.link(&format!("--config {}", config.display()))
}

/// The links of two hosts, with the resources that they need while they run.
struct Secured {
    links: [Running; 2],
    _hosts: [Host; 2],
    _place: TestDir,
}

/// Starts a robot with the guide's configuration, and another host with a changed one.
fn robot_and(change: impl FnOnce(&TestDir, String) -> String) -> Secured {
    let place = secured(port());
    let (robot, other) = (Host::new("robot", None), Host::new("cells", None));
    let robot_link = link(&robot, &place.path("robot.json5"));
    let text = change(&place, place.read("cells.json5"));
    let path = place.write("other.json5", &text);
    let other_link = link(&other, &path);
    Secured { links: [robot_link, other_link], _hosts: [robot, other], _place: place }
}

/// Checks that the two hosts do not connect.
fn is_refused(secured: Secured) {
    for link in secured.links {
        assert!(!link.stderr().contains("has joined"), "{}", link.stderr());
        let report = ended_link(link);
        assert_eq!(report["hosts"], serde_json::json!({}), "{report:#}");
    }
}

#[test]
#[ignore = "tests/hosts runs it"]
fn the_certificates_of_the_guide_are_taken() {
    let secured = robot_and(|_, text| text);
    secured.links[0].wait_for_stderr("host 'cells' has joined");
    secured.links[1].wait_for_stderr("host 'robot' has joined");
    secured.links.into_iter().for_each(|link| _ = ended_link(link));
}

/// Returns the TCP ports at which a process listens, according to the kernel.
fn listening_ports(process: &Running) -> Vec<u16> {
    let pid = process.pid().as_raw_nonzero();
    let files = fs::read_dir(format!("/proc/{pid}/fd")).unwrap().map(|file| file.unwrap().path());
    let sockets: Vec<_> = files.filter_map(|path| fs::read_link(path).ok()).collect();
    let owns =
        |inode: &str| sockets.iter().any(|socket| socket.as_os_str() == format!("socket:[{inode}]").as_str());
    let mut ports = Vec::new();
    for table in ["tcp", "tcp6"] {
        let text = fs::read_to_string(format!("/proc/{pid}/net/{table}")).unwrap();
        for line in text.lines().skip(1) {
            let columns: Vec<_> = line.split_whitespace().collect();
            // 0A: LISTEN.
            if columns[3] == "0A" && owns(columns[9]) {
                let (_, port) = columns[1].rsplit_once(':').unwrap();
                ports.push(u16::from_str_radix(port, 16).unwrap());
            }
        }
    }
    ports
}

#[test]
#[ignore = "tests/hosts runs it"]
fn the_files_of_the_guide_open_one_port_with_tls() {
    // Even without the line that disables listening, the host of the cells does not listen.
    let changes: [fn(String) -> String; 2] =
        [|text| text, |text| text.replace("  listen: { endpoints: [] },\n", "")];
    for change in changes {
        let secured = robot_and(|_, text| change(text));
        secured.links[0].wait_for_stderr("host 'cells' has joined");
        secured.links[1].wait_for_stderr("host 'robot' has joined");
        let [robot, cells] = &secured.links;
        let [port] = listening_ports(robot)[..] else { panic!("{:?}", listening_ports(robot)) };
        assert_eq!(listening_ports(cells), Vec::<u16>::new());
        let refused = Host::new("intruder", None).link(&format!("--connect tcp/127.0.0.1:{port}"));
        refused.wait_for_stderr("cannot connect to tcp/127.0.0.1");
        assert!(!robot.stderr().contains("intruder"), "{}", robot.stderr());
        _ = ended_link(refused);
        secured.links.into_iter().for_each(|link| _ = ended_link(link));
    }
}

#[test]
#[ignore = "tests/hosts runs it"]
fn a_listener_without_tls_beside_the_files_of_the_guide_is_refused() {
    let place = secured(port());
    let host = Host::new("cells", None);
    let config = place.path("cells.json5");
    for option in ["--listen tcp/127.0.0.1:0", "--connect tcp/127.0.0.1:1 --listen tls/127.0.0.1:0"] {
        let words = format!("link vcan0 --bus-kind embedded --config {} {option}", config.display());
        let refusal = host.start(&link_program(), &words).end();
        assert!(refusal.refusal(2).contains("does not use TLS, but tls/"), "{refusal:#?}");
    }
}

#[test]
#[ignore = "tests/hosts runs it"]
fn a_certificate_of_another_authority_is_refused_and_said_on_both_sides() {
    let secured = robot_and(|place, text| {
        let folder = place.path("").join("others");
        fs::create_dir(&folder).unwrap();
        shell(&folder, &block("openssl req -x509"));
        let (mine, others) = (place.path("cells."), folder.join("cells."));
        text.replace(&mine.display().to_string(), &others.display().to_string())
    });
    secured.links[0].wait_for_stderr("vcan0: ");
    secured.links[1].wait_for_stderr("cannot connect to tls/localhost");
    is_refused(secured);
}

#[test]
#[ignore = "tests/hosts runs it"]
fn no_certificate_is_refused_and_said_on_both_sides() {
    let secured = robot_and(|_, text| {
        let without =
            |line: &&str| !line.contains("connect_private_key") && !line.contains("connect_certificate");
        let text: Vec<_> = text.lines().filter(without).collect();
        text.join("\n").replace("enable_mtls: true", "enable_mtls: false")
    });
    secured.links[0].wait_for_stderr("vcan0: ");
    secured.links[1].wait_for_stderr("cannot connect to tls/localhost");
    is_refused(secured);
}

#[test]
#[ignore = "tests/hosts runs it"]
fn an_endpoint_that_is_not_in_the_certificate_is_refused_and_said_on_both_sides() {
    let secured = robot_and(|_, text| text.replace("tls/localhost", "tls/127.0.0.1"));
    secured.links[0].wait_for_stderr("vcan0: ");
    secured.links[1].wait_for_stderr("cannot connect to tls/127.0.0.1");
    is_refused(secured);
}

#[test]
#[ignore = "tests/hosts runs it"]
fn a_host_that_access_control_does_not_name_is_not_heard() {
    let secured = robot_and(|place, text| {
        shell(
            &place.path(""),
            &block("openssl req -x509")
                .lines()
                .filter(|line| !line.contains("-x509 "))
                .collect::<Vec<_>>()
                .join("\n")
                .replace("robot cells", "intruder")
                .replace("DNS:$host.local", "DNS:localhost"),
        );
        text.replace("cells.key", "intruder.key").replace("cells.pem", "intruder.pem")
    });
    // It is connected and learns of no other host, so there is no event to wait for. A named host joins in less than a
    // second.
    thread::sleep(Duration::from_secs(3));
    let said = secured.links[1].stderr();
    assert!(!said.contains("cannot connect"), "its certificate is a good one: {said}");
    is_refused(secured);
}

#[test]
#[ignore = "tests/hosts runs it"]
fn a_configuration_that_is_none_is_one_line() {
    let host = Host::new("robot", None);
    for (text, says) in [
        ("{", "other.json5: "),
        ("{ listen: { endpoints: [\"tls/localhost:1\"] } }", "other.json5: Cannot create"),
    ] {
        let path = host.place.write("other.json5", text);
        let words = format!("link vcan0 --bus-kind embedded --config {}", path.display());
        let ended = host.start(&link_program(), &words).end();
        assert!(ended.refusal(1).contains(says), "{ended:#?}");
    }
}
