//! Checks of refused writes and commits: the cell gives the right reason, and changes nothing.

use protocol::fixed::{Q1_14, Q3_12, Q5_10};

use protocol::parameters::{MAX_ROWS, Parameter, Parameters, Row, RowKind};

use crate::arm;
use crate::bus::StopReason;
use crate::session::{Reply, Session};

pub(super) fn run(session: &mut Session<'_>) -> Result<(), StopReason> {
    if !session.prepare_cell(&arm::example_parameters(2))? {
        return Ok(());
    }
    let before = session.counters()?;
    let staged = Parameters { period_us: 45_000, ..arm::example_parameters(5) };
    session.stage_parameters(&staged)?;
    check_refused_writes(session, &staged)?;
    // A refused write does not change the staged copy.
    let hash = staged.hash().cast_signed();
    let reply = session.write_first_words(Parameter::Commit.number(), [hash])?;
    let is_so = reply.words().is_some_and(|words| words.first() == Some(&hash));
    session.check("CONF-5", is_so, || {
        format!("refused writes must not change the staged copy, but a commit with its hash {hash:04X} was answered with {reply}")
    });
    if is_so {
        session.known.parameters = Some(staged);
        session.known.hash = Some(staged.hash());
        session.known.active = None;
    } else {
        (session.known.parameters, session.known.hash, session.known.staged) = (None, None, None);
    }
    check_refused_commits(session)?;
    // The values in use are unchanged, and so is the rest of the staged copy.
    session.stage_parameters(&staged)?;
    let reply = session.read_parameter(Parameter::Timing.number())?;
    session.check("CONF-5", reply == Reply::Value(staged.words(Parameter::Timing)), || {
        format!("refused commits must not change the period in use, but it reads as {reply}")
    });
    session.exchange_messages(&[])?;
    let after = session.counters()?;
    session.check("COUNT-2", before.refused == after.refused, || {
        format!("refusals must not be counted, but the counters are {after}; before: {before}")
    });
    Ok(())
}

/// Checks writes that are refused at once. If several words are bad, the refusal gives the lowest of their reasons.
fn check_refused_writes(session: &mut Session<'_>, good: &Parameters) -> Result<(), StopReason> {
    let mount = |words: [i16; 5], reason| (Parameter::Mount, words, reason);
    let row = |kind: i16| (Parameter::Row(1), [1, 2, 3, 4, kind], 9);
    let large = session.about.abilities.word() != 0;
    let mut all = vec![
        (Parameter::Identity, [1, 2, 3, 4, 5], 1),
        mount([1, -1, 0, 0, 0], 2),
        mount([1, 256, 0, 0, 0], 2),
        mount([-1, 6, 0, 0, 0], 3),
        mount([256, 6, 0, 0, 0], 3),
        mount([300, -300, 0, 0, 0], 2),
    ];
    if large {
        all.extend([
            mount([1, 6, -1, 0, 0], 8),
            mount([1, 6, 256, 0, 0], 8),
            mount([1, 6, 0, -1, 0], 7),
            mount([1, 6, 0, 256, 0], 7),
            mount([1, 6, 0, 0, 3], 10),
            mount([1, 6, 0, 0, -1], 10),
            mount([-1, -1, -1, -1, -1], 2),
            mount([-1, 6, -1, -1, -1], 3),
            mount([1, 6, -1, -1, -1], 7),
            mount([1, 6, -1, 0, 9], 8),
            mount([4, 6, 0, 0, 9], 10),
            row(3),
            row(-1),
            row(i16::MAX),
        ]);
    }
    for (parameter, words, reason) in all {
        let reply = session.write_first_words(parameter.number(), words)?;
        session.check("CONF-6", reply == Reply::Refused(reason), || {
            format!(
                "a write of parameter {} with the words {} must be refused with reason {reason}, but the \
                 answer was {reply}",
                parameter.number(),
                arm::format_words(&words)
            )
        });
        if reply.words().is_some() {
            // The cell staged it after all: restore the staged copy.
            session.write_parameter(parameter.number(), good.words(parameter))?;
        }
    }
    Ok(())
}

/// A defect of a configuration: the reason that a commit gives, and the change that causes it.
type ConfigurationFlaw = (i16, fn(&mut Parameters));

const CONFIGURATION_FLAWS: &[ConfigurationFlaw] = &[
    (2, |it| it.joints = 0),
    (3, |it| it.joint = 0),
    (4, |it| it.pose.normal = [Q1_14::ZERO, Q1_14::ZERO, Q1_14::from_bits(16_512)]),
    (5, |it| it.contact.alpha_p = Q5_10::from_bits(-1)),
    (6, |it| it.period_us = 0),
    (7, |it| it.table_rows = 33),
    (8, |it| it.row = 40),
];

const COMMIT_FLAWS: &[ConfigurationFlaw] = &[
    (2, |it| it.joints = 15),
    (2, |it| it.joints = 255),
    (3, |it| it.joint = 7),
    (4, |it| it.pose.normal = [Q1_14::ZERO; 3]),
    (4, |it| it.pose.normal = [Q1_14::ZERO, Q1_14::from_bits(-16_255), Q1_14::ZERO]),
    (4, |it| it.pose.normal = [Q1_14::MIN; 3]),
    (5, |it| it.contact.alpha_c = Q3_12::from_bits(-1)),
    (5, |it| it.contact.contact_threshold = Q5_10::MIN),
    (5, |it| it.contact.proximity_threshold = Q1_14::from_bits(-1)),
    (5, |it| it.contact.force_threshold = Q5_10::from_bits(-1)),
    // Valid except for the hash.
    (16, |it| it.pose.normal = [Q1_14::ZERO, Q1_14::ZERO, Q1_14::from_bits(16_511)]),
    (16, |it| it.pose.normal = [Q1_14::from_bits(-16_256), Q1_14::ZERO, Q1_14::ZERO]),
    (16, |it| it.period_us = 0xFFFF),
    (16, |it| it.joint = 6),
];

/// Defects of a configuration's table of rows.
const ROW_TABLE_FLAWS: &[ConfigurationFlaw] = &[
    (7, |it| (it.table_rows, it.row) = (5, 2)),
    (7, |it| it.table_rows = 255),
    (8, |it| (it.table_rows, it.row) = (6, 0)),
    (8, |it| (it.table_rows, it.row) = (6, 3)),
    (8, |it| (it.table_rows, it.row) = (6, 7)),
    (8, |it| (it.table_rows, it.row) = (0, 2)),
    // Joint 6 is the last of all rows, but there is no row 7.
    (8, |it| (it.table_rows, it.row, it.joint) = (6, 7, 6)),
    (7, |it| it.rows.iter_mut().skip(5).take(1).for_each(|row| row.kind = RowKind::Prismatic)),
    (7, |it| it.rows.iter_mut().take(1).for_each(|row| row.kind = RowKind::Fixed)),
    (16, |it| (it.table_rows, it.row) = (6, 2)),
];

/// Checks that a commit of invalid parameters is refused. The hash is wrong too, so that a faulty cell commits nothing.
fn check_refused_commits(session: &mut Session<'_>) -> Result<(), StopReason> {
    let can_rows = session.about.abilities.word() != 0;
    let is_apt = |flaw: &&ConfigurationFlaw| can_rows || !matches!(flaw.0, 7 | 8);
    let base = arm::example_parameters(2);
    if session.about.abilities.max_rows() == MAX_ROWS {
        check_33_rows_refused(session, &base)?;
    }
    let all = CONFIGURATION_FLAWS
        .iter()
        .chain(COMMIT_FLAWS)
        .chain(if can_rows { ROW_TABLE_FLAWS } else { &[] })
        .filter(is_apt);
    for (reason, flaw) in all {
        let mut parameters = base;
        flaw(&mut parameters);
        check_commit_refused(session, &parameters, *reason)?;
    }
    let apt: Vec<_> = CONFIGURATION_FLAWS.iter().filter(is_apt).collect();
    for (place, (reason, first)) in apt.iter().enumerate() {
        for (_, second) in apt.iter().skip(place + 1) {
            let mut parameters = base;
            first(&mut parameters);
            second(&mut parameters);
            check_commit_refused(session, &parameters, *reason)?;
        }
    }
    let mut all = base;
    apt.iter().for_each(|(_, flaw)| flaw(&mut all));
    check_commit_refused(session, &all, 2)
}

/// Checks that a table of 33 rows, one more than possible, is refused with reason 7, whatever the number of joints.
fn check_33_rows_refused(session: &mut Session<'_>, base: &Parameters) -> Result<(), StopReason> {
    let mut full = Parameters { table_rows: 32, row: 6, joint: 6, ..*base };
    for (place, row) in full.rows.iter_mut().enumerate().skip(6) {
        let a = Q1_14::from_bits(i16::try_from(place).unwrap_or_default());
        *row = Row { kind: RowKind::Fixed, a, ..Row::default() };
    }
    check_commit_refused(session, &full, 16)?;
    for joints in [6, 7] {
        let over = Parameters { table_rows: 33, joints, ..full };
        session.write_parameter(Parameter::Mount.number(), over.words(Parameter::Mount))?;
        let reply = session.write_first_words(Parameter::Commit.number(), [1])?;
        session.check("CONF-6", reply == Reply::Refused(7), || {
            format!("a commit of 33 rows with {joints} joints must be refused with reason 7, but the answer was {reply}")
        });
    }
    session.known.staged = None;
    Ok(())
}

fn check_commit_refused(
    session: &mut Session<'_>,
    parameters: &Parameters,
    reason: i16,
) -> Result<(), StopReason> {
    session.stage_parameters(parameters)?;
    let hash = !parameters.hash();
    let reply = session.write_first_words(Parameter::Commit.number(), [hash.cast_signed()])?;
    session.check("CONF-6", reply == Reply::Refused(reason), || {
        let words = |parameter| Reply::Value(parameters.words(parameter));
        format!(
            "a commit with a wrong hash must be refused with reason {reason}, but the answer was {reply}; the staged values are \
             mount {}, pose {}, contact {}, timing {}",
            words(Parameter::Mount),
            words(Parameter::Pose),
            words(Parameter::Contact),
            words(Parameter::Timing)
        )
    });
    Ok(())
}
