//! Commands as processes, and a sender on their bus, for the tests of commands.

use std::process::Command;
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

use protocol::bus::Bus;
use protocol::can::Frame;
use protocol::id::Id;

/// The exit code and the output of a command.
#[derive(Debug)]
pub struct CommandOutput {
    pub code: i32,
    pub out: String,
    pub err: String,
}

impl CommandOutput {
    /// Runs a command to its end.
    pub fn run(command: &mut Command) -> Self {
        let output = command.output().unwrap();
        let [out, err] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
        Self { code: output.status.code().unwrap(), out, err }
    }
}

/// Calls `act` while frames with these identifiers are sent on a bus continuously.
pub fn while_sending<T>(bus: &Bus, ids: &[Id], act: impl FnOnce() -> T) -> T {
    let frames: Vec<_> = ids.iter().map(|id| Frame::fd(id.to_bits().into(), 1, &[0; 16]).unwrap()).collect();
    std::thread::scope(|scope| {
        // The sender ends when this is dropped, also by a panic; otherwise the scope would wait without end.
        let (_going, over) = channel::<()>();
        scope.spawn(move || {
            loop {
                bus.send(&frames).unwrap();
                if over.recv_timeout(Duration::from_millis(10)) != Err(RecvTimeoutError::Timeout) {
                    break;
                }
            }
        });
        act()
    })
}
