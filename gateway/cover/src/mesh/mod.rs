//! Reads triangle meshes from STL, COLLADA (DAE) and OBJ files, and creates those of boxes, cylinders and spheres.

mod collada;
mod misnamed;
mod obj;
mod polygon;
mod primitive;
mod simplify;
mod stl;
#[cfg(test)]
mod tests;

use std::ffi::OsStr;
use std::fs;
use std::io;
use std::path::Path;

use nalgebra::{Matrix3, Point3, Vector3};
use protocol::xml::{UnexpectedFileKind, XmlFault, detect_unexpected_file};
use thiserror::Error;

pub use simplify::simplify;

/// The maximum number of triangles of one mesh.
pub const MAX_TRIANGLES: usize = 1_000_000;

/// The maximum size of a mesh file in bytes: that of an ASCII STL with [`MAX_TRIANGLES`].
const MAX_BYTES: u64 = 300_000_000;

/// The three corners of a triangle, in m. They should be counterclockwise as seen from outside, but this crate does not
/// rely on that.
pub type Triangle = [Point3<f64>; 3];

/// The treatment of the up axis of a COLLADA file. STL and OBJ files have no such axis and are always read unchanged.
#[derive(Clone, Copy, Debug, Default, Eq, Hash, PartialEq)]
pub enum UpAxis {
    /// Ignores the `up_axis` of the file, as RViz and Pinocchio do. Most URDF files are made for this.
    #[default]
    Ignore,
    /// Rotates the mesh so that the `up_axis` of the file becomes z, as the COLLADA specification requires. It is
    /// `Y_UP` if the file has none.
    Follow,
}

/// A set of one or more triangles in m, in no particular order. All coordinates are finite.
#[derive(Clone, Debug, PartialEq)]
pub struct Mesh {
    triangles: Vec<Triangle>,
}

/// The reason why a mesh cannot be read or created.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum MeshError {
    /// The file cannot be read.
    #[error("mesh {file}: {source}; check the path")]
    Read {
        /// The file.
        file: String,
        /// The system error.
        source: io::Error,
    },
    /// The extension of the file is unknown.
    #[error(
        "mesh {file}: the extension {extension:?} is not stl, dae or obj; {}",
        if extension.is_empty() { "add the extension of its format" } else { "convert the file" }
    )]
    Extension {
        /// The file.
        file: String,
        /// The text after the last dot.
        extension: String,
    },
    /// The contents of the file do not follow the format of its extension.
    #[error("mesh {file}: {reason}; export it again")]
    Syntax {
        /// The file.
        file: String,
        /// The message of the parser, in one line.
        reason: String,
    },
    /// The XML cannot be read.
    #[error("mesh {file}: {fault}")]
    Xml {
        /// The file.
        file: String,
        /// The error in the XML, with advice to the user.
        fault: XmlFault,
    },
    /// The file has another format than its extension says, or is a placeholder such as a Git LFS pointer.
    #[error("mesh {file}{}: this is {what}: {hint}", line.map_or_else(String::new, |line| format!(":{line}")))]
    Foreign {
        /// The file.
        file: String,
        /// The line number from 1, if it is known.
        line: Option<usize>,
        /// A description of the file that completes the sentence "it is ...".
        what: String,
        /// Advice to the user.
        hint: &'static str,
    },
    /// A part of the file is missing.
    #[error("mesh {file}: {reason}: it is cut off or damaged; copy or download it again")]
    Damaged {
        /// The file.
        file: String,
        /// A description of what is missing, in one line.
        reason: String,
    },
    /// The file has no triangles.
    #[error("mesh {file}: it has no triangles; export it again, with its surface")]
    Empty {
        /// The file.
        file: String,
    },
    /// A coordinate is infinite or NaN.
    #[error(
        "mesh {file}: triangle {triangle} has the coordinate {value}, which is not finite; export it again"
    )]
    NotFinite {
        /// The file.
        file: String,
        /// The index of the triangle.
        triangle: usize,
        /// The coordinate.
        value: f64,
    },
    /// The file has more bytes, triangles or other items than allowed.
    #[error("mesh {file}: {count} {what} are too many (at most {most}); decimate the mesh")]
    TooLarge {
        /// The file.
        file: String,
        /// The number of items. Triangles may be counted only up to where reading stopped.
        count: u64,
        /// The kind of items.
        what: &'static str,
        /// The maximum number of items.
        most: u64,
    },
    /// A dimension of a box, cylinder or sphere is not above zero, or is not finite.
    #[error("{shape} with {what} {value} m: the size must be above 0 and finite")]
    Size {
        /// The kind of shape.
        shape: &'static str,
        /// The name of the dimension.
        what: &'static str,
        /// The value of the dimension, in m.
        value: f64,
    },
}

impl Mesh {
    /// Creates a mesh from triangles in m. `name` is used in errors.
    ///
    /// # Errors
    /// Returns [`MeshError`] if there are no triangles or more than [`MAX_TRIANGLES`], or if a coordinate is not
    /// finite.
    pub fn new(name: &str, triangles: Vec<Triangle>) -> Result<Self, MeshError> {
        let file = || name.to_owned();
        if triangles.is_empty() {
            return Err(MeshError::Empty { file: file() });
        }
        if triangles.len() > MAX_TRIANGLES {
            return Err(too_many(name, triangles.len()));
        }
        for (triangle, corners) in triangles.iter().enumerate() {
            let mut coordinates = corners.iter().flat_map(|corner| corner.iter());
            if let Some(&value) = coordinates.find(|value| !value.is_finite()) {
                return Err(MeshError::NotFinite { file: file(), triangle, value });
            }
        }
        Ok(Self { triangles })
    }

    /// Reads a mesh from a file. The extension determines the format: `.stl` (binary or ASCII), `.dae` or `.obj`, in
    /// lower or upper case. STL and OBJ files do not state a unit; their numbers are taken as m.
    ///
    /// # Errors
    /// Returns [`MeshError`] if the file cannot be read, has another format, or is not a mesh.
    pub fn load(path: &Path, up: UpAxis) -> Result<Self, MeshError> {
        let name = path.display().to_string();
        let read = |source| MeshError::Read { file: name.clone(), source };
        let about = fs::metadata(path).map_err(read)?;
        if !about.is_file() {
            return Err(read(io::Error::other("it is not a file")));
        }
        if about.len() > MAX_BYTES {
            return Err(MeshError::TooLarge {
                file: name,
                count: about.len(),
                what: "bytes",
                most: MAX_BYTES,
            });
        }
        Self::parse(&name, &fs::read(path).map_err(read)?, up)
    }

    /// Parses the contents of a file like [`Mesh::load`]. `name` is the name of the file.
    ///
    /// # Errors
    /// Returns [`MeshError`] as [`Mesh::load`] does.
    pub fn parse(name: &str, bytes: &[u8], up: UpAxis) -> Result<Self, MeshError> {
        if let Some(UnexpectedFileKind { line, what, hint }) = detect_unexpected_file(bytes) {
            return Err(MeshError::Foreign { file: name.to_owned(), line, what: what.to_owned(), hint });
        }
        let extension = Path::new(name).extension().and_then(OsStr::to_str).unwrap_or_default();
        let known = extension.to_ascii_lowercase();
        let triangles = match known.as_str() {
            "stl" => stl::triangles(name, bytes),
            "obj" => obj::triangles(name, bytes),
            "dae" => collada::triangles(name, bytes, up),
            _ => return Err(MeshError::Extension { file: name.to_owned(), extension: extension.to_owned() }),
        };
        triangles.and_then(|all| Self::new(name, all)).map_err(|error| {
            let is_of_content = matches!(
                error,
                MeshError::Syntax { .. } | MeshError::Damaged { .. } | MeshError::Empty { .. }
            );
            let other = if is_of_content { misnamed::actual_format_error(name, &known, bytes) } else { None };
            other.unwrap_or(error)
        })
    }

    /// Returns the triangles, in m.
    #[must_use]
    pub fn triangles(&self) -> &[Triangle] {
        &self.triangles
    }
}

fn too_many(file: &str, count: usize) -> MeshError {
    MeshError::TooLarge {
        file: file.to_owned(),
        count: u64::try_from(count).unwrap_or(u64::MAX),
        what: "triangles",
        most: u64::try_from(MAX_TRIANGLES).unwrap_or(u64::MAX),
    }
}

fn damaged(file: &str, reason: &str) -> MeshError {
    MeshError::Damaged { file: file.to_owned(), reason: reason.to_owned() }
}

fn syntax(file: &str, reason: &str) -> MeshError {
    MeshError::Syntax { file: file.to_owned(), reason: reason.lines().collect::<Vec<_>>().join(" ") }
}

/// An affine map: a linear map followed by a translation.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Affine {
    pub(crate) linear: Matrix3<f64>,
    pub(crate) shift: Vector3<f64>,
}

impl Affine {
    pub(crate) fn identity() -> Self {
        Self { linear: Matrix3::identity(), shift: Vector3::zeros() }
    }

    /// Returns the map that applies `inner` first and then this map.
    pub(crate) fn after(&self, inner: &Self) -> Self {
        Self { linear: self.linear * inner.linear, shift: self.linear * inner.shift + self.shift }
    }

    /// Applies the map to a triangle. If the map mirrors, two corners are exchanged, so that the winding stays the
    /// same.
    pub(crate) fn map(&self, triangle: &Triangle) -> Triangle {
        let [a, b, c] = triangle.map(|corner| Point3::from(self.linear * corner.coords + self.shift));
        if self.linear.determinant() < 0.0 { [a, c, b] } else { [a, b, c] }
    }
}
