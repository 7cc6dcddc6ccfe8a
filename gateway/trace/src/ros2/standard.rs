//! Types that ROS 2 has: every viewer knows what to make of them.

use super::Message;
use super::cdr::Writer;
use super::messages::{header, write_header};

/// `sensor_msgs/JointState`: a robot's joints. What is not known is empty.
#[derive(Clone, Copy, Debug)]
pub struct JointState<'a> {
    /// When, in ns since 1970.
    pub nanos: u64,
    /// The joints' names.
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
    const DEFINITION: &'static str = concat!(
        "\
std_msgs/Header header
string[] name
float64[] position    # rad
float64[] velocity    # rad/s
float64[] effort      # Nm

",
        header!()
    );

    fn write(&self, out: &mut Writer<'_>) {
        write_header(out, self.nanos, "");
        out.sequence(self.names.iter(), |out, name| out.str(name));
        for values in [self.position, self.velocity, self.effort] {
            out.sequence(values.iter(), |out, &value| out.f64(value));
        }
    }
}

/// A point of a cloud, and the force there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Where, in m, in the cloud's frame.
    pub position: [f32; 3],
    /// In N.
    pub force: f32,
}

/// `sensor_msgs/PointCloud2` with the fields x, y, z and force.
#[derive(Clone, Copy, Debug)]
pub struct PointCloud<'a> {
    /// When, in ns since 1970.
    pub nanos: u64,
    /// The frame that positions are in.
    pub frame_id: &'a str,
    /// The points.
    pub points: &'a [Point],
}

impl PointCloud<'_> {
    /// Bytes of a point.
    const STEP: u32 = 16;
    /// The number that stands for single precision.
    const FLOAT32: u8 = 7;
}

impl Message for PointCloud<'_> {
    const TYPE: &'static str = "sensor_msgs/msg/PointCloud2";
    const DEFINITION: &'static str = concat!(
        "\
std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense

",
        header!(),
        "
================================================================================
MSG: sensor_msgs/PointField
uint8 INT8    = 1
uint8 UINT8   = 2
uint8 INT16   = 3
uint8 UINT16  = 4
uint8 INT32   = 5
uint8 UINT32  = 6
uint8 FLOAT32 = 7
uint8 FLOAT64 = 8
string name
uint32 offset
uint8 datatype
uint32 count
"
    );

    fn write(&self, out: &mut Writer<'_>) {
        write_header(out, self.nanos, self.frame_id);
        let width = u32::try_from(self.points.len()).unwrap_or(u32::MAX);
        out.u32(1);
        out.u32(width);
        out.sequence([("x", 0), ("y", 4), ("z", 8), ("force", 12)].into_iter(), |out, (name, offset)| {
            out.str(name);
            out.u32(offset);
            out.u8(Self::FLOAT32);
            out.u32(1);
        });
        out.bool(false);
        out.u32(Self::STEP);
        out.u32(Self::STEP * width);
        out.count(self.points.len() * Self::STEP as usize);
        for point in self.points {
            let [x, y, z] = point.position;
            for value in [x, y, z, point.force] {
                for byte in value.to_le_bytes() {
                    out.u8(byte);
                }
            }
        }
        out.bool(true);
    }
}

/// How something is.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
#[repr(u8)]
pub enum Level {
    /// As it should be.
    Ok = 0,
    /// It works, and somebody should look.
    Warn = 1,
    /// It does not work.
    Error = 2,
}

/// How one part of a system is.
#[derive(Clone, Debug)]
pub struct Diagnosis {
    /// How.
    pub level: Level,
    /// Of what.
    pub name: String,
    /// In words.
    pub message: String,
    /// Figures, by name.
    pub values: Vec<(&'static str, String)>,
}

/// `diagnostic_msgs/DiagnosticArray`: how the parts of a system are.
#[derive(Clone, Copy, Debug)]
pub struct Diagnostics<'a> {
    /// When, in ns since 1970.
    pub nanos: u64,
    /// Each part.
    pub parts: &'a [Diagnosis],
}

impl Message for Diagnostics<'_> {
    const TYPE: &'static str = "diagnostic_msgs/msg/DiagnosticArray";
    const DEFINITION: &'static str = concat!(
        "\
std_msgs/Header header
diagnostic_msgs/DiagnosticStatus[] status

",
        header!(),
        "
================================================================================
MSG: diagnostic_msgs/DiagnosticStatus
byte OK=0
byte WARN=1
byte ERROR=2
byte STALE=3
byte level
string name
string message
string hardware_id
diagnostic_msgs/KeyValue[] values

================================================================================
MSG: diagnostic_msgs/KeyValue
string key
string value
"
    );

    fn write(&self, out: &mut Writer<'_>) {
        write_header(out, self.nanos, "");
        out.sequence(self.parts.iter(), |out, part| {
            out.u8(part.level as u8);
            out.str(&part.name);
            out.str(&part.message);
            out.str("");
            out.sequence(part.values.iter(), |out, (key, value)| {
                out.str(key);
                out.str(value);
            });
        });
    }
}
