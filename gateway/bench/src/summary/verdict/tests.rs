//! Verdicts and their order.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use std::collections::BTreeSet;

use super::*;
use crate::summary::{
    CellError, ErrorCells, HaltSummary, HostSummary, NetworkSummary, OutagesSummary, SumsSummary,
    UplinkSummary,
};
use model::table::{Contributions, TorqueErrors};
use trace::recording::account::{RecordingAccount, WrittenFile};

/// A run of 253 cells that is well.
fn well() -> Summary {
    let replies = RepliesSummary { due: 17_772, in_time: 17_772, ..RepliesSummary::default() };
    let cell = |node| CellSummary {
        node,
        bus: "vcan0".to_owned(),
        mode: Some("test"),
        error: [6.2e-5].into_iter().collect(),
        ..CellSummary::default()
    };
    let bus = BusSummary {
        name: "vcan0".to_owned(),
        kind: "embedded".to_owned(),
        replies,
        epochs_due: 575,
        epochs_complete: 575,
        ..BusSummary::default()
    };
    let mut summary =
        Summary { cells: (1..=253).map(cell).collect(), buses: vec![bus], ..Summary::default() };
    summary.accuracy.single = [6.2e-5].into_iter().collect();
    summary
}

/// A run of one bus that answers with sums and is well.
fn well_in_sums() -> Summary {
    let mut summary = well();
    let contributions = Contributions { due: 900, in_time: 900, ..Contributions::default() };
    summary.buses[0].replies = RepliesSummary::default();
    summary.buses[0].sums = Some(SumsSummary { roots: 1, contributions, ..SumsSummary::default() });
    summary.buses[0].network = Some(NetworkSummary { tree_ready_s: Some(0.4), ..NetworkSummary::default() });
    summary.accuracy.single = TorqueErrors::default();
    summary.accuracy.sums = [0.0035].into_iter().collect();
    summary
}

fn look_at(change: impl FnOnce(&mut Summary)) -> Vec<String> {
    let mut summary = well();
    change(&mut summary);
    let verdict = Verdict::new(&summary);
    assert_eq!(verdict.well, verdict.look_at.is_empty());
    verdict.look_at
}

#[test]
fn a_run_without_any_fault_is_well() {
    assert_eq!(Verdict::new(&well()), Verdict { well: true, look_at: Vec::new() });
    let sums = "253 cells, 575 of 575 epochs complete, 17772 replies in time, mean error 6.2e-5 Nm";
    assert_eq!(well().totals_line(), sums);
    assert!(Verdict::new(&Summary { outcome: Outcome::Interrupted, ..well() }).well);

    assert!(Verdict::new(&well_in_sums()).well);
    let sums =
        "253 cells, 575 of 575 epochs complete, 900 contributions to sums in time, mean error 3.5e-3 Nm";
    assert_eq!(well_in_sums().totals_line(), sums);

    let mut two = well();
    two.buses.push(BusSummary {
        name: "vcan1".to_owned(),
        epochs_due: 1,
        epochs_complete: 1,
        ..two.buses[0].clone()
    });
    assert!(
        two.totals_line().contains("576 of 576 epochs complete on 2 buses, 35544 replies"),
        "{}",
        two.totals_line()
    );
}

#[test]
fn nothing_is_well_that_is_not_known() {
    assert!(!Verdict::default().well);
    assert!(!Summary::default().with_verdict(None).verdict.well, "of a run without a bus");
    for outcome in Outcome::ALL {
        let verdict = Verdict::new(&Summary { outcome, ..well() });
        assert_eq!(verdict.well, outcome.exit_code() == 0, "{outcome}: {verdict:?}");
    }
    let untouched = look_at(|it| {
        it.buses[0].replies = RepliesSummary::default();
        it.accuracy.single = TorqueErrors::default();
    });
    assert_eq!(
        untouched,
        ["no torque was due, because no cell was in contact: use --scenario FILE to touch cells"]
    );
    let distributed = look_at(|it| it.accuracy.single = TorqueErrors::default());
    assert!(
        distributed[0].starts_with("no torque was compared with the central computation"),
        "{distributed:?}"
    );
    let no_figures = look_at(|it| it.cells[2].bus = "vcan1".to_owned());
    assert_eq!(no_figures, ["cell 3 on vcan1: the run has no results of this bus"]);
    let nan = look_at(|it| it.accuracy.single = [f64::NAN].into_iter().collect());
    assert!(nan[0].starts_with("the mean error of the cells' torques is NaN"), "{nan:?}");
}

/// The beginning of the expected finding, and the change of a good run that causes it.
type Case = (&'static str, fn(&mut Summary));

/// All findings with their causes, the most important first.
const CASES: &[Case] = &[
    ("the run failed: no memory", |it| it.failure = Some("no memory".to_owned())),
    ("the robot was halted at 1.500 s and not resumed: a halt frame", |it| {
        it.halted = Some("a halt frame".to_owned());
        it.halts.push(halt(1.5, None));
    }),
    ("no external controller sent a hello", |it| {
        it.no_controller = Some("no external controller sent a hello".to_owned());
    }),
    ("2 cells ended with errors: 7, 8 on vcan0 (no memory)", |it| {
        let cells = vec![ErrorCells { bus: "vcan0".to_owned(), nodes: vec![7, 8] }];
        it.cell_errors.push(CellError { reason: "no memory".to_owned(), cells });
    }),
    ("vcan0 was lost 2 times for 1.2 s in total, also at the end: ", |it| {
        it.buses[0].outages = OutagesSummary { times: 2, lost_s: 1.2, at_end: true, ticks: 600 };
    }),
    ("cells 1-3, 9 on vcan0: stopped sending, or never sent", |it| {
        it.buses[0].silent_cells = vec![1, 2, 3, 9]
    }),
    ("host cells: unreachable once for 0.5 s in total, unreachable at the end, 1 frame lost; ", |it| {
        let name = "cells".to_owned();
        it.buses[0].hosts.push(HostSummary {
            name,
            gone: 1,
            gone_s: 0.5,
            lost_to: 1,
            ..HostSummary::default()
        });
    }),
    ("12 replies missing on vcan0 for no known reason (unknown): ", |it| {
        it.buses[0].replies.in_time -= 12;
        it.buses[0].replies.unknown = 12;
    }),
    ("1 packet of cells on vcan0 lost for no known reason (unknown): ", |it| {
        it.buses[0].uplink.unknown = 1;
    }),
    ("5 of 900 contributions to sums were missing on vcan0: ", |it| {
        let contributions = Contributions { due: 900, in_time: 895, missing: 5, ..Contributions::default() };
        it.buses[0].sums = Some(SumsSummary { contributions, ..SumsSummary::default() });
    }),
    ("cell 4 on vcan0: no route to the gateway at the end", |it| network(it).unreachable = vec![4]),
    ("vcan0 differs from the skin: cell 2 has no wire", |it| {
        network(it).differences.push("cell 2 has no wire".to_owned());
    }),
    ("cell 5 on vcan0: mean error above 9.8e-4 Nm", |it| it.cells[4].error = [2e-3].into_iter().collect()),
    ("the mean error of the cells' torques is 2.0e-3 Nm, but ", |it| {
        it.accuracy.single = [2e-3].into_iter().collect()
    }),
    ("the mean error of the sums is 2.9e-2 Nm, but ", |it| it.accuracy.sums = [0.029].into_iter().collect()),
    ("3 torques saturated: ", |it| count(it, "saturated", 3)),
    ("cell 6 on vcan0: stuck", |it| _ = it.cells[5].stuck.insert("torque", 40)),
    ("4 torques on vcan0 not compared", |it| it.buses[0].replies.unexpected = 4),
    ("cells 7, 9 on vcan0: restarted", |it| [6, 8].into_iter().for_each(|at| it.cells[at].restarts = 1)),
    ("the robot was halted once and resumed; the reason for the first halt: a halt frame", |it| {
        it.halts.insert(0, halt(0.5, Some(0.6)));
    }),
    ("the recording is incomplete: it lacks 2 frames and 1 other message, ", |it| {
        let messages_lost = [("ticks", 1)].into();
        it.recording =
            Some(RecordingAccount { lost: 2, lost_queue: 2, messages_lost, ..RecordingAccount::default() });
    }),
    ("replies missing on vcan0: 3 lost on the way to the gateway, 1 uncertain", |it| {
        it.buses[0].replies.in_time -= 4;
        (it.buses[0].replies.lost, it.buses[0].replies.in_doubt) = (3, 1);
    }),
    ("packets from cells on vcan0: 4 dropped by the bus, ", |it| {
        it.buses[0].uplink.dropped = 4;
        it.buses[0].dropped_by_bus = 4;
    }),
    ("cell 10 on vcan0: contact unknown", |it| it.cells[9].contact_unknown = 1),
    ("cell 11 on vcan0: in mode \"measure\"", |it| it.cells[10].mode = Some("measure")),
    ("2 bad control cycles, mostly because the torque is not valid", |it| {
        _ = it.control.bad_cycles.insert("the torque is not valid".to_owned(), 2);
    }),
    ("the gateway could not send 3 frames, ", |it| it.control.unsent = 3),
    (
        "17772 replies due on vcan0: 9 late, 2 skipped, because joints messages reached the cells late; ",
        |it| {
            let replies = &mut it.buses[0].replies;
            replies.in_time -= 11;
            (replies.late, replies.too_late, replies.skipped) = (8, 1, 2);
        },
    ),
    (
        "the control loop skipped 8 of 1008 ticks, 1 of them with a joints message: this machine was busy \
         (SCHED_FIFO was refused)",
        |it| {
            (it.control.ticks, it.control.ticks_skipped, it.control.broadcasts_skipped) = (1_000, 8, 1);
        },
    ),
    ("anomalies on vcan0: 2 wrong CRC", |it| count(it, "wrong CRC", 2)),
];

fn halt(at_s: f64, until_s: Option<f64>) -> HaltSummary {
    HaltSummary { at_s, tick: 1, epoch: 1, reason: "a halt frame".to_owned(), until_s }
}

fn network(summary: &mut Summary) -> &mut NetworkSummary {
    let some = || NetworkSummary { tree_ready_s: Some(0.4), ..NetworkSummary::default() };
    summary.buses[0].network.get_or_insert_with(some)
}

fn count(summary: &mut Summary, name: &'static str, count: u64) {
    summary.buses[0].events.insert(name, count);
}

#[test]
fn each_fault_alone_is_what_to_look_at() {
    for (begin, change) in CASES {
        let found = look_at(change);
        let [one] = found.as_slice() else { panic!("{begin}: {found:?}") };
        assert!(one.starts_with(begin), "{begin}: {one}");
        assert!(!one.contains('\n') && one.chars().count() < 160, "{one}");
    }
    let begins: BTreeSet<_> = CASES.iter().map(|(begin, _)| begin).collect();
    assert_eq!(begins.len(), CASES.len());
}

#[test]
fn the_most_important_fault_comes_first() {
    for (at, (begin, change)) in CASES.iter().enumerate() {
        for (after, later) in CASES.iter().skip(at + 1) {
            let found = look_at(|it| {
                later(it);
                change(it);
            });
            let place = |begin: &str| found.iter().position(|one| one.starts_with(begin));
            let [first, second] = [begin, after].map(|begin| place(begin));
            // A failed run already names the reason of an incomplete recording.
            let is_named = second.is_some() || after.starts_with("the recording is incomplete");
            assert!(first == Some(0) && is_named, "{begin}, {after}: {found:?}");
        }
    }
}

#[test]
fn the_error_of_a_file_says_what_to_do_with_it_and_no_other_hint_does() {
    let failure = |lost_write, errors: &[&str]| {
        let path = "r.mcap.part".to_owned();
        let file = WrittenFile { path, format: "mcap", frames: 0, messages: 0, bytes: 0 };
        let errors = errors.iter().map(|&error| error.to_owned()).collect();
        let recording =
            RecordingAccount { lost_write, errors, files: vec![file], ..RecordingAccount::default() };
        Summary { recording: Some(recording), ..well() }.lost_frames().unwrap()
    };
    let taken = "r.mcap: taken; r.mcap.part is the complete recording: rename it";
    assert_eq!(failure(0, &[taken]), format!("the recording has an error: {taken}"));
    let both = failure(2, &["r.mcap: no room", taken]);
    assert_eq!(
        both,
        format!("the recording is incomplete: 2 frames were not written: r.mcap: no room; {taken}")
    );
    assert!(failure(2, &["r.mcap: no room"]).ends_with("repair it with `skinbus recover r.mcap.part`"));
}

#[test]
fn every_loss_is_looked_at() {
    let losses: [fn(&mut UplinkSummary); 9] = [
        |up| up.unknown = 1,
        |up| up.dropped = 1,
        |up| up.backlog = 1,
        |up| up.outage = 1,
        |up| up.hosts = 1,
        |up| up.rejected = 1,
        |up| up.surplus = 1,
        |up| up.in_doubt = 1,
        |up| up.restarts = 1,
    ];
    for (at, loss) in losses.into_iter().enumerate() {
        assert_eq!(look_at(|it| loss(&mut it.buses[0].uplink)).len(), 1, "{at}");
    }
    let missing: [fn(&mut RepliesSummary); 7] = [
        |replies| replies.late = 1,
        |replies| replies.too_late = 1,
        |replies| replies.skipped = 1,
        |replies| replies.not_heard = 1,
        |replies| replies.lost = 1,
        |replies| replies.in_doubt = 1,
        |replies| replies.unknown = 1,
    ];
    for (at, reason) in missing.into_iter().enumerate() {
        let found = look_at(|it| {
            it.buses[0].replies.in_time -= 1;
            reason(&mut it.buses[0].replies);
        });
        assert_eq!(found.len(), 1, "{at}: {found:?}");
    }
    assert_eq!(look_at(|it| it.buses[0].dropped_by_bus = 1).len(), 1, "of joints, for example");
    assert_eq!(
        look_at(|it| it.buses[0].epochs_complete -= 1),
        ["1 of 575 epochs were not complete on vcan0"]
    );
    assert_eq!(look_at(|it| it.control.records_lost = 1).len(), 1);
    for event in FrameEvent::ALL {
        assert_eq!(look_at(|it| count(it, event.name(), 1)).len(), 1, "{event:?}");
    }
}

#[test]
fn torques_in_sums_are_checked_too() {
    let change = |change: fn(&mut Summary)| {
        let mut summary = well_in_sums();
        change(&mut summary);
        Verdict::new(&summary).look_at
    };
    let late = change(|it| {
        let parts = &mut it.buses[0].sums.as_mut().unwrap().contributions;
        (parts.in_time, parts.late) = (890, 10);
    });
    assert!(
        late.len() == 1 && late[0].starts_with("10 of 900 contributions to sums were late on vcan0"),
        "{late:?}"
    );
    let unasked = change(|it| it.buses[0].sums.as_mut().unwrap().contributions.unasked = 2);
    assert!(unasked.len() == 1 && unasked[0].starts_with("2 torques on vcan0 not compared"), "{unasked:?}");
    let never = change(|it| it.buses[0].network.as_mut().unwrap().tree_ready_s = None);
    assert_eq!(never, ["the tree on vcan0 was not complete when the run began"]);
}

#[test]
fn many_cells_are_counted() {
    let found = look_at(|it| it.buses[0].silent_cells = (1..=60).step_by(2).collect());
    assert!(
        found[0].starts_with("30 cells (1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, ...) on vcan0: "),
        "{found:?}"
    );
    let of_two = look_at(|it| {
        it.buses.push(BusSummary { name: "a".to_owned(), ..BusSummary::default() });
        it.cells[0].bus = "a".to_owned();
        it.cells[0].restarts = 1;
        it.cells[1].restarts = 2;
    });
    assert_eq!(of_two.iter().map(|one| &one[..11]).collect::<Vec<_>>(), ["cell 1 on a", "cell 2 on v"]);
}
