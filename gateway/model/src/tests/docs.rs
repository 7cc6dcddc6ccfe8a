//! Checks that the documents on user files match the program: their examples parse, and their tables list exactly the
//! supported keys.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may stop")]

use std::collections::BTreeSet;

use crate::scenario::Scenario;
use protocol::skin::{ControllerKind, Skin};
use protocol::time::Micros;

const SKIN_MD: &str = include_str!("../../../../docs/reference/skin.md");
const SCENARIO_MD: &str = include_str!("../../../../docs/reference/scenario.md");
const CONTROLLER_MD: &str = include_str!("../../../../docs/how-to/external-controller.md");

/// Returns the fenced TOML block that contains this text.
fn block<'a>(document: &'a str, with: &str) -> &'a str {
    let blocks = document.split("```toml\n").skip(1).filter_map(|rest| rest.split("\n```").next());
    let mut found = blocks.filter(|block| block.contains(with));
    let block = found.next().unwrap_or_else(|| panic!("no block of TOML with {with:?}"));
    assert_eq!(found.next(), None, "one block with {with:?}");
    block
}

fn skin_text() -> &'static str {
    block(SKIN_MD, "# skin.toml:")
}

fn scenario_text() -> &'static str {
    block(SCENARIO_MD, "# scenario.toml:")
}

/// Returns the keys under a heading: from the table's first column, or from the list before the parentheses and the
/// colon.
fn documented(page: &str, heading: &str) -> BTreeSet<String> {
    let start = page.find(&format!("\n{heading}\n")).unwrap_or_else(|| panic!("no heading {heading:?}"));
    let section = &page[start + heading.len() + 2..];
    let section = section.split("\n#").next().unwrap();
    let keys = section.lines().filter_map(|line| {
        let row = line.strip_prefix("| ").and_then(|row| row.split(" | ").next());
        let item = line.strip_prefix("- ").and_then(|item| item.split([':', '(']).next());
        row.or(item).filter(|keys| keys.starts_with('`'))
    });
    keys.flat_map(|keys| keys.split('`').skip(1).step_by(2)).map(str::to_owned).collect()
}

/// Returns the keys that a table accepts, from the program's error for an unknown key.
fn allowed(text: &str, read: impl Fn(&str) -> String) -> BTreeSet<String> {
    let said = read(text);
    let (_, keys) = said.split_once("unknown field `zzz`, expected ").unwrap_or_else(|| panic!("{said}"));
    keys.split('`').skip(1).step_by(2).map(str::to_owned).collect()
}

fn read_skin(text: &str) -> String {
    Skin::parse("skin.toml", text).unwrap_err().to_string()
}

fn read_scenario(text: &str) -> String {
    let skin = Skin::parse("skin.toml", skin_text()).unwrap();
    Scenario::parse("scenario.toml", text, &skin).unwrap_err().to_string()
}

/// Returns a text with an unknown key inserted after the first `line`.
fn spoilt(text: &str, line: &str) -> String {
    let with = format!("\n{line}\n");
    assert!(text.contains(&with), "the example has {line}");
    text.replacen(&with, &format!("{with}zzz = 1\n"), 1)
}

#[test]
fn the_examples_are_read_and_mean_what_the_text_says() {
    let skin = Skin::parse("skin.toml", skin_text()).unwrap();
    assert_eq!((skin.cells.len(), skin.robot.joints.len()), (2, 6));
    let [first, second] = skin.cells.as_slice() else { panic!("two cells") };
    assert_eq!((first.serial, second.serial), (1, 2), "1000 * bus + node");
    assert!(second.contact.force_threshold.to_f64() >= 0.5 && first.contact.force_threshold.to_f64() < 0.2);
    let scenario = Scenario::parse("scenario.toml", scenario_text(), &skin).unwrap();
    assert_eq!((scenario.touches.len(), scenario.faults.len(), scenario.modes.len()), (2, 2, 2));
    let points =
        Scenario::parse("scenario.toml", block(SCENARIO_MD, "# a touch that follows points"), &skin).unwrap();
    let touch = points.touches.first().unwrap();
    assert_eq!((touch.cells.len(), touch.at + touch.length), (2, Micros(2_500_000)), "gone at 2.5 s");
    let nowhere = skin_text().replacen("joint = 2", "joint = 9", 1);
    let said = read_skin(&nowhere);
    assert!(said.ends_with(": cell[0].joint = 9: use a joint from 1 to 6"), "{said}");
}

#[test]
fn what_may_be_omitted_has_the_default_that_the_text_says() {
    let safety = "[safety]\nhold_epochs = 2\ndecay_epochs = 4\nbad_cycles = 25\nlost_bus = \"go-on\"\n";
    assert!(skin_text().contains(safety));
    let skin = Skin::parse("skin.toml", skin_text()).unwrap();
    assert_eq!(Skin::parse("skin.toml", &skin_text().replace(safety, "")), Ok(skin.clone()));
    let plain = Scenario::parse("scenario.toml", "version = 1\nduration_s = 6.0\n", &skin).unwrap();
    assert_eq!(plain, Scenario::idle(plain.duration));
    let short = Skin::parse("skin.toml", block(SKIN_MD, "# a short skin.toml")).unwrap();
    let said = "version = 1\nname = \"skin\"\n[timing]\ncontrol_hz = 500.0\njoint_broadcast_hz = 62.5\n[[bus]]\n\
                name = \"vcan0\"\nreply = \"torque\"\nformat = \"fd\"\n[controller]\nkind = \"kinesthetic\"\n\
                inertia = [1.0, 1.0]\ndamping = [4.0, 4.0]\nmax_speed_rad_s = [2.0, 2.0]\n";
    let text = block(SKIN_MD, "# a short skin.toml").replace("[robot]", "[robot]\nname = \"robot\"");
    assert_eq!(Skin::parse("skin.toml", &format!("{said}{text}")), Ok(short.clone()));
    let touch = block(SCENARIO_MD, "# a short scenario.toml");
    let said =
        format!("version = 1\nduration_s = 10.0\n{touch}\nat_s = 0.0\nbus = \"vcan0\"\nprofile = \"step\"\n");
    let pressed = Scenario::parse("scenario.toml", touch, &short).unwrap();
    assert_eq!(Scenario::parse("scenario.toml", &said, &short), Ok(pressed));
    let defaults =
        [("alpha_c", 1.0), ("alpha_p", 0.0), ("contact_threshold_n", 0.0), ("proximity_threshold", 0.0)];
    for (key, default) in defaults {
        let line = skin_text().lines().find(|line| line.starts_with(key)).unwrap();
        let without = Skin::parse("skin.toml", &skin_text().replace(line, "")).unwrap();
        let given = skin_text().replace(line, &format!("{key} = {default:.1}"));
        assert_eq!(without, Skin::parse("skin.toml", &given).unwrap(), "{key}");
    }
}

#[test]
fn every_key_of_a_skin_is_documented_and_no_other() {
    let at_top = format!("zzz = 1\n{}", skin_text());
    assert_eq!(documented(SKIN_MD, "### At the top of a skin"), allowed(&at_top, read_skin));
    for line in ["[robot]", "[timing]", "[contact]", "[[bus]]", "[controller]", "[safety]", "[[cell]]"] {
        let text = spoilt(skin_text(), line);
        assert_eq!(documented(SKIN_MD, &format!("### `{line}`")), allowed(&text, read_skin), "{line}");
    }
    let baseline = skin_text().replacen("[timing]", "[baseline]\nzzz = 1\n[timing]", 1);
    assert_eq!(documented(SKIN_MD, "### `[baseline]`"), allowed(&baseline, read_skin));
    let row = skin_text().replacen("{ a =", "{ zzz = 1, a =", 1);
    assert_eq!(documented(SKIN_MD, "### `robot.joints`"), allowed(&row, read_skin));
}

#[test]
fn every_key_of_a_scenario_is_documented_and_no_other() {
    let at_top = format!("zzz = 1\n{}", scenario_text());
    assert_eq!(documented(SCENARIO_MD, "### At the top of a scenario"), allowed(&at_top, read_scenario));
    for line in ["[motion]", "[[mode]]", "[[touch]]", "[[fault]]"] {
        let text = spoilt(scenario_text(), line);
        assert_eq!(
            documented(SCENARIO_MD, &format!("### `{line}`")),
            allowed(&text, read_scenario),
            "{line}"
        );
    }
    for line in ["[sensors]", "[sensors.force]", "[sensors.acceleration]"] {
        let keys = allowed(&format!("{line}\nzzz = 1\n"), read_scenario);
        assert_eq!(documented(SCENARIO_MD, &format!("### `{line}`")), keys, "{line}");
    }
}

#[test]
fn every_kind_of_fault_is_documented_and_no_other() {
    let text = scenario_text().replacen("kind = \"kill\"", "kind = \"zzz\"", 1);
    let said = read_scenario(&text);
    let (_, kinds) = said.split_once("\"zzz\": ").unwrap_or_else(|| panic!("{said}"));
    let kinds: BTreeSet<&str> = kinds.split('"').skip(1).step_by(2).collect();
    let start = SCENARIO_MD.find("### Kinds of faults").unwrap();
    let rows = SCENARIO_MD[start..].lines().filter(|line| line.starts_with("| `"));
    let names = rows.flat_map(|row| row.split(" | ").next().unwrap().split('`').skip(1).step_by(2));
    assert_eq!(names.collect::<BTreeSet<_>>(), kinds);
}

#[test]
fn the_external_controllers_table_fits_into_a_skin() {
    let external = block(CONTROLLER_MD, "[controller]");
    let start = skin_text().find("[controller]").unwrap();
    let end = skin_text().find("[safety]").unwrap();
    let text = [&skin_text()[..start], external, "\n\n", &skin_text()[end..]].concat();
    let skin = Skin::parse("skin.toml", &text).unwrap();
    assert!(matches!(skin.controller.kind, ControllerKind::External { .. }));
}
