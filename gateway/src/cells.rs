//! `skinbus cells`.

mod show;

use std::io::{self, IsTerminal};
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use bench::cells::CellWatch;
use clap::Args;
use protocol::skin::Skin;
use protocol::usage::{Failure, ignore_broken_pipe, print_text, printable_lines, write_stdout};

use self::show::{CellList, DescribedBus};
use super::arguments::{BusKinds, find_bus, parse_duration};
use super::input;
use super::print::{json_line, to_pretty_json};

/// Default listening time in s.
const DEFAULT_LISTEN_S: f64 = 1.0;
/// Interval between updates of the list.
const UPDATE_INTERVAL: Duration = Duration::from_millis(500);

/// List the cells on a bus with their states and counters
///
/// Queries all cells for their counters and their position in the network, and listens for one second. `-` marks values
/// that a cell has not reported. Empty columns are omitted, and so are the counters on narrow terminals. Ports show the
/// node id of the neighbour; `?` after it means that the neighbour receives nothing from this cell, `!` that it has
/// another protocol version, and `.` that the port receives nothing.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus cells vcan0
  skinbus cells can0 --skin skin.toml --watch
  skinbus cells vcan0 --json | jq '.cells[] | select(.configured | not) | .node'")]
pub(crate) struct CellsCommand {
    /// Name of the bus, such as can0
    bus: String,
    /// Skin file to compare with: show which cells have its configuration, and which are missing
    #[arg(long, value_name = "SKIN")]
    skin: Option<PathBuf>,
    /// Update the list until Ctrl-C
    #[arg(long)]
    watch: bool,
    /// Print one JSON object; with --watch, one per line
    #[arg(long, short)]
    json: bool,
    /// List the cells that send within this time [default: 1s; with --watch, no limit]
    #[arg(long, value_name = "TIME", value_parser = parse_duration, allow_negative_numbers = true)]
    duration: Option<f64>,
    #[command(flatten)]
    kinds: BusKinds,
}

impl CellsCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let known = self.described_bus()?;
        let kind = self.kinds.kinds_of_buses([self.bus.as_str()])?.kind_of(&self.bus);
        let stopped = input::stop_flag()?;
        let format = known.as_ref().map(|known| known.format);
        if Path::new(&self.bus).is_file() {
            return Err(Failure::usage_error(format!(
                "{} is a file: give the name of a bus here, and a skin with --skin",
                self.bus
            )));
        }
        let mut watch = CellWatch::open(&self.bus, kind, format).map_err(Failure::usage_error)?;
        let seconds = self.duration.or_else(|| (!self.watch).then_some(DEFAULT_LISTEN_S));
        let show = |watch: &CellWatch| {
            let shown = CellList::from_watch(watch, known.as_ref());
            match (self.json, self.watch) {
                (false, _) => Ok(shown.table()),
                (true, false) => to_pretty_json(&shown),
                (true, true) => json_line(&shown),
            }
        };
        let terminal = io::stdout().is_terminal() && !self.json;
        let mut drawn = Instant::now();
        while seconds.is_none_or(|seconds| watch.elapsed().as_secs_f64() < seconds)
            && !stopped.load(Ordering::Relaxed)
        {
            watch
                .query_cells(self.watch)
                .and_then(|()| watch.receive(&stopped))
                .map_err(Failure::run_error)?;
            if self.watch && drawn.elapsed() >= UPDATE_INTERVAL {
                drawn = Instant::now();
                let text = show(&watch)?;
                let shown = if terminal {
                    write_stdout(&show::terminal_redraw_text(&printable_lines(&text)))
                } else {
                    write_stdout(&text)
                };
                if shown.is_err() {
                    return ignore_broken_pipe(shown);
                }
            }
        }
        if self.watch {
            return Ok(());
        }
        if watch.listing().cells().len() == 0 {
            let (name, seconds) = (&self.bus, watch.elapsed().as_secs_f64());
            let others = match watch.non_packet_count() {
                0 => String::new(),
                others => format!(" ({others} other frames were received; `skinbus dump` shows them)"),
            };
            return Err(Failure::run_error(format!(
                "no cell sent anything on {name} for {seconds:.1} s{others}: start the cells, or switch them on"
            )));
        }
        print_text(&show(&watch)?)
    }

    /// Returns this bus as the skin of `--skin` describes it, if there is one.
    fn described_bus(&self) -> Result<Option<DescribedBus>, Failure> {
        let Some(path) = &self.skin else { return Ok(None) };
        let skin = Skin::read(path).map_err(Failure::usage_error)?;
        let file = path.display().to_string();
        let index = find_bus(&skin, &file, &self.bus)?;
        Ok(Some(DescribedBus::from_skin(&skin, index, file)))
    }
}
