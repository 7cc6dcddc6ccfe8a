//! The file's text.

use nalgebra::{Isometry3, Translation3, Unit, UnitQuaternion, Vector3};
use roxmltree::{Document, Error, Node};

use super::shape::{Geometry, Shape};
use super::tree::{self, Loose, Placed};
use super::{Kind, Link, Mimic, Urdf, UrdfJoint};
use crate::error::{Problem, RobotError};

/// An axis that is shorter has no direction.
const SHORTEST_AXIS: f64 = 1e-6;

/// Reads a file.
pub(super) fn read(file: &str, xml: &str) -> Result<Urdf, RobotError> {
    let error = |problem| RobotError::new(file, None, problem);
    let text = xml.trim_start_matches('\u{feff}').trim_start();
    if text.is_empty() {
        return Err(error(Problem::Empty));
    }
    let document = Document::parse(text).map_err(|reason| {
        let is_xacro = matches!(&reason, Error::UnknownNamespace(prefix, _) if prefix == "xacro");
        error(if is_xacro { Problem::Xacro } else { Problem::Xml(reason.to_string()) })
    })?;
    let skipped = xml.len() - text.len();
    let breaks = xml.match_indices('\n').map(|(at, _)| at).collect();
    Reader { file, document: &document, skipped, breaks }.robot()
}

/// A file that is being read.
struct Reader<'a> {
    file: &'a str,
    document: &'a Document<'a>,
    /// Bytes before the document.
    skipped: usize,
    /// Where lines end.
    breaks: Vec<usize>,
}

impl<'a> Reader<'a> {
    fn robot(&self) -> Result<Urdf, RobotError> {
        let robot = self.document.root_element();
        // Only the name before the colon tells: files bind it to anything, and many bind it and do not use it.
        if let Some(node) = robot.descendants().find(|node| self.source(node).starts_with("<xacro:")) {
            return Err(self.error(node, Problem::Xacro));
        }
        if robot.tag_name().name() != "robot" {
            return Err(self.error(robot, Problem::NotARobot(robot.tag_name().name().to_owned())));
        }
        let links = self.children(robot, "link").map(|node| self.link(node));
        let links = links.collect::<Result<Vec<_>, _>>()?;
        if links.is_empty() {
            return Err(self.error(robot, Problem::NoLinks));
        }
        let joints = self.children(robot, "joint").map(|node| self.joint(node));
        let joints = joints.collect::<Result<Vec<_>, _>>()?;
        let name = robot.attribute("name").unwrap_or_default().trim().to_owned();
        tree::grow(self.file, name, links, joints)
    }

    fn link(&self, node: Node<'a, 'a>) -> Result<Placed, RobotError> {
        let name = self.text(node, "link", "name")?;
        let thing = format!("link {name:?}");
        let shapes = |element| {
            let shapes = self.children(node, element).map(|node| self.shape(node, &thing));
            shapes.filter_map(Result::transpose).collect::<Result<Vec<_>, _>>()
        };
        let (visuals, collisions) = (shapes("visual")?, shapes("collision")?);
        Ok((Link { name, visuals, collisions, parent: None }, self.line(node)))
    }

    /// A shape; none where there is no geometry.
    fn shape(&self, node: Node<'a, 'a>, thing: &str) -> Result<Option<Shape>, RobotError> {
        let origin = self.origin(node, thing)?;
        let geometry = self.child(node, "geometry").and_then(|node| node.first_element_child());
        let Some(node) = geometry else { return Ok(None) };
        let size = |attribute| {
            let [size] = self.numbers(node, thing, attribute, "a length in m")?.ok_or_else(|| {
                self.error(node, Problem::Missing { thing: thing.to_owned(), missing: attribute })
            })?;
            Ok(size)
        };
        let geometry = match node.tag_name().name() {
            "mesh" => {
                let path = self.text(node, thing, "filename")?;
                let scale = self.numbers(node, thing, "scale", "three factors")?.unwrap_or([1.0; 3]);
                Geometry::Mesh { path, scale }
            }
            "box" => {
                let size = self.numbers(node, thing, "size", "three lengths in m")?;
                let missing = || Problem::Missing { thing: thing.to_owned(), missing: "size" };
                Geometry::Box { size: size.ok_or_else(|| self.error(node, missing()))? }
            }
            "cylinder" => Geometry::Cylinder { radius: size("radius")?, length: size("length")? },
            "sphere" => Geometry::Sphere { radius: size("radius")? },
            other => Geometry::Other { element: other.to_owned() },
        };
        Ok(Some(Shape { origin, geometry }))
    }

    fn joint(&self, node: Node<'a, 'a>) -> Result<Loose, RobotError> {
        let name = self.text(node, "joint", "name")?;
        let thing = format!("joint {name:?}");
        let kind = match self.text(node, &thing, "type")?.as_str() {
            "revolute" => Kind::Revolute,
            "continuous" => Kind::Continuous,
            "prismatic" => Kind::Prismatic,
            "fixed" => Kind::Fixed,
            "floating" => Kind::Floating,
            "planar" => Kind::Planar,
            other => {
                let allowed = "revolute, continuous, prismatic, fixed, floating or planar";
                return Err(self.value(node, &thing, "type", other, allowed));
            }
        };
        let link = |role: &'static str| {
            let missing = || Problem::Missing { thing: thing.clone(), missing: role };
            let found = self.child(node, role).ok_or_else(|| self.error(node, missing()))?;
            self.text(found, &format!("the {role} of {thing}"), "link")
        };
        let (parent, child) = (link("parent")?, link("child")?);
        let limit = self.child(node, "limit");
        let read = |attribute| match limit {
            Some(limit) => self.any_number(limit, &thing, attribute),
            None => Ok(None),
        };
        let joint = UrdfJoint {
            origin: self.origin(node, &thing)?,
            axis: self.axis(node, &thing, kind)?,
            limits: [read("lower")?.unwrap_or_default(), read("upper")?.unwrap_or_default()],
            velocity: read("velocity")?,
            mimic: self.child(node, "mimic").map(|node| self.mimic(node, &thing)).transpose()?,
            line: self.line(node),
            parent: 0,
            child: 0,
            name,
            kind,
        };
        Ok(Loose { joint, parent, child })
    }

    fn axis(&self, node: Node<'a, 'a>, thing: &str, kind: Kind) -> Result<Unit<Vector3<f64>>, RobotError> {
        match kind {
            Kind::Revolute | Kind::Continuous | Kind::Prismatic => {}
            // Often 0 0 0, and never used.
            Kind::Fixed | Kind::Floating | Kind::Planar => return Ok(Vector3::z_axis()),
        }
        let Some(node) = self.child(node, "axis") else { return Ok(Vector3::x_axis()) };
        let allowed = "three numbers, not all zero";
        let axis = self.numbers(node, thing, "xyz", allowed)?.unwrap_or([1.0, 0.0, 0.0]);
        let axis = Vector3::from(axis);
        Unit::try_new(axis, SHORTEST_AXIS)
            .filter(|_| axis.norm().is_finite())
            .ok_or_else(|| self.value(node, thing, "xyz", node.attribute("xyz").unwrap_or_default(), allowed))
    }

    fn mimic(&self, node: Node<'a, 'a>, thing: &str) -> Result<Mimic, RobotError> {
        let joint = self.text(node, &format!("the mimic of {thing}"), "joint")?;
        let multiplier = self.any_number(node, thing, "multiplier")?.unwrap_or(1.0);
        let offset = self.any_number(node, thing, "offset")?.unwrap_or_default();
        Ok(Mimic { joint, multiplier, offset })
    }

    fn origin(&self, node: Node<'a, 'a>, thing: &str) -> Result<Isometry3<f64>, RobotError> {
        let Some(node) = self.child(node, "origin") else { return Ok(Isometry3::identity()) };
        if let Some(got) = node.attribute("quat_xyzw") {
            return Err(self.value(node, thing, "quat_xyzw", got, "write it as rpy, the angles in rad"));
        }
        let [x, y, z] = self.numbers(node, thing, "xyz", "three lengths in m")?.unwrap_or_default();
        let [roll, pitch, yaw] = self.numbers(node, thing, "rpy", "three angles in rad")?.unwrap_or_default();
        let turn = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
        Ok(Isometry3::from_parts(Translation3::new(x, y, z), turn))
    }

    /// Direct children of the robot's namespace.
    fn children(&self, node: Node<'a, 'a>, name: &'static str) -> impl Iterator<Item = Node<'a, 'a>> {
        let namespace = self.document.root_element().tag_name().namespace();
        node.children().filter(move |child| {
            child.is_element() && child.tag_name().name() == name && child.tag_name().namespace() == namespace
        })
    }

    /// The first child of a name.
    fn child(&self, node: Node<'a, 'a>, name: &'static str) -> Option<Node<'a, 'a>> {
        self.children(node, name).next()
    }

    /// A word that has to be there.
    fn text(&self, node: Node<'a, 'a>, thing: &str, attribute: &'static str) -> Result<String, RobotError> {
        let text = node.attribute(attribute).map(str::trim).filter(|text| !text.is_empty());
        let missing = || Problem::Missing { thing: thing.to_owned(), missing: attribute };
        text.map(str::to_owned).ok_or_else(|| self.error(node, missing()))
    }

    /// Finite numbers, if they are there: as many as the type has.
    fn numbers<const N: usize>(
        &self,
        node: Node<'a, 'a>,
        thing: &str,
        attribute: &'static str,
        allowed: &'static str,
    ) -> Result<Option<[f64; N]>, RobotError> {
        let Some(text) = node.attribute(attribute) else { return Ok(None) };
        let numbers = text.split_whitespace().map(|word| word.parse().ok().filter(|it: &f64| it.is_finite()));
        let numbers = numbers.collect::<Option<Vec<_>>>().and_then(|numbers| numbers.try_into().ok());
        numbers.map(Some).ok_or_else(|| self.value(node, thing, attribute, text, allowed))
    }

    /// A number that may be infinite, if it is there.
    fn any_number(
        &self,
        node: Node<'a, 'a>,
        thing: &str,
        attribute: &'static str,
    ) -> Result<Option<f64>, RobotError> {
        let Some(text) = node.attribute(attribute) else { return Ok(None) };
        let number = text.trim().parse().ok().filter(|it: &f64| !it.is_nan());
        number.map(Some).ok_or_else(|| self.value(node, thing, attribute, text, "a number"))
    }

    /// A value that is not allowed; where a xacro expression was left, that is what is wrong.
    fn value(
        &self,
        node: Node<'a, 'a>,
        thing: &str,
        attribute: &'static str,
        value: &str,
        allowed: &'static str,
    ) -> RobotError {
        if value.contains("${") || value.contains("$(") {
            return self.error(node, Problem::Xacro);
        }
        let (thing, value) = (thing.to_owned(), value.to_owned());
        self.error(node, Problem::Value { thing, attribute, value, allowed })
    }

    fn source(&self, node: &Node<'a, 'a>) -> &'a str {
        self.document.input_text().get(node.range()).unwrap_or_default()
    }

    fn line(&self, node: Node<'a, 'a>) -> u32 {
        let at = node.range().start + self.skipped;
        u32::try_from(self.breaks.partition_point(|end| *end < at) + 1).unwrap_or(u32::MAX)
    }

    fn error(&self, node: Node<'a, 'a>, problem: Problem) -> RobotError {
        RobotError::new(self.file, Some(self.line(node)), problem)
    }
}
