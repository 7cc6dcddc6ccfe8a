//! The parser for the text of a URDF.

use nalgebra::{Isometry3, Translation3, Unit, UnitQuaternion, Vector3};
use roxmltree::{Document, Node};

use super::shape::{Geometry, Shape};
use super::tree::{self, LinkWithLine, UnlinkedJoint};
use super::{Mimic, ParsedShapes, Urdf, UrdfJoint, UrdfJointKind, UrdfLink, xml};
use crate::error::{RobotError, RobotProblem};

/// Minimum length of an axis vector. A shorter one has no direction.
const MIN_AXIS_LENGTH: f64 = 1e-6;

/// Parses the text of a URDF file.
pub(super) fn read(file: &str, xml: &str) -> Result<Urdf, RobotError> {
    let prepared = xml::prepare_text(file, xml)?;
    let document = xml::parse_document(file, &prepared)?;
    let breaks = prepared.text.match_indices('\n').map(|(at, _)| at).collect();
    UrdfParser { file, document: &document, lines_before: prepared.lines_before, breaks }.parse_robot()
}

/// The state of the parser.
struct UrdfParser<'a> {
    file: &'a str,
    document: &'a Document<'a>,
    /// Number of lines of the file before the XML document.
    lines_before: usize,
    /// Byte offsets of the line ends in the document.
    breaks: Vec<usize>,
}

impl<'a> UrdfParser<'a> {
    fn parse_robot(&self) -> Result<Urdf, RobotError> {
        let robot = self.document.root_element();
        self.refuse_xacro(robot)?;
        let outermost = robot.tag_name().name();
        if outermost != "robot" {
            let kind = protocol::xml::format_of_root_element(outermost).map(|kind| format!(" ({kind})"));
            let element = format!("{outermost:?}{}", kind.unwrap_or_default());
            return Err(self.error_at_node(robot, RobotProblem::NotARobot(element)));
        }
        let links = self.children(robot, "link").map(|node| self.link(node));
        let links = links.collect::<Result<Vec<_>, _>>()?;
        if links.is_empty() {
            let of_srdf = ["group", "group_state", "disable_collisions", "virtual_joint", "end_effector"];
            let is_srdf = of_srdf.iter().any(|name| self.child(robot, name).is_some());
            return Err(
                self.error_at_node(robot, if is_srdf { RobotProblem::Srdf } else { RobotProblem::NoLinks })
            );
        }
        let joints = self.children(robot, "joint").map(|node| self.joint(node));
        let joints = joints.collect::<Result<Vec<_>, _>>()?;
        let name = robot.attribute("name").unwrap_or_default().trim().to_owned();
        tree::build_tree(self.file, name, links, joints)
    }

    /// Returns an error if the file contains elements or expressions that xacro should have replaced. Unused
    /// definitions are accepted.
    fn refuse_xacro(&self, robot: Node<'a, 'a>) -> Result<(), RobotError> {
        // Only the prefix is decisive: files bind it to arbitrary namespaces, and many bind it without using it.
        let is_xacro = |node: &Node<'a, 'a>| self.source_text(node).starts_with("<xacro:");
        let defines =
            |node: &Node<'a, 'a>| is_xacro(node) && matches!(node.tag_name().name(), "property" | "arg");
        let mut any = None;
        for node in robot.descendants().filter(is_xacro) {
            if !defines(&node) {
                let name = format!("element <xacro:{}>", node.tag_name().name());
                return Err(self.xacro_error(node, name));
            }
            any = any.or(Some(node));
        }
        if any.is_none() {
            return Ok(());
        }
        let kept = |node: &Node<'a, 'a>| !node.ancestors().any(|above| defines(&above));
        for node in robot.descendants().filter(kept) {
            let text = node.is_text().then(|| node.text()).flatten();
            let values = node.attributes().map(|attribute| attribute.value());
            if let Some(expression) = values.chain(text).find_map(xacro_expression) {
                return Err(self.xacro_error(node, format!("expression {expression}")));
            }
        }
        Ok(())
    }

    fn xacro_error(&self, node: Node<'a, 'a>, what: String) -> RobotError {
        self.error_at_node(node, RobotProblem::Xacro { what, file: self.file.to_owned() })
    }

    fn link(&self, node: Node<'a, 'a>) -> Result<LinkWithLine, RobotError> {
        let name = self.required_attribute(node, "link", "name")?;
        let thing = format!("link {name:?}");
        let shapes = |element| {
            let shapes = self.children(node, element).map(|node| self.shape(node, &thing));
            shapes.filter_map(Result::transpose).collect::<ParsedShapes>()
        };
        let (visuals, collisions) = (shapes("visual"), shapes("collision"));
        Ok((UrdfLink { name, visuals, collisions, parent: None }, self.line(node)))
    }

    /// Parses a visual or collision shape; returns `None` if it has no geometry.
    fn shape(&self, node: Node<'a, 'a>, thing: &str) -> Result<Option<Shape>, RobotError> {
        let origin = self.parse_origin(node, thing)?;
        let geometry = self.child(node, "geometry").and_then(|node| node.first_element_child());
        let Some(node) = geometry else { return Ok(None) };
        let size = |attribute| {
            let [size] =
                self.parse_numbers(node, thing, attribute, "must be a length in m")?.ok_or_else(|| {
                    self.error_at_node(
                        node,
                        RobotProblem::Missing { thing: thing.to_owned(), missing: attribute },
                    )
                })?;
            Ok(size)
        };
        let geometry = match node.tag_name().name() {
            "mesh" => {
                let path = self.required_attribute(node, thing, "filename")?;
                if let Some(expression) = xacro_expression(&path) {
                    return Err(self.xacro_error(node, format!("expression {expression}")));
                }
                let allowed = "must be three factors, as in \"0.001 0.001 0.001\"";
                let scale = self.parse_numbers(node, thing, "scale", allowed)?.unwrap_or([1.0; 3]);
                Geometry::Mesh { path, scale }
            }
            "box" => {
                let size = self.parse_numbers(node, thing, "size", "must be three lengths in m")?;
                let missing = || RobotProblem::Missing { thing: thing.to_owned(), missing: "size" };
                Geometry::Box { size: size.ok_or_else(|| self.error_at_node(node, missing()))? }
            }
            "cylinder" => Geometry::Cylinder { radius: size("radius")?, length: size("length")? },
            "sphere" => Geometry::Sphere { radius: size("radius")? },
            other => Geometry::Other { element: other.to_owned() },
        };
        Ok(Some(Shape { origin, geometry }))
    }

    fn joint(&self, node: Node<'a, 'a>) -> Result<UnlinkedJoint, RobotError> {
        let name = self.required_attribute(node, "joint", "name")?;
        let thing = format!("joint {name:?}");
        let kind = match self.required_attribute(node, &thing, "type")?.as_str() {
            "revolute" => UrdfJointKind::Revolute,
            "continuous" => UrdfJointKind::Continuous,
            "prismatic" => UrdfJointKind::Prismatic,
            "fixed" => UrdfJointKind::Fixed,
            "floating" => UrdfJointKind::Floating,
            "planar" => UrdfJointKind::Planar,
            other => {
                let allowed = "must be revolute, continuous, prismatic, fixed, floating or planar";
                return Err(self.value_error(node, &thing, "type", other, allowed));
            }
        };
        let link = |role: &'static str| {
            let missing = || RobotProblem::Missing { thing: thing.clone(), missing: role };
            let found = self.child(node, role).ok_or_else(|| self.error_at_node(node, missing()))?;
            self.required_attribute(found, &format!("the {role} of {thing}"), "link")
        };
        let (parent, child) = (link("parent")?, link("child")?);
        let limit = self.child(node, "limit");
        let read = |attribute| match limit {
            Some(limit) => self.parse_number(limit, &thing, attribute),
            None => Ok(None),
        };
        let joint = UrdfJoint {
            origin: self.parse_origin(node, &thing)?,
            axis: self.parse_axis(node, &thing, kind)?,
            has_limit: limit.is_some_and(|it| it.has_attribute("lower") || it.has_attribute("upper")),
            limits: [read("lower")?.unwrap_or_default(), read("upper")?.unwrap_or_default()],
            velocity: read("velocity")?,
            mimic: self.child(node, "mimic").map(|node| self.parse_mimic(node, &thing)).transpose()?,
            line: self.line(node),
            parent: 0,
            child: 0,
            name,
            kind,
        };
        Ok(UnlinkedJoint { joint, parent, child })
    }

    fn parse_axis(
        &self,
        node: Node<'a, 'a>,
        thing: &str,
        kind: UrdfJointKind,
    ) -> Result<Unit<Vector3<f64>>, RobotError> {
        match kind {
            UrdfJointKind::Revolute | UrdfJointKind::Continuous | UrdfJointKind::Prismatic => {}
            // The axis of these joints is often 0 0 0, and is never used.
            UrdfJointKind::Fixed | UrdfJointKind::Floating | UrdfJointKind::Planar => {
                return Ok(Vector3::z_axis());
            }
        }
        let Some(node) = self.child(node, "axis") else { return Ok(Vector3::x_axis()) };
        let allowed = "must be three numbers, not all zero";
        let axis = self.parse_numbers(node, thing, "xyz", allowed)?.unwrap_or([1.0, 0.0, 0.0]);
        let axis = Vector3::from(axis);
        Unit::try_new(axis, MIN_AXIS_LENGTH).filter(|_| axis.norm().is_finite()).ok_or_else(|| {
            self.value_error(node, thing, "xyz", node.attribute("xyz").unwrap_or_default(), allowed)
        })
    }

    fn parse_mimic(&self, node: Node<'a, 'a>, thing: &str) -> Result<Mimic, RobotError> {
        let joint = self.required_attribute(node, &format!("the mimic of {thing}"), "joint")?;
        let multiplier = self.parse_number(node, thing, "multiplier")?.unwrap_or(1.0);
        let offset = self.parse_number(node, thing, "offset")?.unwrap_or_default();
        Ok(Mimic { joint, multiplier, offset })
    }

    fn parse_origin(&self, node: Node<'a, 'a>, thing: &str) -> Result<Isometry3<f64>, RobotError> {
        let Some(node) = self.child(node, "origin") else { return Ok(Isometry3::identity()) };
        if let Some(got) = node.attribute("quat_xyzw") {
            return Err(self.value_error(
                node,
                thing,
                "quat_xyzw",
                got,
                "must be given as rpy, the angles in rad",
            ));
        }
        let [x, y, z] =
            self.parse_numbers(node, thing, "xyz", "must be three lengths in m")?.unwrap_or_default();
        let [roll, pitch, yaw] =
            self.parse_numbers(node, thing, "rpy", "must be three angles in rad")?.unwrap_or_default();
        let turn = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
        Ok(Isometry3::from_parts(Translation3::new(x, y, z), turn))
    }

    /// Returns the direct children of an element that have this name and the robot's namespace.
    fn children(&self, node: Node<'a, 'a>, name: &'static str) -> impl Iterator<Item = Node<'a, 'a>> {
        let namespace = self.document.root_element().tag_name().namespace();
        node.children().filter(move |child| {
            child.is_element() && child.tag_name().name() == name && child.tag_name().namespace() == namespace
        })
    }

    /// Returns the first direct child of an element that has this name.
    fn child(&self, node: Node<'a, 'a>, name: &'static str) -> Option<Node<'a, 'a>> {
        self.children(node, name).next()
    }

    fn required_attribute(
        &self,
        node: Node<'a, 'a>,
        thing: &str,
        attribute: &'static str,
    ) -> Result<String, RobotError> {
        let text = node.attribute(attribute).map(str::trim).filter(|text| !text.is_empty());
        let missing = || RobotProblem::Missing { thing: thing.to_owned(), missing: attribute };
        text.map(str::to_owned).ok_or_else(|| self.error_at_node(node, missing()))
    }

    /// Parses an optional attribute that consists of `N` finite numbers.
    fn parse_numbers<const N: usize>(
        &self,
        node: Node<'a, 'a>,
        thing: &str,
        attribute: &'static str,
        allowed: &'static str,
    ) -> Result<Option<[f64; N]>, RobotError> {
        let Some(text) = node.attribute(attribute) else { return Ok(None) };
        let numbers = text.split_whitespace().map(|word| word.parse().ok().filter(|it: &f64| it.is_finite()));
        let numbers = numbers.collect::<Option<Vec<_>>>().and_then(|numbers| numbers.try_into().ok());
        numbers.map(Some).ok_or_else(|| self.value_error(node, thing, attribute, text, allowed))
    }

    /// Parses an optional attribute that is one number, possibly infinite.
    fn parse_number(
        &self,
        node: Node<'a, 'a>,
        thing: &str,
        attribute: &'static str,
    ) -> Result<Option<f64>, RobotError> {
        let Some(text) = node.attribute(attribute) else { return Ok(None) };
        let number = text.trim().parse().ok().filter(|it: &f64| !it.is_nan());
        let allowed =
            if text.contains(',') { "must be one number with a decimal point" } else { "must be a number" };
        number.map(Some).ok_or_else(|| self.value_error(node, thing, attribute, text, allowed))
    }

    /// Creates the error for a value that is not allowed. If the value contains a xacro expression, the error is about
    /// the expression.
    fn value_error(
        &self,
        node: Node<'a, 'a>,
        thing: &str,
        attribute: &'static str,
        value: &str,
        allowed: &'static str,
    ) -> RobotError {
        if let Some(expression) = xacro_expression(value) {
            return self.xacro_error(node, format!("expression {expression}"));
        }
        let commas = if value.contains([',', ';']) && allowed.starts_with("must be three") {
            ", separated by blanks, not commas"
        } else {
            ""
        };
        let (thing, value, allowed) = (thing.to_owned(), value.to_owned(), format!("{allowed}{commas}"));
        self.error_at_node(node, RobotProblem::Value { thing, attribute, value, allowed })
    }

    fn source_text(&self, node: &Node<'a, 'a>) -> &'a str {
        self.document.input_text().get(node.range()).unwrap_or_default()
    }

    fn line(&self, node: Node<'a, 'a>) -> u32 {
        let at = node.range().start;
        let line = self.lines_before + self.breaks.partition_point(|end| *end < at) + 1;
        u32::try_from(line).unwrap_or(u32::MAX)
    }

    fn error_at_node(&self, node: Node<'a, 'a>, problem: RobotProblem) -> RobotError {
        RobotError::new(self.file, Some(self.line(node)), problem)
    }
}

/// Returns the first xacro expression in a value, as it is written; `None` if it contains none.
fn xacro_expression(value: &str) -> Option<&str> {
    let begin = [value.find("${"), value.find("$(")].into_iter().flatten().min()?;
    let rest = value.get(begin..)?;
    let end = rest.find(['}', ')']).map_or(rest.len(), |end| end + 1);
    rest.get(..end)
}
