//! Packs the surface of a robot for the page: the corners of all triangles, each with a normal.

use std::collections::HashMap;

use nalgebra::Vector3;
use serde::Serialize;

/// The cosine of 40 degrees. An edge between two faces is drawn smooth if their normals differ by less than this angle.
const SMOOTH_EDGE_COSINE: f64 = 0.77;

/// A mesh of the robot's surface, fixed to a row of a chain.
#[derive(Clone, Debug, PartialEq)]
pub struct RowMesh {
    /// The index of the chain in the skin.
    pub chain: usize,
    /// The row in whose frame the mesh is given, from 1; 0 is the base of the chain.
    pub row: usize,
    /// The triangles in the frame of the row, in m.
    pub triangles: Vec<[[f64; 3]; 3]>,
}

/// A shell of the scene: the range of its corners among those of all shells.
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
pub struct SceneMeshRange {
    /// The index of the chain in [`Scene::chains`](crate::Scene::chains).
    pub chain: usize,
    /// The number of the row, from 1; 0 is the base of the chain.
    pub row: usize,
    /// The index of the shell's first corner.
    pub first: usize,
    /// The number of corners, which is three for each triangle.
    pub count: usize,
}

/// Returns the shells of the scene, and the corners of all shells as bytes. A corner has a position and a normal,
/// together 6 little-endian f32.
#[must_use]
pub fn pack_meshes(shells: &[RowMesh]) -> (Vec<SceneMeshRange>, Vec<u8>) {
    let (mut all, mut bytes) = (Vec::new(), Vec::new());
    let mut first = 0;
    for RowMesh { chain, row, triangles } in shells {
        let count = 3 * triangles.len();
        if count == 0 {
            continue;
        }
        all.push(SceneMeshRange { chain: *chain, row: *row, first, count });
        first += count;
        let corners = triangles.iter().flatten().zip(corner_normals(triangles));
        for value in corners.flat_map(|(place, normal)| [*place, normal.into()]).flatten() {
            #[expect(clippy::cast_possible_truncation, reason = "to be drawn")]
            bytes.extend((value as f32).to_le_bytes());
        }
    }
    (all, bytes)
}

/// Returns the normal of each corner: the mean normal of those faces at the corner whose direction is similar to that
/// of the corner's own face.
fn corner_normals(triangles: &[[[f64; 3]; 3]]) -> Vec<Vector3<f64>> {
    let key = |corner: &[f64; 3]| corner.map(f64::to_bits);
    let faces: Vec<_> = triangles
        .iter()
        .map(|triangle| {
            let [a, b, c] = triangle.map(Vector3::from);
            (b - a).cross(&(c - a))
        })
        .collect();
    let mut around = HashMap::<_, Vec<Vector3<f64>>>::new();
    for (triangle, face) in triangles.iter().zip(&faces) {
        for corner in triangle {
            around.entry(key(corner)).or_default().push(*face);
        }
    }
    let unit = |vector: Vector3<f64>| vector.try_normalize(0.0).unwrap_or_else(Vector3::z);
    let of = |(triangle, face): (&[[f64; 3]; 3], &Vector3<f64>)| {
        let own = unit(*face);
        triangle.map(|corner| {
            let near = around.get(&key(&corner)).into_iter().flatten();
            unit(near.filter(|other| unit(**other).dot(&own) > SMOOTH_EDGE_COSINE).sum())
        })
    };
    triangles.iter().zip(&faces).flat_map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_of_flat_faces_have_their_normal_and_round_ones_the_mean() {
        let (low, high) = ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]);
        // Two faces share an edge: at a right angle, and at 20 degrees.
        for (turn, together) in [(90.0_f64, false), (20.0, true)] {
            let (sine, cosine) = turn.to_radians().sin_cos();
            let shell = RowMesh {
                chain: 1,
                row: 2,
                triangles: vec![[low, high, [0.0, 1.0, 0.0]], [high, low, [0.0, -cosine, sine]]],
            };
            let nothing = RowMesh { chain: 0, row: 0, triangles: Vec::new() };
            let (shells, bytes) = pack_meshes(&[nothing, shell.clone(), shell]);
            let of = |first| SceneMeshRange { chain: 1, row: 2, first, count: 6 };
            assert_eq!(shells, [of(0), of(6)]);
            assert_eq!(bytes.len(), 2 * 6 * 24);
            let values: Vec<_> =
                bytes.chunks(4).map(|it| f32::from_le_bytes(it.try_into().unwrap())).collect();
            assert_eq!(values[6..9], [1.0, 0.0, 0.0], "the second corner");
            let normal = &values[9..12];
            let is_mean = (f64::from(normal[2]) - 10.0_f64.to_radians().cos()).abs() < 1e-3;
            let is_own = normal == [0.0, 0.0, 1.0];
            assert_eq!((is_mean, is_own), (together, !together), "{normal:?}");
            assert_eq!(values[15..18], [0.0, 0.0, 1.0], "the corner that is only its own");
        }
    }
}
