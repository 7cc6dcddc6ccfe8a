//! Reads binary and ASCII STL files. The normals in them are ignored.
//!
//! ```text
//!              0        80      84     96                        132    134
//!              +--------+-------+------+--------+--------+--------+------+-- --
//! binary       | title  | count |normal| corner | corner | corner | attr | ...      little endian
//!              +--------+-------+------+--------+--------+--------+------+-- --
//! ```

use nalgebra::Point3;

use super::{MeshError, Triangle, damaged, syntax};

const TITLE_BYTES: usize = 80;
const HEADER_BYTES: usize = TITLE_BYTES + 4;
const TRIANGLE_BYTES: usize = 50;
const NORMAL_BYTES: usize = 12;

/// Returns the triangles of a file with these contents. A file is binary if its length fits the number of triangles
/// that it states, even if its title begins like an ASCII file.
pub(super) fn triangles(name: &str, bytes: &[u8]) -> Result<Vec<Triangle>, MeshError> {
    let binary = parse_binary(bytes);
    if let Some(BinaryContents { announced, body }) = binary {
        let (all, rest) = body.as_chunks();
        // Some exporters write a line break after the last triangle.
        if usize::try_from(announced) == Ok(all.len()) && matches!(rest, b"" | b"\n" | b"\r\n") {
            return Ok(all.iter().map(parse_triangle).collect());
        }
    }
    if is_ascii(bytes) {
        return parse_ascii(name, bytes);
    }
    match binary {
        Some(BinaryContents { announced, body }) => {
            let (count, rest) = (body.len() / TRIANGLE_BYTES, body.len() % TRIANGLE_BYTES);
            let rest = if rest == 0 { String::new() } else { format!(" and {rest} bytes") };
            Err(damaged(
                name,
                &format!("its header announces {announced} triangles, but it has {count}{rest}"),
            ))
        }
        None => Err(damaged(
            name,
            &format!(
                "it has {} bytes; a binary STL has {HEADER_BYTES} or more, and an ASCII STL begins with solid",
                bytes.len()
            ),
        )),
    }
}

/// The number of triangles that a binary file states, and the bytes after this number.
#[derive(Clone, Copy)]
struct BinaryContents<'a> {
    announced: u32,
    body: &'a [u8],
}

fn parse_binary(bytes: &[u8]) -> Option<BinaryContents<'_>> {
    let (count, body) = bytes.get(TITLE_BYTES..)?.split_first_chunk()?;
    Some(BinaryContents { announced: u32::from_le_bytes(*count), body })
}

fn parse_triangle(bytes: &[u8; TRIANGLE_BYTES]) -> Triangle {
    let corners = bytes.get(NORMAL_BYTES..).unwrap_or_default();
    let mut values = corners.as_chunks().0.iter().map(|word| f64::from(f32::from_le_bytes(*word)));
    let mut next = || values.next().unwrap_or(f64::NAN);
    core::array::from_fn(|_| Point3::new(next(), next(), next()))
}

/// Returns the bytes without a byte order mark at their beginning.
fn strip_byte_order_mark(bytes: &[u8]) -> &[u8] {
    bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes)
}

/// Returns true if the contents are text that begins with `solid`. A binary file may begin in the same way, but has
/// zeros in its title or its first triangles.
fn is_ascii(bytes: &[u8]) -> bool {
    let text = strip_byte_order_mark(bytes).trim_ascii_start();
    let head = bytes.get(..bytes.len().min(HEADER_BYTES + TRIANGLE_BYTES)).unwrap_or_default();
    text.get(..5).is_some_and(|word| word.eq_ignore_ascii_case(b"solid")) && !head.contains(&0)
}

/// Returns the triangles of an ASCII file. Numbers are rounded to single precision, as in binary files. The names of
/// solids may have any encoding.
fn parse_ascii(name: &str, bytes: &[u8]) -> Result<Vec<Triangle>, MeshError> {
    let text = String::from_utf8_lossy(strip_byte_order_mark(bytes));
    let mut triangles = Vec::new();
    let mut corners: Vec<Point3<f64>> = Vec::new();
    let mut last = String::new();
    for (index, line) in text.lines().enumerate() {
        let wrong = |why: &str| syntax(name, &format!("line {}: {why}", index + 1));
        let mut words = line.split_ascii_whitespace();
        while let Some(word) = words.next() {
            last = word.to_ascii_lowercase();
            match last.as_str() {
                // The rest of the line is a name.
                "solid" | "endsolid" => break,
                "normal" => _ = words.nth(2),
                "vertex" => {
                    let numbers: Vec<f32> = words.by_ref().take(3).map_while(|it| it.parse().ok()).collect();
                    let Ok(numbers) = <[f32; 3]>::try_from(numbers) else {
                        return Err(wrong("a vertex has three numbers"));
                    };
                    corners.push(Point3::from(numbers.map(f64::from)));
                }
                "endfacet" => {
                    let facet = core::mem::take(&mut corners);
                    let count = facet.len();
                    let facet = facet.try_into();
                    triangles
                        .push(facet.map_err(|_| wrong(&format!("a facet has {count} vertices, not 3")))?);
                }
                "facet" | "outer" | "loop" | "outerloop" | "endloop" => (),
                _ => return Err(wrong(&format!("{word:?} is not a keyword of an ASCII STL"))),
            }
        }
    }
    if last == "endsolid" {
        return Ok(triangles);
    }
    let count = triangles.len();
    let hint = if count > 0 { "; if it is complete, add that line" } else { "" };
    Err(damaged(name, &format!("it ends without endsolid, after {count} triangles{hint}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a binary file with twelve triangles that states the number `announced`.
    fn binary(announced: u32) -> Vec<u8> {
        let mut bytes = vec![b' '; TITLE_BYTES];
        bytes.extend(announced.to_le_bytes());
        for number in 0_u8..12 {
            bytes.extend([0; NORMAL_BYTES]);
            for value in 0_u8..9 {
                bytes.extend(f32::from(number + value * value).to_le_bytes());
            }
            bytes.extend([0; 2]);
        }
        bytes
    }

    fn refused(bytes: &[u8]) -> String {
        let message = triangles("a.stl", bytes).unwrap_err().to_string();
        assert_eq!(message.lines().count(), 1, "{message}");
        message
    }

    #[test]
    fn a_binary_file_has_as_many_triangles_as_it_announces() {
        let whole = binary(12);
        assert_eq!(triangles("a.stl", &whole).unwrap().len(), 12);
        for end in ["\n", "\r\n"] {
            assert_eq!(triangles("a.stl", &[&whole, end.as_bytes()].concat()).unwrap().len(), 12);
        }
        for title in [&b"solid arm"[..], b"", b"COLOR="] {
            let titled = |mut bytes: Vec<u8>| {
                bytes[..title.len()].copy_from_slice(title);
                bytes
            };
            for announced in [0, 11, 13, 24, u32::MAX] {
                let message = refused(&titled(binary(announced)));
                let words = format!(
                    "mesh a.stl: its header announces {announced} triangles, but it has 12: it is cut off"
                );
                assert!(message.starts_with(&words), "{message}");
            }
            for length in HEADER_BYTES..whole.len() {
                let message = refused(&titled(whole.clone())[..length]);
                let body = length - HEADER_BYTES;
                assert!(
                    message.contains(&format!("announces 12 triangles, but it has {}", body / 50)),
                    "{message}"
                );
                assert_eq!(
                    message.contains(&format!(" and {} bytes", body % 50)),
                    !body.is_multiple_of(50),
                    "{message}"
                );
            }
            assert!(
                refused(&[&titled(whole.clone())[..], b"more"].concat()).contains("it has 12 and 4 bytes")
            );
        }
        assert!(refused(b"").contains("it has 0 bytes; a binary STL has 84 or more"));
    }

    fn text() -> String {
        let facet = |at: u8| {
            let vertex = |k: u8| format!("  vertex {at} {k} 1e{}\n", k * k);
            format!(
                "facet normal 0 0 1\n outer loop\n{}{}{} endloop\nendfacet\n",
                vertex(0),
                vertex(1),
                vertex(2)
            )
        };
        format!("solid arm\n{}endsolid\n", (0..4).map(facet).collect::<String>())
    }

    #[test]
    fn a_text_is_read_as_others_read_it() {
        let whole = text();
        let expected = triangles("a.stl", whole.as_bytes()).unwrap();
        assert_eq!(expected.len(), 4);
        for (from, to) in [
            ("solid arm\n", "solid m\u{fc}ller\n"),
            ("solid arm\n", "\u{feff}solid arm\n"),
            ("solid arm\n", "\n  solid\n"),
            ("outer loop", "outerloop"),
            ("\n", "\r\n"),
            ("facet", "FACET"),
        ] {
            assert_eq!(triangles("a.stl", whole.replace(from, to).as_bytes()).unwrap(), expected, "{to:?}");
        }
        let mut latin = whole.into_bytes();
        latin[6] = 0xfc;
        assert_eq!(triangles("a.stl", &latin).unwrap(), expected);
    }

    #[test]
    fn a_text_that_is_cut_off_is_refused() {
        let whole = text();
        for length in 0..whole.rfind("endsolid").unwrap() {
            let message = refused(&whole.as_bytes()[..length]);
            assert!(message.starts_with("mesh a.stl: "), "{message}");
        }
        let last = &whole[..whole.find("endsolid").unwrap()];
        assert!(refused(last.as_bytes()).contains(
            "it ends without endsolid, after 4 triangles; if it is complete, add that line: it is cut off"
        ));
        assert!(refused(b"solid arm\n").contains("after 0 triangles: it is cut off"));
        assert!(refused(whole.replace("vertex 0 1", "vertx 0 1").as_bytes()).contains("line 5: \"vertx\""));
        let line = "  vertex 2 1 1e1\n";
        assert!(whole.contains(line));
        assert!(refused(whole.replace(line, "").as_bytes()).contains("a facet has 2 vertices, not 3"));
    }
}
