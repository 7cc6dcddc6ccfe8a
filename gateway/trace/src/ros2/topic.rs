//! The descriptions of ROS 2 topics in a recording: encodings and quality of service.

/// The encoding of messages.
pub const MESSAGE_ENCODING: &str = "cdr";
/// The language of the definitions of message types.
pub const SCHEMA_ENCODING: &str = "ros2msg";
/// The key of a channel's metadata that holds the quality of service with which a topic was offered. Bag tools require
/// it, and accept an empty value.
pub const QOS_KEY: &str = "offered_qos_profiles";
/// The quality of service that bag tools store for latched topics: readers that join later get the last message.
pub const LATCHED_QOS: &str = "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n  deadline:\n    \
     sec: 9223372036\n    nsec: 854775807\n  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n  liveliness: 1\n  \
     liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n  \
     avoid_ros_namespace_conventions: false\n";

/// Returns true if readers that join later need the last message of a topic with this quality of service.
#[must_use]
pub fn is_latched(qos: &str) -> bool {
    qos.contains("durability: 1\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn latched_topics_are_known_by_their_durability() {
        assert!(is_latched(LATCHED_QOS));
        assert!(!is_latched("") && !is_latched(&LATCHED_QOS.replace("durability: 1", "durability: 2")));
    }
}
