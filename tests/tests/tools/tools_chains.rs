//! Published robots, and Pinocchio: torques of cells on the chains of three URDFs of example-robot-data.
//!
//! `tests/tools/install` installs them; `tests/run --all` does that, and then runs this test.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::cast_precision_loss,
    clippy::print_stdout,
    reason = "a test may stop, and its figures are what it is about"
)]

use skinbus_tests::process;

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use process::{Running, TestDir};
use protocol::fixed::Q1_14;
use protocol::parameters::{Parameter, RowKind};
use protocol::skin::Skin;
use serde_json::Value;

/// The columns of the vectors.
const COLUMNS: &str = "robot,urdf,root_link,tip_link,link,px,py,pz,nx,ny,nz,force_n,joints,q,tau";
/// The mean and the maximum of the difference between a cell's torque and the exact one, in Nm or N.
const BOUNDS: [f64; 2] = [1.4e-4, 2e-3];

fn tools() -> PathBuf {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/tools");
    let python = folder.join("bin/python");
    assert!(python.exists(), "{} is missing: tests/tools/install makes it ready", python.display());
    folder
}

/// Returns the folder of the URDFs.
fn robots() -> PathBuf {
    let mut libraries = fs::read_dir(tools().join("lib")).unwrap();
    let python = libraries.next().unwrap().unwrap().path();
    python.join("site-packages/cmeel.prefix/share/example-robot-data/robots")
}

/// Returns the rows of a chain, each as its columns.
fn rows(robot: &str) -> Vec<Vec<&'static str>> {
    let mut lines = include_str!("../../data/robots.csv").lines();
    assert_eq!(lines.next(), Some(COLUMNS));
    let rows = lines.map(|line| line.split(',').collect::<Vec<_>>());
    let rows: Vec<_> = rows.filter(|row| row[0] == robot).collect();
    assert_eq!(rows.len(), 150, "{robot}");
    rows
}

fn numbers(text: &str) -> Vec<f64> {
    text.split(' ').map(|number| number.parse().unwrap()).collect()
}

/// Writes `skin.toml`: a cell for each row, by `cells.csv`.
fn import(place: &TestDir, rows: &[Vec<&str>], torque_format: &str) -> PathBuf {
    let mut cells = "link,px,py,pz,nx,ny,nz\n".to_owned();
    for row in rows {
        writeln!(cells, "{}", row[4..11].join(",")).unwrap();
    }
    place.write("cells.csv", &cells);
    let urdf = robots().join(rows[0][1]);
    let words =
        format!("skin import {} --tip {} --places cells.csv -o skin.toml", urdf.display(), rows[0][3]);
    place.start("skinbus", &words).end().succeeded();
    let name = "name = \"vcan0\"\n";
    let skin = place.read("skin.toml");
    assert_eq!(skin.matches(name).count(), 1);
    place.write("skin.toml", &skin.replace(name, &format!("{name}torque_format = \"{torque_format}\"\n")));
    urdf
}

/// Checks the torque of a force, by the central computation and by the code of a cell.
fn check_calculator(robot: &str) {
    let place = TestDir::new();
    let rows = rows(robot);
    import(&place, &rows, "Q3.12");
    let mut batch = "cell,force_n,q\n".to_owned();
    for (node, row) in (1..).zip(&rows) {
        writeln!(batch, "{node},{},{}", row[11], row[13]).unwrap();
    }
    place.write("rows.csv", &batch);
    let said = place.start("skinbus", "explain skin.toml --batch rows.csv --json").end().succeeded().stdout;
    let answers: Vec<Value> = said.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(answers.len(), rows.len());
    let (mut central_off, mut fixed_off) = (0.0_f64, Vec::new());
    for (row, answer) in rows.iter().zip(&answers) {
        let names: Vec<_> =
            answer["joints"].as_array().unwrap().iter().map(|it| it.as_str().unwrap()).collect();
        assert_eq!(names.join(" "), row[12]);
        assert_eq!(answer["saturated"], false, "{answer}");
        let tau = numbers(row[14]);
        let loaded = tau.iter().rposition(|torque| *torque != 0.0).map_or(0, |last| last + 1);
        for (joint, exact) in tau.iter().enumerate() {
            let [central, fixed] = ["central", "fixed"].map(|key| answer[key][joint].as_f64().unwrap());
            central_off = central_off.max((central - exact).abs());
            if joint < loaded {
                fixed_off.push((fixed - exact).abs());
            } else {
                assert_eq!(fixed.to_bits() << 1, 0, "{answer}");
            }
        }
    }
    assert!(central_off <= 1e-9, "{robot}: {central_off}");
    let mean = fixed_off.iter().sum::<f64>() / fixed_off.len() as f64;
    let max = fixed_off.iter().copied().fold(0.0, f64::max);
    println!("{robot}: central {central_off:.1e}; fixed point mean {mean:.2e}, max {max:.1e}");
    assert!(mean <= BOUNDS[0] && max <= BOUNDS[1], "{robot}: {mean} {max}");
}

/// Runs every seventh cell as a process, pressed while the robot gives way.
fn check_moving(robot: &str) {
    let place = TestDir::new();
    let rows: Vec<_> = rows(robot).into_iter().step_by(7).collect();
    let urdf = import(&place, &rows, "Q3.12");
    place.scenario(
        "version = 1\nduration_s = 6.0\n\n[[touch]]\nat_s = 0.3\nfor_s = 9.0\nall = true\nforce_n = 1.5\nprofile = \"step\"\n",
    );
    place.bench(4.0, "--record run.mcap").end().succeeded();
    let dump = place.start("skinbus", "dump run.mcap --json --kind joints,stimulus,torque").end().succeeded();
    place.write("dump.jsonl", &dump.stdout);
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tools/chains.py");
    let joints = rows[0][12].replace(' ', ",");
    let words = format!("{} {} cells.csv {joints} dump.jsonl", script.display(), urdf.display());
    let said = Running::start(place.command_of(&tools().join("bin/python"), &words)).end().succeeded().stdout;
    let [torques, mean, max, moved, saturated] = numbers(said.trim()).try_into().unwrap();
    println!(
        "{robot}: {torques} torques, mean {mean:.2e}, max {max:.1e}; moved by {moved:.2}; {saturated} saturated"
    );
    // A tenth of the torques of a machine that is always in time.
    assert!(torques >= 500.0 && moved > 0.02 && saturated < torques, "{said}");
    assert!(mean <= BOUNDS[0] && max <= BOUNDS[1], "{robot}: {said}");
}

/// Writes the contacts in words, as cells on these robots are configured and receive them.
fn in_words(robot: &str, text: &mut String) {
    let place = TestDir::new();
    let rows = rows(robot);
    import(&place, &rows, "Q3.12");
    let skin = Skin::parse("skin.toml", &place.read("skin.toml")).unwrap();
    let said = |words: &[i16]| words.iter().map(i16::to_string).collect::<Vec<_>>().join(" ");
    for (cell, row) in skin.cells.iter().zip(&rows) {
        let parameters = skin.parameters(cell);
        let kinds = parameters.all_rows().iter().filter(|row| row.has_joint()).map(|row| row.kind);
        let positions = numbers(row[13]).into_iter().zip(kinds).map(|(position, kind)| match kind {
            RowKind::Prismatic => Q1_14::nearest(position).to_bits(),
            RowKind::Revolute | RowKind::Fixed => Q1_14::from_radians(position).unwrap().to_bits(),
        });
        let pose = said(&parameters.words(Parameter::Pose));
        let force = (row[11].parse::<f64>().unwrap() * 65_536.0).round();
        let positions = said(&positions.collect::<Vec<_>>());
        let table = (0_u8..)
            .take(parameters.all_rows().len())
            .flat_map(|row| parameters.words(Parameter::Row(row))[..5].to_vec());
        let (joint, row) = (parameters.joint, parameters.rows_to_cell().len());
        writeln!(
            text,
            "{robot},{joint},{row},{pose},{force},{positions},{}",
            said(&table.collect::<Vec<_>>())
        )
        .unwrap();
    }
}

#[test]
#[ignore = "needs tests/tools/install"]
fn the_words_that_firmware_is_measured_with_are_those_of_the_robots() {
    let mut text = "robot,joint,row,pose,force,joints,rows\n".to_owned();
    ["ur10", "panda", "tiago"].into_iter().for_each(|robot| in_words(robot, &mut text));
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../cell-node/tests/vectors/chains.csv");
    if std::env::var_os("SKINBUS_TAKE_OVER").is_some() {
        fs::write(&file, &text).unwrap();
    }
    assert!(fs::read_to_string(&file).unwrap() == text, "SKINBUS_TAKE_OVER=yes writes {}", file.display());
}

#[test]
#[ignore = "needs tests/tools/install"]
fn torques_on_imported_robots_are_those_of_pinocchio() {
    ["ur10", "panda", "tiago"].into_iter().for_each(check_calculator);
}

#[test]
#[ignore = "needs tests/tools/install"]
fn cells_of_moving_robots_send_the_torques_of_pinocchio() {
    ["ur10", "panda", "tiago"].into_iter().for_each(check_moving);
}
