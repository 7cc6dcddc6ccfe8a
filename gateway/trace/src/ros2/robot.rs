//! ROS 2 message types that show a robot: the poses of its links, and its description.

use super::cdr::{CdrWriter, Encode};
use super::{Header, Message, definition};

/// The pose of a coordinate frame relative to its parent frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transform<'a> {
    /// The name of the parent frame.
    pub parent: &'a str,
    /// The name of the frame.
    pub child: &'a str,
    /// The translation in m.
    pub translation: [f64; 3],
    /// A unit quaternion: x, y, z, w.
    pub rotation: [f64; 4],
}

/// `tf2_msgs/TFMessage`: the poses of coordinate frames.
#[derive(Clone, Copy, Debug)]
pub struct Transforms<'a> {
    /// The time, in ns since 1970.
    pub nanos: u64,
    /// One transform for each frame.
    pub transforms: &'a [Transform<'a>],
}

impl Message for Transforms<'_> {
    const TYPE: &'static str = "tf2_msgs/msg/TFMessage";
    const DEFINITION: &'static str = definition!(
        "tf2_msgs/TFMessage",
        "geometry_msgs/TransformStamped",
        "std_msgs/Header",
        "builtin_interfaces/Time",
        "geometry_msgs/Transform",
        "geometry_msgs/Vector3",
        "geometry_msgs/Quaternion"
    );
}

impl Encode for Transforms<'_> {
    fn encode(&self, out: &mut CdrWriter<'_>) {
        out.put_sequence(self.transforms.iter().map(|transform| StampedTransform(self.nanos, transform)));
    }
}

/// `geometry_msgs/TransformStamped`.
struct StampedTransform<'a>(u64, &'a Transform<'a>);

impl Encode for StampedTransform<'_> {
    fn encode(&self, out: &mut CdrWriter<'_>) {
        let Self(nanos, Transform { parent, child, translation, rotation }) = self;
        out.put(Header { nanos: *nanos, frame_id: parent });
        out.put(*child);
        translation.iter().chain(rotation).for_each(|number| out.put(number));
    }
}

/// `std_msgs/String`.
#[derive(Clone, Copy, Debug)]
pub struct StringMessage<'a>(pub &'a str);

impl Message for StringMessage<'_> {
    const TYPE: &'static str = "std_msgs/msg/String";
    const DEFINITION: &'static str = definition!("std_msgs/String");
}

impl Encode for StringMessage<'_> {
    fn encode(&self, out: &mut CdrWriter<'_>) {
        out.put(self.0);
    }
}
