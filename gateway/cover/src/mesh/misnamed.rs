//! Recognises files whose contents have another format than their extension says.

use protocol::xml::format_of_root_element;
use roxmltree::Document;

use super::MeshError;

/// The advice for a file of an unsupported format.
const CONVERT_ADVICE: &str = "convert it to stl, dae or obj, and name the converted file in the URDF";

/// The first bytes, the name of the format, and the advice for each known format.
const FORMAT_SIGNATURES: &[(&[u8], &str, &str)] = &[
    (b"glTF", "a binary glTF file", CONVERT_ADVICE),
    (b"ply\n", "a PLY mesh", CONVERT_ADVICE),
    (b"ply\r", "a PLY mesh", CONVERT_ADVICE),
    (b"ISO-10303-21", "a STEP file", CONVERT_ADVICE),
    (b"#VRML", "a VRML file", CONVERT_ADVICE),
    (b"Kaydara FBX", "an FBX file", CONVERT_ADVICE),
];

/// Returns an error that names the actual format of a file; `None` if no other format is recognised. `extension` is in
/// lower case.
pub(super) fn actual_format_error(file: &str, extension: &str, bytes: &[u8]) -> Option<MeshError> {
    let (what, hint) = detect_format(extension, bytes)?;
    Some(MeshError::Foreign { file: file.to_owned(), line: None, what, hint })
}

fn detect_format(extension: &str, bytes: &[u8]) -> Option<(String, &'static str)> {
    let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes).trim_ascii_start();
    if let Some((_, what, hint)) = FORMAT_SIGNATURES.iter().find(|(magic, ..)| bytes.starts_with(magic)) {
        return Some(((*what).to_owned(), hint));
    }
    if extension != "stl" && text.starts_with(b"solid") {
        return Some(("an ASCII STL".to_owned(), "rename it to .stl, in the URDF too"));
    }
    if text.starts_with(b"<") {
        return detect_xml_format(extension, bytes);
    }
    let begins = |line: &[u8], word: &[u8]| line.trim_ascii_start().starts_with(word);
    let mut lines = bytes.split(|byte| *byte == b'\n');
    let is_obj = lines.any(|line| begins(line, b"v ")) && lines.any(|line| begins(line, b"f "));
    (extension != "obj" && is_obj).then(|| ("an OBJ mesh".to_owned(), "rename it to .obj, in the URDF too"))
}

/// Recognises XML that is not COLLADA, and COLLADA whose extension is another. Returns the name of the format and
/// advice.
fn detect_xml_format(extension: &str, bytes: &[u8]) -> Option<(String, &'static str)> {
    let text = protocol::xml::decode(bytes).ok()?;
    let prepared = protocol::xml::prepare(&text).ok()?;
    let document = Document::parse(&prepared.text).ok()?;
    let name = document.root_element().tag_name().name();
    let what = format_of_root_element(name)
        .map_or_else(|| format!("XML with the outermost element {name}"), str::to_owned);
    match (name, extension) {
        ("COLLADA", "dae") => None,
        ("COLLADA", _) => Some((what, "rename it to .dae, in the URDF too")),
        _ => Some((what, "name the file of the mesh")),
    }
}

#[cfg(test)]
mod tests {
    use crate::mesh::{Mesh, UpAxis};

    const STL: &str = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid\n";
    const OBJ: &str = "# by hand\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";

    fn refused(name: &str, bytes: &[u8]) -> String {
        Mesh::parse(name, bytes, UpAxis::Ignore).unwrap_err().to_string()
    }

    #[test]
    fn a_name_that_a_hint_gives_is_right() {
        for (text, right, wrong) in [(STL, "stl", ["obj", "dae"]), (OBJ, "obj", ["stl", "dae"])] {
            assert!(Mesh::parse(&format!("a.{right}"), text.as_bytes(), UpAxis::Ignore).is_ok());
            for name in wrong.map(|extension| format!("a.{extension}")) {
                let error = refused(&name, text.as_bytes());
                assert!(error.ends_with(&format!(": rename it to .{right}, in the URDF too")), "{error}");
            }
        }
    }

    #[test]
    fn what_is_not_read_is_not_called_damaged() {
        for (bytes, what) in [
            (&b"glTF\x02\0\0\0"[..], "a binary glTF file"),
            (b"ply\nformat ascii 1.0\n", "a PLY mesh"),
            (b"ISO-10303-21;\n", "a STEP file"),
        ] {
            for extension in ["stl", "dae", "obj"] {
                // The bytes that follow are enough for the header of an STL file.
                let error = refused(&format!("a.{extension}"), &[bytes, &[0; 100]].concat());
                assert!(
                    error.ends_with(&format!(
                        "{what}: convert it to stl, dae or obj, and name the converted file in the URDF"
                    )),
                    "{error}"
                );
            }
        }
    }

    #[test]
    fn hints_do_not_contradict_each_other() {
        let latin = refused("a.dae", b"<COLLADA>\xfc</COLLADA>");
        assert!(latin.ends_with("(if it is in Latin-1)"), "{latin}");
        let typed = refused("a.dae", b"<!DOCTYPE a [<!ENTITY a 'b'>]><COLLADA/>");
        assert!(typed.ends_with("and replace its entities by their values"), "{typed}");
        assert!(refused("a", STL.as_bytes()).ends_with("; add the extension of its format"));
    }
}
