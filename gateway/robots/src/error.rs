//! Errors in the file of a robot, or in a chain that a user requests from it.

use thiserror::Error;

use protocol::parameters::{MAX_JOINTS, MAX_ROWS};
use protocol::skin::MAX_REACH;

use crate::rows::{MAX_LENGTH_M, MAX_RESIDUAL};

/// An error in the file of a robot. The message is one line.
#[derive(Clone, Debug, Error, PartialEq)]
#[error("{file}{}: {problem}", line.map_or_else(String::new, |line| format!(":{line}")))]
pub struct RobotError {
    /// The name of the file, as it was given.
    pub file: String,
    /// The line, from 1, if it is known.
    pub line: Option<u32>,
    /// The kind of error, with its details.
    pub problem: Box<RobotProblem>,
}

impl RobotError {
    /// Creates an error for a problem in a file, at a line if it is known.
    pub(crate) fn new(file: &str, line: Option<u32>, problem: RobotProblem) -> Self {
        Self { file: file.to_owned(), line, problem: Box::new(problem) }
    }
}

/// A problem in the file of a robot, or in a chain of the robot.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum RobotProblem {
    /// The file is empty.
    #[error("the file is empty; a URDF has a robot element with links and joints")]
    Empty,
    /// The file does not begin like an XML file.
    #[error("not XML: a URDF begins with <?xml or <robot; give the path of the robot's URDF")]
    NotXml,
    /// The file is not readable XML. The text says what is wrong and what to do.
    #[error("{0}")]
    Xml(String),
    /// The file is a xacro template, from which a URDF must be generated first.
    #[error(
        "{what} is not expanded: this is a xacro file, a template of a URDF. Generate the URDF with `xacrodoc {file} -o NEW.urdf` (pip install xacrodoc), and give its path"
    )]
    Xacro {
        /// The xacro element or expression.
        what: String,
        /// Name of the file.
        file: String,
    },
    /// The file is XML, but its root element is not that of a URDF.
    #[error("the outermost element is {0}; that of a URDF is `robot`: give the path of the robot's URDF")]
    NotARobot(String),
    /// The file is an SRDF, which defines groups of a robot's joints.
    #[error("this is an SRDF file (MoveIt), which has no links: give the path of the robot's URDF")]
    Srdf,
    /// The robot has no links.
    #[error("the robot has no links; a URDF has at least one")]
    NoLinks,
    /// An element or attribute is missing.
    #[error("{thing} has no {missing}: add it")]
    Missing {
        /// The element.
        thing: String,
        /// The missing element or attribute.
        missing: &'static str,
    },
    /// The value of an attribute is not allowed.
    #[error("{thing}: {attribute} = {value:?}: {allowed}")]
    Value {
        /// The element with the attribute.
        thing: String,
        /// The attribute.
        attribute: &'static str,
        /// The rejected value.
        value: String,
        /// The allowed values.
        allowed: String,
    },
    /// Two links or two joints have the same name.
    #[error("two {what}s are named {name:?}; each needs a unique name: rename one")]
    Duplicate {
        /// Kind of the two elements: `link` or `joint`.
        what: &'static str,
        /// The name that occurs twice.
        name: String,
    },
    /// A joint names a link that does not exist.
    #[error("joint {joint:?} has the {role} {link:?}, but there is no such link; similar names: {nearest}")]
    JointWithoutLink {
        /// Name of the joint.
        joint: String,
        /// Role of the link: `parent` or `child`.
        role: &'static str,
        /// Name of the missing link.
        link: String,
        /// Names of existing links that are similar.
        nearest: String,
    },
    /// Two joints move the same link.
    #[error(
        "link {link:?} is the child of the joints {first:?} and {second:?}; only one is allowed: remove the other"
    )]
    TwoParents {
        /// Name of the link.
        link: String,
        /// Name of the first joint.
        first: String,
        /// Name of the second joint.
        second: String,
    },
    /// A link is its own ancestor. The text names the link.
    #[error("link {0:?} is its own ancestor; links must form a tree: remove a joint of the cycle")]
    Cycle(String),
    /// Two links have no parent, so that the links form more than one tree.
    #[error(
        "the links {first:?} and {second:?} have no parent; only one root is allowed: connect them with a fixed joint"
    )]
    TwoRoots {
        /// Name of the first link without a parent.
        first: String,
        /// Name of the second link without a parent.
        second: String,
    },
    /// The requested link does not exist.
    #[error("there is no link {link:?}; similar names: {nearest}")]
    NoSuchLink {
        /// The requested name.
        link: String,
        /// Names of existing links that are similar.
        nearest: String,
    },
    /// The requested joint does not exist, or does not move by itself.
    #[error("there is no moving joint {joint:?}; similar names: {nearest}")]
    NoSuchJoint {
        /// The requested name.
        joint: String,
        /// Names of existing joints that are similar.
        nearest: String,
    },
    /// The rows of a chain in a skin differ from those of the same chain in the file.
    #[error(
        "the URDF and chain {chain:?} of the skin place the link behind joint {joint:?} differently: import the skin \
         from this file again, or correct the rows"
    )]
    OtherRows {
        /// Name of the first joint that differs.
        joint: String,
        /// Name of the chain.
        chain: String,
    },
    /// The tip of the chain is not below its root.
    #[error("link {tip:?} is not below {root:?}; the path to it is {path}: choose a root on that path")]
    NotBelow {
        /// Name of the tip link.
        tip: String,
        /// Name of the root link.
        root: String,
        /// Names of the links above the tip, beginning with the robot's root.
        path: String,
    },
    /// No joint of the chain moves.
    #[error(
        "no joint moves between {root:?} and {tip:?}, but a chain needs 1 to {MAX_JOINTS} moving joints: choose a tip \
         farther out, or a root nearer to the base"
    )]
    NoMovingJoint {
        /// Name of the root link.
        root: String,
        /// Name of the tip link.
        tip: String,
    },
    /// The chain has too many joints.
    #[error(
        "{count} joints move between {root:?} and {tip:?}; the maximum is {MAX_JOINTS}: choose a root and a tip that \
         are nearer to each other"
    )]
    TooManyJoints {
        /// Number of joints of the chain.
        count: usize,
        /// Name of the root link.
        root: String,
        /// Name of the tip link.
        tip: String,
    },
    /// The chain needs too many rows.
    #[error(
        "the chain to {tip:?} needs {count} rows; the maximum is {MAX_ROWS}: choose a root and a tip that are nearer \
         to each other"
    )]
    TooManyRows {
        /// Number of rows that the chain needs.
        count: usize,
        /// Name of the tip link.
        tip: String,
    },
    /// A joint of the chain is of a type with several degrees of freedom.
    #[error(
        "joint {joint:?} is {kind}; a chain may only have revolute, continuous, prismatic and fixed joints: choose a root below it, or a tip above it"
    )]
    Kind {
        /// Name of the joint.
        joint: String,
        /// Type of the joint.
        kind: &'static str,
    },
    /// A joint of the chain mimics another joint.
    #[error(
        "joint {joint:?} mimics {of:?}; the joints of a chain must move independently: choose a tip above it, or make it fixed"
    )]
    Mimic {
        /// Name of the joint.
        joint: String,
        /// Name of the joint that it mimics.
        of: String,
    },
    /// A revolute or prismatic joint has no limits.
    #[error(
        "joint {joint:?} has no limits: add <limit lower=\"..\" upper=\"..\"/>, or make the joint continuous or fixed"
    )]
    NoLimit {
        /// Name of the joint.
        joint: String,
    },
    /// The lower limit of a joint is not below the upper limit.
    #[error(
        "joint {joint:?} has the limits {lower} to {upper}; the lower must be below the upper, both finite: correct them, or make the joint fixed"
    )]
    Limits {
        /// Name of the joint.
        joint: String,
        /// The lower limit, in rad or m.
        lower: f64,
        /// The upper limit, in rad or m.
        upper: f64,
    },
    /// A length of a row exceeds the range of a cell's parameters.
    #[error(
        "row {row}, to {to}: {what} = {value:.3} m; allowed: [-{MAX_LENGTH_M}, {MAX_LENGTH_M}) m; {hint}"
    )]
    Length {
        /// Number of the row, from 1.
        row: usize,
        /// Name of the next joint, or of the tip link.
        to: String,
        /// The length: `a` or `d`, or `d` with the joint at a limit.
        what: &'static str,
        /// The length in m.
        value: f64,
        /// Advice for the user.
        hint: &'static str,
    },
    /// A cell on the chain can be farther from a joint than a cell can compute.
    #[error(
        "link {link:?} is too far from an earlier link of its chain: the distance can reach {reach:.3} m, but must be below \
         {MAX_REACH} m: choose a root and a tip that are nearer to each other"
    )]
    Reach {
        /// Name of the link.
        link: String,
        /// The reach of the link's origin in m.
        reach: f64,
    },
    /// The kinematics of the rows differs from that of the URDF.
    #[error(
        "the rows differ by {residual:.1e} m or rad from the URDF at link {link:?}; at most {MAX_RESIDUAL:.0e} is \
         allowed: please report this robot"
    )]
    Residual {
        /// Name of the link with the largest difference.
        link: String,
        /// The difference in m or rad.
        residual: f64,
    },
    /// A requested link does not move, because it is before the first joint of the chain.
    #[error(
        "link {link:?} is before the chain's first joint {joint:?}, so no joint moves it: put the cell on a link behind that joint"
    )]
    BeforeFirstJoint {
        /// Name of the link.
        link: String,
        /// Name of the first joint of the chain.
        joint: String,
    },
    /// A requested link is moved by a joint that is not in the chain.
    #[error(
        "link {link:?} is moved by joint {joint:?}, which is not between {root:?} and {tip:?}: choose another tip, or a link of the chain"
    )]
    OutsideChain {
        /// Name of the link.
        link: String,
        /// Name of the joint that moves it.
        joint: String,
        /// Name of the root link of the chain.
        root: String,
        /// Name of the tip link of the chain.
        tip: String,
    },
    /// A requested link is not below the root of the chain.
    #[error("link {link:?} is not below the chain's root {root:?}: choose a root above it")]
    AboveChain {
        /// Name of the link.
        link: String,
        /// Name of the root link of the chain.
        root: String,
    },
}
