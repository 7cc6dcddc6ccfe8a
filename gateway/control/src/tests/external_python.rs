//! Test in which the Python example of an external controller closes the loop over the real socket.
#![allow(clippy::unwrap_used, reason = "a test may stop")]

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use crate::controller::{Controller, ControllerInput, ControllerOutput};
use crate::external::ExternalController;
use protocol::packet::pad_with_defaults;
use protocol::skin::Skin;
use protocol::time::Micros;

/// A process that is killed at the end of the test.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn the_example_in_python_makes_the_arm_give_way() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("controller.sock");
    let skin = Skin::parse("ur5-253.toml", include_str!("../../../examples/ur5-253.toml")).unwrap();
    let mut gateway = ExternalController::listen(&path, &skin).unwrap();
    let example = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/external_controller.py");
    let python = Command::new("python3").arg(example).arg(&path).stdout(Stdio::piped()).spawn();
    let mut python = Running(python.expect("python3 is needed: apt install python3"));
    let torque = [2.0, -1.0, 0.5, 0.0, 0.0, 0.0];
    let target = ControllerOutput::Move(pad_with_defaults(&[0.5, -0.25, 0.125, 0.0, 0.0, 0.0]));
    let (start, mut tick, mut answers) = (Instant::now(), 0, 0);
    let mut report = BufReader::new(python.0.stdout.take().unwrap());
    let report = thread::spawn(move || {
        let mut line = String::new();
        report.read_line(&mut line).map(|_| line)
    });
    // Until Python reports, after one second of its own.
    while answers < 100 || !report.is_finished() {
        assert!(start.elapsed() < Duration::from_secs(60), "{answers} answers, and no report from python3");
        let time = Micros(u64::try_from(start.elapsed().as_micros()).unwrap());
        let input = ControllerInput {
            tick,
            time,
            torque: pad_with_defaults(&torque),
            contributing: 3,
            valid: true,
            ..ControllerInput::default()
        };
        tick += 1;
        if let ControllerOutput::Move(velocity) = gateway.step(&input) {
            assert_eq!(ControllerOutput::Move(velocity), target);
            answers += 1;
        }
        thread::yield_now();
    }
    let counts = gateway.named_counters();
    assert!(counts.iter().all(|(name, count)| !name.starts_with("nonsense") || *count == 0), "{counts:?}");
    let report = report.join().unwrap().unwrap();
    assert!(report.contains("3 cells") && report.contains("torque +2.00 -1.00 +0.50"), "{report}");
}
