//! Reads the `mesh` element of a geometry: its vertices, and the triangles of its primitives.

use nalgebra::Point3;
use roxmltree::Node;

use super::{ElementIds, Named as _, child, children, floats, numbers};
use crate::mesh::polygon::{Triangulation, add_fan};
use crate::mesh::{MAX_TRIANGLES, MeshError, Triangle, syntax, too_many};

/// The maximum number of indices that a file may give for a corner.
const MAX_INDICES_PER_CORNER: usize = 64;

/// A `mesh` element, with the elements that it refers to.
#[derive(Debug)]
pub(super) struct MeshElement<'a, 'i, 'n> {
    /// The name of the file, which is used in errors.
    name: &'a str,
    mesh: Node<'a, 'i>,
    /// The elements within the mesh that have ids.
    own: ElementIds<'a, 'i>,
    /// The elements of the whole file that have ids.
    all: &'n ElementIds<'a, 'i>,
}

/// The form in which a primitive lists its corners: as indices into a list of points.
struct CornerFormat {
    kind: &'static str,
    /// The position of the vertex index among the indices of a corner.
    offset: usize,
    /// The number of indices per corner.
    stride: usize,
    points: Vec<Point3<f64>>,
}

impl<'a, 'i, 'n> MeshElement<'a, 'i, 'n> {
    pub(super) fn new(name: &'a str, mesh: Node<'a, 'i>, all: &'n ElementIds<'a, 'i>) -> Self {
        Self { name, mesh, own: ElementIds::from_nodes(name, mesh.descendants()), all }
    }

    fn error(&self, reason: &str) -> MeshError {
        syntax(self.name, reason)
    }

    /// Returns the triangles of the mesh, in the unit and axes of the file.
    pub(super) fn triangles(&self) -> Result<Vec<Triangle>, MeshError> {
        let mut filled = Triangulation::default();
        for element in self.mesh.children().filter(Node::is_element) {
            let kinds = ["triangles", "polylist", "polygons", "tristrips", "trifans"];
            let Some(kind) = kinds.into_iter().find(|kind| element.has_tag_name_of(kind)) else { continue };
            let corners = self.read_corner_format(element, kind)?;
            match kind {
                "triangles" => self.read_triangles(element, &corners, &mut filled)?,
                "polylist" => self.read_polylist(element, &corners, &mut filled)?,
                "polygons" => self.read_polygons(element, &corners, &mut filled)?,
                _ => {
                    for indices in children(element, "p") {
                        let points = self.corner_points(indices, &corners)?;
                        if kind == "tristrips" {
                            add_strip(&points, &mut filled.triangles);
                        } else {
                            add_fan(&points, &mut filled.triangles);
                        }
                    }
                }
            }
            if filled.triangles.len() > MAX_TRIANGLES {
                return Err(too_many(self.name, filled.triangles.len()));
            }
        }
        filled.finish().map_err(|why| self.error(&why))
    }

    /// Reads a primitive of triangles, each with three corners.
    fn read_triangles(
        &self,
        element: Node<'a, 'i>,
        corners: &CornerFormat,
        Triangulation { triangles, .. }: &mut Triangulation,
    ) -> Result<(), MeshError> {
        let before = triangles.len();
        for indices in children(element, "p") {
            let points = self.corner_points(indices, corners)?;
            let (all, rest) = points.as_chunks();
            if !rest.is_empty() {
                return Err(self.error(&format!(
                    "triangles have {} corners, which is not a multiple of 3",
                    points.len()
                )));
            }
            triangles.extend_from_slice(all);
        }
        self.check_count(element, "triangles", triangles.len() - before)
    }

    /// Reads a primitive of polygons whose corners are in one list.
    fn read_polylist(
        &self,
        element: Node<'a, 'i>,
        corners: &CornerFormat,
        filled: &mut Triangulation,
    ) -> Result<(), MeshError> {
        let sizes = child(element, "vcount").map(|node| numbers(self.name, node, str::parse::<usize>));
        let sizes = sizes.transpose()?.unwrap_or_default();
        let points = child(element, "p").map(|node| self.corner_points(node, corners)).transpose()?;
        let points = points.unwrap_or_default();
        let announced = sizes.iter().fold(0_usize, |sum, size| sum.saturating_add(*size));
        if announced != points.len() {
            let got = points.len();
            return Err(
                self.error(&format!("a polylist has {got} corners, but its vcount announces {announced}"))
            );
        }
        self.check_count(element, "polygons", sizes.len())?;
        let mut rest = points.as_slice();
        for size in sizes {
            let Some((outline, after)) = rest.split_at_checked(size) else { break };
            filled.add_polygon(outline, &[]);
            rest = after;
        }
        Ok(())
    }

    /// Reads a primitive of polygons with a list of corners each. Polygons may have holes.
    fn read_polygons(
        &self,
        element: Node<'a, 'i>,
        corners: &CornerFormat,
        filled: &mut Triangulation,
    ) -> Result<(), MeshError> {
        let mut count = 0;
        for polygon in element.children().filter(Node::is_element) {
            let (outline, holes) = match polygon.tag_name().name() {
                "p" => (Some(polygon), Vec::new()),
                "ph" => {
                    let holes = children(polygon, "h").map(|hole| self.corner_points(hole, corners));
                    (child(polygon, "p"), holes.collect::<Result<_, _>>()?)
                }
                _ => continue,
            };
            let outline = outline.ok_or_else(|| self.error("a polygon with holes has no outline"))?;
            filled.add_polygon(&self.corner_points(outline, corners)?, &holes);
            count += 1;
        }
        self.check_count(element, "polygons", count)
    }

    /// Checks that an element has as many primitives as it states, if it states a number.
    fn check_count(&self, element: Node<'_, '_>, what: &str, got: usize) -> Result<(), MeshError> {
        match element.attribute("count").map(|count| count.trim().parse::<usize>()) {
            Some(Ok(count)) if count != got => {
                Err(self.error(&format!("the file has {got} {what}, but announces {count}")))
            }
            _ => Ok(()),
        }
    }

    /// Returns the points of the corners in a list of indices.
    fn corner_points(
        &self,
        indices: Node<'_, '_>,
        corners: &CornerFormat,
    ) -> Result<Vec<Point3<f64>>, MeshError> {
        let CornerFormat { kind, offset, stride, points } = corners;
        let indices = numbers(self.name, indices, str::parse::<usize>)?;
        let groups = indices.chunks_exact(*stride);
        if !groups.remainder().is_empty() {
            let got = indices.len();
            return Err(self.error(&format!(
                "{got} indices of {kind} are not a multiple of {stride}, the number per corner"
            )));
        }
        let point = |group: &[usize]| {
            let index = group.get(*offset).copied().unwrap_or(usize::MAX);
            points.get(index).copied().ok_or_else(|| {
                self.error(&format!(
                    "vertex {index} of {kind} does not exist; the geometry has {} vertices",
                    points.len()
                ))
            })
        };
        groups.map(point).collect()
    }

    /// Returns the element of this kind to which an input of the mesh refers. It is an element within the mesh, or else
    /// the only one with this id in the file.
    fn referenced_element(&self, kind: &'static str, input: Node<'_, '_>) -> Result<Node<'a, 'i>, MeshError> {
        let source = input.attribute("source").unwrap_or_default();
        let own = self.own.find(kind, source)?;
        let found = own.map_or_else(|| self.all.find(kind, source), |own| Ok(Some(own)))?;
        found.ok_or_else(|| self.error(&format!("{kind} {source:?} does not exist")))
    }

    /// Reads the inputs of a primitive, which state what the indices of its corners refer to.
    fn read_corner_format(
        &self,
        element: Node<'a, 'i>,
        kind: &'static str,
    ) -> Result<CornerFormat, MeshError> {
        let mut stride = 0;
        let mut vertex = None;
        for input in children(element, "input") {
            let text = input.attribute("offset").unwrap_or("0");
            let offset = text.trim().parse().ok().filter(|offset| *offset < MAX_INDICES_PER_CORNER);
            let offset = offset.ok_or_else(|| {
                self.error(&format!(
                    "an input has the offset {text:?}, which must be 0 to {}",
                    MAX_INDICES_PER_CORNER - 1
                ))
            })?;
            stride = stride.max(offset + 1);
            if input.attribute("semantic") == Some("VERTEX") {
                vertex = Some((offset, self.referenced_element("vertices", input)?));
            }
        }
        let (offset, vertices) = vertex.ok_or_else(|| self.error("a geometry has no vertices"))?;
        let position = |input: &Node<'_, '_>| input.attribute("semantic") == Some("POSITION");
        let position = children(vertices, "input").find(position);
        let position = position.ok_or_else(|| self.error("vertices have no position"))?;
        let points = self.source_points(self.referenced_element("source", position)?)?;
        Ok(CornerFormat { kind, offset, stride, points })
    }

    /// Returns the points that a source lists.
    fn source_points(&self, source: Node<'a, 'i>) -> Result<Vec<Point3<f64>>, MeshError> {
        let accessor = child(source, "technique_common").and_then(|common| child(common, "accessor"));
        let number = |name: &str| accessor?.attribute(name)?.trim().parse::<usize>().ok();
        let within = ElementIds::from_nodes(self.name, source.descendants());
        let named = accessor.filter(|accessor| accessor.has_attribute("source")).map(|accessor| {
            let reference = accessor.attribute("source").unwrap_or_default();
            let near = within.find("float_array", reference)?;
            near.map_or_else(|| self.referenced_element("float_array", accessor), Ok)
        });
        let array = named.or_else(|| child(source, "float_array").map(Ok));
        let array = array.ok_or_else(|| self.error("a source has no numbers"))??;
        let values = floats(self.name, array)?;
        self.check_count(array, "numbers in a float_array", values.len())?;
        let values = values.get(number("offset").unwrap_or(0)..).unwrap_or_default();
        let stride = number("stride").unwrap_or(3);
        if stride < 3 {
            return Err(
                self.error(&format!("a source of positions has {stride} numbers per position, not 3"))
            );
        }
        let groups = values.chunks(stride);
        let points = groups.filter_map(|group| group.first_chunk().map(|&[x, y, z]| Point3::new(x, y, z)));
        Ok(points.collect())
    }
}

/// Adds the triangles of a strip. Every other triangle is reversed, so that all have the same winding.
fn add_strip(corners: &[Point3<f64>], triangles: &mut Vec<Triangle>) {
    triangles.extend(corners.windows(3).enumerate().filter_map(|(at, corners)| {
        let &[a, b, c] = corners else { return None };
        Some(if at % 2 == 0 { [a, b, c] } else { [b, a, c] })
    }));
}
