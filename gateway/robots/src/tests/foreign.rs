//! Tests with the robots of other authors. They need `pip install example-robot-data==6.0.0`; the environment variable
//! `SKINBUS_ROBOTS` is the folder `cmeel.prefix/share/example-robot-data/robots` of this package.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use crate::{RobotError, RobotProblem, Urdf};
use nalgebra::{Point3, Vector3};
use protocol::skin::max_frame_distance;

use super::common::{folder, torques};

/// Returns the URDF files in a folder and its subfolders, sorted.
fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(files(&path));
        } else if path.extension().is_some_and(|extension| extension == "urdf") {
            found.push(path);
        }
    }
    found.sort();
    found
}

fn read(path: &Path) -> Result<Urdf, RobotError> {
    Urdf::parse(&path.display().to_string(), &fs::read_to_string(path).unwrap())
}

/// Returns one word that stands for a problem.
fn word(problem: &RobotProblem) -> &'static str {
    let words = [
        (matches!(problem, RobotProblem::Mimic { .. }), "mimic"),
        (matches!(problem, RobotProblem::Kind { .. }), "floating"),
        (matches!(problem, RobotProblem::NoLimit { .. } | RobotProblem::Limits { .. }), "limits"),
        (matches!(problem, RobotProblem::Reach { .. }), "reach"),
        (matches!(problem, RobotProblem::NoMovingJoint { .. }), "none moves"),
        (matches!(problem, RobotProblem::TooManyJoints { .. }), "joints"),
    ];
    let found = words.iter().find(|(is, _)| *is);
    found.unwrap_or_else(|| panic!("not a reason to refuse a robot that others use: {problem}")).1
}

#[test]
#[ignore = "needs example-robot-data"]
fn every_chain_is_imported_or_refused_for_a_reason() {
    let folder = folder();
    let (mut counts, mut worst, mut total) = (BTreeMap::<_, usize>::new(), 0.0_f64, 0);
    let mut unread = Vec::new();
    for path in files(&folder) {
        let name = path.strip_prefix(&folder).unwrap().display().to_string();
        let urdf = match read(&path) {
            Ok(urdf) => urdf,
            Err(error) => {
                println!("{name}: {error}");
                unread.push(name);
                continue;
            }
        };
        for tip in urdf.leaves() {
            match urdf.chain(None, tip) {
                Ok(chain) if chain.joints.len() < 3 => {}
                Ok(chain) => {
                    total += 1;
                    *counts.entry("imported").or_default() += 1;
                    worst = worst.max(chain.residual);
                    let rows = chain.chain_rows();
                    let far = |(_, place): (&str, crate::LinkFrame)| {
                        max_frame_distance(&rows[..place.row], place.frame.translation.vector.into())
                    };
                    let far = chain.links().map(far).fold(0.0, f64::max);
                    let longest =
                        chain.rows.iter().map(|row| row.a.abs().max(row.d.abs())).fold(0.0, f64::max);
                    println!(
                        "{name} {tip}: {} joints, {} rows, longest {longest:.3} m, reach {far:.3} m, residual {:.1e}",
                        chain.joints.len(),
                        chain.rows.len(),
                        chain.residual
                    );
                }
                Err(error) => {
                    let word = word(&error.problem);
                    if word != "none moves" {
                        *counts.entry(word).or_default() += 1;
                        total += 1;
                        println!("{name} {tip}: {error}");
                    }
                }
            }
        }
    }
    println!("{total} chains: {counts:?}; residual at most {worst:.1e}; not read: {unread:?}");
    assert!(worst <= 1e-9, "{worst:.1e}");
    let expected = [("imported", 428), ("joints", 12), ("limits", 10), ("mimic", 50)];
    assert_eq!(counts, BTreeMap::from(expected), "of version 6.0.0");
    assert_eq!(unread, ["ur_description/urdf/ur3.urdf"], "it has no links");
}

/// Compares torques with those of Pinocchio in `tests/data/robots.csv`.
#[test]
#[ignore = "needs example-robot-data"]
fn torques_from_rows_are_those_of_pinocchio() {
    let csv = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/data/robots.csv");
    let csv = fs::read_to_string(csv).unwrap();
    let mut lines = csv.lines();
    let columns: Vec<_> = lines.next().unwrap().split(',').collect();
    let (mut urdfs, mut worst, mut rows) = (BTreeMap::new(), 0.0_f64, 0);
    for line in lines {
        let fields: BTreeMap<_, _> = columns.iter().copied().zip(line.split(',')).collect();
        let number = |column: &str| fields[column].parse::<f64>().unwrap();
        let numbers = |column: &str| {
            fields[column].split(' ').map(|word| word.parse::<f64>().unwrap()).collect::<Vec<_>>()
        };
        let (file, tip) = (fields["urdf"], fields["tip_link"]);
        let chain = urdfs.entry((file, tip)).or_insert_with(|| {
            read(&folder().join(file)).unwrap().chain(Some(fields["root_link"]), tip).unwrap()
        });
        let joints: Vec<_> = chain.joints.iter().map(|joint| joint.name.as_str()).collect();
        assert_eq!(joints, fields["joints"].split(' ').collect::<Vec<_>>());
        let point = Point3::new(number("px"), number("py"), number("pz"));
        let normal = Vector3::new(number("nx"), number("ny"), number("nz"));
        let got = torques(chain, fields["link"], &point, &normal, number("force_n"), &numbers("q"));
        for (got, expected) in got.iter().zip(numbers("tau")) {
            worst = worst.max((got - expected).abs());
            assert!((got - expected).abs() < 1e-9, "{line}: {got} for {expected}");
        }
        rows += 1;
    }
    println!("{rows} rows: the largest difference is {worst:.1e}");
    assert_eq!(rows, 450);
}
