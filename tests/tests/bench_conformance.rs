//! The conformance test in virtual time: this project's cell passes, and cells that do one thing wrong are found out, each
//! by the requirement that says so.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

#[path = "conformance/cell.rs"]
mod cell;

use cell::{Mutant, Right, Virtual};
use conformance::Session;
use conformance::findings::{Finding, Only, Verdict};
use conformance::survey::Survey;
use protocol::can::Format;
use protocol::id::CellId;
use protocol::time::Span;

/// What came of a cell, and why the test ended early.
fn test(bus: &mut Virtual, format: Format, number: u8, only: &Only) -> (Vec<Finding>, Vec<&'static str>) {
    let cell = CellId::new(number.into()).unwrap();
    let survey = Survey::take(bus, "vcan0").unwrap();
    assert_eq!(survey.check(cell, "vcan0", None, false), Ok(format));
    let mut session = Session::new(bus, "vcan0", cell, format, Span::from_millis(80_000));
    let saved = session.save().unwrap();
    let stopped = conformance::run(&mut session, only).err();
    if let Ok(saved) = &saved {
        let _ = session.restore(saved);
    }
    let failed = session.findings.failed();
    (session.findings.list(only, stopped.as_ref()), failed)
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
        let mut bus = Virtual::new(format, number, Box::new(Right) as Box<dyn Mutant>);
        let (findings, failed) = test(&mut bus, format, number, &Only::default());
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
    let mut bus = Virtual::new(Format::Fd, 7, Box::new(Right)).without_restart();
    let (findings, failed) = test(&mut bus, Format::Fd, 7, &Only::default());
    assert_eq!(failed, [""; 0], "{}", failures(&findings));
    let untested: Vec<_> = findings
        .iter()
        .filter(|it| matches!(&it.verdict, Verdict::NotTested { why } if why == "without --restart"))
        .map(|it| it.requirement.id)
        .collect();
    assert_eq!(untested, ["ID-3", "CLAIM-1", "CLAIM-2", "CLAIM-3", "CLAIM-4", "CLAIM-5", "CONF-8"]);
}
