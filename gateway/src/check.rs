//! `skinbus check`.

mod scenario;
mod skin;

use std::path::{Path, PathBuf};

use clap::Args;
use protocol::document;
use protocol::skin::{CellName, Skin};
use protocol::usage::{Failure, print_text};

use self::skin::ListedCells;

/// Check skins and scenarios, and summarise them
///
/// For a skin, also reads its URDF, and summarises the skin in a few lines. For a scenario, lists touches with their
/// forces, faults and changes of the gateway's mode in the order of time. If a file is wrong, exits with code 2 and one
/// line that gives the line and column, the key, the value and the allowed values.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus check gateway/examples/ur5-253.toml gateway/examples/demo.toml
  skinbus check scenario.toml --skin skin.toml --json | jq '.events[] | select(.what == \"touch\")'
  skinbus check skin.toml --cell vcan0:12")]
pub(crate) struct CheckCommand {
    /// Skin and scenario files (TOML); - for standard input
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,
    /// Skin file that the scenarios refer to [default: the skin among the files]
    #[arg(long, value_name = "SKIN")]
    skin: Option<PathBuf>,
    /// Also list the cells of skins, one per line: position in the frame of the joint, neighbours, and configuration
    /// hash
    #[arg(long)]
    list: bool,
    /// Show only this cell of the skin
    #[arg(long, value_name = "[BUS:]NODE", conflicts_with = "list")]
    cell: Option<CellName>,
    /// Print one JSON object per file; its keys are those of the TOML files
    #[arg(long, short)]
    json: bool,
}

/// Content of a checked file: a skin, or the text of a scenario.
enum CheckedContent {
    Skin(Box<Skin>),
    /// Text of the file, kept until its skin is known.
    Scenario(String),
}

impl CheckCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let has_skin = self.skin.is_some() || self.files.len() > 1;
        let described = self.files.iter().map(|file| Ok((file, read_description(file, has_skin)?)));
        let described = described.collect::<Result<Vec<_>, Failure>>()?;
        let named = self.skin.as_deref().map(Skin::read).transpose().map_err(Failure::usage_error)?;
        let mut skins = described.iter().filter_map(|(_, described)| match described {
            CheckedContent::Skin(skin) => Some(&**skin),
            CheckedContent::Scenario(_) => None,
        });
        let beside = (skins.next(), skins.next());
        let listed = match &self.cell {
            Some(cell) => ListedCells::Only(cell),
            None if self.list => ListedCells::All,
            None => ListedCells::None,
        };
        let (mut text, mut refused) = (String::new(), None);
        for (file, described) in &described {
            text += &match described {
                CheckedContent::Skin(skin) => skin::check_and_summarize(file, skin, listed, self.json)?,
                CheckedContent::Scenario(text) => {
                    let skin = match (&named, beside) {
                        (Some(skin), _) | (None, (Some(skin), None)) => skin,
                        (None, (None, _)) => return Err(ambiguous_skin_failure(file, "no skin is")),
                        (None, (Some(_), Some(_))) => {
                            return Err(ambiguous_skin_failure(file, "several skins are"));
                        }
                    };
                    let (text, refusal) = scenario::describe_scenario(file, text, skin, self.json)?;
                    refused = refused.or(refusal);
                    text
                }
            };
        }
        print_text(&text)?;
        refused.map_or(Ok(()), Err)
    }
}

fn ambiguous_skin_failure(file: &Path, found: &str) -> Failure {
    let file = file.display();
    Failure::usage_error(format!(
        "{file} is a scenario, but {found} among the files: name the skin of the scenario with --skin"
    ))
}

/// Reads a skin, or recognises a scenario by its tables, which differ from those of a skin. A file without any of these
/// tables counts as a scenario if `has_skin`, else as a skin.
fn read_description(file: &Path, has_skin: bool) -> Result<CheckedContent, Failure> {
    const SKIN_TABLES: [&str; 8] =
        ["robot", "chain", "bus", "cell", "timing", "controller", "contact", "safety"];
    const SCENARIO_TABLES: [&str; 5] = ["motion", "mode", "touch", "fault", "sensors"];
    let text = document::read_text(file).map_err(Failure::usage_error)?;
    let has = |names: &[&str]| {
        let tables = text.lines().filter_map(|line| line.trim_start().strip_prefix('['));
        let name = |line: &str| {
            line.trim_start_matches([' ', '[']).split([']', '.', ' ']).next().unwrap_or_default().to_owned()
        };
        tables.map(name).any(|name| names.contains(&name.as_str()))
    };
    if !has(&SKIN_TABLES) && (has(&SCENARIO_TABLES) || has_skin) {
        return Ok(CheckedContent::Scenario(text));
    }
    let skin = Skin::parse(&file.display().to_string(), &text).map_err(Failure::usage_error)?;
    Ok(CheckedContent::Skin(Box::new(skin)))
}
