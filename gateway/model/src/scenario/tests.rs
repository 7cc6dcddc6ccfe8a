use proptest::prelude::*;

mod repeat;

use super::*;
use crate::testing::{ONE_CELL_SKIN_TOML, one_cell_skin};

const GOOD: &str = r#"version = 1
duration_s = 12.0
seed = 7

[motion]
kind = "sine"
start_rad = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]
amplitude_rad = [0.5, 0.1, 0.0, 0.0, 0.0, 0.0]
period_s = 4.0

[[mode]]
at_s = 0.0
kind = "compare"
[[mode]]
at_s = 5.7
kind = "distributed"

[[touch]]
at_s = 2.0
for_s = 1.6
bus = "vcan0"
cells = [1, 3]
force_n = 3.0
profile = "half-sine"

[[touch]]
at_s = 3.0
for_s = 0.5
cells = [2]
force_n = 1.0
profile = "step"
proximity = 0.5
temperature_c = [30.0, 31.5]

[[fault]]
at_s = 9.0
kind = "delay"
for_s = 1.0
bus = "vcan0"
probability = 0.25
delay_us = 3000

[[fault]]
at_s = 8.0
kind = "kill"
cells = [1]
"#;

/// Returns a skin with three cells on one bus.
fn three() -> Skin {
    let cell = ONE_CELL_SKIN_TOML.get(ONE_CELL_SKIN_TOML.find("[[cell]]").unwrap()..).unwrap();
    let text = [2, 3].map(|node| cell.replace("node = 1", &format!("node = {node}")));
    Skin::parse("skin.toml", &format!("{ONE_CELL_SKIN_TOML}\n{}", text.concat())).unwrap()
}

fn good() -> Scenario {
    Scenario::parse("scenario.toml", GOOD, &three()).unwrap()
}

/// Formats an error with its line only; columns have their own test.
fn by_line(error: DocumentError) -> String {
    let DocumentError::InvalidValue { path, line, what, .. } = error else { return error.to_string() };
    format!("{path}:{line}: {what}")
}

fn says(from: &str, to: &str) -> String {
    assert!(GOOD.contains(from), "{from}");
    by_line(Scenario::parse("s.toml", &GOOD.replacen(from, to, 1), &three()).unwrap_err())
}

#[test]
fn speeds_and_accelerations_of_a_motion_are_the_differences_of_its_positions() {
    let motion = good().motion;
    let step = 1e-4;
    for at in 0..50 {
        let seconds = f64::from(at) * 0.1;
        let [before, now, after] =
            [seconds - step, seconds, seconds + step].map(|seconds| motion.state_at(seconds).unwrap());
        for joint in 0..6 {
            let [before, position, after] = [before, now, after].map(|state| state.position[joint]);
            assert!(((after - before) / (2.0 * step) - now.speed[joint]).abs() < 1e-6, "{seconds}");
            let acceleration = (after - 2.0 * position + before) / (step * step);
            assert!((acceleration - now.acceleration[joint]).abs() < 1e-5, "{seconds}");
        }
    }
    let unknown = Motion { kind: MotionKind::Kinesthetic, ..motion };
    assert_eq!(unknown.state_at(1.0), None);
    let hold = Motion { kind: MotionKind::Hold, ..motion };
    assert_eq!(
        hold.state_at(1.0).map(|state| (state.position, state.speed)),
        Some((motion.start, [0.0; MAX_ROBOT_JOINTS]))
    );
}

#[test]
fn a_good_scenario_is_read() {
    let scenario = good();
    assert_eq!((scenario.duration, scenario.seed), (Span(12_000_000), 7));
    assert!(matches!(scenario.motion.kind, MotionKind::Sine { .. }));
    assert_eq!(scenario.mode_at(Micros(5_699_999)), TorqueSource::Compare);
    assert_eq!(scenario.mode_at(Micros(5_700_000)), TorqueSource::Distributed);
    assert_eq!(scenario.touches[0].cells, [0, 2]);
    assert_eq!(scenario.touches[1].values.temperature.unwrap()[1].to_f64(), 31.5);
    let [kill, delay] = scenario.faults.as_slice() else { panic!("{:?}", scenario.faults) };
    let action = ProcessAction::Kill;
    assert_eq!(kill.kind, FaultKind::Process { action, cells: vec![0] }, "in the order of time");
    let fault = BusFault::Delay { probability: 0.25, delay: Span(3_000) };
    let length = Span(1_000_000);
    assert_eq!(delay.kind, FaultKind::Bus { fault, length, bus: 0, cells: vec![] });
}

#[test]
fn most_keys_have_defaults() {
    let scenario = Scenario::parse("s.toml", "version = 1\nduration_s = 2.5\n", &one_cell_skin()).unwrap();
    assert_eq!(scenario, Scenario::idle(Span(2_500_000)));
    assert_eq!(scenario.mode_at(Micros(0)), TorqueSource::Compare);
    let parse = |text: &str| Scenario::parse("s.toml", text, &one_cell_skin()).unwrap();
    assert_eq!(parse(""), Scenario::idle(DEFAULT_DURATION));
    // The shortest file with an effect: a constant force on one cell, until the end.
    let short = parse("[[touch]]\ncells = [1]\nforce_n = 3.0\n");
    let touch = &short.touches[0];
    assert_eq!((short.duration, touch.at, touch.length), (DEFAULT_DURATION, Micros(0), Span(u64::MAX)));
    assert_eq!((&touch.profile, touch.cells.as_slice()), (&ForceProfile::Step, [0].as_slice()));
    let pressed = Touches::new(&short, &one_cell_skin()).sensors(0, 1_000_000);
    assert_eq!(pressed.contact, contact_words(3.0), "also when the run is longer");
    let later = "[[touch]]\nat_s = 12.5\nfor_s = 1.0\nall = true\nforce_n = 3.0\nprofile = \"ramp\"\n";
    assert_eq!(parse(later).duration, Span(14_500_000), "a second after the last touch");
    let fault = "[[fault]]\nat_s = 20.0\nkind = \"kill\"\ncells = [1]\n";
    assert_eq!(parse(&format!("{later}{fault}")).duration, Span(21_000_000));
    assert_eq!(parse("[motion]\n").motion.kind, MotionKind::Kinesthetic);
}

#[test]
fn every_kind_of_fault_and_motion_is_named_as_it_is_read() {
    let skin = three();
    let faults = [
        ("kill", ""),
        ("stop", ""),
        ("continue", ""),
        ("restart", ""),
        ("stuck", ""),
        ("drift", "n_per_s = -0.5"),
        ("drop", "probability = 0.5"),
        ("delay", "probability = 0.5\ndelay_us = 20"),
        ("duplicate", "probability = 0.5"),
        ("corrupt", "probability = 0.5"),
        ("reorder", "probability = 0.5"),
        ("babble", "frames_per_s = 10"),
    ];
    for (kind, more) in faults {
        let text = format!("version = 1\n[[fault]]\nat_s = 0.5\nkind = \"{kind}\"\ncells = [1]\n{more}\n");
        let scenario = Scenario::parse("s.toml", &text, &skin).unwrap();
        assert_eq!(scenario.faults.first().map(|fault| fault.kind.name()), Some(kind));
        assert!(faults::FAULT_KINDS.contains(&format!("{kind:?}")), "{kind}");
    }
    for motion in [
        "kind = \"hold\"",
        "kind = \"kinesthetic\"",
        "kind = \"sine\"\namplitude_rad = [0.0, 0.1, 0.0, 0.0, 0.0, 0.0]\nperiod_s = 4.0",
    ] {
        let scenario =
            Scenario::parse("s.toml", &format!("version = 1\n[motion]\n{motion}\n"), &skin).unwrap();
        assert!(motion.contains(&format!("{:?}", scenario.motion.kind.name())), "{motion}");
    }
}

#[test]
fn what_has_no_effect_is_remarked() {
    let skin = three();
    let remarks = |text: &str, skin: &Skin| {
        Scenario::parse("s.toml", &format!("version = 1\n{text}"), skin).unwrap().warnings(skin)
    };
    let touch = |force: &str| format!("[[touch]]\nat_s = 0.5\ncells = [1, 2]\nforce_n = {force}\n");
    assert!(remarks(&touch("3.0"), &skin).is_empty());
    assert!(remarks(&touch("0.0\nproximity = 0.5"), &skin).is_empty(), "it presses nobody");
    assert_eq!(
        remarks(&touch("0.01"), &skin),
        ["the touch at 0.5 s: force_n = 0.01 is below the thresholds of its cells, so they send no torque"]
    );
    let external = ONE_CELL_SKIN_TOML.replace("\"kinesthetic\"", "\"external\"\nsocket = \"arm.sock\"");
    let external =
        external.lines().filter(|line| !line.starts_with("inertia") && !line.starts_with("damping"));
    let external = Skin::parse("skin.toml", &external.collect::<Vec<_>>().join("\n")).unwrap();
    assert!(remarks("", &external).is_empty());
    let said = remarks("[motion]\nkind = \"hold\"\n", &external);
    assert!(
        said[0].starts_with("motion.kind = \"hold\": the scenario moves the robot, and the external"),
        "{said:?}"
    );
}

#[test]
fn what_comes_and_goes_needs_a_length_and_a_skin_is_no_scenario() {
    let said = |text: &str| Scenario::parse("s.toml", text, &one_cell_skin()).unwrap_err().to_string();
    let endless = "[[touch]]\nall = true\nforce_n = 3.0\nprofile = \"half-sine\"\n";
    assert_eq!(said(endless), "s.toml:1:1: touch[0].for_s: required with profile = \"half-sine\"");
    let taken = "this is a skin, not a scenario: give both, as in `skinbus run SKIN --scenario SCENARIO`";
    assert_eq!(said(ONE_CELL_SKIN_TOML), format!("s.toml: {taken}"));
}

#[test]
fn every_error_names_line_key_value_and_what_is_allowed() {
    assert_eq!(says("version = 1", "version = 2"), "s.toml:1: version = 2: this program reads version 1");
    assert_eq!(says("12.0", "0.0"), "s.toml:2: duration_s = 0: must be above 0, and at most 3.2e7");
    assert_eq!(says("seed = 7", "seed = -7"), "s.toml:3: seed = -7: must not be negative");
    assert_eq!(
        says("\"sine\"", "\"dance\""),
        "s.toml:6: motion.kind = \"dance\": must be \"hold\", \"sine\" or \"kinesthetic\""
    );
    assert_eq!(
        says("\"sine\"", "\"hold\""),
        "s.toml:8: motion.amplitude_rad: allowed only with kind = \"sine\""
    );
    assert_eq!(says("period_s = 4.0\n", ""), "s.toml:5: motion.period_s: required with kind = \"sine\"");
    assert_eq!(
        says("-1.57, 0.0]", "-1.57]"),
        "s.toml:7: motion.start_rad = 5 values: must have one value for each of the robot's 6 joints"
    );
    assert_eq!(
        says("start_rad = [0.0", "start_rad = [6.0"),
        "s.toml:7: motion.start_rad[0] = 6 rad: joint1 is limited to -6.2832 to 6.2832 rad, and it swings by 0.5 rad"
    );
    assert_eq!(
        says("[0.5, 0.1", "[1.5, 0.1"),
        "s.toml:8: motion.amplitude_rad[0] = 1.5: with a period of 4 s this needs 2.356 rad/s, but the limit of joint 1 is 2"
    );
    assert_eq!(
        says("at_s = 5.7", "at_s = 0.0"),
        "s.toml:15: mode[1].at_s = 0: modes must be in the order of their times"
    );
    assert_eq!(
        says("\"distributed\"", "\"central\""),
        "s.toml:16: mode[1].kind = \"central\": must be \"compare\" or \"distributed\""
    );
    assert_eq!(
        says("at_s = 2.0", "at_s = 12.0"),
        "s.toml:19: touch[0].at_s = 12: must be within the scenario, from 0 to duration_s = 12"
    );
    assert_eq!(
        says("\"vcan0\"", "\"vcan7\""),
        "s.toml:21: touch[0].bus = \"vcan7\": the skin has no such bus, only \"vcan0\""
    );
    assert_eq!(
        says("[1, 3]", "[1, 4]"),
        "s.toml:22: touch[0].cells[1] = 4: no cell of \"vcan0\" has node id 4: it has 1-3"
    );
    assert_eq!(says("[1, 3]", "[1, 1]"), "s.toml:22: touch[0].cells[1] = 1: cells[0] is the same cell");
    assert_eq!(says("[1, 3]", "[]"), "s.toml:22: touch[0].cells = []: at least one cell is needed");
    assert_eq!(
        says("cells = [1, 3]\n", ""),
        "s.toml:18: touch[0].cells: give the node ids of the cells, or all = true"
    );
    assert_eq!(
        says("force_n = 3.0", "force_n = 96.0"),
        "s.toml:23: touch[0].force_n = 96: must be 0 to 95.997 N, the most that a cell's three contact \
         sensors can report"
    );
    assert_eq!(
        says("\"step\"", "\"poke\""),
        "s.toml:31: touch[1].profile = \"poke\": must be \"half-sine\", \"step\", \"ramp\" or points \
         [[t_s, force_n], ...]"
    );
    assert_eq!(says("31.5]", "600.0]"), "s.toml:33: touch[1].temperature_c = 600: must be in [-512, 512)");
    assert_eq!(
        says("cells = [2]\nforce_n = 1.0", "all = true\nforce_n = 94.0"),
        "s.toml:30: touch[1].force_n = 94: together with earlier touches this makes 97 N on cell 1 of \
         \"vcan0\", more than the 95.997 N of three contact words"
    );
    assert_eq!(
        says("probability = 0.25", "probability = 25"),
        "s.toml:40: fault[0].probability = 25: must be 0 to 1 with kind = \"delay\""
    );
    assert_eq!(
        says("delay_us = 3000\n", ""),
        "s.toml:35: fault[0].delay_us: must be 1 to 1000000 us with kind = \"delay\""
    );
    assert_eq!(
        says("kind = \"kill\"", "kind = \"kill\"\nprobability = 0.5"),
        "s.toml:46: fault[1].probability: is not allowed with kind = \"kill\""
    );
    assert!(
        says("\"kill\"", "\"kil\"")
            .starts_with("s.toml:45: fault[1].kind = \"kil\": must be a fault of processes: \"kill\"")
    );
    assert_eq!(
        says("for_s = 1.6", "for = 1.6"),
        "s.toml:20: unknown field `for`, expected one of `at_s`, `for_s`, `bus`, `cells`, `all`, \
         `force_n`, `profile`, `proximity`, `temperature_c`"
    );
}

#[test]
fn with_several_buses_the_bus_must_be_named() {
    let more = ONE_CELL_SKIN_TOML.replacen(
        "[controller]",
        "[[bus]]\nname = \"vcan1\"\nreply = \"torque\"\nformat = \"fd\"\n\n[controller]",
        1,
    );
    let skin = Skin::parse("skin.toml", &more).unwrap();
    let text = "version = 1\nduration_s = 1.0\n[[fault]]\nat_s = 0.5\nkind = \"kill\"\ncells = [1]\n";
    assert_eq!(
        by_line(Scenario::parse("s.toml", text, &skin).unwrap_err()),
        "s.toml:3: fault[0].bus: missing: give the bus (\"vcan0\", \"vcan1\"), or name each cell with its \
         bus, as in \"vcan0:1\""
    );
    let text = format!("{text}bus = \"vcan1\"\n");
    assert_eq!(
        by_line(Scenario::parse("s.toml", &text, &skin).unwrap_err()),
        "s.toml:6: fault[0].cells[0] = 1: no cell of \"vcan1\" has node id 1: it has no cells"
    );
}

/// Returns the force in N of a cell's words in an epoch.
fn force(touches: &Touches, cell: usize, epoch: u64) -> f64 {
    touches.sensors(cell, epoch).contact.iter().map(|word| word.to_f64()).sum()
}

#[test]
fn touches_come_and_go_by_their_profile() {
    let touches = Touches::new(&good(), &three());
    // At 62.5 epochs per second, the half-sine covers epochs 125 to 225, the step 187.5 to 218.75.
    assert_eq!(force(&touches, 0, 125), 0.0);
    assert_eq!(force(&touches, 0, 175), 3.0, "the middle");
    assert!((force(&touches, 0, 150) - 3.0 * 0.5_f64.sqrt()).abs() < 1e-3);
    assert_eq!(force(&touches, 0, 225), 0.0);
    assert_eq!((force(&touches, 1, 187), force(&touches, 1, 188)), (0.0, 1.0));
    assert_eq!((force(&touches, 1, 218), force(&touches, 1, 219)), (1.0, 0.0));
    assert_eq!(touches.sensors(1, 200).proximity.to_f64(), 0.5);
    assert_eq!(touches.sensors(1, 219), Default::default());
    assert_eq!(touches.sensors(77, 200), Default::default(), "no such cell");
    let text = GOOD.replacen("\"half-sine\"", "\"ramp\"", 1);
    let scenario = Scenario::parse("s.toml", &text, &three()).unwrap();
    assert_eq!(force(&Touches::new(&scenario, &three()), 0, 150), 0.75);
}

#[test]
fn forces_of_overlapping_touches_add_up() {
    let text = GOOD.replacen("cells = [2]", "cells = [1]", 1);
    let touches = Touches::new(&Scenario::parse("s.toml", &text, &three()).unwrap(), &three());
    let alone = Touches::new(&good(), &three());
    assert_eq!(force(&touches, 0, 200), force(&alone, 0, 200) + 1.0);
}

#[test]
fn only_touches_at_the_same_time_press_together() {
    let touch = |at, length, force| {
        format!(
            "[[touch]]\nat_s = {at}\nfor_s = {length}\nall = true\nforce_n = {force}\nprofile = \"step\"\n"
        )
    };
    let parse = |touches: [String; 3]| {
        let text = format!("version = 1\nduration_s = 9.0\n{}", touches.concat());
        Scenario::parse("s.toml", &text, &three())
    };
    assert!(parse([touch(1.0, 1.0, 50.0), touch(2.0, 1.0, 50.0), touch(0.5, 4.0, 40.0)]).is_ok());
    assert!(parse([touch(1.0, 1.5, 50.0), touch(2.0, 1.0, 30.0), touch(0.5, 4.0, 40.0)]).is_err());
    assert!(parse([touch(0.5, 4.0, 40.0), touch(2.0, 1.0, 30.0), touch(1.0, 1.5, 50.0)]).is_err());
}

#[test]
fn only_changes_make_stimuli() {
    let mut touches = Touches::new(&good(), &three());
    let mut stimuli =
        |epoch| touches.stimuli_for(epoch).map(|it| (it.cell, it.node.get())).collect::<Vec<_>>();
    assert_eq!(stimuli(0), []);
    assert_eq!(stimuli(125), [], "the half-sine begins with nothing");
    assert_eq!(stimuli(126), [(0, 1), (2, 3)]);
    assert_eq!(stimuli(188), [(0, 1), (1, 2), (2, 3)]);
    assert_eq!(stimuli(190), [(0, 1), (2, 3)], "the step holds");
    assert_eq!(stimuli(219), [(0, 1), (1, 2), (2, 3)], "and ends");
    assert_eq!(stimuli(226), []);
}

#[test]
fn sensors_get_stuck_and_drift() {
    let faults = "[[fault]]\nat_s = 3.2\nkind = \"stuck\"\nfor_s = 4.8\ncells = [2]\n\
                  [[fault]]\nat_s = 0.0\nkind = \"drift\"\ncells = [3]\nn_per_s = 0.5\n";
    let scenario = Scenario::parse("s.toml", &format!("{GOOD}{faults}"), &three()).unwrap();
    let touches = Touches::new(&scenario, &three());
    assert_eq!((force(&touches, 1, 199), force(&touches, 1, 499), force(&touches, 1, 500)), (1.0, 1.0, 0.0));
    assert_eq!((force(&touches, 2, 0), force(&touches, 2, 125)), (0.0, 1.0), "half a newton a second");
    assert!((force(&touches, 2, 175) - 4.4).abs() < 1e-3, "on top of the touch");
}

proptest! {
    #[test]
    fn three_words_add_up_exactly_to_the_rounded_force(force_n in -96.0_f64..96.0) {
        let words = contact_words(force_n).map(|word| i32::from(word.to_bits()));
        let target = (force_n * 1_024.0).round().clamp(3.0 * -32_768.0, 3.0 * 32_767.0);
        prop_assert_eq!(f64::from(words.iter().sum::<i32>()), target);
        prop_assert!(words.iter().max().unwrap() - words.iter().min().unwrap() <= 1);
    }

    #[test]
    fn no_force_panics(force_n: f64) {
        let _ = contact_words(force_n);
    }

    /// The changes from epoch to epoch add up to the words of every cell, even if epochs are skipped.
    #[test]
    fn changes_add_up_to_the_words_of_every_cell(steps in proptest::collection::vec(1_u64..40, 1..60)) {
        let faults = "[[fault]]\nat_s = 2.5\nkind = \"stuck\"\nfor_s = 0.3\ncells = [1]\n\
                      [[fault]]\nat_s = 2.0\nkind = \"drift\"\nfor_s = 2.0\ncells = [3]\nn_per_s = -0.5\n";
        let scenario = Scenario::parse("s.toml", &format!("{GOOD}{faults}"), &three()).unwrap();
        let mut touches = Touches::new(&scenario, &three());
        let mut known = [protocol::message::SkinSensors::default(); 3];
        let (mut before, mut epoch) = (None, 0);
        for step in steps {
            for stimulus in touches.stimuli_between(before, epoch) {
                prop_assert_ne!(known[stimulus.cell], stimulus.readings.skin);
                known[stimulus.cell] = stimulus.readings.skin;
            }
            for (cell, known) in known.iter().enumerate() {
                prop_assert_eq!(*known, touches.sensors(cell, epoch));
            }
            (before, epoch) = (Some(epoch), epoch + step);
        }
    }
}

#[test]
fn words_saturate_outside_their_range() {
    assert_eq!(contact_words(200.0).map(|word| word.to_bits()), [i16::MAX; 3]);
    assert_eq!(contact_words(-200.0).map(|word| word.to_bits()), [i16::MIN; 3]);
    assert_eq!(contact_words(1.0).map(|word| word.to_bits()), [342, 341, 341]);
}

#[test]
fn a_link_between_two_wired_cells_goes_down_and_comes_up_in_time() {
    let (head, cell) = ONE_CELL_SKIN_TOML.split_at(ONE_CELL_SKIN_TOML.find("[[cell]]").unwrap());
    let cell = cell.split("[[cell]]").nth(1).unwrap();
    let described = |reply: &str, neighbors: [&str; 3]| {
        let cells = (1..).zip(neighbors).map(|(node, neighbors)| {
            let more = format!("node = {node}\nroot = {}\nneighbors = {neighbors}", node == 1);
            format!("[[cell]]{}", cell.replacen("node = 1", &more, 1))
        });
        let text = format!("{}{}", head.replace("reply = \"torque\"", reply), cells.collect::<String>());
        Skin::parse("skin.toml", &text).unwrap()
    };
    let line = ["[2, 0, 0, 0]", "[1, 3, 0, 0]", "[2, 0, 0, 0]"];
    let sums = described("reply = \"sum\"\nslot_us = 1500", line);
    let fault = |skin: &Skin, text: &str| {
        let text = format!("version = 1\nduration_s = 9.0\n[[fault]]\nat_s = 0.5\n{text}\n");
        Scenario::parse("s.toml", &text, skin).map(|scenario| scenario.faults).map_err(by_line)
    };
    let wire = |at, link_down, from, to, both_ways| Fault {
        at: Micros(at),
        kind: FaultKind::Wire { link_down, from, to, both_ways },
    };
    assert_eq!(
        fault(&sums, "kind = \"link_down\"\ncells = [3, 2]\none_way = true\nfor_s = 1.0").unwrap(),
        [wire(500_000, true, 2, 1, false), wire(1_500_000, false, 2, 1, false)]
    );
    assert_eq!(
        fault(&sums, "kind = \"link_down\"\ncells = [1, 2]").unwrap(),
        [wire(500_000, true, 0, 1, true)]
    );
    assert_eq!(
        fault(&sums, "kind = \"link_up\"\ncells = [1, 2]").unwrap(),
        [wire(500_000, false, 0, 1, true)]
    );
    for names in [("link_down", "cut"), ("link_up", "mend")] {
        let read = |kind| fault(&sums, &format!("kind = {kind:?}\ncells = [1, 2]")).unwrap();
        assert_eq!(read(names.0), read(names.1), "former names are read too");
    }
    let wrong = |skin, text| fault(skin, text).unwrap_err();
    assert_eq!(
        wrong(&sums, "kind = \"link_down\"\ncells = [3, 1]"),
        "s.toml:6: fault[0].cells = [3, 1]: no wire connects these two cells"
    );
    assert_eq!(
        wrong(&sums, "kind = \"link_down\"\ncells = [1]"),
        "s.toml:6: fault[0].cells = 1 cells: name the two cells that the wire connects"
    );
    assert_eq!(
        wrong(&sums, "kind = \"link_up\"\nfor_s = 1.0\ncells = [1, 2]"),
        "s.toml:6: fault[0].for_s: is not allowed with kind = \"link_up\""
    );
    let torques = described("reply = \"torque\"", line);
    assert_eq!(
        wrong(&torques, "kind = \"link_down\"\ncells = [1, 2]"),
        "s.toml:6: fault[0].cells: only a bus with reply = \"sum\" uses wires"
    );
}
