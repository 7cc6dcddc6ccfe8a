use protocol::id::CellId;
use protocol::touch::contact_force;

use super::*;
use crate::scenario::{Scenario, Touches};
use crate::testing::ONE_CELL_SKIN_TOML;

const EPOCHS_PER_S: u64 = 62;

/// Returns a skin with three cells in a row, wired one to the next.
fn three() -> Skin {
    let cell = ONE_CELL_SKIN_TOML.get(ONE_CELL_SKIN_TOML.find("[[cell]]").unwrap()..).unwrap();
    let at = |node: u8, neighbors: &str| {
        let text = cell.replace("node = 1", &format!("node = {node}"));
        let lines = text.lines().filter(|line| !line.starts_with("neighbors"));
        format!("{}\nneighbors = {neighbors}\n", lines.collect::<Vec<_>>().join("\n"))
    };
    let head = ONE_CELL_SKIN_TOML.get(..ONE_CELL_SKIN_TOML.find("[[cell]]").unwrap()).unwrap();
    let text =
        [head.to_owned(), at(1, "[2, 0, 0, 0]"), at(2, "[1, 3, 0, 0]"), at(3, "[2, 0, 0, 0]")].join("\n");
    Skin::parse("skin.toml", &text).unwrap()
}

fn touches(text: &str) -> Touches {
    let skin = three();
    Touches::new(&Scenario::parse("s.toml", text, &skin).unwrap(), &skin)
}

/// Returns the forces that cells read at a time, in N.
fn read(touches: &Touches, seconds: f64) -> [f64; 3] {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a few seconds")]
    let epoch = (seconds * 62.5) as u64;
    [0, 1, 2].map(|cell| f64::from(contact_force(&touches.sensors(cell, epoch))) / 1_024.0)
}

const PRESS: &str = "[[touch]]\nat_s = 1.0\nfor_s = 3.0\ncells = [2]\nforce_n = 4.0\n";

fn with(errors: &str) -> Touches {
    touches(&format!("duration_s = 2000.0\n{PRESS}[sensors.force]\nkind = \"perfect\"\n{errors}\n"))
}

#[test]
fn a_neighbour_reads_a_part_of_the_force() {
    let read = read(&with("crosstalk = 0.05"), 2.0);
    assert!((read[0] - 0.2).abs() < 1e-3 && (read[2] - 0.2).abs() < 1e-3, "{read:?}");
    assert!((read[1] - 4.0).abs() < 1e-3, "{read:?}");
}

#[test]
fn offsets_and_gains_differ_from_cell_to_cell_and_with_the_seed() {
    let text = |seed: u8| {
        format!("seed = {seed}\n{PRESS}[sensors.force]\nkind = \"perfect\"\noffset_n = 0.5\ngain = 0.1\n")
    };
    let first = touches(&text(1));
    let zero = read(&first, 0.0);
    assert!(zero.iter().all(|zero| zero.abs() <= 0.501 && zero.abs() > 1e-3), "{zero:?}");
    assert!((zero[0] - zero[1]).abs() > 1e-2 && (zero[1] - zero[2]).abs() > 1e-2, "{zero:?}");
    let pressed = read(&first, 2.0)[1] - zero[1];
    assert!((pressed - 4.0).abs() <= 0.401 && (pressed - 4.0).abs() > 1e-2, "{pressed}");
    assert_eq!(read(&touches(&text(1)), 2.0), read(&first, 2.0));
    assert!((read(&touches(&text(2)), 0.0)[0] - zero[0]).abs() > 1e-2);
}

#[test]
fn it_reads_more_while_the_force_falls_and_nothing_after_it() {
    let text = "[[touch]]\nat_s = 0.0\nfor_s = 4.0\ncells = [2]\nforce_n = 4.0\nprofile = \"half-sine\"\n\
                [sensors.force]\nkind = \"perfect\"\nhysteresis = 0.1\n";
    let touches = touches(text);
    let [rising, falling, after] = [1.0, 3.0, 5.0].map(|seconds| read(&touches, seconds)[1]);
    assert!((falling / rising - 1.1).abs() < 0.03, "{rising} {falling}");
    assert_eq!(after, 0.0);
}

#[test]
fn creep_grows_with_the_logarithm_of_time() {
    let text = "duration_s = 2000.0\n[[touch]]\ncells = [2]\nforce_n = 4.0\n[sensors.force]\nkind = \"perfect\"\n\
                creep = 0.05\n";
    let touches = touches(text);
    let at = [2.0, 20.0, 200.0, 2_000.0].map(|seconds| read(&touches, seconds)[1]);
    for pair in at.windows(2) {
        assert!(((pair[1] - pair[0]) / 4.0 - 0.05).abs() < 0.015, "{at:?}");
    }
}

#[test]
fn zero_and_gain_change_with_the_temperature_which_the_cells_measure() {
    let text = "duration_s = 600.0\n[sensors]\ntemperature_c = [[0.0, 25.0], [600.0, 35.0]]\n[sensors.force]\n\
                kind = \"perfect\"\ntemperature_n_per_c = 0.02\n";
    let touches = touches(text);
    let [start, end] = [0.0, 600.0].map(|seconds| read(&touches, seconds));
    let shifts: Vec<_> = start.iter().zip(end).map(|(start, end)| end - start).collect();
    assert_eq!(start, [0.0; 3]);
    assert!(shifts.iter().all(|shift| shift.abs() <= 0.201 && shift.abs() > 1e-3), "{shifts:?}");
    let words = touches.sensors(0, 300 * EPOCHS_PER_S + 150);
    assert!((words.temperature[0].to_f64() - 30.0).abs() < 0.02);
}

#[test]
fn the_zero_walks_as_far_in_an_hour_as_the_scenario_says() {
    let mut walks = Vec::new();
    for seed in 0..40 {
        let text = format!(
            "duration_s = 900.0\nseed = {seed}\n[sensors.force]\nkind = \"perfect\"\ndrift_n = 0.2\n"
        );
        walks.extend(read(&touches(&text), 900.0));
    }
    let square: f64 = walks.iter().map(|walk| walk * walk).sum::<f64>() / 120.0;
    assert!((square.sqrt() - 0.1).abs() < 0.025, "half of it in a quarter of an hour: {}", square.sqrt());
}

#[test]
fn changes_in_order_at_random_and_over_a_gap_are_the_same() {
    let text = "duration_s = 60.0\n[[touch]]\nat_s = 0.5\ncells = [2]\nforce_n = 3.0\nfor_s = 1.0\n\
                [[fault]]\nat_s = 0.8\nkind = \"stuck\"\nfor_s = 0.3\ncells = [2]\n\
                [sensors.force]\nkind = \"resistive\"\noffset_n = 0.2\nnoise_n = 0.01\ndrift_n = 0.5\n";
    let mut each = touches(text);
    let mut words = [SkinSensors::default(); 3];
    for epoch in 0..150 {
        for change in each.stimuli_for(epoch) {
            words[change.cell] = change.readings.skin;
            assert_eq!(Some(change.node), CellId::new(i64::try_from(change.cell).unwrap() + 1).ok());
        }
        assert_eq!(words, [0, 1, 2].map(|cell| each.sensors(cell, epoch)));
    }
    let mut gap = touches(text);
    let _ = gap.stimuli_between(None, 20).count();
    for change in gap.stimuli_between(Some(20), 149) {
        assert_eq!(change.readings.skin, words[change.cell]);
    }
    assert_eq!(gap.sensors(1, 60), touches(text).sensors(1, 60), "back in time");
    assert_eq!(gap.sensors(1, 55), gap.sensors(1, 62), "stuck");
}
