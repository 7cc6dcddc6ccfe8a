//! Tables of times in the recording at which something happened, each with the command that shows it.

use model::table::Notice;

use super::super::moments::ListedLoss;
use super::PageDraft;
use crate::report::figure::{Table, format_quantity};

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
        let files: Vec<_> = self.run.files.iter().map(|file| shell_quoted(file)).collect();
        let skin = self.run.frames_only.as_ref().map(|it| format!(" --skin {}", shell_quoted(&it.skin_file)));
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
            vec![format!("{:.3}\u{a0}s", at - self.zero), what, self.view_command(at)]
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

/// Quotes a word for a shell.
fn shell_quoted(word: &str) -> String {
    let is_plain = |letter: char| letter.is_ascii_alphanumeric() || "/._-+=:,@%".contains(letter);
    if !word.is_empty() && word.chars().all(is_plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests {
    use super::shell_quoted;

    #[test]
    fn names_of_files_are_one_word_for_a_shell() {
        for (name, word) in
            [("runs/a-1.mcap", "runs/a-1.mcap"), ("a b", "'a b'"), ("it's", r"'it'\''s'"), ("", "''")]
        {
            assert_eq!(shell_quoted(name), word);
        }
    }
}
