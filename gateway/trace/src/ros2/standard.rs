//! Standard ROS 2 message types, which every viewer supports.

use super::cdr::{CdrWriter, Encode};
use super::{Header, Message, definition};

/// `sensor_msgs/JointState`: the joints of a robot. An array of unknown values is empty.
#[derive(Clone, Copy, Debug)]
pub struct JointState<'a> {
    /// The time, in ns since 1970.
    pub nanos: u64,
    /// The names of the joints.
    pub names: &'a [String],
    /// Positions in rad.
    pub position: &'a [f64],
    /// Velocities in rad/s.
    pub velocity: &'a [f64],
    /// Torques in Nm.
    pub effort: &'a [f64],
}

impl Message for JointState<'_> {
    const TYPE: &'static str = "sensor_msgs/msg/JointState";
    const DEFINITION: &'static str =
        definition!("sensor_msgs/JointState", "std_msgs/Header", "builtin_interfaces/Time");
}

impl Encode for JointState<'_> {
    fn encode(&self, out: &mut CdrWriter<'_>) {
        out.put(Header { nanos: self.nanos, frame_id: "" });
        out.put_sequence(self.names.iter().map(String::as_str));
        for values in [self.position, self.velocity, self.effort] {
            out.put_sequence(values.iter());
        }
    }
}

/// A point of a cloud: a cell with the force on it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// The position in the cloud's frame, in m.
    pub position: [f32; 3],
    /// The force, in N.
    pub force: f32,
}

/// `sensor_msgs/PointCloud2` with the fields x, y, z and force.
#[derive(Clone, Copy, Debug)]
pub struct PointCloud<'a> {
    /// The time, in ns since 1970.
    pub nanos: u64,
    /// The name of the frame in which positions are given.
    pub frame_id: &'a str,
    /// The points.
    pub points: &'a [Point],
}

impl PointCloud<'_> {
    /// The size of an encoded point, in bytes.
    const POINT_STEP_BYTES: u32 = 16;
    /// The `PointField` constant for single precision.
    const FLOAT32_FIELD_TYPE: u8 = 7;
}

impl Message for PointCloud<'_> {
    const TYPE: &'static str = "sensor_msgs/msg/PointCloud2";
    const DEFINITION: &'static str = definition!(
        "sensor_msgs/PointCloud2",
        "std_msgs/Header",
        "builtin_interfaces/Time",
        "sensor_msgs/PointField"
    );
}

impl Encode for PointCloud<'_> {
    fn encode(&self, out: &mut CdrWriter<'_>) {
        out.put(Header { nanos: self.nanos, frame_id: self.frame_id });
        let width = u32::try_from(self.points.len()).unwrap_or(u32::MAX);
        out.put((1_u32, width));
        let fields = [("x", 0_u32), ("y", 4), ("z", 8), ("force", 12)].into_iter();
        out.put_sequence(fields.map(|field| (field, (Self::FLOAT32_FIELD_TYPE, 1_u32))));
        out.put(false);
        out.put((Self::POINT_STEP_BYTES, Self::POINT_STEP_BYTES * width));
        out.put_count(self.points.len() * Self::POINT_STEP_BYTES as usize);
        for &Point { position: [x, y, z], force } in self.points {
            for value in [x, y, z, force] {
                out.put(value);
            }
        }
        out.put(true);
    }
}

/// The level of a diagnosis.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
#[repr(u8)]
pub enum DiagnosisLevel {
    /// Normal operation.
    Ok = 0,
    /// A working component that needs attention.
    Warn = 1,
    /// A failed component.
    Error = 2,
}

/// The state of one component.
#[derive(Clone, Debug)]
pub struct Diagnosis {
    /// The level.
    pub level: DiagnosisLevel,
    /// The name of the component.
    pub name: String,
    /// A description.
    pub message: String,
    /// Values by name.
    pub values: Vec<(&'static str, String)>,
}

/// `diagnostic_msgs/DiagnosticArray`: the states of components.
#[derive(Clone, Copy, Debug)]
pub struct Diagnostics<'a> {
    /// The time, in ns since 1970.
    pub nanos: u64,
    /// One diagnosis for each component.
    pub parts: &'a [Diagnosis],
}

impl Message for Diagnostics<'_> {
    const TYPE: &'static str = "diagnostic_msgs/msg/DiagnosticArray";
    const DEFINITION: &'static str = definition!(
        "diagnostic_msgs/DiagnosticArray",
        "std_msgs/Header",
        "builtin_interfaces/Time",
        "diagnostic_msgs/DiagnosticStatus",
        "diagnostic_msgs/KeyValue"
    );
}

impl Encode for Diagnostics<'_> {
    fn encode(&self, out: &mut CdrWriter<'_>) {
        out.put(Header { nanos: self.nanos, frame_id: "" });
        out.put_sequence(self.parts.iter());
    }
}

impl Encode for Diagnosis {
    fn encode(&self, out: &mut CdrWriter<'_>) {
        out.put((self.level as u8, self.name.as_str()));
        out.put((self.message.as_str(), ""));
        out.put_sequence(self.values.iter().map(|(name, value)| (*name, value.as_str())));
    }
}
