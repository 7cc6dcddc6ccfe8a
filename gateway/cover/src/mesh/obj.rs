//! Reads the vertices and faces of Wavefront OBJ files. Normals, textures, materials, groups and lines are ignored.

use nalgebra::Point3;

use super::polygon::Triangulation;
use super::{MAX_TRIANGLES, MeshError, Triangle, syntax, too_many};

/// Returns the triangles of a file with these contents.
pub(super) fn triangles(name: &str, bytes: &[u8]) -> Result<Vec<Triangle>, MeshError> {
    let mut vertices: Vec<Point3<f64>> = Vec::new();
    let mut filled = Triangulation::default();
    // Names may have any encoding, but numbers are always ASCII.
    let text = String::from_utf8_lossy(bytes);
    for (line, words) in numbered_word_lines(&text) {
        let wrong = |why: String| syntax(name, &format!("line {line}: {why}"));
        let mut words = words.iter().flat_map(|part| part.split_ascii_whitespace());
        match words.next() {
            Some("v") => vertices.push(parse_vertex(words).map_err(wrong)?),
            Some("f") => {
                let corners: Vec<_> = words
                    .map(|word| parse_corner(word, &vertices))
                    .collect::<Result<_, _>>()
                    .map_err(wrong)?;
                filled.add_polygon(&corners, &[]);
                if filled.triangles.len() > MAX_TRIANGLES {
                    return Err(too_many(name, filled.triangles.len()));
                }
            }
            _ => (),
        }
    }
    filled.finish().map_err(|why| syntax(name, &why))
}

/// Splits a text into lines of words, each with its line number from 1. Comments are removed, and a line that ends with
/// `\` is joined with the next one.
fn numbered_word_lines(text: &str) -> impl Iterator<Item = (usize, Vec<&str>)> {
    let text = text.trim_start_matches('\u{feff}');
    let mut lines = text.lines().enumerate();
    core::iter::from_fn(move || {
        let (index, mut line) = lines.next()?;
        let mut parts = Vec::new();
        loop {
            let (code, comment) = line.split_once('#').map_or((line, false), |(code, _)| (code, true));
            let goes_on = (!comment).then(|| code.trim_end().strip_suffix('\\')).flatten();
            parts.push(goes_on.unwrap_or(code));
            match goes_on.and_then(|_| lines.next()) {
                Some((_, next)) => line = next,
                None => return Some((index + 1, parts)),
            }
        }
    })
}

/// Parses a vertex: x, y, z, and optionally a weight or a colour.
fn parse_vertex<'a>(words: impl Iterator<Item = &'a str>) -> Result<Point3<f64>, String> {
    let number = |word: &str| word.parse::<f32>().map_err(|_| format!("{word:?} is not a number"));
    let number = |word| number(word).map(f64::from);
    let numbers = words.map(number).collect::<Result<Vec<_>, _>>()?;
    match *numbers.as_slice() {
        [x, y, z, weight] if weight != 0.0 => Ok(Point3::new(x / weight, y / weight, z / weight)),
        [_, _, _, _] => Err("the weight of a vertex is 0".to_owned()),
        [x, y, z, ..] => Ok(Point3::new(x, y, z)),
        _ => Err(format!("a vertex has {} numbers, not 3", numbers.len())),
    }
}

/// Returns the vertex of a face's corner: `5`, `5/1`, `5//1` or `5/1/1`. Only the first number is used; a negative one
/// counts back from the last vertex.
fn parse_corner(word: &str, vertices: &[Point3<f64>]) -> Result<Point3<f64>, String> {
    let number = word.split('/').next().unwrap_or_default();
    let index = number.parse::<i64>().map_err(|_| format!("{word:?} is not a corner of a face"))?;
    let count = i64::try_from(vertices.len()).unwrap_or(i64::MAX);
    let index = if index < 0 { index.checked_add(count) } else { index.checked_sub(1) };
    let vertex = index.and_then(|index| vertices.get(usize::try_from(index).ok()?));
    vertex
        .copied()
        .ok_or_else(|| format!("vertex {number} does not exist; {count} vertices come before the face"))
}
