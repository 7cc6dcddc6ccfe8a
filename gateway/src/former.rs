//! Former names of commands and options. They are refused with a line that gives the present name, and appear in no
//! help, completion or man page.

/// Returns the line that gives the present name of a former command. `words` are the words of the command line.
pub(crate) fn former_command_hint(words: &[String], name: &str) -> Option<String> {
    let first = words.first().map(String::as_str).unwrap_or_default();
    let now = match (first, name) {
        ("ack", _) => "skinbus frame resume --bus BUS, or --skin SKIN for all of its buses",
        ("sensing", _) => "skinbus frame sensing MODE --bus BUS",
        ("scenario", _) => "skinbus check SCENARIO --skin SKIN",
        ("skin", "check") => "skinbus check SKIN",
        ("torque", _) => "skinbus explain SKIN --cell NODE --force N --joints POSITIONS",
        ("dbc", _) => "skinbus skin dbc SKIN",
        ("shadow", _) => "skinbus fit FILE, or buses",
        ("help", _) => "skinbus --help, and skinbus COMMAND --help",
        ("info", _) => "skinbus dump FILE --stats",
        _ => return None,
    };
    let old = if first == name { name.to_owned() } else { format!("{first} {name}") };
    Some(format!("there is no command {old}; use {now}"))
}

/// Text for former options whose value can no longer be chosen.
const FIXED_VALUE_HINT: &str = "its value is fixed now";

/// Returns the line that gives the present name of a former option. `words` are the words of the command line.
pub(crate) fn former_option_hint(words: &[String], option: &str) -> Option<String> {
    let name = option.split([' ', '=']).next().unwrap_or_default();
    let command = words.first().map(String::as_str).unwrap_or_default();
    let now = match (command, name) {
        ("explain" | "frame", "--force") => return None,
        (_, "--force") => "--overwrite",
        (_, "--cell-node") => "the environment variable SKINBUS_CELL_NODE",
        (_, "--vcan-setup") => "the environment variable SKINBUS_VCAN_SETUP",
        ("dump", "--max") => "-n, --count",
        ("dump", "--node") => "--cell",
        ("dump", "--strict") => "skinbus convert --strict",
        ("view", "--token") => {
            "--token-file, or the environment variable SKINBUS_TOKEN: every user can read a command line"
        }
        ("conformance", "--only") => "--requirement",
        ("frame" | "conformance" | "check", "--node") => "--cell",
        ("check", "--cells") => "--list",
        ("cells", "--for") => "--duration",
        ("replay", "--max") => "--speed max",
        ("replay", "--json") => "--summary -",
        ("skin", "--robot") if words.get(1).is_some_and(|word| word == "generate") => {
            "its value is fixed now: the robot is a UR5"
        }
        ("replay", "--view" | "--address-file" | "--token-file") => "`skinbus view SKIN` in another shell",
        ("replay", "--kind" | "--node") => {
            "--only, or skinbus dump to choose frames and canplayer to send them"
        }
        ("replay", "--spin" | "--send-timeout" | "--strict") => FIXED_VALUE_HINT,
        ("demo", "--record-split" | "--address-file" | "--token-file") => "skinbus run",
        ("run", "--receive-buffer") => "the environment variable SKINBUS_RECEIVE_BUFFER",
        ("calibrate", "--from") => "--recording",
        ("demo" | "replay", "--cells-per-process") => "the environment variable SKINBUS_CELLS_PER_PROCESS",
        ("calibrate", "--package") => "a skin whose URDF is beside its packages",
        ("calibrate", "--seed") | ("calibrate" | "experiment", "--cells-per-process") => FIXED_VALUE_HINT,
        ("skin", "--cells") if words.get(1).is_some_and(|word| word == "import") => "--places",
        _ => return None,
    };
    let verb = if now.starts_with(FIXED_VALUE_HINT) { "" } else { "use " };
    Some(format!("there is no option {name} in {command}; {verb}{now}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(line: &str) -> Vec<String> {
        line.split(' ').map(str::to_owned).collect()
    }

    #[test]
    fn former_names_lead_to_the_present_ones() {
        let of_command = |line: &str, name| former_command_hint(&words(line), name).unwrap_or_default();
        assert_eq!(of_command("dbc s.toml", "dbc"), "there is no command dbc; use skinbus skin dbc SKIN");
        assert_eq!(
            of_command("skin check s.toml", "check"),
            "there is no command skin check; use skinbus check SKIN"
        );
        assert_eq!(of_command("skin dbc s.toml", "x"), "");
        let of_option = |line: &str, name| former_option_hint(&words(line), name).unwrap_or_default();
        assert_eq!(
            of_option("run s.toml --force", "--force"),
            "there is no option --force in run; use --overwrite"
        );
        assert_eq!(of_option("dump b --max=3", "--max"), "there is no option --max in dump; use -n, --count");
        assert_eq!(of_option("explain s.toml --force", "--force"), "");
        assert!(of_option("skin import r.urdf --cells c.csv", "--cells").ends_with("use --places"));
        assert_eq!(of_option("skin generate --cells x", "--cells"), "", "it has this option");
    }
}
