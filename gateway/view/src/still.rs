//! A picture of a skin without buses, as one HTML page that needs no server, library or network.
//!
//! The page draws the same [`Scene`] with the same scripts as the live page. Cells are hexagons with their node ids,
//! coloured by bus; a root has a second hexagon. The user can rotate and zoom the view. Details are shown of a cell
//! that is clicked, searched for as `bus:node`, or given after `#` in the address.

use data_encoding::BASE64;
use protocol::xml::escaped;
use serde::Serialize;

use crate::scene::Scene;
use crate::surface::{RowMesh, pack_meshes};
use crate::web;

/// The contents of a page that shows a skin without buses.
#[derive(Clone, Debug, PartialEq)]
pub struct StaticSkinPage {
    /// The scene to draw.
    pub scene: Scene,
    /// The surface of the robot's links; empty if it is unknown.
    pub surface: Vec<RowMesh>,
    /// The position of each joint of the robot, in rad or m.
    pub positions: Vec<f64>,
    /// Further properties of each cell as names and values, in the order of [`Scene::cells`].
    pub details: Vec<Vec<(String, String)>>,
    /// Cells that were at another place before. The page draws a line from the old place to the new one.
    pub moved: Vec<PreviousCellPlace>,
    /// A value of each cell, which gives its colour; `None` to colour cells by bus.
    pub shades: Option<CellShades>,
    /// The results that the page shows at its top, in parts.
    pub findings: Vec<FindingPart>,
}

/// A value of each cell, which gives its colour.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CellShades {
    /// The name of the value.
    pub caption: String,
    /// The unit of the value.
    pub unit: String,
    /// The value from which on cells have the last colour.
    pub high: f64,
    /// True if a value is larger than `high`.
    pub more: bool,
    /// The values in the order of [`Scene::cells`]; `None` for a cell without colour.
    pub values: Vec<Option<f64>>,
    /// The meaning of a cell without colour.
    pub unknown: String,
}

/// A part of a sentence.
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
pub struct FindingPart {
    /// The text.
    pub text: String,
    /// True if the text is the name of a cell, `bus:node`, to which the page links.
    #[serde(rename = "isCell")]
    pub is_cell: bool,
}

impl FindingPart {
    /// Creates a part that is plain text.
    pub fn text(text: impl Into<String>) -> Self {
        Self { text: text.into(), is_cell: false }
    }

    /// Creates a part that names a cell.
    #[must_use]
    pub fn cell(bus: &str, node: u8) -> Self {
        Self { text: format!("{bus}:{node}"), is_cell: true }
    }
}

/// The place at which a cell was before.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PreviousCellPlace {
    /// The index of the cell in [`Scene::cells`].
    pub cell: usize,
    /// The index of the chain to which the row belongs.
    pub chain: usize,
    /// The number of the row in whose frame the place is given, from 1.
    pub row: u8,
    /// The former centre of the cell in the frame of the row, in m.
    pub position: [f64; 3],
    /// The former normal of the cell in the frame of the row.
    pub normal: [f64; 3],
}

/// The data that the page's script reads.
#[derive(Serialize)]
struct StaticPageData<'a> {
    scene: &'a Scene,
    positions: &'a [f64],
    details: &'a [Vec<(String, String)>],
    moved: &'a [PreviousCellPlace],
    shades: Option<&'a CellShades>,
    findings: &'a [FindingPart],
    /// The corners of the surface in base64, in the format of [`pack_meshes`].
    surface: String,
}

impl StaticSkinPage {
    /// Returns the HTML text of the page.
    #[must_use]
    pub fn to_html(&self) -> String {
        let (shells, corners) = pack_meshes(&self.surface);
        let data = StaticPageData {
            scene: &Scene { shells, may_press: false, ..self.scene.clone() },
            positions: &self.positions,
            details: &self.details,
            moved: &self.moved,
            shades: self.shades.as_ref(),
            findings: &self.findings,
            surface: BASE64.encode(&corners),
        };
        // Serialising strings and numbers cannot fail. `<` is escaped, so that the data cannot end the script element.
        let data = serde_json::to_string(&data).unwrap_or_default().replace('<', "\\u003c");
        let mut text = String::new();
        // The template is split at its marks first, so that marks in inserted text are not replaced.
        for (at, piece) in web::file_text("still.html").unwrap_or_default().split('@').enumerate() {
            match piece {
                "NAME" => text.push_str(&escaped(&self.scene.name)),
                "CSS" => text.push_str(web::file_text("style.css").unwrap_or_default()),
                "DATA" => text.push_str(&data),
                "SCRIPT" => text.push_str(&web::bundle_modules("still.js")),
                _ => {
                    debug_assert!(at % 2 == 0, "an unknown mark: {piece}");
                    text.push_str(piece);
                }
            }
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::skin::Skin;

    fn still() -> StaticSkinPage {
        let skin = Skin::parse("ur5", include_str!("../../examples/ur5-253.toml")).unwrap();
        let mut scene = Scene::from_skin(&skin, true);
        scene.name = "<arm> & @DATA@ 'x'".to_owned();
        let details = vec![vec![("a<b".to_owned(), "</script><b>".to_owned())]; scene.cells.len()];
        let triangles = vec![[[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]];
        let [position, normal] = [[0.0, 0.1, 0.2], [0.0, 0.0, 1.0]];
        StaticSkinPage {
            positions: vec![0.0; scene.joints.len()],
            moved: vec![PreviousCellPlace { cell: 7, chain: 0, row: 2, position, normal }],
            surface: vec![RowMesh { chain: 0, row: 1, triangles }],
            shades: None,
            findings: vec![FindingPart::text("</script>"), FindingPart::cell("vcan0", 7)],
            scene,
            details,
        }
    }

    #[test]
    fn text_is_escaped_and_data_can_be_read() {
        let page = still().to_html();
        assert_eq!(page.matches("&lt;arm&gt; &amp; @DATA@ &#39;x&#39;").count(), 2, "title and heading");
        assert_eq!(page.matches("</script>").count(), 2, "of the page's own two");
        let (_, data) = page.split_once(r#"id="skin">"#).unwrap();
        let (data, _) = data.split_once("</script>").unwrap();
        let data: serde_json::Value = serde_json::from_str(data).unwrap();
        assert_eq!(data["scene"]["cells"].as_array().unwrap().len(), 253);
        assert_eq!(
            (&data["scene"]["may_press"], &data["scene"]["shells"][0]["count"]),
            (&false.into(), &3.into())
        );
        assert_eq!(data["details"][9], serde_json::json!([["a<b", "</script><b>"]]));
        assert_eq!(data["findings"][0], serde_json::json!({ "text": "</script>", "isCell": false }));
        assert_eq!(data["findings"][1], serde_json::json!({ "text": "vcan0:7", "isCell": true }));
        assert_eq!(data["moved"][0]["position"], serde_json::json!([0.0, 0.1, 0.2]));
        assert_eq!(data["surface"].as_str().unwrap().len(), 3 * 24 / 3 * 4);
    }

    #[test]
    fn the_page_has_the_colours_of_the_live_page_once() {
        let page = still().to_html();
        assert_eq!(page.matches("const STOPS = [[68, 1, 84]").count(), 1);
        assert_eq!(page.matches("const BUSES = [[86, 180, 233]").count(), 1);
    }

    #[test]
    fn the_page_asks_for_nothing_outside() {
        let page = still().to_html();
        assert!(!page.contains("http:") && !page.contains("https:") && !page.contains("import "));
        assert!(!page.contains("src=") && !page.contains("href=") && !page.contains("@import"));
        assert!(page.contains("default-src 'none'"));
    }

    #[test]
    fn bytes_in_base64_are_those_of_the_rfc() {
        for (bytes, text) in
            [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")]
        {
            assert_eq!(BASE64.encode(bytes.as_bytes()), text);
        }
        assert_eq!(BASE64.encode(&[0xff, 0xef, 0xbe]), "/+++");
    }
}
