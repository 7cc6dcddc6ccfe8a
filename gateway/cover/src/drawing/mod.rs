//! A skin in 3D as one HTML page that needs nothing else: no server, no library, no network.
//!
//! Cells are hexagons with their node ids, coloured by bus; a root has a second hexagon. The page turns and zooms,
//! and shows a cell that is chosen, searched as `bus:node`, or named behind `#` in its address.

use nalgebra::Point3;
use protocol::xml::escaped;
use serde::Serialize;

use crate::mesh::simplify;

/// The most triangles that a page has; more are merged.
pub const MAX_TRIANGLES: usize = 12_000;

/// What to draw; all coordinates in one frame whose z points up, in m.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Drawing {
    /// The page's title.
    pub name: String,
    /// From one cell's middle to the next one's, in m: how large hexagons are.
    pub pitch: f64,
    /// The buses' names.
    pub buses: Vec<String>,
    /// The cells.
    pub cells: Vec<DrawnCell>,
    /// Lines below the cells, for instance from joint to joint.
    pub segments: Vec<[[f64; 3]; 2]>,
    /// The links' surface, of which at most [`MAX_TRIANGLES`] are drawn.
    pub triangles: Vec<[[f64; 3]; 3]>,
}

/// A cell as it is drawn.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct DrawnCell {
    /// Its bus, as an index of [`Drawing::buses`].
    pub bus: usize,
    /// Its node id.
    pub node: u16,
    /// What it is called beside `bus:node`; may be empty.
    pub label: String,
    /// Its middle, in m.
    pub position: [f64; 3],
    /// Which way it faces: a unit vector.
    pub normal: [f64; 3],
    /// The node ids that it is wired to, on its bus.
    pub neighbors: Vec<u16>,
    /// Whether it is wired to the gateway.
    pub root: bool,
    /// More about it, as names and values.
    pub details: Vec<(String, String)>,
}

/// What the page's script reads.
#[derive(Debug, Serialize)]
struct Data<'a> {
    pitch: f64,
    buses: &'a [String],
    cells: &'a [DrawnCell],
    segments: &'a [[[f64; 3]; 2]],
    triangles: Vec<[[f64; 3]; 3]>,
}

/// The page. Coordinates that are not finite are drawn at 0.
#[must_use]
pub fn page(drawing: &Drawing) -> String {
    let mut cells = drawing.cells.clone();
    for cell in &mut cells {
        (cell.position, cell.normal) = (cell.position.map(rounded), cell.normal.map(rounded));
    }
    let segments: Vec<_> =
        drawing.segments.iter().map(|segment| segment.map(|end| end.map(rounded))).collect();
    let triangles = drawing.triangles.iter().map(|triangle| triangle.map(Point3::from)).collect();
    let triangles = simplify(vec![triangles], MAX_TRIANGLES).into_iter().flatten();
    let data = Data {
        pitch: if drawing.pitch.is_finite() { drawing.pitch } else { 0.0 },
        buses: &drawing.buses,
        cells: &cells,
        segments: &segments,
        triangles: triangles
            .map(|triangle| triangle.map(|corner| <[f64; 3]>::from(corner.coords).map(rounded)))
            .collect(),
    };
    // Strings and finite numbers are always JSON. Without `<`, nothing in it ends the script element.
    let data = serde_json::to_string(&data).unwrap_or_default().replace('<', "\\u003c");
    let mut text = String::new();
    // Parts are put in from left to right, so that no text is searched for marks again.
    for (at, piece) in include_str!("page.html").split('@').enumerate() {
        match piece {
            "NAME" => text.push_str(&escaped(&drawing.name)),
            "CSS" => text.push_str(include_str!("page.css")),
            "DATA" => text.push_str(&data),
            "SCRIPT" => text.push_str(include_str!("page.js")),
            _ => {
                debug_assert!(at % 2 == 0, "an unknown mark: {piece}");
                text.push_str(piece);
            }
        }
    }
    text
}

/// To a hundredth of a millimetre.
fn rounded(value: f64) -> f64 {
    if value.is_finite() { (value * 1e5).round() / 1e5 } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drawing() -> Drawing {
        let cell = DrawnCell {
            node: 7,
            normal: [0.0, 0.0, 1.0],
            position: [0.123_456_789, f64::NAN, 0.0],
            label: "</script><b>".to_owned(),
            details: vec![("a<b".to_owned(), "\"c\"".to_owned())],
            ..DrawnCell::default()
        };
        Drawing {
            name: "<arm> & @DATA@ 'x'".to_owned(),
            pitch: 0.028,
            buses: vec!["vcan0".to_owned()],
            cells: vec![cell],
            triangles: vec![[[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]],
            ..Drawing::default()
        }
    }

    #[test]
    fn text_is_escaped_and_data_can_be_read() {
        let page = page(&drawing());
        assert_eq!(page.matches("&lt;arm&gt; &amp; @DATA@ &#39;x&#39;").count(), 2, "title and heading");
        assert_eq!(page.matches("</script>").count(), 2, "of the page's own two");
        let (_, data) = page.split_once(r#"id="skin">"#).unwrap();
        let (data, _) = data.split_once("</script>").unwrap();
        let data: serde_json::Value = serde_json::from_str(data).unwrap();
        assert_eq!(data["cells"][0]["label"], "</script><b>");
        assert_eq!(data["cells"][0]["details"][0], serde_json::json!(["a<b", "\"c\""]));
        assert_eq!(data["cells"][0]["position"], serde_json::json!([0.12346, 0.0, 0.0]));
        assert_eq!(data["triangles"].as_array().unwrap().len(), 1);
    }

    #[test]
    fn the_page_asks_for_nothing_outside() {
        let page = page(&drawing());
        let outside = page.replace("http://www.w3.org/2000/svg", "");
        assert!(!outside.contains("http:") && !outside.contains("https:"));
        assert!(!page.contains("src=") && !page.contains("href=") && !page.contains("@import"));
        assert!(page.contains("default-src 'none'"));
    }
}
