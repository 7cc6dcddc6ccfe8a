//! Published robots with defects: files that lack something or deviate from the specification.

use std::fs;

use super::{ARM, arm, refused, run};

const COVER: &str = "skin import arm.urdf --tip bare --cover fore";

#[test]
fn a_link_without_its_mesh_is_left_out() {
    let place = arm();
    place.write("arm.urdf", &ARM.replace("upper=\"1.5\"", "upper=\"180\""));
    let said = run(&place, &format!("{COVER} --leave-out plate -o skin.toml")).succeeded().stderr;
    assert!(said.contains("joint elbow: limits of 0.5 to 180 rad are more than four turns"), "{said}");
    assert!(place.read("skin.toml").contains(" --leave-out plate "));
}

#[test]
fn a_mesh_is_found_by_its_uri() {
    let place = arm();
    fs::rename(place.path("parts"), place.path("my parts")).unwrap();
    place.write("arm.urdf", &ARM.replace("package://arm_parts", "file:my%20parts"));
    run(&place, &format!("{COVER} -o skin.toml")).succeeded();
}

#[test]
fn a_mesh_that_stands_for_another_file_is_named() {
    let place = arm();
    place.write(
        "parts/meshes/plate.stl",
        "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n",
    );
    let words = format!("{COVER} --package arm_parts=parts");
    refused(
        &place,
        &words,
        "plate.stl: this is a Git LFS pointer to a file, not the file: fetch it with `git lfs pull`",
    );
}

#[test]
fn a_faulty_visual_stops_only_what_needs_it() {
    let place = arm();
    place.write("arm.urdf", &ARM.replace("box size=\"0.08 0.08 0.3\"", "box size=\"0.08\""));
    run(&place, "skin import arm.urdf --tip bare -o skin.toml").succeeded();
    refused(
        &place,
        &format!("{COVER} --leave-out plate"),
        "arm.urdf:4: link \"fore\": size = \"0.08\": must be three lengths in m",
    );
    let said = run(&place, "skin show skin.toml -o skin.html").succeeded().stderr;
    assert!(said.contains("2 links not drawn: arm.urdf:4: link \"fore\": size = \"0.08\""), "{said}");
}

#[test]
fn a_description_in_latin_1_is_read_and_recorded_as_utf_8() {
    let place = arm();
    let declared = format!("<?xml version=\"1.0\" encoding=\"ISO-8859-1\"?>\n<!-- M\u{fc}ller -->\n{ARM}");
    let bytes: Vec<_> = declared.chars().map(|letter| u8::try_from(u32::from(letter)).unwrap()).collect();
    fs::write(place.path("arm.urdf"), bytes).unwrap();
    run(&place, "skin import arm.urdf --tip bare -o skin.toml").succeeded();
    run(&place, "run skin.toml --bus-kind embedded --duration 0.2 --record run.mcap").succeeded();
    let recorded = super::Recorded::read(&place.path("run.mcap"));
    let expected = declared.replace("ISO-8859-1", "UTF-8");
    assert_eq!(recorded.attachments["robot.urdf"], expected.as_bytes());
}
