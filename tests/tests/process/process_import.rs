//! A user's own robots: a URDF becomes a skin, is covered with cells, drawn, recorded, and computed with.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    reason = "a test may stop"
)]

mod drawn;
mod odd_robots;

use skinbus_tests::process;
use skinbus_tests::process::recorded;

use std::collections::BTreeSet;
use std::fs;

use process::{Ended, TestDir, example};
use protocol::skin::Skin;
use recorded::{Message, Recorded};
use serde_json::Value;

/// A robot with two joints, a tube, a box, and a plate that is a mesh of a package.
const ARM: &str = r#"<robot name="arm">
  <link name="base"><visual><geometry><cylinder radius="0.06" length="0.1"/></geometry></visual></link>
  <link name="upper"><visual><origin xyz="0 0 0.2"/><geometry><cylinder radius="0.05" length="0.3"/></geometry></visual></link>
  <link name="fore"><visual><origin xyz="0 0 0.2"/><geometry><box size="0.08 0.08 0.3"/></geometry></visual></link>
  <link name="plate"><visual><geometry><mesh filename="package://arm_parts/meshes/plate.stl"/></geometry></visual></link>
  <link name="bare"/>
  <joint name="shoulder" type="revolute">
    <parent link="base"/><child link="upper"/><origin xyz="0 0 0.1"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="2" velocity="1" effort="9"/>
  </joint>
  <joint name="elbow" type="revolute">
    <parent link="upper"/><child link="fore"/><origin xyz="0 0 0.4"/><axis xyz="0 1 0"/>
    <limit lower="0.5" upper="1.5" velocity="1" effort="9"/>
  </joint>
  <joint name="wrist" type="fixed"><parent link="fore"/><child link="plate"/><origin xyz="0 0 0.4"/></joint>
  <joint name="end" type="fixed"><parent link="plate"/><child link="bare"/></joint>
</robot>
"#;

const COVER: &str =
    "skin import arm.urdf --tip bare --cover upper,fore --pitch 0.04 --package arm_parts=parts";

/// Writes `arm.urdf`, and its mesh in `parts/meshes`: a square of 0.2 m.
fn arm() -> TestDir {
    let place = TestDir::new();
    place.write("arm.urdf", ARM);
    fs::create_dir_all(place.path("parts/meshes")).unwrap();
    let triangle = |corners: [[f64; 2]; 3]| {
        let corners = corners.map(|[x, y]| format!("vertex {x} {y} 0\n")).concat();
        format!("facet normal 0 0 1\nouter loop\n{corners}endloop\nendfacet\n")
    };
    let square = [[[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1]], [[-0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]];
    let facets = square.map(triangle).concat();
    place.write("parts/meshes/plate.stl", &format!("solid plate\n{facets}endsolid plate\n"));
    place
}

fn run(place: &TestDir, words: &str) -> Ended {
    place.start("skinbus", words).end()
}

/// Checks that a command is refused with exit code 2 in one line, and writes no file.
fn refused(place: &TestDir, words: &str, expected: &str) {
    let before = place.files();
    let ended = run(place, words);
    let said = ended.refusal(2);
    assert!(said.contains(expected), "{words}\n{said}\n{expected}");
    assert_eq!(place.files(), before, "{words}");
}

fn read(place: &TestDir, name: &str) -> Skin {
    Skin::read(&place.path(name)).unwrap()
}

#[test]
fn each_example_becomes_a_skin() {
    let place = TestDir::new();
    for (file, tips, joints) in [
        ("panda.urdf", &["hand"][..], 7),
        ("ur10.urdf", &["tool0"], 6),
        ("two-arms.urdf", &["left_palm", "right_palm"], 12),
        ("lift.urdf", &["tool"], 8),
    ] {
        fs::copy(example(file), place.path(file)).unwrap();
        let tips_words = tips.iter().map(|tip| format!(" --tip {tip}")).collect::<String>();
        let ended =
            run(&place, &format!("skin import {file}{tips_words} -o skin.toml --overwrite")).succeeded();
        assert_eq!(ended.stderr.lines().count(), tips.len(), "a line for each chain: {}", ended.stderr);
        let said = run(&place, "check skin.toml").succeeded().stdout;
        assert!(said.contains(&format!("{joints} joints")), "{file}: {said}");
        let skin = read(&place, "skin.toml");
        assert_eq!((skin.cells.len(), skin.robot.chains.len()), (tips.len(), tips.len()), "{file}");
        assert_eq!(skin.robot.urdf.as_deref(), Some(file));
    }
}

#[test]
fn links_are_covered_and_the_skin_runs() {
    let place = arm();
    let said = run(&place, &format!("{COVER} --nodes-per-bus 60 -o skin.toml")).succeeded();
    for link in ["upper: ", "fore: "] {
        let line = said.stderr.lines().find(|line| line.starts_with(link)).unwrap();
        assert!(line.contains(" cells, ") && line.contains(" % of ") && line.contains(" mm from "), "{line}");
    }
    run(&place, "check skin.toml").succeeded();
    let skin = read(&place, "skin.toml");
    assert!(skin.cells.len() > 100 && skin.buses.len() >= 2, "{} cells", skin.cells.len());
    for (index, bus) in skin.buses.iter().enumerate() {
        assert_eq!(bus.name, format!("vcan{index}"));
        assert!((1..=60).contains(&skin.cells_on_bus(index).count()), "{}", bus.name);
        assert!(skin.cells_on_bus(index).any(|cell| cell.root), "{} has a root", bus.name);
        let wired = skin.cells_on_bus(index).filter(|cell| cell.neighbors.iter().any(Option::is_some));
        assert!(wired.count() > skin.cells_on_bus(index).count() * 9 / 10);
    }
    // The command in the first line gives the same again; another seed gives other cells.
    let again = run(&place, &format!("{COVER} --nodes-per-bus 60 -o again.toml")).succeeded();
    assert_eq!((place.read("again.toml"), again.stderr), (place.read("skin.toml"), said.stderr));
    run(&place, &format!("{COVER} --seed 2 -o other.toml")).succeeded();
    assert_ne!(read(&place, "other.toml").cells, skin.cells);

    let words = "run skin.toml --bus-kind embedded --cells-per-process 60 --duration 1.5 --record run.mcap --record-split 1s";
    run(&place, words).succeeded();
    for part in ["run.mcap", "run-1.mcap"] {
        let recorded = Recorded::read(&place.path(part));
        assert_eq!(recorded.attachments["robot.urdf"], ARM.as_bytes(), "{part}");
        let said = |topic: &str| recorded.on(topic).next().unwrap().value.clone();
        assert_eq!(said("/robot_description")["data"], ARM, "{part}");
        let frames = ["/tf", "/tf_static"].map(|topic| said(topic)["transforms"].as_array().unwrap().clone());
        let frames: BTreeSet<_> =
            frames.iter().flatten().map(|it| it["child_frame_id"].as_str().unwrap()).collect();
        let patches: Vec<_> = recorded.messages.iter().filter(|it| it.topic.starts_with("/skin/")).collect();
        let named = |it: &Message| it.value["header"]["frame_id"].as_str().unwrap().to_owned();
        assert!(!patches.is_empty());
        for patch in patches {
            let base = named(patch) == "base" && patch.topic.ends_with("/points");
            assert!(base || frames.contains(named(patch).as_str()), "{}", named(patch));
        }
        assert!(frames.contains("upper") && frames.contains("vcan0/1"), "{frames:?}");
    }
    // A file that is not a URDF is not added to a recording.
    place.write("arm.urdf", "root:x:0:0:root:/root:/bin/bash\n");
    refused(
        &place,
        "run skin.toml --bus-kind embedded --record no.mcap",
        "robot.urdf: arm.urdf:1: not XML: a URDF begins with <?xml or <robot; give the path of the robot's URDF; correct the \
         path in the skin, or remove the key",
    );
    fs::remove_file(place.path("arm.urdf")).unwrap();
    refused(
        &place,
        "run skin.toml --bus-kind embedded --record no.mcap",
        "robot.urdf: arm.urdf: No such file",
    );
}

#[test]
fn a_box_holds_no_cell_and_a_bus_has_one_chain() {
    let place = arm();
    let box_words = "--keep-out upper:-1,-1,0.2,1,1,1";
    run(&place, &format!("{COVER} {box_words} -o kept.toml")).succeeded();
    run(&place, &format!("{COVER} -o all.toml")).succeeded();
    let [kept, all] = ["kept.toml", "all.toml"].map(|name| read(&place, name).cells.len());
    assert!(kept + 20 < all, "{kept} of {all}");
    assert!(place.read("kept.toml").lines().next().unwrap().contains(box_words));

    fs::copy(example("two-arms.urdf"), place.path("two.urdf")).unwrap();
    let words = "skin import two.urdf --tip left_palm --tip right_palm --pitch 0.05 -o two.toml \
                 --cover torso,left_upper_arm,right_upper_arm";
    run(&place, words).succeeded();
    let skin = read(&place, "two.toml");
    let chains: Vec<_> = skin.buses.iter().map(|bus| skin.robot.chains[bus.chain].name.as_str()).collect();
    assert_eq!(chains, ["left_palm", "right_palm"]);
    let joints = |bus| skin.cells_on_bus(bus).map(|cell| cell.joint).collect::<BTreeSet<_>>();
    assert!(joints(0).contains(&2) && !joints(1).contains(&2), "the torso belongs to the first chain");
}

#[test]
fn what_cannot_be_covered_is_said_in_a_line() {
    let place = arm();
    let cover = |links: &str, more: &str| format!("skin import arm.urdf --tip bare --cover {links} {more}");
    let with = "--package arm_parts=parts";
    for (words, expected) in [
        (cover("fore", ""), "link plate: mesh package://arm_parts/meshes/plate.stl: "),
        (cover("fore", ""), "is not a file: name its directory with --package arm_parts=DIR"),
        (cover("fore", "--package arm_parts=nowhere"), "nowhere is not a folder: correct --package"),
        (cover("fore", ""), "; or treat it as absent with --leave-out plate"),
        (cover("fore", "--package arm_parts=."), ". is not the directory of the package, or lacks this file"),
        (cover("fore", "--leave-out fore"), "--leave-out fore: --cover names this link"),
        (
            cover("fore", "--leave-out plat"),
            "--leave-out plat: arm.urdf: there is no link \"plat\"; similar names:",
        ),
        (cover("bare", with), "--cover bare: arm.urdf has no visual for this link"),
        (cover("forearm", with), "--cover forearm: arm.urdf: there is no link \"forearm\"; similar names:"),
        (cover("base", with), "--cover base: no chain moves this link: use one of upper, fore"),
        (cover("fore,fore", with), "--cover fore: this link is named twice"),
        (cover("fore", "--pitch 2"), "a length from 0.001 to 1 m"),
        (cover("fore", "--nodes-per-bus 251"), "251 is not in 1..=250"),
        (cover("fore", "--keep-out fore:0,0,0,1,1"), "six lengths in m"),
        (cover("fore", "--keep-out fore:1,0,0,0,1,1"), "six lengths in m"),
        (cover("fore", "--keep-out upper:0,0,0,1,1,1"), "upper is not covered: the covered links are fore"),
        (cover("fore", "--package arm_parts"), "NAME=DIR"),
        (cover("fore", "--places cells.csv"), "cannot be used with"),
    ] {
        refused(&place, &words, expected);
    }
}

#[test]
fn what_is_no_chain_of_joints_is_said_in_a_line() {
    let place = arm();
    let floating = ARM.replacen("type=\"revolute\"", "type=\"floating\"", 1);
    let mimic = ARM.replacen("<limit", "<mimic joint=\"elbow\"/><limit", 1);
    let far = ARM.replace("<origin xyz=\"0 0 0.4\"/><axis", "<origin xyz=\"0 0 2.5\"/><axis");
    for (text, words, expected) in [
        (floating.as_str(), "--tip bare", "joint \"shoulder\" is floating"),
        (&mimic, "--tip bare", "joint \"shoulder\" mimics \"elbow\""),
        (&far, "--tip bare", "; allowed: [-2, 2) m; "),
        ("", "--tip bare", "the file is empty"),
        (
            "<robot xmlns:xacro=\"x\"><xacro:a/></robot>",
            "--tip bare",
            "`xacrodoc arm.urdf -o NEW.urdf` (pip install xacrodoc)",
        ),
        (ARM, "--tip hand", "there is no link \"hand\"; similar names:"),
        (ARM, "--tip bare --tip bare", "--tip bare: this tip is named twice"),
        (ARM, "--tip base", "no joint moves between"),
    ] {
        place.write("arm.urdf", text);
        refused(&place, &format!("skin import arm.urdf {words}"), expected);
    }
    // Standard input.
    refused(&place, "skin import - --tip a", "-: the file is empty");
    refused(&place, "skin import nowhere.urdf --tip a", "nowhere.urdf: No such file");
    let head = "link,px,py,pz,nx,ny,nz";
    for (text, expected) in [
        (
            "link,px,py,pz,nx,ny,up\nfore,0,0,0,0,0,1\n".to_owned(),
            "cells.csv: line 1: the first line must be the header link,px,py,pz,nx,ny,nz, optionally with bus,node, \
             not \"link,px,py,pz,nx,ny,up\": correct it",
        ),
        ("fore,0,0,0,0,0,1\n".to_owned(), "not \"fore,0,0,0,0,0,1\": write the header above it"),
        (format!("{head}\nfore,0,0,x,0,0,1\n"), "cells.csv: line 2: pz = \"x\": use a finite number"),
        (format!("{head}\nfore,0,0,0,0,0,1\nfourth,0,0,0,0,0,1\n"), "cells.csv: line 3: "),
        (format!("{head}\nfore,0,0,0,0,0,0\n"), "line 2: the normal"),
        (
            format!("{head}\nfore,0,0\n"),
            "cells.csv: line 2 has 3 values: write one value for each of the columns link, ",
        ),
        (head.to_owned(), "it contains no cells"),
        // A defect that only the skin's check finds, reported with its line in the file.
        (
            format!("# mine\n{head}\nfore,0,0,0,0,0,1\n\nfore,3,0,0,0,0,1\n"),
            "skinbus: cells.csv: line 5: position px,py,pz = 3,0,0 of link \"fore\" is too far from an earlier link of its chain: the distance can reach 3.",
        ),
        (
            format!("{head},bus,node\nfore,0,0,0,0,0,1,,300\n"),
            "skinbus: cells.csv: line 2: node = \"300\": use 1 to 254",
        ),
        (
            format!("{head},bus,node\nfore,0,0,0,0,0,1,,\nupper,0,0,0,0,0,1,,1\n"),
            "skinbus: cells.csv: line 3: node 1 of bus \"vcan0\" is already used in line 2",
        ),
        (
            format!("{head},bus\nfore,0,0,0,0,0,1,my bus\n"),
            "skinbus: cells.csv: line 2: bus \"my bus\": its name must have 1 to 15 letters",
        ),
    ] {
        place.write("cells.csv", &text);
        refused(&place, "skin import arm.urdf --tip bare --places cells.csv", expected);
    }
}

/// A torso with several arms of 12 joints each.
#[test]
fn a_robot_has_at_most_32_joints() {
    let place = TestDir::new();
    let mut inner = "<link name=\"torso\"/>".to_owned();
    for arm in ["a", "b", "c"] {
        for joint in 1..=12 {
            let below = if joint == 1 { "torso".to_owned() } else { format!("{arm}{}", joint - 1) };
            inner += &format!(
                "<link name=\"{arm}{joint}\"/><joint name=\"j{arm}{joint}\" type=\"revolute\"><parent link=\"{below}\"/>\
                 <child link=\"{arm}{joint}\"/><origin xyz=\"0 0 0.1\"/><axis xyz=\"0 1 0\"/><limit lower=\"-1\" \
                 upper=\"1\" velocity=\"1\" effort=\"9\"/></joint>"
            );
        }
    }
    place.write("arms.urdf", &format!("<robot name=\"arms\">{inner}</robot>"));
    place.write("cells.csv", "link,px,py,pz,nx,ny,nz\na12,0,0,0,0,0,1\nb12,0,0,0,0,0,1\n");
    for cells in ["", " --places cells.csv"] {
        refused(
            &place,
            &format!("skin import arms.urdf --tip a12 --tip b12 --tip c12{cells}"),
            "skinbus: arms.urdf: 36 joints move between the root and the tips; a robot must have 1 to 32: use fewer --tip options",
        );
        run(&place, &format!("skin import arms.urdf --tip a12 --tip b12{cells}")).succeeded();
    }
}

#[test]
fn each_covered_link_has_a_cell() {
    let place = arm();
    // A knob that is smaller than a cell, beside a link with room.
    let knob = ARM.replace(
        "<link name=\"bare\"/>",
        "<link name=\"bare\"><visual><origin xyz=\"0 0 0.3\"/><geometry><sphere radius=\"0.003\"/></geometry></visual></link>",
    );
    place.write("arm.urdf", &knob);
    let cover = |links: &str, more: &str| {
        let mut command = place
            .command("skinbus", "skin import arm.urdf --tip bare --package arm_parts=parts --pitch 0.04");
        command.args(["--cover", links]).args(more.split_whitespace()).output().unwrap()
    };
    let boxes = "--keep-out fore:-1,-1,-1,1,1,1";
    for (links, more, expected) in [
        ("upper,bare", "", "skinbus: --cover bare: no cell fits on its 0.0001 m2: lower the pitch, or"),
        ("bare", "", "skinbus: --cover bare: no cell fits on its 0.0001 m2: lower the pitch, or"),
        (
            "upper,fore",
            boxes,
            "skinbus: --cover fore: the boxes of --keep-out contain the whole link: make them smaller",
        ),
    ] {
        let output = cover(links, more);
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!((output.status.code(), said.lines().count()), (Some(2), 1), "{said}");
        assert!(said.starts_with(expected) && output.stdout.is_empty(), "{said}");
    }
    let [plain, blanks] = ["upper,fore", " upper, fore "].map(|links| cover(links, "").stdout);
    assert!(!plain.is_empty() && plain == blanks, "blanks around names do not count");
}

/// Checks the torques of 10 N on a cell 0.3 m above the shoulder, and 0.2 m in front of it.
#[test]
fn torques_of_a_force_are_computed_in_both_ways() {
    let place = arm();
    place.write("cells.csv", "link,px,py,pz,nx,ny,nz\nupper,0,0,0.3,1,0,0\nfore,0.2,0,0.1,0,0,1\n");
    run(&place, "skin import arm.urdf --tip bare --places cells.csv -o skin.toml").succeeded();
    place.write("rows.csv", "cell,force_n,q\nvcan0:1,10,0 0.5\n2,10,0 0.5\n1,10,1.5707963267948966 0.5\n");
    let said = run(&place, "explain skin.toml --batch rows.csv --json").succeeded().stdout;
    let rows: Vec<Value> = said.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let numbers = |row: &Value, key: &str| {
        row[key].as_array().unwrap().iter().map(|it| it.as_f64().unwrap()).collect::<Vec<_>>()
    };
    // A lever r and a force -F n give the torque r_z F_x - r_x F_z about y. The forearm is turned by 0.5 about y at 0.4
    // m.
    let (sine, cosine) = 0.5_f64.sin_cos();
    let (x, z) = (0.2 * cosine + 0.1 * sine, 0.1 * cosine - 0.2 * sine);
    let elbow = z * -10.0 * sine + x * 10.0 * cosine;
    let expected = [[-3.0, 0.0], [elbow + 0.4 * -10.0 * sine, elbow], [-3.0, 0.0]];
    assert_eq!(rows.len(), expected.len());
    for (row, expected) in rows.iter().zip(expected) {
        assert_eq!(row["joints"], serde_json::json!(["shoulder", "elbow"]));
        assert_eq!((&row["units"][0], &row["saturated"]), (&Value::from("Nm"), &Value::from(false)));
        let keys = ["central", "fixed", "difference"].map(|key| numbers(row, key));
        for joint in 0..2 {
            let [central, fixed, difference] = [0, 1, 2].map(|key| keys[key][joint]);
            assert!((central - expected[joint]).abs() < 1e-9, "{row}");
            assert!((fixed - central).abs() < 0.01 && (fixed - central - difference).abs() < 1e-12, "{row}");
        }
    }
    let mut single = place.command("skinbus", "explain skin.toml --json --cell vcan0:1 --force 10 --joints");
    single.arg("0 0.5");
    let out = single.output().unwrap();
    assert!(out.status.success());
    let same: Value = serde_json::from_slice(&out.stdout).unwrap();
    assert_eq!(same, rows[0]);

    for (words, expected) in [
        ("--cell 9 --force 1 --joints 0,0.5", "--cell 9: the skin has no such cell on vcan0"),
        ("--cell 1 --force 1 --joints 0", "one is needed for each of the chain's 2 joints: shoulder, elbow"),
        ("--cell 1 --force 1 --joints 0,x", "position \"x\" of elbow: use a number in rad"),
        ("--cell 1 --force -1 --joints 0,0.5", "force -1 N: the force against the outward normal"),
        ("--cell 1 --force 95.998 --joints 0,0.5", "skinbus: --cell 1: force 95.998 N: "),
        (
            "--cell vcan0:1 --force 1 --joints 45,0.5",
            "skinbus: --cell vcan0:1: position 45 rad: shoulder allows -6.2832 to 6.2832 rad",
        ),
        ("--cell 1 --joints 0,0.5", "--force"),
        ("--cell 1 --force 1 --joints 0,0.5 --batch rows.csv", "cannot be used with"),
        ("--batch nowhere.csv", "nowhere.csv: No such file"),
        (
            "--batch cells.csv",
            "cells.csv: line 1: the first line must be the header cell,force_n,q, not \"link,",
        ),
    ] {
        refused(&place, &format!("explain skin.toml {words}"), expected);
    }
    for (text, expected) in [
        ("cell,force_n,q\n", "it contains no rows"),
        (
            "cell,force_n,q\n7,1,0 0.5\n",
            "skinbus: rows.csv, row 1: cell 7: the skin has no such cell on vcan0",
        ),
        (
            "cell,force_n,q\n1,1,0 0.5\nvcan5:1,1,0 0.5\n",
            "skinbus: rows.csv, row 2: cell vcan5:1: the skin has no such bus; it has vcan0",
        ),
        ("cell,force_n,q\n1,1,0\n", "skinbus: rows.csv, row 1: cell 1: 1 position given, but one is needed"),
        ("cell,force_n,q\n1,x,0 0.5\n", "skinbus: rows.csv: line 2: force_n = \"x\": use a finite number"),
        ("1,1,0 0.5\n2,1,0 0.5\n", ", not \"1,1,0 0.5\": write the header above it"),
        (
            "cell,force_n,q\n1,1,0 0.5\nvcan0:2,96,0 0.5\n",
            "skinbus: rows.csv, row 2: cell vcan0:2: force 96 N: the force against the outward normal must \
             be 0 to 95.997 N, the most that a cell's three contact sensors can report",
        ),
        (
            "cell,force_n,q\n2,1,0 -6.3\n",
            "skinbus: rows.csv, row 1: cell 2: position -6.3 rad: elbow allows -6.2832 to 6.2832 rad",
        ),
    ] {
        place.write("rows.csv", text);
        refused(&place, "explain skin.toml --batch rows.csv", expected);
    }

    // The limits of the ranges.
    place.write("rows.csv", "# ends\ncell,force_n,q\n1,0,-6.28 0.5\n1,95.9970703125,2 6.28\n");
    run(&place, "explain skin.toml --batch rows.csv").succeeded();
    let endless = ARM.replacen("revolute", "continuous", 1).replacen("revolute", "prismatic", 1);
    place.write("arm.urdf", &endless.replace("\"0.5\" upper=\"1.5\"", "\"0\" upper=\"0.5\""));
    run(&place, "skin import arm.urdf --tip bare -o skin.toml --overwrite").succeeded();
    run(&place, "explain skin.toml --cell 1 --force 1 --joints -3.14159,0.5").succeeded();
    for (joints, expected) in [
        ("-6.3,0", "position -6.3 rad: shoulder allows -6.2832 to 6.2832 rad"),
        ("0,0.6", "position 0.6 m: elbow allows 0.0000 to 0.5000 m"),
    ] {
        refused(&place, &format!("explain skin.toml --cell 1 --force 1 --joints {joints}"), expected);
    }
}
