//! Calibrations of simulated cells over a bus: the robot moves, and the recording gives the same result again.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use process::TestDir;
use protocol::skin::Skin;
use serde_json::Value;

const START: [&str; 2] = ["--start", "0 -1.2 1.0 -1.4 -1.57 0"];

/// Returns the exit code, the result unless it was refused, and standard error.
fn calibrate(place: &TestDir, words: &str) -> (Option<i32>, Option<Value>, String) {
    let mut command = place.command("skinbus", &format!("calibrate skin.toml --json --overwrite {words}"));
    let output = command.args(START).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    let found = (!output.stdout.is_empty())
        .then(|| serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {said}")));
    (output.status.code(), found, said)
}

#[test]
fn a_calibration_finds_cells_and_its_recording_finds_the_same() {
    let place = TestDir::new();
    place.skin(6);
    let live = "--duration 24s --quiet --bus-kind embedded --record run.mcap -o found.toml --page found.html";
    let (_, found, said) = calibrate(&place, live);
    let (code, again, repeated) = calibrate(&place, "--recording run.mcap -o again.toml");
    assert_eq!(found, again, "{said}");
    let exists = |name: &str| place.path(name).exists();
    // The same cells with the description of other ones.
    let skin = place.read("skin.toml");
    place.write("skin.toml", &skin.replace("serial = 100001", "serial = 7"));
    let (refused, nothing, why) = calibrate(&place, "--recording run.mcap -o other.toml");
    assert_eq!((refused, nothing), (Some(2), None), "{why}");
    let other = "was recorded with a different skin: serial numbers: 100002 in the given skin, but 100001 in the \
                 recording";
    assert!(why.contains(other), "{why}");
    assert!(!exists("other.toml"));
    place.write("skin.toml", &skin);
    let Some(found) = found else {
        // A machine that is late too often: the refusal names the gaps, and no file is written.
        assert_eq!(code, Some(1));
        assert!(
            said.contains("joint broadcasts have") && repeated.contains("joint broadcasts have"),
            "{said}{repeated}"
        );
        assert!(!exists("found.toml") && !exists("again.toml") && !exists("found.html"));
        return;
    };
    assert_eq!(place.read("found.toml"), place.read("again.toml"));
    let skin = Skin::parse("skin.toml", &place.read("skin.toml")).unwrap();
    let new = Skin::parse("found.toml", &place.read("found.toml")).unwrap();
    let cells = found["cells"].as_array().unwrap();
    for ((old, new), result) in skin.cells.iter().zip(&new.cells).zip(cells) {
        assert_eq!((old.joint, old.node), (new.joint, new.node), "{result}");
        assert!(result["readings"].as_u64().unwrap() > 120, "{result}");
        // As accurate as a machine allows that is late for some broadcasts.
        assert!(result["moved_mm"].as_f64().unwrap() < 15.0, "{result}");
        assert!(result["turned_deg"].as_f64().unwrap() < 3.0, "{result}");
    }
    let page = place.read("found.html");
    assert!(page.contains("calibrated") && page.contains("of 6 cells moved by more than their uncertainty"));
    assert!(page.contains(r#""caption":"Distance from the skin's place","unit":"mm""#));
    place.is_left_clean();
}

#[test]
fn what_cannot_be_calibrated_is_refused_in_one_line() {
    let place = TestDir::new();
    place.skin(2);
    let refused = |words: &str| {
        let output = place.command("skinbus", &format!("calibrate skin.toml {words}")).output().unwrap();
        assert_eq!(output.status.code(), Some(2));
        String::from_utf8(output.stderr).unwrap()
    };
    assert_eq!(
        refused("--start 0.5 --dry-run"),
        "skinbus: the pose has 1 positions, but the robot has 6 joints: give one position for each joint\n"
    );
    assert_eq!(
        refused("--duration 5s --dry-run"),
        "skinbus: the motion cannot last 5 s: choose 20 to 3600 s\n"
    );
    place.write("sheet.toml", "noise_g = 3.0\n");
    assert_eq!(
        refused("--data-sheet sheet.toml --dry-run"),
        "skinbus: sheet.toml:1:11: noise_g = 3: must be 0 to 1\n"
    );
    place.write("empty.log", "(1.000000) vcan0 080##1\n");
    let said = refused("--recording empty.log");
    assert!(said.contains("no cell of the skin sent an acceleration; record a bus with"), "{said}");
}
