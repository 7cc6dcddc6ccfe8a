//! Reads robots from the text of URDF files, and converts a chain of joints to standard Denavit-Hartenberg rows. This
//! crate opens no files itself.
//!
//! ```
//! # fn main() -> Result<(), robots::RobotError> {
//! let xml = r#"<robot name="pendulum">
//!   <link name="base"/>
//!   <link name="arm"/>
//!   <joint name="hinge" type="revolute">
//!     <parent link="base"/> <child link="arm"/>
//!     <origin xyz="0 0 0.5"/> <axis xyz="0 1 0"/> <limit lower="-1" upper="1" velocity="2"/>
//!   </joint>
//! </robot>"#;
//! let urdf = robots::Urdf::parse("pendulum.urdf", xml)?;
//! let chain = urdf.chain(None, "arm")?;
//! assert_eq!(chain.joints.len(), 1);
//! assert!(chain.residual < 1e-12);
//! # Ok(())
//! # }
//! ```
//!
//! | module | what |
//! |---|---|
//! | `urdf` | a parsed file: links, joints, shapes, and its own kinematics |
//! | `describe` | writing a skin for chains and cells |
//! | `links` | the pose of each link on its parent, for given positions of joints |
//! | `taken` | unique names for output |
//! | `written` | writing a URDF for the chains of a skin |
//! | `chain` | the joints between two links, with rows and the frame of each link |
//! | `rows` | rows, and how one axis leads to the next |

mod chain;
mod describe;
mod error;
mod links;
mod nearest;
mod residual;
mod rows;
mod taken;
mod urdf;
mod written;

pub use chain::{ChainJoint, LinkFrame, UrdfChain};
pub use describe::{CellOnLink, DEFAULT_CELLS_PER_BUS, ImportError, SkinImport};
pub use error::{RobotError, RobotProblem};
pub use links::LinkPose;
pub use nalgebra::Isometry3;
pub use protocol::parameters::RowKind;
pub use protocol::skin::JointKind;
pub use rows::{DhRow, MAX_LENGTH_M, MAX_RESIDUAL, chain_base_pose, frames};
pub use taken::{UniqueNames, chain_prefixes, sanitized};
pub use urdf::{Geometry, Shape, Urdf, decode_text};
pub use written::{WrittenUrdf, write_urdf};

#[cfg(test)]
mod tests;
