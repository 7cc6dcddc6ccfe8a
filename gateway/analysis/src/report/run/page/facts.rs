//! The facts at the head of a report: the capture, its origin, and the machine.

use super::super::RunData;
use crate::report::figure::format_quantity;

/// Formats a time in µs from the recording's metadata.
pub(super) fn format_micros(text: &str) -> String {
    text.parse().map_or_else(|_| text.to_owned(), |micros| format_quantity(micros, "µs"))
}

/// Returns the facts about the capture, each with its name.
pub(super) fn capture_facts(run: &RunData, command: &str) -> Vec<(String, String)> {
    if let Some(frames_only) = &run.frames_only {
        let began = frames_only.began.map(format_utc).map(|began| ("first frame", began));
        let capture = ("capture", format!("{}, {}, {} bytes", run.name, frames_only.format, run.bytes));
        let skin = ("skin", frames_only.skin_file.display().to_string());
        let all =
            [Some(capture), Some(skin), began, Some(("command that made the report", command.to_owned()))];
        return all.into_iter().flatten().map(|(name, value)| (name.to_owned(), value)).collect();
    }
    let fact = |record: &str, key: &str| run.metadata_value(record, key).unwrap_or("unknown");
    let [machine, program] = ["machine", "program"].map(|record| move |key: &str| fact(record, key));
    let began = program("began_ns").parse().map_or_else(|_| "unknown".to_owned(), format_utc);
    let idle = run.metadata_value("machine", "idle_late_p50_us").map(|idle| {
        let (p99, max) = (machine("idle_late_p99_us"), machine("idle_late_max_us"));
        let [idle, p99, max] = [idle, p99, max].map(format_micros);
        format!("a thread woke up {idle} late (median), {p99} (99 %), {max} (max)")
    });
    let clock = format!(
        "{} (available: {}); wall clock in steps of {} ns",
        machine("clocksource"),
        machine("clocksources"),
        machine("realtime_resolution_ns")
    );
    let kernel = [machine("sysname"), machine("release"), "on", machine("machine")].join(" ");
    let configuration = run.metadata.iter().find(|(name, _)| name == "configuration").map(|(_, facts)| {
        facts.iter().map(|(key, value)| format!("{key} = {value}")).collect::<Vec<_>>().join("; ")
    });
    let facts = [
        ("command that started the run", Some(program("command_line").to_owned())),
        ("program", Some(format!("{}, revision {}", program("program"), program("git_revision")))),
        ("began", Some(began)),
        ("machine", Some(format!("{kernel}, {} processors", machine("processors")))),
        ("clock", Some(clock)),
        ("idle machine", idle),
        ("recording", Some(format!("{}, part {}, {} bytes", run.name, fact("part", "number"), run.bytes))),
        ("command that made the report", Some(command.to_owned())),
        ("configuration", configuration),
    ];
    facts.into_iter().filter_map(|(name, value)| Some((name.to_owned(), value?))).collect()
}

/// Formats a time in ns since 1970 as UTC (Hinnant's `civil_from_days`).
fn format_utc(nanos: u64) -> String {
    let seconds = nanos / 1_000_000_000;
    let (days, second) = (seconds / 86_400 + 719_468, seconds % 86_400);
    let (era, day) = (days / 146_097, days % 146_097);
    let year = (day - day / 1_460 + day / 36_524 - day / 146_096) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    let month = (5 * day + 2) / 153;
    let (day, month) = (day - (153 * month + 2) / 5 + 1, if month < 10 { month + 3 } else { month - 9 });
    let year = year + era * 400 + u64::from(month <= 2);
    let (hour, minute, second) = (second / 3_600, second / 60 % 60, second % 60);
    format!("{year}-{month:02}-{day:02} {hour:02}:{minute:02}:{second:02} UTC")
}
