//! The conformance test in virtual time: this project's cell passes, and each faulty cell is detected by the
//! requirement that it breaks.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::wildcard_enum_match_arm,
    reason = "a test may stop, and a wrong cell changes one kind of packet"
)]

mod cell;
mod lesser;
mod mutants;
mod wrong;

use cell::{FaultlessCell, Mutant, VirtualBus};
use conformance::Session;
use conformance::findings::{Finding, RequirementFilter, Verdict};
use conformance::survey::Survey;
use protocol::can::{Format, Frame};
use protocol::id::CellId;
use protocol::packet::Packet;
use protocol::time::Span;

/// Returns the findings on a cell and the failed requirements.
fn test(
    bus: &mut VirtualBus,
    format: Format,
    number: u8,
    only: &RequirementFilter,
) -> (Vec<Finding>, Vec<&'static str>) {
    let cell = CellId::new(number.into()).unwrap();
    let survey = Survey::listen(bus, "vcan0").unwrap();
    assert_eq!(survey.check_cell(cell, "vcan0", None, false), Ok(format));
    let mut session = Session::new(bus, "vcan0", cell, format, Span::from_millis(80_000));
    let saved = session.save().unwrap();
    let stopped = conformance::run(&mut session, only).err();
    if let Ok(saved) = &saved {
        let _ = session.restore(saved);
    }
    let failed = session.findings.failed_requirements();
    (session.findings.requested_findings(only, stopped.as_ref()), failed)
}

fn failures(findings: &[Finding]) -> String {
    let of = |it: &Finding| match &it.verdict {
        Verdict::Failed { what, frames, .. } => {
            Some(format!("{}: {what}\n  {}", it.requirement.id, frames.join("\n  ")))
        }
        _ => None,
    };
    findings.iter().filter_map(of).collect::<Vec<_>>().join("\n")
}

#[test]
fn this_projects_cell_passes() {
    for (format, number) in [(Format::Fd, 12), (Format::Classic, 12), (Format::Fd, 254), (Format::Classic, 1)]
    {
        let mut bus = VirtualBus::new(format, number, Box::new(FaultlessCell) as Box<dyn Mutant>);
        let (findings, failed) = test(&mut bus, format, number, &RequirementFilter::default());
        assert_eq!(failed, [""; 0], "{format:?}\n{}", failures(&findings));
        let untested: Vec<_> = findings
            .iter()
            .filter(|it| matches!(it.verdict, Verdict::NotTested { .. }))
            .map(|it| it.requirement.id)
            .collect();
        assert_eq!(untested, [""; 0], "SEND-1 and all others are tested");
    }
}

#[test]
fn without_a_restart_what_shows_only_at_a_start_is_not_tested() {
    let mut bus = VirtualBus::new(Format::Fd, 7, Box::new(FaultlessCell)).without_restart();
    let (findings, failed) = test(&mut bus, Format::Fd, 7, &RequirementFilter::default());
    assert_eq!(failed, [""; 0], "{}", failures(&findings));
    let untested: Vec<_> = findings
        .iter()
        .filter(|it| {
            let expected = "the test needs the option --restart COMMAND";
            matches!(&it.verdict, Verdict::NotTested { why } if why == expected)
        })
        .map(|it| it.requirement.id)
        .collect();
    assert_eq!(untested, ["ID-3", "CLAIM-1", "CLAIM-2", "CLAIM-3", "CLAIM-4", "CLAIM-5", "CONF-8"]);
}

/// A restart may end the former life of a cell anywhere, also between the segments of an answer; none of its packets
/// count.
#[test]
fn a_right_cell_that_is_cut_off_anywhere_passes() {
    let longest = Span(3_000);
    let only = RequirementFilter::new(&["SEND-1", "CLAIM", "CONF-8", "ID-3"].map(str::to_owned)).unwrap();
    let runs =
        std::env::var("SKINBUS_RESTARTS").map_or(8, |restarts| restarts.parse::<u64>().unwrap().div_ceil(13));
    let (mut restarts, mut torn) = (0, 0);
    for run in 0..runs {
        // The last restart of a run comes while a commit is answered, at another place in each run.
        let first = Span(run * longest.0 / runs);
        let mut bus =
            VirtualBus::new(Format::Classic, 12, Box::new(FaultlessCell)).cut(first, Span(233), longest);
        let (findings, failed) = test(&mut bus, Format::Classic, 12, &only);
        assert_eq!(failed, [""; 0], "run {run} of {runs}\n{}", failures(&findings));
        let (now, torn_now) = bus.restarted();
        (restarts, torn) = (restarts + now, torn + torn_now);
    }
    println!("{restarts} restarts, {torn} of them in the middle of what was sent");
    assert!(
        restarts >= 10 * usize::try_from(runs).unwrap() && torn > 0,
        "{restarts} restarts, {torn} in the middle"
    );
}

/// A cell that waits for a processor skips joints and is late, which is allowed: only requirements on times may fail.
#[test]
fn a_cell_that_waits_for_a_processor_is_not_blamed() {
    let timed = |id: &&str| {
        ["TIME-", "BEAT-", "SENSE-5", "SENSE-6", "CLAIM-"].iter().any(|start| id.starts_with(start))
    };
    for (seed, format) in (1..=6).zip([Format::Fd, Format::Classic].into_iter().cycle()) {
        for is_seen in [true, false] {
            let mut bus = VirtualBus::new(format, 12, Box::new(FaultlessCell)).starved(seed, is_seen);
            let (findings, failed) = test(&mut bus, format, 12, &RequirementFilter::default());
            let failed: Vec<_> = failed.into_iter().filter(|id| !timed(id)).collect();
            assert_eq!(failed, [""; 0], "seed {seed}, {format:?}, {is_seen}\n{}", failures(&findings));
            let passed = findings.iter().filter(|it| matches!(it.verdict, Verdict::Passed { .. })).count();
            assert!(passed > 65, "{passed}");
        }
    }
}

/// Correct cells with less: no options, few abilities, or slow.
#[test]
fn cells_with_less_pass() {
    for (name, lessen) in lesser::ALL {
        for format in [Format::Fd, Format::Classic] {
            let mut lesser = wrong::FaultyCell::new(format, mutants::NODE);
            lessen(&mut lesser);
            // The first of two segments has the first words, which are not changed on the way.
            let measures = lesser.memory.measures;
            if measures && format == Format::Classic {
                continue;
            }
            let mut bus = VirtualBus::new(format, mutants::NODE, Box::new(lesser));
            if measures {
                bus = bus.measuring();
            }
            let (findings, failed) = test(&mut bus, format, mutants::NODE, &RequirementFilter::default());
            assert_eq!(failed, [""; 0], "{name}, {format:?}\n{}", failures(&findings));
        }
    }
}

/// A cell without a single valid packet is detected as present, and its mistake is named.
#[test]
fn a_cell_without_a_single_packet_is_named_with_its_mistake() {
    type Put = fn(&mut wrong::Memory, &Packet, Format) -> Vec<Frame>;
    let all: [(&str, Format, Put); 5] = [
        ("the cell sends the CRC with the high byte first", Format::Fd, |_, packet, format| {
            spoilt(packet, format, |_, crc| crc.swap_bytes())
        }),
        ("the cell computes the CRC without the identifier", Format::Fd, |_, packet, format| {
            spoilt(packet, format, |body, _| protocol::packet::crc16(&body[2..]))
        }),
        (
            "the cell computes the CRC with the high byte of the identifier first",
            Format::Classic,
            |_, packet, format| {
                spoilt(packet, format, |body, _| {
                    protocol::packet::crc16(&[&[body[1], body[0]], &body[2..]].concat())
                })
            },
        ),
        ("the cell sends the segments in the wrong order", Format::Classic, |_, packet, format| {
            packet.frames(format).collect::<Vec<_>>().into_iter().rev().collect()
        }),
        ("docs/reference/protocol.md", Format::Classic, |_, packet, format| {
            packet.frames(format).take(1).collect()
        }),
    ];
    for (mistake, format, put) in all {
        let mut wrong = wrong::FaultyCell::new(format, mutants::NODE);
        wrong.put = put;
        let mut bus = VirtualBus::new(format, mutants::NODE, Box::new(wrong));
        let survey = Survey::listen(&mut bus, "vcan0").unwrap();
        let cell = CellId::new(mutants::NODE.into()).unwrap();
        let why = survey.check_cell(cell, "vcan0", None, false).unwrap_err();
        assert!(why.starts_with("cell 12 on vcan0 fails requirement SEND-1: none of "), "{why}");
        assert!(
            why.contains("is a valid packet, for example 40C#") && why.contains(mistake),
            "{mistake}: {why}"
        );
    }
}

/// Returns the frames of a packet with another CRC, computed from the identifier, the bytes before it and the right
/// CRC.
fn spoilt(packet: &Packet, format: Format, crc: fn(&[u8], u16) -> u16) -> Vec<Frame> {
    let frames: Vec<_> = packet.frames(format).collect();
    let mut bytes: Vec<u8> = frames.iter().flat_map(Frame::data).copied().collect();
    let (body, right) = bytes.split_last_chunk::<2>().unwrap();
    let id = u16::try_from(frames[0].id()).unwrap().to_le_bytes();
    let crc = crc(&[&id, body].concat(), u16::from_le_bytes(*right)).to_le_bytes();
    let end = bytes.len() - 2;
    bytes[end..].copy_from_slice(&crc);
    let size = bytes.len() / frames.len();
    let parts = frames.iter().zip(bytes.chunks(size));
    let made = parts.map(|(frame, part)| match format {
        Format::Fd => Frame::fd(frame.id(), frame.flags(), part),
        Format::Classic => Frame::classic(frame.id(), part),
    });
    made.map(Result::unwrap).collect()
}

/// Checks that each faulty cell fails the requirement that it breaks.
fn are_found(spoilt: &[mutants::FaultCase], format: Format) {
    let mut found_out = Vec::new();
    for (name, id, spoil) in spoilt {
        let mut wrong = wrong::FaultyCell::new(format, mutants::NODE);
        spoil(&mut wrong);
        let mut bus = VirtualBus::new(format, mutants::NODE, Box::new(wrong));
        let (findings, failed) = test(&mut bus, format, mutants::NODE, &RequirementFilter::default());
        let is_found = findings
            .iter()
            .any(|it| it.requirement.id == *id && matches!(it.verdict, Verdict::Failed { .. }));
        if !is_found {
            found_out.push(format!("{name}: not {id} but {failed:?}"));
        }
        for it in &findings {
            if let Verdict::Failed { frames, .. } = &it.verdict {
                // A cell that sends nothing has no frames to show; neither has its timing as a whole.
                let has_none = ["TIME-1", "TIME-2", "BEAT-1"].contains(&it.requirement.id)
                    || *name == "it is silent after a reset";
                assert!(!frames.is_empty() || has_none, "{name}: {}", it.requirement.id);
            }
        }
    }
    assert!(found_out.is_empty(), "{}", found_out.join("\n"));
}

#[test]
fn wrong_arithmetic_is_found() {
    are_found(mutants::arithmetic::ARITHMETIC, Format::Fd);
}

#[test]
fn wrong_answers_to_joints_are_found() {
    are_found(mutants::joints::JOINTS, Format::Fd);
}

#[test]
fn wrong_commands_are_found() {
    are_found(mutants::commands::COMMANDS, Format::Fd);
}

#[test]
fn wrong_parameters_are_found() {
    are_found(mutants::parameters::PARAMETERS, Format::Fd);
}

#[test]
fn wrong_stimuli_are_found() {
    are_found(mutants::stimuli::STIMULI, Format::Fd);
}

#[test]
fn wrong_heartbeats_are_found() {
    are_found(mutants::beats::BEATS, Format::Fd);
}

#[test]
fn wrong_defence_of_a_node_id_is_found() {
    are_found(mutants::beats::CLAIMS, Format::Fd);
}

#[test]
fn wrong_counts_are_found() {
    are_found(mutants::counters::COUNTERS, Format::Fd);
}

#[test]
fn wrong_reassembly_is_found() {
    are_found(mutants::segments::SEGMENTS, Format::Classic);
}

#[test]
fn wrong_sensor_pages_are_found() {
    are_found(mutants::sensing::SENSING, Format::Fd);
}

#[test]
fn wrong_zeros_are_found() {
    are_found(mutants::baseline::BASELINE, Format::Fd);
}

#[test]
fn wrong_starts_are_found() {
    are_found(mutants::starts::STARTS, Format::Fd);
}

#[test]
fn flash_that_loses_something_is_found() {
    are_found(mutants::flash::FLASH, Format::Fd);
}

#[test]
fn commits_that_take_something_along_are_found() {
    are_found(mutants::flash::LEAVES, Format::Fd);
}

/// Each requirement that the right cell passes is failed by a faulty one, except those that follow from others.
#[test]
fn each_requirement_is_broken_by_a_wrong_cell() {
    let mut passed = std::collections::BTreeSet::new();
    for format in [Format::Fd, Format::Classic] {
        let mut bus = VirtualBus::new(format, 12, Box::new(FaultlessCell));
        let (findings, _) = test(&mut bus, format, 12, &RequirementFilter::default());
        let is_passed = |it: &&Finding| matches!(it.verdict, Verdict::Passed { .. });
        passed.extend(findings.iter().filter(is_passed).map(|it| it.requirement.id));
    }
    let broken: std::collections::BTreeSet<_> =
        mutants::ALL.iter().flat_map(|(all, _)| all.iter().map(|(_, id, _)| *id)).collect();
    let unbroken: Vec<_> = passed.difference(&broken).copied().collect();
    assert!(passed.len() > 70, "{passed:?}");
    // A cell without its node id after a reset sends nothing, which breaks CLAIM-1.
    assert_eq!(unbroken, ["ID-3"]);
    let count: usize = mutants::ALL.iter().map(|(all, _)| all.len()).sum();
    assert!(count >= 24, "{count} wrong cells");
}
