//! The checks, in groups that each begin with a cell that is ready.

mod baseline;
mod beats;
mod begin;
mod claims;
mod commands;
mod counters;
mod force;
mod joints;
mod kinematics;
mod leaves;
mod measuring;
mod options;
mod parameters;
mod refusals;
mod restart;
mod segments;
mod sensing;
mod sensing_model;
mod stimuli;
mod unconfigured;

use std::collections::BTreeSet;

use protocol::can::Format;
use protocol::time::Span;

use crate::bus::StopReason;
use crate::findings::RequirementFilter;
use crate::session::Session;

/// The ability of the cell or of the bus that a group of checks needs.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Precondition {
    Nothing,
    /// Test mode, and a configuration that can be committed.
    Press,
    /// The option --restart, so that the cell can be switched off and on.
    Restart,
    /// A cell that sends sensor values without a request.
    Sensing,
    /// A cell that subtracts a baseline from its force readings.
    Baseline,
    /// A bus with classic frames.
    Classic,
}

/// A group of checks that are run, and repeated, together.
struct CheckGroup {
    /// The ids of the requirements that the group covers.
    about: &'static [&'static str],
    needs: Precondition,
    run: fn(&mut Session<'_>) -> Result<(), StopReason>,
}

const fn check_group(
    about: &'static [&'static str],
    needs: Precondition,
    run: fn(&mut Session<'_>) -> Result<(), StopReason>,
) -> CheckGroup {
    CheckGroup { about, needs, run }
}

const CHECK_GROUPS: &[CheckGroup] = &[
    check_group(
        &["CONF-1", "CONF-2", "CONF-3", "CONF-4", "CONF-7", "CONF-12"],
        Precondition::Nothing,
        parameters::run,
    ),
    check_group(
        &["CONF-11", "CONF-13", "ID-2", "OPT-1"],
        Precondition::Nothing,
        parameters::check_addressing,
    ),
    check_group(&["CONF-7", "CONF-9", "CMD-2", "STATE-1"], Precondition::Press, leaves::run),
    check_group(&["CONF-5", "CONF-6", "COUNT-2"], Precondition::Nothing, refusals::run),
    check_group(
        &["CONF-9", "CONF-10", "SENSE-3", "OPT-1", "LINK-1"],
        Precondition::Nothing,
        options::check_switches,
    ),
    check_group(&["OPT-2"], Precondition::Nothing, options::check_unused_bits_ignored),
    check_group(&["J-1", "J-2", "J-3", "TORQUE-1"], Precondition::Press, kinematics::run),
    check_group(&["FORCE-1", "TORQUE-1", "TORQUE-2", "STATE-1"], Precondition::Press, force::run),
    check_group(
        &["JOINTS-1", "JOINTS-2", "JOINTS-3", "JOINTS-5", "JOINTS-6"],
        Precondition::Press,
        joints::run,
    ),
    check_group(&["JOINTS-4", "STIM-8"], Precondition::Press, joints::check_old_joints),
    check_group(&["JOINTS-6"], Precondition::Nothing, measuring::run),
    check_group(
        &["STIM-1", "STIM-2", "STIM-3", "STIM-4", "STIM-5", "STIM-6", "STIM-7", "STIM-8"],
        Precondition::Press,
        stimuli::run,
    ),
    check_group(
        &["CMD-1", "CMD-2", "CMD-3", "CMD-4", "STATE-1", "SENSE-1", "SENSE-2"],
        Precondition::Press,
        commands::run,
    ),
    check_group(
        &["BASE-1", "BASE-2", "BASE-3", "BASE-4", "BASE-5", "BASE-6", "BASE-7", "BASE-8"],
        Precondition::Baseline,
        baseline::run,
    ),
    check_group(&["COUNT-1", "SEND-1"], Precondition::Nothing, counters::run),
    check_group(&["COUNT-3"], Precondition::Classic, segments::run),
    check_group(&["CLAIM-6", "CLAIM-7", "STATE-2"], Precondition::Nothing, claims::run),
    check_group(
        &["BEAT-1", "BEAT-2", "BEAT-3", "CMD-1", "STIM-7", "TIME-1", "TIME-3"],
        Precondition::Nothing,
        beats::run,
    ),
    check_group(
        &["SENSE-4", "SENSE-5", "SENSE-6", "SENSE-7", "SENSE-8", "SENSE-9", "SENSE-10", "SENSE-11", "TIME-3"],
        Precondition::Sensing,
        sensing::run,
    ),
    check_group(
        &[
            "CLAIM-1", "CLAIM-2", "CLAIM-3", "CLAIM-4", "CLAIM-5", "CLAIM-7", "CONF-2", "CONF-8", "CONF-9",
            "ID-3",
        ],
        Precondition::Restart,
        restart::run,
    ),
];

/// The time to leave for the other groups when a group is repeated.
const OTHER_GROUPS_TIME_RESERVE: Span = Span::from_millis(20_000);

/// The parts of requirements that cannot be tested from the bus of any cell, with the reason.
const UNTESTABLE_REQUIREMENTS: &[(&str, &str)] = &[
    ("CLAIM-8", "the wires between cells are not accessible from the bus"),
    ("TIME-3", "the order of sums and of network pages 3 and 4"),
    ("CONF-7", "failing flash, which the test cannot cause over the bus"),
    ("CONF-8", "damaged flash, which the test cannot cause over the bus"),
    ("BEAT-1", "heartbeats after a hang, which the test cannot cause over the bus"),
    ("ID-1", "uniqueness of the serial number among all cells"),
    (
        "CLAIM-1",
        "the delay of (serial number mod 64) ms after the start, because the bus does not show the start",
    ),
];

/// Runs the requested checks. Call [`Session::save`] before it and [`Session::restore`] after it.
///
/// # Errors
/// Returns the reason why the test could not continue.
pub fn run(session: &mut Session<'_>, only: &RequirementFilter) -> Result<(), StopReason> {
    let done = run_groups(session, only);
    if done.is_ok() {
        for (id, why) in UNTESTABLE_REQUIREMENTS {
            session.findings.mark_not_tested(id, *why);
        }
    }
    session.check_answer_times();
    done
}

fn run_groups(session: &mut Session<'_>, only: &RequirementFilter) -> Result<(), StopReason> {
    begin::run(session)?;
    mark_tree_requirements(session);
    for group in CHECK_GROUPS {
        if let Err((is_applicable, why)) = check_precondition(session, group.needs) {
            for id in group.about {
                if is_applicable {
                    session.findings.mark_not_tested(id, why);
                } else {
                    session.findings.mark_not_applicable(id, why);
                }
            }
        } else if group.about.iter().any(|id| only.is_selected(id)) {
            if group.needs == Precondition::Restart {
                session.check_heartbeat_total();
            }
            run_group(session, group)?;
        }
    }
    session.check_heartbeat_total();
    session.check_segment_times()?;
    if only.is_selected("TIME-2") && session.about.committed {
        session.measure_answer_times()
    } else {
        Ok(())
    }
}

/// Runs a group, and repeats it if something failed while this computer was late: a cell that is a process may have
/// waited for a processor as well. The cell then has to meet each requirement in one of a few attempts.
fn run_group(session: &mut Session<'_>, group: &CheckGroup) -> Result<(), StopReason> {
    const MAX_GROUP_ATTEMPTS: usize = 4;
    const MAX_BENCH_LATENESS: Span = Span::from_millis(4);
    let before = session.findings.clone();
    let mut failed: Option<BTreeSet<&'static str>> = None;
    for attempt in 1..=MAX_GROUP_ATTEMPTS {
        session.worst_bench_lateness();
        let began = session.now();
        session.check_regular_heartbeat()?;
        (group.run)(session)?;
        session.wait_for_late_packets()?;
        if group.needs != Precondition::Restart {
            session.check_regular_heartbeat()?;
        }
        let now: BTreeSet<_> = session.findings.failed_since(&before).collect();
        let each: BTreeSet<_> =
            failed.map_or_else(|| now.clone(), |failed| failed.intersection(&now).copied().collect());
        for forgiven in now.difference(&each) {
            session.findings.retract_failures(forgiven, &before);
        }
        let took = session.now().elapsed_since(began);
        let is_over = attempt == MAX_GROUP_ATTEMPTS
            || session.remaining_time().0 < took.0 + OTHER_GROUPS_TIME_RESERVE.0;
        if each.is_empty() || is_over || session.worst_bench_lateness() < MAX_BENCH_LATENESS {
            break;
        }
        session.findings = before.clone();
        session.forget_cell_state();
        failed = Some(each);
    }
    Ok(())
}

/// Checks that the cell has the group's precondition. The error gives the reason, and true if the cell might have it
/// (not tested) or false if it does not (not applicable).
fn check_precondition(session: &Session<'_>, needs: Precondition) -> Result<(), (bool, &'static str)> {
    let about = &session.about;
    match needs {
        Precondition::Press if !about.test_mode => {
            Err((true, "the cell has no test mode (parameter 5), so the test cannot simulate a touch"))
        }
        Precondition::Press if !about.committed => Err((true, "the cell does not accept a configuration")),
        Precondition::Restart if !session.can_restart() => {
            Err((true, "the test needs the option --restart COMMAND"))
        }
        Precondition::Sensing if !about.sensing => {
            Err((false, "the cell sends no sensor values without a request"))
        }
        Precondition::Sensing if !about.test_mode => {
            Err((true, "the cell has no test mode (parameter 5), so the test cannot simulate a touch"))
        }
        Precondition::Baseline if !about.baseline => {
            Err((false, "the cell has no baseline: it subtracts no zero from its readings"))
        }
        Precondition::Baseline if !about.test_mode || !about.committed => {
            Err((true, "the cell lacks test mode or a configuration, so the test cannot simulate a touch"))
        }
        Precondition::Classic if session.format == Format::Fd => Err((false, "a CAN FD bus has no segments")),
        Precondition::Nothing
        | Precondition::Press
        | Precondition::Restart
        | Precondition::Sensing
        | Precondition::Baseline
        | Precondition::Classic => Ok(()),
    }
}

/// Marks the requirements that need wires as not tested, or as not applicable to a cell without ports.
fn mark_tree_requirements(session: &mut Session<'_>) {
    use crate::requirements::{Document, REQUIREMENTS};
    let ids = REQUIREMENTS.iter().filter(|it| it.document == Document::Tree && it.id != "LINK-1");
    for id in ids.map(|it| it.id).chain(["CLAIM-8"]) {
        if session.about.ports {
            session.findings.mark_not_tested(id, "the wires between cells are not accessible from the bus");
        } else {
            session.findings.mark_not_applicable(id, "the cell has no ports");
        }
    }
}
