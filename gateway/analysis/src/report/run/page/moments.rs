//! Tables of times in the recording at which something happened, each with the command that shows it.

use std::path::Path;

use model::table::Notice;
use protocol::usage::shell_quoted_os;

use super::super::moments::ListedLoss;
use super::super::motion::{HALTED, RESUMED};
use super::PageDraft;
use crate::report::figure::{Finding, Table, format_quantity, with_minus_signs};

/// Maximum number of rows of a table of moments.
const MAX_MOMENT_ROWS: usize = 25;

/// The headings of a table of times.
const MOMENT_TABLE_HEAD: [&str; 3] = ["at", "what", "command"];

/// An event in the recording: its time, its weight by which it is selected, and its description.
struct WeightedMoment {
    at: f64,
    weight: f64,
    what: String,
}

impl PageDraft<'_> {
    /// Returns the command that shows the recording around a time, given in s after its first message.
    pub(super) fn view_command(&self, at: f64) -> String {
        let seconds = (at - self.run.zero.unwrap_or(0.0)).max(0.0);
        let files: Vec<_> = self.run.files.iter().map(|file| path_word(file)).collect();
        let skin = self.run.frames_only.as_ref().map(|it| format!(" --skin {}", path_word(&it.skin_file)));
        format!("skinbus view {}{} --at {seconds:.3}", files.join(" "), skin.unwrap_or_default())
    }

    /// Creates the table of touches, each on a link.
    pub(super) fn touch_table(&self) -> Option<Table> {
        let skin = &self.run.skin;
        let mut all = Vec::new();
        let mut further = 0;
        for (bus, bus_figures) in self.run.bus_figures.iter().enumerate() {
            let nodes: Vec<_> = skin.cells_on_bus(bus).map(|cell| cell.node).collect();
            let chain = skin.buses.get(bus).map_or(0, |bus| bus.chain);
            further += bus_figures.touched.further;
            all.extend(bus_figures.touched.touches.iter().map(|touch| {
                let ((from, to), (place, force)) = (touch.seconds, touch.strongest);
                let link = self.link_name((chain, touch.row), Some(bus));
                let (cells, node) = (touch.cells.len(), nodes.get(place));
                let cell = node.map_or_else(String::new, |node| format!(" {node}"));
                let long = format_quantity(to - from, "s");
                let force_n = format_quantity(force, "N");
                let what = if cells == 1 {
                    format!("{link}: cell{cell}, at most {force_n}, {long}")
                } else {
                    format!("{link}: {cells} cells, at most {force_n} on cell{cell}, {long}")
                };
                WeightedMoment { at: from, weight: force * cells as f64, what }
            }));
        }
        self.moment_table("Touches, grouped by link", all, further)
    }

    /// Creates the finding of the first touch of a cell, if there is one.
    pub(super) fn first_touch_finding(&self) -> Option<Finding> {
        let touches = self.run.bus_figures.iter().enumerate().flat_map(|(bus, bus_figures)| {
            bus_figures.touched.touches.iter().map(move |touch| (bus, bus_figures, touch))
        });
        let (bus, bus_figures, touch) =
            touches.min_by(|(.., one), (.., other)| one.seconds.0.total_cmp(&other.seconds.0))?;
        let node = bus_figures.table.cells().get(*touch.cells.first()?)?.node;
        let chain = self.run.skin.buses.get(bus).map_or(0, |bus| bus.chain);
        let what = format!("first touch: {}, cell {node}", self.link_name((chain, touch.row), Some(bus)));
        let command = self.view_command(touch.seconds.0);
        Some(Finding::new_unrated(what, (touch.seconds.0 - self.zero, "s")).with_command(Some(command)))
    }

    /// Creates the finding on halts of the robot.
    pub(super) fn halts_finding(&self) -> Finding {
        let (halts, first) = self.run.motion.halts;
        let finding = super::zero_required_finding("halts of the robot".to_owned(), halts);
        finding.with_command(first.filter(|_| halts > 0).map(|at| self.view_command(at)))
    }

    /// Creates the table of halts, and of their ends.
    pub(super) fn halt_table(&self) -> Option<Table> {
        let changes = self.run.motion.changes.iter().filter(|(_, what)| [HALTED, RESUMED].contains(what));
        let all = changes.map(|&(at, what)| WeightedMoment {
            at,
            weight: f64::INFINITY,
            what: format!("the robot was {what}"),
        });
        self.moment_table("Halts", all.collect(), 0)
    }

    /// Creates the table of losses, and of cells that fell silent, came back or restarted.
    pub(super) fn loss_table(&self) -> Option<Table> {
        let mut all = Vec::new();
        let mut further = 0;
        for bus_figures in &self.run.bus_figures {
            let (name, moments) = (&bus_figures.name, &bus_figures.moments);
            further += moments.further;
            all.extend(moments.losses.iter().map(|loss| {
                let what = format!(
                    "{name}: {} within {}",
                    loss_text(loss),
                    format_quantity(loss.seconds.1 - loss.seconds.0, "s")
                );
                WeightedMoment { at: loss.seconds.0, weight: loss.total() as f64, what }
            }));
            all.extend(moments.notices.iter().filter_map(|(at, notice)| {
                let what = match notice {
                    Notice::Dead(node) => format!("{name}: cell {node} is silent"),
                    Notice::Revived(node) => format!("{name}: cell {node} sends again"),
                    Notice::Restarted(node) => format!("{name}: cell {node} restarted"),
                    Notice::Duplicate(node) => {
                        format!(
                            "{name}: cell {node} received packets from another cell that uses the same node id"
                        )
                    }
                    Notice::OtherGateway => format!("{name}: another gateway sends on this bus"),
                    Notice::Returned(_) => return None,
                };
                Some(WeightedMoment { at: *at, weight: f64::INFINITY, what })
            }));
        }
        self.moment_table("Moments of losses", all, further)
    }

    /// Creates a table of the events with the highest weights, in order of time. `further` is the number of events that
    /// were not kept.
    fn moment_table(&self, title: &str, mut all: Vec<WeightedMoment>, further: u64) -> Option<Table> {
        if all.is_empty() {
            return None;
        }
        all.sort_by(|one, other| other.weight.total_cmp(&one.weight).then(one.at.total_cmp(&other.at)));
        let out = all.len().saturating_sub(MAX_MOMENT_ROWS) as u64 + further;
        all.truncate(MAX_MOMENT_ROWS);
        all.sort_by(|one, other| one.at.total_cmp(&other.at));
        let title = if out > 0 {
            format!("{title}: the {MAX_MOMENT_ROWS} largest, {out} more are left out")
        } else {
            title.to_owned()
        };
        let rows = all.into_iter().map(|WeightedMoment { at, what, .. }| {
            // Adding 0 removes the sign of a zero.
            let seconds = ((at - self.zero) * 1e3).round() / 1e3 + 0.0;
            vec![with_minus_signs(&format!("{seconds:.3}\u{a0}s")), what, self.view_command(at)]
        });
        Some(Table::new(title, MOMENT_TABLE_HEAD, rows).with_commands())
    }
}

/// Formats the counts of a loss.
fn loss_text(loss: &ListedLoss) -> String {
    let all =
        [(loss.late, "replies late"), (loss.missing, "replies missing"), (loss.packets, "packets lost")];
    let all = all.iter().filter(|(count, _)| *count > 0).map(|(count, what)| format!("{count} {what}"));
    all.collect::<Vec<_>>().join(", ")
}

/// Returns a path as a word for a shell that no program takes for an option.
fn path_word(path: &Path) -> String {
    match path.as_os_str().as_encoded_bytes().starts_with(b"-") {
        true => shell_quoted_os(Path::new(".").join(path).as_os_str()),
        false => shell_quoted_os(path.as_os_str()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_files_are_one_word_for_a_shell_and_no_options() {
        for (name, word) in [
            ("runs/a-1.mcap", "runs/a-1.mcap"),
            ("a b", "'a b'"),
            ("it's", r"'it'\''s'"),
            ("-j", "./-j"),
            ("- a", "'./- a'"),
        ] {
            assert_eq!(path_word(Path::new(name)), word);
        }
    }
}
