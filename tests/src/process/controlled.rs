//! A run that a test controls by commands on its standard input.

use std::io::{BufRead, BufReader, Read, Write};
use std::process::{Child, ChildStdin, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::{Duration, Instant};

use rustix::process::Pid;
use serde_json::Value;

use super::{TIMEOUT, TestDir};

/// A run with `--control`; it is ended when this value is dropped.
pub struct ControlledRun {
    child: Child,
    input: Option<ChildStdin>,
    events: Receiver<Value>,
    /// The events so far.
    pub seen: Vec<Value>,
}

impl TestDir {
    /// Starts a run of `skin.toml` with `--control`, and waits for its first event.
    pub fn controlled_run(&self, more: &str) -> ControlledRun {
        let mut run = self.starting_controlled_run(more);
        run.wait_for("ready", |_| true);
        run
    }

    /// Starts a run of `skin.toml` with `--control`.
    pub fn starting_controlled_run(&self, more: &str) -> ControlledRun {
        let words = format!("run skin.toml --bus-kind {} --control --quiet {more}", self.kind());
        let mut command = self.command("skinbus", &words);
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let (sender, events) = channel();
        let output = BufReader::new(child.stdout.take().unwrap());
        thread::spawn(move || {
            for line in output.lines() {
                let line = line.unwrap();
                let event = serde_json::from_str(&line).unwrap_or_else(|error| panic!("{error}: {line}"));
                if sender.send(event).is_err() {
                    return;
                }
            }
        });
        ControlledRun { input: child.stdin.take(), child, events, seen: Vec::new() }
    }
}

impl ControlledRun {
    pub fn pid(&self) -> Pid {
        Pid::from_child(&self.child)
    }

    /// Sends a command, or any other value.
    pub fn send(&mut self, command: &Value) {
        self.send_text(&format!("{command}\n"));
    }

    /// Sends a text, which may be several lines or a part of one.
    pub fn send_text(&mut self, text: &str) {
        self.input.as_mut().unwrap().write_all(text.as_bytes()).unwrap();
    }

    /// Waits for the next event of this name that meets a condition, and returns it.
    pub fn wait_for(&mut self, name: &str, meets: impl Fn(&Value) -> bool) -> Value {
        let until = Instant::now() + TIMEOUT;
        loop {
            let left = until.saturating_duration_since(Instant::now());
            let event = self.events.recv_timeout(left);
            let event =
                event.unwrap_or_else(|error| panic!("no event {name}: {error}; {:#?}", self.last_events()));
            self.seen.push(event.clone());
            if event["event"] == name && meets(&event) {
                return event;
            }
        }
    }

    /// Waits for the outcome of the press or release with this id, and returns it.
    pub fn outcome(&mut self, id: u64) -> Value {
        let of = |event: &Value| {
            event["id"] == id && (event["event"] == "confirmed" || event["event"] == "unconfirmed")
        };
        if let Some(event) = self.seen.iter().find(|event| of(event)) {
            return event.clone();
        }
        let until = Instant::now() + TIMEOUT;
        loop {
            let left = until.saturating_duration_since(Instant::now());
            let event = self.events.recv_timeout(left);
            let event = event
                .unwrap_or_else(|error| panic!("no outcome of {id}: {error}; {:#?}", self.last_events()));
            self.seen.push(event.clone());
            if of(&event) {
                return event;
            }
        }
    }

    fn last_events(&self) -> Vec<&Value> {
        self.seen.iter().rev().take(20).collect()
    }

    /// Ends the input, waits for the end, and returns the last event, the exit status and standard error.
    pub fn end(mut self) -> (Value, ExitStatus, String) {
        self.input = None;
        let last = self.wait_for("ended", |_| true);
        assert!(self.events.recv_timeout(Duration::from_secs(5)).is_err(), "an event after the last one");
        let mut stderr = String::new();
        self.child.stderr.take().unwrap().read_to_string(&mut stderr).unwrap();
        (last, self.child.wait().unwrap(), stderr)
    }
}

impl Drop for ControlledRun {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
