//! `skinbus skin show`: one file that draws a skin.

use std::fs;

use serde_json::Value;

use super::{COVER, arm, example, read, refused, run};

/// Returns the data for a page's script.
fn data(page: &str) -> Value {
    let (_, data) = page.split_once(r#"id="skin">"#).unwrap();
    serde_json::from_str(data.split_once("</script>").unwrap().0).unwrap()
}

/// Decodes little-endian f32 from base64.
fn floats(base64: &str) -> Vec<f32> {
    let value = |letter: u8| match letter {
        b'A'..=b'Z' => letter - b'A',
        b'a'..=b'z' => letter - b'a' + 26,
        b'0'..=b'9' => letter - b'0' + 52,
        b'+' => 62,
        _ => 63,
    };
    let letters: Vec<_> = base64.bytes().filter(|letter| *letter != b'=').collect();
    let bits = letters.iter().flat_map(|letter| (0..6).rev().map(move |bit| value(*letter) >> bit & 1));
    let bits: Vec<_> = bits.collect();
    let bytes: Vec<_> =
        bits.chunks_exact(8).map(|bits| bits.iter().fold(0, |byte, bit| byte << 1 | bit)).collect();
    bytes.chunks_exact(4).map(|four| f32::from_le_bytes(four.try_into().unwrap())).collect()
}

#[test]
fn a_skin_is_drawn_on_one_page() {
    let place = arm();
    run(&place, &format!("{COVER} -o skin.toml")).succeeded();
    let ended = run(&place, "skin show skin.toml --package arm_parts=parts -o skin.html").succeeded();
    assert_eq!(ended.stderr, "");
    let page = place.read("skin.html");
    assert!(!page.contains("http:") && !page.contains("https:"), "it asks for nothing outside");
    let drawn = data(&page);
    let scene = &drawn["scene"];
    let names = |value: &Value| (value["bus"].as_u64().unwrap(), value["node"].as_u64().unwrap());
    let drawn_names: Vec<_> = scene["cells"].as_array().unwrap().iter().map(names).collect();
    let skin = read(&place, "skin.toml");
    let all: Vec<_> = skin.cells.iter().map(|cell| (cell.bus as u64, cell.node.get().into())).collect();
    assert_eq!(drawn_names, all);
    assert_eq!(scene["buses"][0]["name"], "vcan0");
    // Each cell of the upper arm lies on its tube, which is drawn in the same frame.
    let of_row = |shell: &&Value| shell["row"] == 1;
    let shell = scene["shells"].as_array().unwrap().iter().find(of_row).unwrap();
    let number = |key: &str| usize::try_from(shell[key].as_u64().unwrap()).unwrap();
    let floats = floats(drawn["surface"].as_str().unwrap());
    let corners: Vec<_> = floats.chunks(6).skip(number("first")).take(number("count")).collect();
    assert!(corners.len() > 100);
    for cell in skin.cells.iter().filter(|cell| cell.row == 1) {
        for axis in 0..3 {
            let along = || corners.iter().map(|corner| f64::from(corner[axis]));
            let (low, high) = (along().fold(f64::MAX, f64::min), along().fold(f64::MIN, f64::max));
            let at = cell.position[axis];
            assert!((low - 0.001..high + 0.001).contains(&at), "{at} of {low} to {high}");
        }
    }

    // Without the mesh, the other parts; without the URDF, tubes.
    let said = run(&place, "skin show skin.toml -o less.html").succeeded().stderr;
    assert!(said.starts_with("1 link not drawn: arm.urdf: link plate: mesh package://arm_parts/"), "{said}");
    fs::remove_file(place.path("arm.urdf")).unwrap();
    let ended = run(&place, "skin show skin.toml").succeeded();
    assert!(ended.stderr.starts_with("the robot is not drawn: arm.urdf: No such file"), "{}", ended.stderr);
    let without = data(&ended.stdout);
    assert_eq!(without["scene"]["shells"], serde_json::json!([]));
    for same in ["cells", "chains", "tubes"] {
        assert_eq!(without["scene"][same], scene[same], "{same}");
    }
    let ur5 = example("ur5-253.toml").display().to_string();
    let page = run(&place, &format!("skin show {ur5}")).succeeded().stdout;
    assert_eq!(data(&page)["scene"]["cells"].as_array().unwrap().len(), 253);
    place.write("skin.html", "mine");
    refused(&place, &format!("skin show {ur5} -o skin.html"), "-o skin.html: ");
}
