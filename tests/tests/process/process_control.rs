//! A program controls a run by commands on standard input, and reads events from standard output.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use std::collections::BTreeMap;
use std::io::Write;
use std::process::Stdio;

use model::generate::{ReplyMode, SkinRequest, generate};
use serde_json::{Value, json};
use skinbus_tests::process::{TestDir, until};

fn reason(outcome: &Value) -> &str {
    assert_eq!(outcome["event"], "unconfirmed", "{outcome}");
    outcome["reason"].as_str().unwrap()
}

#[test]
fn presses_are_confirmed_in_the_epoch_where_the_recording_has_them_first() {
    let place = TestDir::new();
    place.skin(8);
    let mut run = place.controlled_run("--candump run.log");
    let mut asked = BTreeMap::new();
    for id in 0..60_u64 {
        let (cell, force_n) =
            (1 + id * 5 % 8, if id % 9 == 8 { 0.02 } else { 0.5 + 0.25 * (id % 13) as f64 });
        let released = id % 3 == 2;
        let force_n = if released { 0.0 } else { force_n };
        match (released, id) {
            (_, 20) => run.send(&json!({"do": "kill", "cell": cell})),
            (_, 33) => run.send(&json!({"do": "restart", "cell": 1 + 20 * 5 % 8})),
            (_, _) => {}
        }
        if released {
            run.send(&json!({"do": "release", "cell": cell, "id": id}));
        } else {
            run.send(&json!({"do": "press", "cell": cell, "force_n": force_n, "id": id}));
        }
        let accepted = run.wait_for("accepted", |event| event["id"] == id);
        asked.insert(id, (cell, accepted["epoch"].as_u64().unwrap(), accepted["force_n"].as_f64().unwrap()));
        if id % 7 == 0 {
            run.outcome(id);
        }
    }
    let outcomes: Vec<_> = asked.keys().copied().map(|id| run.outcome(id)).collect();
    let (last, status, _) = run.end();
    assert_eq!((last["code"].as_u64(), status.code()), (Some(0), Some(0)), "{last}");
    place.is_left_clean();

    let dumped = place.start("skinbus", "dump run.log --json --kind torque").end().succeeded();
    let torques: Vec<Value> = dumped.stdout.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let mut confirmed = 0;
    for (outcome, (cell, epoch, force_n)) in outcomes.iter().zip(asked.values()) {
        if outcome["event"] == "unconfirmed" {
            let expected: &[&str] = match outcome["id"].as_u64().unwrap() {
                _ if *force_n > 0.0 && *force_n < 0.1 => &["below-threshold"],
                _ if *cell == 1 + 20 * 5 % 8 => {
                    &["dead", "restarted", "not-ready", "not-touched", "superseded", "no-torque", "no-answer"]
                }
                // A cell that had no processor time skips old joints.
                _ => &["not-touched", "superseded", "no-torque", "no-answer"],
            };
            assert!(expected.contains(&reason(outcome)), "{outcome}");
            continue;
        }
        confirmed += 1;
        let at_ns = outcome["at_ns"].as_u64().unwrap();
        // The log has the stamps of another socket.
        let is_near = |torque: &&Value| {
            let stamp_ns = torque["time_ns"].as_u64().unwrap();
            torque["node"] == *cell && stamp_ns.abs_diff(at_ns) < 200_000_000
        };
        let since_asked = |torque: &Value| (torque["epoch"].as_u64().unwrap() + 256 - epoch) % 256;
        let shows =
            |torque: &&Value| since_asked(torque) < 64 && torque["values"]["torque_nm"] == outcome["torque"];
        let first = torques.iter().filter(is_near).find(shows);
        assert_eq!(first.map(|first| &first["epoch"]), Some(&outcome["epoch"]), "{outcome}");
    }
    assert!(confirmed > 20, "{confirmed} of {}: {outcomes:#?}", outcomes.len());
}

#[test]
fn an_unconfirmed_press_has_its_reason() {
    let place = TestDir::new();
    place.skin(8);
    let mut run = place.controlled_run("");
    let mut id = 0;
    let mut outcome = |run: &mut _, cell: u8, force_n: f64| {
        id += 1;
        let run: &mut skinbus_tests::process::controlled::ControlledRun = run;
        run.send(&json!({"do": "press", "cell": cell, "force_n": force_n, "id": id}));
        run.outcome(id)
    };
    assert_eq!(outcome(&mut run, 2, 3.0)["event"], "confirmed");
    assert_eq!(outcome(&mut run, 2, 3.0)["event"], "confirmed", "the same force again");
    assert_eq!(reason(&outcome(&mut run, 3, 0.01)), "below-threshold");
    assert_eq!(reason(&outcome(&mut run, 4, 0.0)), "not-touched");
    run.send(&json!({"do": "stop", "cell": 5}));
    assert_eq!(reason(&outcome(&mut run, 5, 1.0)), "dead");
    run.send(&json!({"do": "continue", "cell": 5}));
    run.wait_for("cell", |event| event["cell"] == "vcan0:5" && event["state"] == "alive");
    assert_eq!(outcome(&mut run, 5, 2.0)["event"], "confirmed");
    run.send(&json!({"do": "restart", "cell": 5}));
    assert_eq!(reason(&outcome(&mut run, 5, 1.0)), "restarted");
    run.send(&json!({"do": "halt"}));
    assert_eq!(reason(&outcome(&mut run, 6, 1.0)), "halted");
    assert_eq!(run.seen.iter().filter(|event| event["event"] == "halted").count(), 1);
    run.send(&json!({"do": "resume"}));
    run.wait_for("resumed", |_| true);
    run.send(&json!({"do": "bus", "bus": "vcan0", "down": true}));
    run.wait_for("bus", |event| event["up"] == false);
    run.send(&json!({"do": "press", "cell": 6, "force_n": 1, "id": 99}));
    let error = run.wait_for("error", |event| event["id"] == 99);
    assert_eq!(error["text"], "cell vcan0:6: no joints come on vcan0: wait for the bus, or bring it up");
    let (last, status, stderr) = run.end();
    // The loop halts the robot while its only bus is down.
    assert_eq!((last["code"].as_u64(), status.code()), (Some(3), Some(3)), "{stderr}");
    assert!(last["text"].as_str().unwrap().starts_with("the robot was halted at "), "{last}");
    place.is_left_clean();
}

#[test]
fn the_torques_of_cells_that_sum_are_not_told_apart() {
    let place = TestDir::new();
    place.write(
        "skin.toml",
        &generate(&SkinRequest { cells: 6, reply: ReplyMode::Sum, ..SkinRequest::default() }).unwrap(),
    );
    let mut run = place.controlled_run("");
    run.send(&json!({"do": "press", "cell": 2, "force_n": 3, "id": 1}));
    assert_eq!(reason(&run.outcome(1)), "sums");
    run.send(&json!({"do": "link", "cells": [1, 2], "down": true, "id": 2}));
    run.wait_for("accepted", |event| event["id"] == 2);
    assert_eq!(run.end().1.code(), Some(0));
}

#[test]
fn lines_that_are_not_commands_are_answered_once_and_the_others_work() {
    let place = TestDir::new();
    place.skin(3);
    let mut run = place.controlled_run("--duration 60");
    run.send_text("garbage\n[1]\n\n{\"do\":\"fly\",\"id\":1}\n");
    run.send_text(&format!("{{\"do\":\"{}\"}}\n", "x".repeat(10_000)));
    run.send_text("{\"do\":\"press\",\"cell\":2,");
    run.send_text("\"force_n\":2,\"id\":2}\n\u{fffd}\n");
    for wrong in [
        json!({"do": "press", "cell": 9, "force_n": 1, "id": 3}),
        json!({"do": "press", "cell": "vcan7:1", "force_n": 1, "id": 4}),
        json!({"do": "press", "cell": 1, "force_n": 1e9, "id": 5}),
        json!({"do": "bus", "bus": "can9", "down": true, "id": 6}),
        json!({"do": "continue", "cell": 1, "id": 7}),
        json!({"do": "link", "cells": [1, 2], "down": true, "id": 8}),
    ] {
        run.send(&wrong);
    }
    run.send(&json!({"do": "report", "id": 9}));
    let report = run.wait_for("report", |_| true);
    assert_eq!(
        (report["id"].as_u64(), report["buses"][0]["up"].as_bool()),
        (Some(9), Some(true)),
        "{report}"
    );
    assert_eq!(run.outcome(2)["event"], "confirmed");
    let errors: Vec<_> = run.seen.iter().filter(|event| event["event"] == "error").collect();
    let ids: Vec<_> = errors.iter().map(|event| event["id"].as_u64()).collect();
    let expected = [None, None, Some(1), None, None, Some(3), Some(4), Some(5), Some(6), Some(7), Some(8)];
    assert_eq!(ids, expected, "{errors:#?}");
    assert_eq!(errors[9]["text"], "continue cell 1 on vcan0: the process is running");
    run.send(&json!({"do": "end", "id": 10}));
    run.wait_for("accepted", |event| event["id"] == 10);
    let (last, status, stderr) = run.end();
    assert_eq!((last["summary"]["outcome"].as_str(), status.code()), (Some("done"), Some(0)), "{stderr}");
    assert!(last["summary"]["duration_s"].as_f64().unwrap() < 30.0);
    place.is_left_clean();
}

#[test]
fn epochs_are_reported_on_request_and_their_torques_agree() {
    let place = TestDir::new();
    place.skin(8);
    let mut run = place.controlled_run("");
    run.send(&json!({"do": "press", "cell": 2, "force_n": 5, "id": 1}));
    run.outcome(1);
    run.send(&json!({"do": "epochs", "every": 4}));
    let first = run.wait_for("epoch", |_| true);
    let second = run.wait_for("epoch", |_| true);
    let number = |event: &Value| event["number"].as_u64().unwrap();
    assert_eq!((number(&first) % 4, number(&second) % 4), (0, 0));
    assert!(number(&second) > number(&first));
    for kind in ["positions", "distributed", "central"] {
        assert_eq!(second[kind].as_array().unwrap().len(), 6, "{second}");
    }
    let torque = |kind: &str| second[kind][0].as_f64().unwrap();
    assert!(
        torque("central").abs() > 0.1 && (torque("central") - torque("distributed")).abs() < 2e-3,
        "{second}"
    );
    assert_eq!(run.end().1.code(), Some(0));
}

#[test]
fn a_run_whose_program_has_gone_ends_and_leaves_nothing() {
    let place = TestDir::new();
    place.skin(3);
    // The input ends before the loop runs.
    let (last, status, stderr) = place.starting_controlled_run("--verbose").end();
    assert!(stderr.lines().filter(|line| line.starts_with('│')).count() > 5, "{stderr}");
    assert_eq!((last["code"].as_u64(), status.code()), (Some(0), Some(0)));
    place.is_left_clean();

    // The program reads nothing and closes its end, as one that was killed.
    let mut command = place.command("skinbus", "run skin.toml --bus-kind embedded --control --quiet");
    let mut child =
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    drop(child.stdout.take());
    let mut input = child.stdin.take().unwrap();
    for _ in 0..100 {
        input.write_all(b"{\"do\":\"press\",\"cell\":1,\"force_n\":1}\n").unwrap();
    }
    drop(input);
    let status = until("the end of the run", || child.try_wait().unwrap());
    assert_eq!(status.code(), Some(1), "its last event was not read");
    place.is_left_clean();
}

#[test]
fn a_run_that_cannot_start_says_why() {
    let place = TestDir::new();
    place.skin(3);
    let refused = place.start("skinbus", "run skin.toml --control --summary -").end();
    let expected = "skinbus: --summary -: with --control, standard output has only events: name a file";
    assert_eq!(refused.refusal(2), expected);
    let server = place.start("vcan-setup", "serve vcan0");
    server.wait_for_stdout("serving vcan0 at ");
    let (last, status, stderr) = place.starting_controlled_run("--no-spawn").end();
    assert_eq!(last["code"].as_i64(), status.code().map(i64::from));
    assert_eq!(stderr, format!("skinbus: {}\n", last["text"].as_str().unwrap()));
    assert_ne!(status.code(), Some(0));
}
