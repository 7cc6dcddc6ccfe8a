//! Cell processes that ended during a run or a replay. Groups them into notes for the user, and keeps the reasons of
//! failed processes for the summary.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use super::EndedProcess;
use crate::summary::{CellError, ErrorCells};

/// Time within which processes must end to be reported in the same note.
const END_GROUPING_TIME: Duration = Duration::from_millis(50);
/// Maximum number of processes named in one note.
const MAX_NAMED_PROCESSES: usize = 6;

/// The processes that ended so far.
#[derive(Debug, Default)]
pub(crate) struct EndedProcesses {
    /// Ended processes that no note has reported yet.
    pending: Vec<EndedProcess>,
    /// Time at which the last end of a process was found.
    last_found_at: Option<Instant>,
    /// Cells whose processes failed, by reason and by bus.
    errors: BTreeMap<String, BTreeMap<String, BTreeSet<u8>>>,
}

impl EndedProcesses {
    /// Adds processes that ended. Once no process has ended for 50 ms, or if `last` is set, returns notes on all that
    /// have not been reported.
    pub(crate) fn add_ended(&mut self, ended: Vec<EndedProcess>, last: bool) -> Vec<String> {
        if !ended.is_empty() {
            self.last_found_at = Some(Instant::now());
            self.pending.extend(ended);
        }
        if self.pending.is_empty()
            || (!last && self.last_found_at.is_some_and(|found| found.elapsed() < END_GROUPING_TIME))
        {
            return Vec::new();
        }
        let mut groups = BTreeMap::<(String, String), Vec<EndedProcess>>::new();
        for ended in self.pending.drain(..) {
            groups.entry((ended.bus.clone(), ended.status_text())).or_default().push(ended);
        }
        groups.into_iter().map(|((bus, how), group)| self.format_note((&bus, &how), &group)).collect()
    }

    /// Returns the note on processes of one bus that ended in the same way. A reason that an earlier note gave is not
    /// repeated.
    fn format_note(&mut self, (bus, how): (&str, &str), group: &[EndedProcess]) -> String {
        let error = group.first().and_then(|ended| Some((ended.status, ended.failure_reason()?)));
        let how = error.map_or_else(
            || how.to_owned(),
            |(status, why)| {
                let known = self.errors.contains_key(&why);
                let cells = self.errors.entry(why).or_default().entry(bus.to_owned()).or_default();
                cells.extend(group.iter().flat_map(|ended| ended.nodes.0..=ended.nodes.1));
                if known { format!("{status}; for the reason see above") } else { how.to_owned() }
            },
        );
        match group {
            [one] => format!("the process of {one} ended ({how})"),
            many => {
                let named: Vec<_> =
                    many.iter().take(MAX_NAMED_PROCESSES).map(|ended| ended.cells().to_string()).collect();
                let more = if many.len() > MAX_NAMED_PROCESSES { ", ..." } else { "" };
                let named = named.join(", ");
                format!("{} processes of cells on {bus} ended ({how}): {named}{more}", many.len())
            }
        }
    }

    /// Returns the errors that ended processes, each once with all cells that it ended.
    pub(crate) fn errors(&self) -> Vec<CellError> {
        let cells = |(bus, nodes): (&String, &BTreeSet<u8>)| ErrorCells {
            bus: bus.clone(),
            nodes: nodes.iter().copied().collect(),
        };
        let errors = self.errors.iter();
        errors
            .map(|(why, buses)| CellError { reason: why.clone(), cells: buses.iter().map(cells).collect() })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::process::ExitStatusExt;
    use std::process::ExitStatus;

    fn ended(nodes: (u8, u8), raw_status: i32, said: Option<&str>) -> EndedProcess {
        let said = said.map(str::to_owned);
        EndedProcess {
            bus: "vcan0".to_owned(),
            nodes,
            status: ExitStatus::from_raw(raw_status),
            reason: said,
        }
    }

    #[test]
    fn many_that_end_for_one_reason_are_one_note_and_one_error() {
        let nodes: Vec<u8> = (1..=252).collect();
        let mut processes = EndedProcesses::default();
        let all = || nodes.iter().map(|&node| ended((node, node), 1 << 8, Some("cannot send"))).collect();
        let [note] = processes.add_ended(all(), true).try_into().unwrap();
        assert_eq!(note.matches("cannot send").count(), 1, "{note}");
        let [again] = processes.add_ended(all(), true).try_into().unwrap();
        assert!(!again.contains("cannot send"), "{again}");
        let [error] = processes.errors().try_into().unwrap();
        assert_eq!((error.reason.as_str(), &error.cells[0].nodes), ("cannot send", &nodes));
    }

    #[test]
    fn signals_are_no_errors_and_a_process_without_a_reason_has_its_exit_code() {
        let mut processes = EndedProcesses::default();
        let notes = processes.add_ended(vec![ended((1, 1), 9, None), ended((2, 2), 0, None)], true);
        assert_eq!(notes.len(), 2);
        assert!(
            notes.contains(&"the process of cell 1 on vcan0 ended (signal: 9 (SIGKILL))".to_owned()),
            "{notes:?}"
        );
        assert!(processes.errors().is_empty());
        let [note] = processes.add_ended(vec![ended((1, 1), 101 << 8, None)], true).try_into().unwrap();
        assert_eq!(note, "the process of cell 1 on vcan0 ended (exit status: 101)");
        let [error] = processes.errors().try_into().unwrap();
        assert_eq!(error.reason, "exit code 101, and no reason was given");
    }

    #[test]
    fn those_that_end_together_wait_for_each_other() {
        let mut processes = EndedProcesses::default();
        assert!(processes.add_ended(vec![ended((1, 1), 9, None)], false).is_empty());
        assert!(processes.add_ended(vec![ended((2, 2), 9, None)], false).is_empty());
        let [note] = processes.add_ended(Vec::new(), true).try_into().unwrap();
        assert!(
            note.starts_with("2 processes of cells on vcan0 ended (signal: 9 (SIGKILL)): cell 1, cell 2"),
            "{note}"
        );
        assert!(processes.add_ended(Vec::new(), true).is_empty());
    }
}
