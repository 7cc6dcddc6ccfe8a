//! Groups of the commands in the help.

use std::fmt::Write;

use clap::Command;

/// The groups of commands, each with its commands in the order of the help.
const GROUPS: [(&str, &[&str]); 7] = [
    ("Run", &["demo", "run", "view"]),
    ("Inspect", &["dump", "explain", "report", "cells", "compare"]),
    ("Files", &["convert", "replay", "recover"]),
    ("Bus load", &["fit"]),
    ("Real cells", &["commission", "calibrate", "conformance", "frame"]),
    ("Describe", &["skin", "check", "experiment"]),
    ("Shell", &["completions", "man"]),
];

/// Text at the end of the help.
const HELP_END: &str =
    "The sockets of embedded buses are in $SKINBUS_DIR, else $XDG_RUNTIME_DIR/skinbus, else /tmp/skinbus-UID.
`skinbus COMMAND -h` lists the options of a command, `--help` explains them.

Examples:
  skinbus demo
  skinbus run skin.toml --scenario scenario.toml --record run.mcap";

/// Replaces the list of commands in the help by groups.
pub(crate) fn group_commands(program: Command) -> Command {
    let help = format!(
        "{{about-with-newline}}\n{{usage-heading}} {{usage}}\n{}\nOptions:\n{{options}}\n\n{HELP_END}\n",
        format_command_list(&program)
    );
    program.help_template(help)
}

fn format_command_list(program: &Command) -> String {
    let mut text = String::new();
    for (group, names) in GROUPS {
        let _ = write!(text, "\n{group}:\n");
        for command in names.iter().filter_map(|name| program.find_subcommand(name)) {
            let about = command.get_about().map(ToString::to_string).unwrap_or_default();
            let _ = writeln!(text, "  {:<12} {about}", command.get_name());
        }
    }
    text
}

/// Returns the error for an unknown command, which suggests a similar name or lists all commands.
pub(crate) fn unknown_command(program: &Command, name: &str) -> String {
    let names: Vec<_> = program.get_subcommands().map(Command::get_name).collect();
    let likely = names.iter().map(|it| (strsim::jaro_winkler(name, it), it));
    let best = likely.max_by(|one, other| one.0.total_cmp(&other.0)).filter(|(likeness, _)| *likeness > 0.75);
    match best {
        Some((_, best)) => format!("there is no command {name}; did you mean {best}?"),
        None => {
            format!("there is no command {name}; the commands are {}", crate::print::comma_separated(names))
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::{BTreeMap, BTreeSet};

    use clap::{Arg, CommandFactory};

    use super::*;

    fn program() -> Command {
        let mut program = group_commands(crate::Arguments::command());
        program.build();
        program
    }

    /// Collects a command and all its subcommands.
    fn all<'a>(command: &'a Command, found: &mut Vec<&'a Command>) {
        found.push(command);
        command.get_subcommands().for_each(|it| all(it, found));
    }

    /// Returns the visible options of a command, except help and version.
    fn options(command: &Command) -> impl Iterator<Item = &Arg> {
        let is_own = |arg: &&Arg| !matches!(arg.get_id().as_str(), "help" | "version");
        command.get_arguments().filter(is_own).filter(|arg| !arg.is_hide_set() && !arg.is_positional())
    }

    #[test]
    fn every_command_is_in_one_group() {
        let grouped: Vec<_> = GROUPS.iter().flat_map(|(_, names)| names.iter().copied()).collect();
        let program = program();
        let there: BTreeSet<_> = program.get_subcommands().map(Command::get_name).collect();
        assert_eq!(grouped.iter().copied().collect::<BTreeSet<_>>(), there);
        assert!(grouped.len() <= 21 && grouped.len() == there.len(), "{}", grouped.len());
        let help = program.clone().render_help().to_string();
        assert!(help.contains("\nReal cells:\n  commission   Write the parameters in a skin file"), "{help}");
    }

    #[test]
    fn there_are_at_most_216_options() {
        // The command is not built yet, so global options count once, where they are defined.
        let program = crate::Arguments::command();
        let mut commands = Vec::new();
        all(&program, &mut commands);
        let of_all: usize = commands.iter().map(|it| options(it).count()).sum();
        assert!(
            of_all <= 216,
            "{of_all}: {:?}",
            commands.iter().map(|it| (it.get_name(), options(it).count())).collect::<Vec<_>>()
        );
    }

    #[test]
    fn an_option_means_the_same_in_every_command() {
        let program = program();
        let mut commands = Vec::new();
        all(&program, &mut commands);
        let mut meanings = BTreeMap::<String, BTreeSet<String>>::new();
        let mut shorts = BTreeMap::<char, BTreeSet<String>>::new();
        for arg in commands.iter().flat_map(|it| options(it)) {
            let long = arg.get_long().unwrap_or_default().to_owned();
            let names = arg.get_value_names().unwrap_or_default();
            let takes = if arg.get_action().takes_values() {
                crate::print::space_separated(names)
            } else {
                String::new()
            };
            // FILE and DIR both name a path.
            let takes = if takes == "DIR" { "FILE".to_owned() } else { takes };
            meanings.entry(long.clone()).or_default().insert(takes);
            if let Some(short) = arg.get_short() {
                shorts.entry(short).or_default().insert(long);
            }
        }
        let several: Vec<_> = meanings.iter().filter(|(_, takes)| takes.len() > 1).collect();
        assert_eq!(several, Vec::<(&String, &BTreeSet<String>)>::new());
        let several: Vec<_> = shorts.iter().filter(|(_, longs)| longs.len() > 1).collect();
        assert_eq!(several, Vec::<(&char, &BTreeSet<String>)>::new());
        // Two options with other values than `FILE`: --overwrite has none, --force is in newtons.
        assert_eq!(meanings["overwrite"], BTreeSet::from([String::new()]));
        assert_eq!(meanings["force"], BTreeSet::from(["N".to_owned()]));
    }

    #[test]
    fn a_name_that_is_nearly_a_command_is_asked_about() {
        let program = program();
        assert_eq!(unknown_command(&program, "dmup"), "there is no command dmup; did you mean dump?");
        assert_eq!(unknown_command(&program, "reply"), "there is no command reply; did you mean replay?");
        assert!(
            unknown_command(&program, "xyz")
                .starts_with("there is no command xyz; the commands are demo, run, view")
        );
    }

    #[test]
    fn the_command_line_is_sound() {
        crate::Arguments::command().debug_assert();
    }
}
