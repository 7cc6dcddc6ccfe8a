//! Errors in a robot's file, or in a requested chain.

use thiserror::Error;

use protocol::parameters::{MAX_JOINTS, MAX_ROWS};
use protocol::skin::REACH;

use crate::rows::{MAX_LENGTH_M, MAX_RESIDUAL};

/// An error in a file, in one line.
#[derive(Clone, Debug, Error, PartialEq)]
#[error("{file}{}: {problem}", line.map_or_else(String::new, |line| format!(":{line}")))]
pub struct RobotError {
    /// The name of the file, as it was given.
    pub file: String,
    /// The line, from 1, if it is known.
    pub line: Option<u32>,
    /// The problem.
    pub problem: Box<RobotProblem>,
}

impl RobotError {
    /// Creates an error in a file.
    pub(crate) fn new(file: &str, line: Option<u32>, problem: RobotProblem) -> Self {
        Self { file: file.to_owned(), line, problem: Box::new(problem) }
    }
}

/// A problem in a robot's file, or in a chain of it.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum RobotProblem {
    /// The file is empty.
    #[error("the file is empty; a URDF has a robot element with links and joints")]
    Empty,
    /// The file does not begin as XML does.
    #[error("not XML: a URDF begins with <?xml or <robot, and this does not; name the robot's URDF")]
    NotXml,
    /// The file is not readable XML, with the fault and the action to take.
    #[error("{0}")]
    Xml(String),
    /// The file is a template of a URDF.
    #[error(
        "{what} is left: this is a xacro file, a template of a URDF. Make one with `xacrodoc {file} -o NEW.urdf` (pip install xacrodoc), and name that"
    )]
    Xacro {
        /// The element or expression.
        what: String,
        /// The file.
        file: String,
    },
    /// The file is XML of another kind.
    #[error("the outermost element is {0}; a URDF has `robot`: name the robot's URDF")]
    NotARobot(String),
    /// The file is an SRDF, which defines groups of a robot's joints.
    #[error("an SRDF file, of MoveIt, which has no links: name the robot's URDF")]
    Srdf,
    /// The robot has no links.
    #[error("the robot has no links; a URDF has at least one")]
    NoLinks,
    /// An element or attribute is missing.
    #[error("{thing} has no {missing}: add it")]
    Missing {
        /// The element.
        thing: String,
        /// The missing part.
        missing: &'static str,
    },
    /// A value is not allowed.
    #[error("{thing}: {attribute} = {value:?}: {allowed}")]
    Value {
        /// The element.
        thing: String,
        /// The attribute.
        attribute: &'static str,
        /// The value.
        value: String,
        /// The allowed values.
        allowed: String,
    },
    /// A name occurs twice.
    #[error("two {what}s are named {name:?}; each needs a name of its own: rename one")]
    Duplicate {
        /// `link` or `joint`.
        what: &'static str,
        /// The name.
        name: String,
    },
    /// A joint names a link that does not exist.
    #[error("joint {joint:?} has the {role} {link:?}, but there is no such link; the nearest are {nearest}")]
    JointWithoutLink {
        /// The joint.
        joint: String,
        /// `parent` or `child`.
        role: &'static str,
        /// The name of the link.
        link: String,
        /// Similar names.
        nearest: String,
    },
    /// Two joints move the same link.
    #[error(
        "link {link:?} is the child of the joints {first:?} and {second:?}; one is allowed: remove the other"
    )]
    TwoParents {
        /// The link.
        link: String,
        /// The first joint.
        first: String,
        /// The second joint.
        second: String,
    },
    /// A link is its own ancestor.
    #[error("link {0:?} is above itself; links must be a tree: remove a joint of the cycle")]
    Cycle(String),
    /// The links form two trees.
    #[error(
        "the links {first:?} and {second:?} have no parent; one root is allowed: connect them with a fixed joint"
    )]
    TwoRoots {
        /// The first root.
        first: String,
        /// The second root.
        second: String,
    },
    /// A requested link does not exist.
    #[error("there is no link {link:?}; the nearest are {nearest}")]
    NoSuchLink {
        /// The requested name.
        link: String,
        /// Similar names.
        nearest: String,
    },
    /// A requested joint does not exist, or does not move by itself.
    #[error("no joint {joint:?} moves; the nearest are {nearest}")]
    NoSuchJoint {
        /// The requested name.
        joint: String,
        /// Similar names.
        nearest: String,
    },
    /// A chain of a skin differs from that of the file.
    #[error(
        "behind joint {joint:?} it is not where chain {chain:?} of the skin has it: import the skin from this file again, or correct the rows"
    )]
    OtherRows {
        /// The joint.
        joint: String,
        /// The chain.
        chain: String,
    },
    /// The tip of the chain is not below its root.
    #[error("link {tip:?} is not below {root:?}; the path to it is {path}: choose a root on it")]
    NotBelow {
        /// The tip.
        tip: String,
        /// The root.
        root: String,
        /// The links above the tip, from the root.
        path: String,
    },
    /// No joint of the chain moves.
    #[error(
        "no joint moves between {root:?} and {tip:?}; 1 to {MAX_JOINTS} are needed: choose a tip farther out, or a root nearer to the base"
    )]
    NoMovingJoint {
        /// The root of the chain.
        root: String,
        /// The tip of the chain.
        tip: String,
    },
    /// The chain has too many joints.
    #[error(
        "{count} joints move between {root:?} and {tip:?}; {MAX_JOINTS} are possible: choose a root or a tip nearer to the other"
    )]
    TooManyJoints {
        /// The number of joints.
        count: usize,
        /// The root of the chain.
        root: String,
        /// The tip of the chain.
        tip: String,
    },
    /// The chain needs too many rows.
    #[error(
        "the chain to {tip:?} needs {count} rows; {MAX_ROWS} are possible: choose a root or a tip nearer to the other"
    )]
    TooManyRows {
        /// The number of rows.
        count: usize,
        /// The tip of the chain.
        tip: String,
    },
    /// A joint of the chain has several degrees of freedom.
    #[error(
        "joint {joint:?} is {kind}; a chain has revolute, continuous, prismatic and fixed joints: choose a root below it, or a tip above it"
    )]
    Kind {
        /// The joint.
        joint: String,
        /// Its type.
        kind: &'static str,
    },
    /// A joint of the chain follows another one.
    #[error(
        "joint {joint:?} mimics {of:?}; the joints of a chain move by themselves: choose a tip above it, or make it fixed"
    )]
    Mimic {
        /// The joint.
        joint: String,
        /// The joint that it follows.
        of: String,
    },
    /// A joint has no limits.
    #[error(
        "joint {joint:?} has no limits: add <limit lower=\"..\" upper=\"..\"/>, or make the joint continuous or fixed"
    )]
    NoLimit {
        /// The joint.
        joint: String,
    },
    /// A joint cannot move within its limits.
    #[error(
        "joint {joint:?} has the limits {lower} to {upper}; the lower must be below the upper, both finite: correct them, or make the joint fixed"
    )]
    Limits {
        /// The joint.
        joint: String,
        /// The lower limit, in rad or m.
        lower: f64,
        /// The upper limit, in rad or m.
        upper: f64,
    },
    /// A length exceeds the range of a cell's parameters.
    #[error(
        "row {row}, to {to}: {what} = {value:.3} m; [-{MAX_LENGTH_M}, {MAX_LENGTH_M}) m is possible: {hint}"
    )]
    Length {
        /// The row, from 1.
        row: usize,
        /// The next joint, or the tip.
        to: String,
        /// `a` or `d`, or `d` with the joint at a limit.
        what: &'static str,
        /// The length in m.
        value: f64,
        /// The action to take.
        hint: &'static str,
    },
    /// The chain is longer than a cell can compute.
    #[error(
        "link {link:?} can come {reach:.3} m from a frame of the rows below it, if all joints turn freely; less than {REACH} m is possible: choose a tip or a root nearer to the other"
    )]
    Reach {
        /// The link.
        link: String,
        /// The reach in m.
        reach: f64,
    },
    /// Rows and URDF differ.
    #[error(
        "the rows differ by {residual:.1e} m or rad from the URDF at link {link:?}; {MAX_RESIDUAL:.0e} is allowed: please report this robot"
    )]
    Residual {
        /// The link.
        link: String,
        /// The difference in m or rad.
        residual: f64,
    },
    /// A link does not move.
    #[error(
        "link {link:?} is before the chain's first joint {joint:?} and moves with none; a cell needs a link behind it"
    )]
    BeforeFirstJoint {
        /// The link.
        link: String,
        /// The first joint of the chain.
        joint: String,
    },
    /// A link moves, but not with the chain.
    #[error(
        "link {link:?} is moved by joint {joint:?}, which is not between {root:?} and {tip:?}: choose another tip, or a link of the chain"
    )]
    OutsideChain {
        /// The link.
        link: String,
        /// The joint.
        joint: String,
        /// The root of the chain.
        root: String,
        /// The tip of the chain.
        tip: String,
    },
    /// A link is not below the root of the chain.
    #[error("link {link:?} is not below the chain's root {root:?}: choose a root above it")]
    AboveChain {
        /// The link.
        link: String,
        /// The root of the chain.
        root: String,
    },
}
