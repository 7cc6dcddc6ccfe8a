//! What is wrong with a robot's file, or with the chain that was asked for.

use thiserror::Error;

use protocol::parameters::{MAX_JOINTS, MAX_ROWS};
use protocol::skin::REACH;

use crate::rows::{MAX_LENGTH_M, MAX_RESIDUAL};

/// What is wrong, and in which file: one line.
#[derive(Clone, Debug, Error, PartialEq)]
#[error("{file}{}: {problem}", line.map_or_else(String::new, |line| format!(":{line}")))]
pub struct RobotError {
    /// The file's name, as it was given.
    pub file: String,
    /// The line, from 1, where the file has it.
    pub line: Option<u32>,
    /// What is wrong.
    pub problem: Box<Problem>,
}

impl RobotError {
    /// An error in a file.
    pub(crate) fn new(file: &str, line: Option<u32>, problem: Problem) -> Self {
        Self { file: file.to_owned(), line, problem: Box::new(problem) }
    }
}

/// What is wrong with a robot's file, or with a chain of it.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum Problem {
    /// There is nothing in the file.
    #[error("the file is empty; a URDF has a robot element with links and joints")]
    Empty,
    /// It does not begin as XML does.
    #[error("not XML: a URDF begins with <?xml or <robot, and this does not; name the robot's URDF")]
    NotXml,
    /// It is not XML that can be read: what there is, and what to do.
    #[error("{0}")]
    Xml(String),
    /// It is a template of a URDF.
    #[error(
        "{what} is left: this is a xacro file, a template of a URDF. Make one with `xacrodoc {file} -o NEW.urdf` (pip install xacrodoc), and name that"
    )]
    Xacro {
        /// The element or expression.
        what: String,
        /// The file.
        file: String,
    },
    /// It is XML of another kind.
    #[error("the outermost element is {0}; a URDF has `robot`: name the robot's URDF")]
    NotARobot(String),
    /// It says which of a robot's joints belong together.
    #[error("an SRDF file, of MoveIt, which has no links: name the robot's URDF")]
    Srdf,
    /// There are no links.
    #[error("the robot has no links; a URDF has at least one")]
    NoLinks,
    /// An element or attribute is missing.
    #[error("{thing} has no {missing}: add it")]
    Missing {
        /// The element.
        thing: String,
        /// What it lacks.
        missing: &'static str,
    },
    /// A value is not what is allowed.
    #[error("{thing}: {attribute} = {value:?}: {allowed}")]
    Value {
        /// The element.
        thing: String,
        /// The attribute.
        attribute: &'static str,
        /// What it says.
        value: String,
        /// What is allowed.
        allowed: String,
    },
    /// A name is there twice.
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
        /// The name.
        link: String,
        /// Names like it.
        nearest: String,
    },
    /// Two joints move the same link.
    #[error(
        "link {link:?} is the child of the joints {first:?} and {second:?}; one is allowed: remove the other"
    )]
    TwoParents {
        /// The link.
        link: String,
        /// A joint.
        first: String,
        /// Another.
        second: String,
    },
    /// Links are each other's parents.
    #[error("link {0:?} is above itself; links must be a tree: remove a joint of the cycle")]
    Cycle(String),
    /// There are two trees.
    #[error(
        "the links {first:?} and {second:?} have no parent; one root is allowed: connect them with a fixed joint"
    )]
    TwoRoots {
        /// A root.
        first: String,
        /// Another.
        second: String,
    },
    /// A link is asked for that does not exist.
    #[error("there is no link {link:?}; the nearest are {nearest}")]
    NoSuchLink {
        /// What was asked for.
        link: String,
        /// Names like it.
        nearest: String,
    },
    /// A joint is asked for that does not exist, or does not move by itself.
    #[error("no joint {joint:?} moves; the nearest are {nearest}")]
    NoSuchJoint {
        /// What was asked for.
        joint: String,
        /// Names like it.
        nearest: String,
    },
    /// A chain of a skin is another one than that of the file.
    #[error(
        "behind joint {joint:?} it is not where chain {chain:?} of the skin has it: import the skin from this file again, or correct the rows"
    )]
    OtherRows {
        /// The joint.
        joint: String,
        /// The chain.
        chain: String,
    },
    /// The chain's end is not below its start.
    #[error("link {tip:?} is not below {root:?}; the path to it is {path}: choose a root on it")]
    NotBelow {
        /// The chain's end.
        tip: String,
        /// The chain's start.
        root: String,
        /// The links above the end, from the root.
        path: String,
    },
    /// No joint of the chain moves.
    #[error(
        "no joint moves between {root:?} and {tip:?}; 1 to {MAX_JOINTS} are needed: choose a tip farther out, or a root nearer to the base"
    )]
    NoMovingJoint {
        /// The chain's start.
        root: String,
        /// The chain's end.
        tip: String,
    },
    /// The chain has too many joints.
    #[error(
        "{count} joints move between {root:?} and {tip:?}; {MAX_JOINTS} are possible: choose a root or a tip nearer to the other"
    )]
    TooManyJoints {
        /// How many.
        count: usize,
        /// The chain's start.
        root: String,
        /// The chain's end.
        tip: String,
    },
    /// The chain needs too many rows.
    #[error(
        "the chain to {tip:?} needs {count} rows; {MAX_ROWS} are possible: choose a root or a tip nearer to the other"
    )]
    TooManyRows {
        /// How many.
        count: usize,
        /// The chain's end.
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
        /// The one that it follows.
        of: String,
    },
    /// A joint says nothing of its limits.
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
        /// In rad or m.
        lower: f64,
        /// In rad or m.
        upper: f64,
    },
    /// A length does not fit a cell's words.
    #[error(
        "row {row}, to {to}: {what} = {value:.3} m; [-{MAX_LENGTH_M}, {MAX_LENGTH_M}) m is possible: {hint}"
    )]
    Length {
        /// The row, from 1.
        row: usize,
        /// The joint that comes next, or the tip.
        to: String,
        /// `a` or `d`, or `d` with the joint at a limit.
        what: &'static str,
        /// In m.
        value: f64,
        /// The hint, as an order.
        hint: &'static str,
    },
    /// The chain is longer than a cell can compute.
    #[error(
        "link {link:?} can come {reach:.3} m from a frame of the rows below it, if all joints turn freely; less than {REACH} m is possible: choose a tip or a root nearer to the other"
    )]
    Reach {
        /// The link.
        link: String,
        /// In m.
        reach: f64,
    },
    /// Rows and URDF do not agree.
    #[error(
        "the rows differ by {residual:.1e} m or rad from the URDF at link {link:?}; {MAX_RESIDUAL:.0e} is allowed: please report this robot"
    )]
    Residual {
        /// The link.
        link: String,
        /// In m or rad.
        residual: f64,
    },
    /// A link does not move.
    #[error(
        "link {link:?} is before the chain's first joint {joint:?} and moves with none; a cell needs a link behind it"
    )]
    BeforeFirstJoint {
        /// The link.
        link: String,
        /// The chain's first joint.
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
        /// The chain's start.
        root: String,
        /// The chain's end.
        tip: String,
    },
    /// A link that is not above nor below anything of the chain.
    #[error("link {link:?} is not below the chain's root {root:?}: choose a root above it")]
    AboveChain {
        /// The link.
        link: String,
        /// The chain's start.
        root: String,
    },
}
