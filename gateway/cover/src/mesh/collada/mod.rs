//! Reads COLLADA files: the unit, the up axis, the nodes of the scene with their transforms, and the geometries at the
//! nodes.
//!
//! Triangles, polygons with and without holes, strips and fans are read; lines, materials and animations are ignored. A
//! reference must name exactly one element of its kind: if several elements of the kind have the id, the reference is
//! an error. Sources and vertices are first searched within the same geometry, because many exporters give them the
//! same ids in all geometries.

mod geometry;
#[cfg(test)]
mod tests;

use std::collections::HashMap;

use nalgebra::{Matrix3, Rotation3, Unit, Vector3};
use protocol::usage::printable;
use protocol::xml::XmlFault;
use roxmltree::{Document, Node};

use super::{Affine, MAX_TRIANGLES, MeshError, Triangle, UpAxis, syntax, too_many};
use geometry::MeshElement;

/// The maximum nesting depth of nodes, at which a cycle of `instance_node` elements is detected.
const MAX_DEPTH: usize = 64;

/// The maximum number of nodes to be visited. The limit is needed because a node may be placed repeatedly.
const MAX_NODES: usize = 100_000;

/// Returns the triangles of the scene in a file, in m.
pub(super) fn triangles(name: &str, bytes: &[u8], up: UpAxis) -> Result<Vec<Triangle>, MeshError> {
    let wrong = |fault: XmlFault| MeshError::Xml { file: name.to_owned(), fault };
    let text = protocol::xml::decode(bytes).map_err(wrong)?;
    let prepared = protocol::xml::prepare(&text).map_err(wrong)?;
    let document = Document::parse(&prepared.text).map_err(|error| {
        let (all, place) = (error.to_string(), format!(" at {}", error.pos()));
        let row = usize::try_from(error.pos().row).unwrap_or_default() + prepared.lines_before;
        syntax(name, &format!("line {row}: {}", printable(all.strip_suffix(place.as_str()).unwrap_or(&all))))
    })?;
    let root = document.root_element();
    if root.tag_name().name() != "COLLADA" {
        return Err(syntax(name, &format!("its root element is {}, not COLLADA", root.tag_name().name())));
    }
    let names = ElementIds::from_nodes(name, root.descendants());
    let mut reader = SceneReader { name, names, geometry: HashMap::new(), visited: 0, triangles: Vec::new() };
    let outer = asset_transform(name, root, up)?;
    let scene = child(root, "scene").and_then(|scene| child(scene, "instance_visual_scene"));
    let scene = scene.map(|instance| reader.referred(instance, "visual_scene")).transpose()?;
    let scene = scene.or_else(|| child(child(root, "library_visual_scenes")?, "visual_scene"));
    match scene {
        Some(scene) => {
            for node in children(scene, "node") {
                reader.node(node, &outer, 0)?;
            }
        }
        None => {
            // The file has no scene, only geometries. All of them are read.
            for geometry in root.descendants().filter(|node| node.has_tag_name_of("geometry")) {
                reader.place(geometry, &outer)?;
            }
        }
    }
    Ok(reader.triangles)
}

/// Comparison of element names without the namespace, which only some files have.
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

/// Returns the transform from the unit and axes of the file to m and z up.
fn asset_transform(name: &str, root: Node<'_, '_>, up: UpAxis) -> Result<Affine, MeshError> {
    let asset = child(root, "asset");
    let meter = asset.and_then(|asset| child(asset, "unit")?.attribute("meter"));
    let scale = match meter {
        None => 1.0,
        Some(meter) => {
            let parsed = meter.trim().parse::<f64>().ok().filter(|value| value.is_finite() && *value > 0.0);
            parsed.ok_or_else(|| syntax(name, &format!("its unit is {meter:?} m, which must be above 0")))?
        }
    };
    let axis = asset.and_then(|asset| child(asset, "up_axis")?.text()).map_or("Y_UP", str::trim);
    let turn = match (up, axis) {
        (UpAxis::Ignore, _) | (UpAxis::Follow, "Z_UP") => Matrix3::identity(),
        // x stays, y becomes z, and z becomes -y.
        (UpAxis::Follow, "Y_UP") => Matrix3::new(1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0),
        // x becomes z, y becomes -x, and z becomes -y: X_UP has y to the left, and z towards the viewer.
        (UpAxis::Follow, "X_UP") => Matrix3::new(0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0),
        (UpAxis::Follow, _) => {
            return Err(syntax(name, &format!("its up_axis is {axis:?}, not X_UP, Y_UP or Z_UP")));
        }
    };
    Ok(Affine { linear: turn * scale, shift: Vector3::zeros() })
}

/// The elements that have ids, by kind and id.
#[derive(Debug)]
struct ElementIds<'a, 'i> {
    /// The name of the file, which is used in errors.
    file: &'a str,
    elements: HashMap<(&'a str, &'a str), Vec<Node<'a, 'i>>>,
}

impl<'a, 'i> ElementIds<'a, 'i> {
    fn from_nodes(file: &'a str, nodes: impl Iterator<Item = Node<'a, 'i>>) -> Self {
        let mut elements = HashMap::<_, Vec<_>>::new();
        for node in nodes {
            if let Some(id) = node.attribute("id") {
                elements.entry((node.tag_name().name(), id)).or_default().push(node);
            }
        }
        Self { file, elements }
    }

    /// Returns the element of this kind with the id in `reference`; `None` if there is none.
    fn find(&self, kind: &str, reference: &str) -> Result<Option<Node<'a, 'i>>, MeshError> {
        let wrong = |reason: String| Err(syntax(self.file, &reason));
        let Some(id) = reference.strip_prefix('#') else {
            return wrong(format!("its {kind} {reference:?} is in another file; write all into one file"));
        };
        match self.elements.get(&(kind, id)).map_or(&[][..], Vec::as_slice) {
            [] => Ok(None),
            [one] => Ok(Some(*one)),
            several => wrong(format!("the id {id:?} belongs to {} {kind} elements", several.len())),
        }
    }
}

#[derive(Debug)]
struct SceneReader<'a, 'i> {
    /// The name of the file, which is used in errors.
    name: &'a str,
    names: ElementIds<'a, 'i>,
    /// The triangles of each geometry that was already read.
    geometry: HashMap<roxmltree::NodeId, Vec<Triangle>>,
    /// The number of nodes visited so far.
    visited: usize,
    triangles: Vec<Triangle>,
}

impl<'a, 'i> SceneReader<'a, 'i> {
    fn error(&self, reason: &str) -> MeshError {
        syntax(self.name, reason)
    }

    /// Returns the element of this kind to which the `url` of an element refers. It must be in the same file.
    fn referred(&self, node: Node<'_, '_>, kind: &str) -> Result<Node<'a, 'i>, MeshError> {
        let url = node.attribute("url").unwrap_or_default();
        let missing = || self.error(&format!("{kind} {url:?} does not exist"));
        self.names.find(kind, url)?.ok_or_else(missing)
    }

    fn node(&mut self, node: Node<'a, 'i>, outer: &Affine, depth: usize) -> Result<(), MeshError> {
        self.visited += 1;
        if depth > MAX_DEPTH || self.visited > MAX_NODES {
            return Err(self.error(&format!(
                "its nodes are nested more than {MAX_DEPTH} deep, or there are more than {MAX_NODES}"
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
                    let target = self.referred(element, "node")?;
                    self.node(target, &here, depth + 1)?;
                }
                "instance_geometry" => {
                    let geometry = self.referred(element, "geometry")?;
                    self.place(geometry, &here)?;
                }
                // The vertices of a controller are moved by joints, which are not read.
                "instance_controller" => {
                    let url = element.attribute("url").unwrap_or_default();
                    return Err(
                        self.error(&format!("controller {url:?} deforms a mesh; apply the deformation"))
                    );
                }
                _ => (),
            }
        }
        Ok(())
    }

    /// Returns the transform of an element such as `translate` or `matrix`; `None` if the element is no transform.
    fn transform(&self, element: Node<'_, '_>) -> Result<Option<Affine>, MeshError> {
        let kind = element.tag_name().name();
        if !matches!(kind, "matrix" | "translate" | "rotate" | "scale") {
            return Ok(None);
        }
        let numbers = floats(self.name, element)?;
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
            _ => {
                let expected = match kind {
                    "matrix" => 16,
                    "rotate" => 4,
                    _ => 3,
                };
                let got = numbers.len();
                return Err(self.error(&format!("a {kind} has {got} numbers, not {expected}")));
            }
        }))
    }

    fn place(&mut self, geometry: Node<'a, 'i>, here: &Affine) -> Result<(), MeshError> {
        if !self.geometry.contains_key(&geometry.id()) {
            let read = match child(geometry, "mesh") {
                Some(mesh) => MeshElement::new(self.name, mesh, &self.names).triangles()?,
                None => Vec::new(),
            };
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
}

/// Returns the numbers in the text of an element.
fn floats(file: &str, element: Node<'_, '_>) -> Result<Vec<f64>, MeshError> {
    numbers(file, element, str::parse::<f64>)
}

fn numbers<T, E>(
    file: &str,
    element: Node<'_, '_>,
    parse: impl Fn(&str) -> Result<T, E>,
) -> Result<Vec<T>, MeshError> {
    let words = element.text().unwrap_or_default().split_ascii_whitespace();
    let number = |word| {
        parse(word).map_err(|_| {
            let kind = element.tag_name().name();
            syntax(file, &format!("{word:?} in element {kind} is not a number"))
        })
    };
    words.map(number).collect()
}
