//! COLLADA files: unit, axis, the scene's nodes with their transforms, and what geometry they place.
//!
//! Triangles, polygons, strips and fans are read; a polygon is cut into a fan. Lines, materials, skins and
//! animations are ignored.

use std::collections::HashMap;

use nalgebra::{Matrix3, Point3, Rotation3, Unit, Vector3};
use roxmltree::{Document, Node};

use super::{Affine, MAX_TRIANGLES, MeshError, Triangle, UpAxis, syntax, too_many};

/// How deep nodes may be nested. A circle of `instance_node` ends here.
const MAX_DEPTH: usize = 64;

/// How many nodes may be visited, so that nodes which are placed again and again come to an end.
const MAX_NODES: usize = 100_000;

/// The triangles of a file's scene, in m.
pub(super) fn triangles(name: &str, bytes: &[u8], up: UpAxis) -> Result<Vec<Triangle>, MeshError> {
    let text = core::str::from_utf8(bytes).map_err(|error| syntax(name, &error.to_string()))?;
    let document = Document::parse(text).map_err(|error| syntax(name, &error.to_string()))?;
    let root = document.root_element();
    if root.tag_name().name() != "COLLADA" {
        return Err(syntax(name, &format!("its first element is {}, not COLLADA", root.tag_name().name())));
    }
    let named = root.descendants().filter_map(|node| Some((node.attribute("id")?, node))).collect();
    let mut reader = Reader { name, named, geometry: HashMap::new(), visited: 0, triangles: Vec::new() };
    let outer = outer(name, root, up)?;
    let scene = child(root, "scene").and_then(|scene| child(scene, "instance_visual_scene"));
    let scene = scene.and_then(|instance| reader.referred(instance));
    let scene = scene.or_else(|| child(child(root, "library_visual_scenes")?, "visual_scene"));
    match scene {
        Some(scene) => {
            for node in children(scene, "node") {
                reader.node(node, &outer, 0)?;
            }
        }
        None => {
            // A file of geometry alone.
            for geometry in root.descendants().filter(|node| node.has_tag_name_of("geometry")) {
                reader.place(geometry, &outer)?;
            }
        }
    }
    Ok(reader.triangles)
}

/// Names without their namespace, which some files have and some have not.
trait Named {
    fn has_tag_name_of(&self, name: &str) -> bool;
}

impl Named for Node<'_, '_> {
    fn has_tag_name_of(&self, name: &str) -> bool {
        self.is_element() && self.tag_name().name() == name
    }
}

fn children<'a, 'i>(node: Node<'a, 'i>, name: &'static str) -> impl Iterator<Item = Node<'a, 'i>> {
    node.children().filter(move |child| child.has_tag_name_of(name))
}

fn child<'a, 'i>(node: Node<'a, 'i>, name: &'static str) -> Option<Node<'a, 'i>> {
    children(node, name).next()
}

/// The file's unit and axis.
fn outer(name: &str, root: Node<'_, '_>, up: UpAxis) -> Result<Affine, MeshError> {
    let asset = child(root, "asset");
    let meter = asset.and_then(|asset| child(asset, "unit")?.attribute("meter"));
    let scale = match meter {
        None => 1.0,
        Some(meter) => {
            let parsed = meter.trim().parse::<f64>().ok().filter(|value| value.is_finite() && *value > 0.0);
            parsed.ok_or_else(|| syntax(name, &format!("its unit is {meter:?} m, which is not above 0")))?
        }
    };
    let axis = asset.and_then(|asset| child(asset, "up_axis")?.text()).map_or("Y_UP", str::trim);
    let turn = match (up, axis) {
        (UpAxis::Ignore, _) | (UpAxis::Follow, "Z_UP") => Matrix3::identity(),
        // x stays; y to z.
        (UpAxis::Follow, "Y_UP") => Matrix3::new(1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0),
        // x to z, y to -x, z to -y: X_UP has y to the left, and z towards the viewer.
        (UpAxis::Follow, "X_UP") => Matrix3::new(0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0),
        (UpAxis::Follow, _) => {
            return Err(syntax(name, &format!("its up_axis is {axis:?}, none of X_UP, Y_UP and Z_UP")));
        }
    };
    Ok(Affine { linear: turn * scale, shift: Vector3::zeros() })
}

#[derive(Debug)]
struct Reader<'a, 'i> {
    name: &'a str,
    /// Elements by id.
    named: HashMap<&'a str, Node<'a, 'i>>,
    /// What was read of a geometry.
    geometry: HashMap<roxmltree::NodeId, Vec<Triangle>>,
    /// Nodes visited.
    visited: usize,
    triangles: Vec<Triangle>,
}

impl<'a, 'i> Reader<'a, 'i> {
    fn error(&self, reason: &str) -> MeshError {
        syntax(self.name, reason)
    }

    /// What an element's `url` refers to, in this file.
    fn referred(&self, node: Node<'_, '_>) -> Option<Node<'a, 'i>> {
        self.named.get(node.attribute("url")?.strip_prefix('#')?).copied()
    }

    fn node(&mut self, node: Node<'a, 'i>, outer: &Affine, depth: usize) -> Result<(), MeshError> {
        self.visited += 1;
        if depth > MAX_DEPTH || self.visited > MAX_NODES {
            return Err(self.error(&format!(
                "its nodes are nested more than {MAX_DEPTH} deep, or more than {MAX_NODES}"
            )));
        }
        let mut here = *outer;
        for element in node.children().filter(Node::is_element) {
            if let Some(step) = self.transform(element)? {
                here = here.after(&step);
            }
        }
        for element in node.children().filter(Node::is_element) {
            match element.tag_name().name() {
                "node" => self.node(element, &here, depth + 1)?,
                "instance_node" => {
                    if let Some(target) = self.referred(element) {
                        self.node(target, &here, depth + 1)?;
                    }
                }
                "instance_geometry" => {
                    let url = element.attribute("url").unwrap_or_default();
                    let geometry = self.referred(element);
                    let geometry =
                        geometry.ok_or_else(|| self.error(&format!("geometry {url:?} is not there")))?;
                    self.place(geometry, &here)?;
                }
                _ => (),
            }
        }
        Ok(())
    }

    /// A node's element as a transform, if it is one.
    fn transform(&self, element: Node<'_, '_>) -> Result<Option<Affine>, MeshError> {
        let kind = element.tag_name().name();
        if !matches!(kind, "matrix" | "translate" | "rotate" | "scale") {
            return Ok(None);
        }
        let numbers = self.floats(element)?;
        let identity = Affine::identity();
        Ok(Some(match (kind, numbers.as_slice()) {
            ("matrix", &[a, b, c, x, d, e, f, y, g, h, i, z, _, _, _, _]) => {
                Affine { linear: Matrix3::new(a, b, c, d, e, f, g, h, i), shift: Vector3::new(x, y, z) }
            }
            ("translate", &[x, y, z]) => Affine { shift: Vector3::new(x, y, z), ..identity },
            ("scale", &[x, y, z]) => {
                Affine { linear: Matrix3::from_diagonal(&Vector3::new(x, y, z)), ..identity }
            }
            ("rotate", &[x, y, z, degrees]) => {
                let axis = Unit::try_new(Vector3::new(x, y, z), 0.0);
                let turn = axis.map(|axis| Rotation3::from_axis_angle(&axis, degrees.to_radians()));
                turn.map_or(identity, |turn| Affine { linear: turn.into_inner(), ..identity })
            }
            _ => return Err(self.error(&format!("a {kind} has {} numbers", numbers.len()))),
        }))
    }

    fn floats(&self, element: Node<'_, '_>) -> Result<Vec<f64>, MeshError> {
        self.numbers(element, str::parse::<f64>)
    }

    fn numbers<T, E>(
        &self,
        element: Node<'_, '_>,
        parse: impl Fn(&str) -> Result<T, E>,
    ) -> Result<Vec<T>, MeshError> {
        let words = element.text().unwrap_or_default().split_ascii_whitespace();
        let number = |word| {
            parse(word).map_err(|_| {
                let kind = element.tag_name().name();
                self.error(&format!("{word:?} in element {kind} is not a number"))
            })
        };
        words.map(number).collect()
    }

    fn place(&mut self, geometry: Node<'a, 'i>, here: &Affine) -> Result<(), MeshError> {
        if !self.geometry.contains_key(&geometry.id()) {
            let read = self.read(geometry)?;
            self.geometry.insert(geometry.id(), read);
        }
        let triangles = self.geometry.get(&geometry.id()).map_or(&[][..], Vec::as_slice);
        let count = self.triangles.len() + triangles.len();
        if count > MAX_TRIANGLES {
            return Err(too_many(self.name, count));
        }
        self.triangles.extend(triangles.iter().map(|triangle| here.map(triangle)));
        Ok(())
    }

    /// The triangles of a geometry, as the file has them.
    fn read(&self, geometry: Node<'a, 'i>) -> Result<Vec<Triangle>, MeshError> {
        let mut triangles = Vec::new();
        let Some(mesh) = child(geometry, "mesh") else { return Ok(triangles) };
        for element in mesh.children().filter(Node::is_element) {
            let kind = element.tag_name().name();
            if !matches!(kind, "triangles" | "polylist" | "polygons" | "tristrips" | "trifans") {
                continue;
            }
            let (offset, stride, points) = self.points(element)?;
            let sizes = child(element, "vcount").map(|node| self.numbers(node, str::parse::<usize>));
            let sizes = sizes.transpose()?;
            for indices in children(element, "p") {
                let indices = self.numbers(indices, str::parse::<usize>)?;
                let corner = |vertex: &[usize]| {
                    let index = vertex.get(offset).copied();
                    let point = index.and_then(|index| points.get(index).copied());
                    point.ok_or_else(|| self.error(&format!("vertex {index:?} of a {kind} is not there")))
                };
                let corners: Vec<_> = indices.chunks_exact(stride).map(corner).collect::<Result<_, _>>()?;
                match (kind, &sizes) {
                    ("triangles", _) => triangles.extend(corners.chunks_exact(3).filter_map(three)),
                    ("tristrips", _) => strip(&corners, &mut triangles),
                    ("polylist", Some(sizes)) => {
                        let mut rest = corners.as_slice();
                        for &size in sizes {
                            let (polygon, after) = rest.split_at_checked(size).ok_or_else(|| {
                                self.error("a polylist has fewer vertices than its vcount says")
                            })?;
                            fan(polygon, &mut triangles);
                            rest = after;
                        }
                    }
                    _ => fan(&corners, &mut triangles),
                }
                if triangles.len() > MAX_TRIANGLES {
                    return Err(too_many(self.name, triangles.len()));
                }
            }
        }
        Ok(triangles)
    }

    /// Where an element's indices have the vertex, how many of them are one corner, and the vertices' points.
    fn points(&self, element: Node<'a, 'i>) -> Result<(usize, usize, Vec<Point3<f64>>), MeshError> {
        let offset = |input: Node<'_, '_>| {
            let offset = input.attribute("offset").map_or(Some(0), |offset| offset.trim().parse().ok());
            offset
                .filter(|offset| *offset < 64_usize)
                .ok_or_else(|| self.error("an input has a wrong offset"))
        };
        let source = |input: Node<'_, '_>| {
            let id = input.attribute("source").and_then(|source| source.strip_prefix('#'));
            let found = id.and_then(|id| self.named.get(id).copied());
            found.ok_or_else(|| self.error(&format!("source {:?} is not there", id.unwrap_or_default())))
        };
        let mut stride = 0;
        let mut vertex = None;
        for input in children(element, "input") {
            let offset = offset(input)?;
            stride = stride.max(offset + 1);
            if input.attribute("semantic") == Some("VERTEX") {
                vertex = Some((offset, source(input)?));
            }
        }
        let (offset, vertices) = vertex.ok_or_else(|| self.error("a geometry has no vertices"))?;
        let position = |input: &Node<'_, '_>| input.attribute("semantic") == Some("POSITION");
        let position = children(vertices, "input").find(position);
        let position = source(position.ok_or_else(|| self.error("vertices have no position"))?)?;
        let array = child(position, "float_array").ok_or_else(|| self.error("a source has no numbers"))?;
        let accessor = child(position, "technique_common").and_then(|common| child(common, "accessor"));
        let number = |name: &str| accessor?.attribute(name)?.trim().parse::<usize>().ok();
        let step = number("stride").unwrap_or(3).max(3);
        let numbers = self.floats(array)?;
        let points = numbers.get(number("offset").unwrap_or(0)..).unwrap_or_default().chunks_exact(step);
        let points = points.filter_map(|point| match *point {
            [x, y, z, ..] => Some(Point3::new(x, y, z)),
            _ => None,
        });
        Ok((offset, stride, points.collect()))
    }
}

fn three(corners: &[Point3<f64>]) -> Option<Triangle> {
    corners.try_into().ok()
}

/// The triangles between the first corner and each edge.
fn fan(corners: &[Point3<f64>], triangles: &mut Vec<Triangle>) {
    if let [first, rest @ ..] = corners {
        triangles.extend(rest.windows(2).filter_map(|edge| match *edge {
            [a, b] => Some([*first, a, b]),
            _ => None,
        }));
    }
}

/// The triangles of a strip, of which every other one is wound the other way.
fn strip(corners: &[Point3<f64>], triangles: &mut Vec<Triangle>) {
    triangles.extend(corners.windows(3).enumerate().filter_map(|(at, corners)| {
        let [a, b, c] = three(corners)?;
        Some(if at % 2 == 0 { [a, b, c] } else { [b, a, c] })
    }));
}
