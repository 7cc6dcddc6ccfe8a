//! Names the buses of frames that other programs recorded. The topic and the `frame_id` of a message together identify
//! its bus.
//!
//! ```text
//! /can0/from_can_bus  can ──┬─ one frame_id ──> /can0/from_can_bus
//! /can1/from_can_bus  can ──┘                   /can1/from_can_bus
//! /left               can7 ───────────────────> can7
//! ```
//!
//! ROS nodes write the same `frame_id` whatever their interface is. All pairs of a file are known from the beginning.
//! In a pipe, whose pairs are not known in advance, the first topic with a `frame_id` uses it as the name of its bus;
//! later topics get their own names.

use std::collections::{HashMap, HashSet};

/// The maximum number of pairs of topic and `frame_id`. Frames of further pairs are named by their `frame_id`.
const MAX_TOPIC_FRAME_ID_PAIRS: usize = 4_096;
/// The maximum length of a bus name made from a topic, in bytes.
const MAX_NAME_BYTES: usize = 255;

/// The names of the buses in a recording of another program.
#[derive(Clone, Debug, Default)]
pub(crate) struct ForeignBusNames {
    /// The name of the bus, by topic and `frame_id`.
    names: HashMap<String, HashMap<String, String>>,
    /// The topics that use each `frame_id`.
    topics: HashMap<String, HashSet<String>>,
    /// Pairs of topic and `frame_id`, in the order of their first frames.
    pairs: Vec<(String, String)>,
    taken: HashSet<String>,
    is_shared: bool,
}

impl ForeignBusNames {
    /// Returns the name of the bus for a message with this topic and `frame_id`.
    pub(super) fn name<'a>(&'a mut self, topic: &str, frame_id: &'a str) -> &'a str {
        let is_known = self.names.get(topic).is_some_and(|names| names.contains_key(frame_id));
        if !is_known && self.pairs.len() < MAX_TOPIC_FRAME_ID_PAIRS {
            self.topics.entry(frame_id.to_owned()).or_default().insert(topic.to_owned());
            self.pairs.push((topic.to_owned(), frame_id.to_owned()));
            self.assign(topic, frame_id);
        }
        self.names.get(topic).and_then(|names| names.get(frame_id)).map_or(frame_id, String::as_str)
    }

    /// Returns the names with all pairs taken into account: buses whose topics share a `frame_id` are named by their
    /// topics.
    pub(crate) fn renamed_with_all_pairs(self) -> Self {
        let mut all = Self { topics: self.topics, ..Self::default() };
        for (topic, frame_id) in &self.pairs {
            all.assign(topic, frame_id);
        }
        Self { pairs: self.pairs, ..all }
    }

    /// Returns true if several topics share one `frame_id`.
    pub(crate) const fn is_frame_id_shared(&self) -> bool {
        self.is_shared
    }

    /// Assigns a unique bus name to a pair of topic and `frame_id`.
    fn assign(&mut self, topic: &str, frame_id: &str) {
        let is_shared = self.topics.get(frame_id).is_some_and(|topics| topics.len() > 1);
        let own = Some(frame_id).filter(|name| !name.is_empty() && !is_shared).map(str::to_owned);
        self.is_shared |= is_shared && !frame_id.is_empty();
        let short = truncate_topic(topic);
        let further = (1..).map(|number| match number {
            1 => format!("{short}/{frame_id}"),
            _ => format!("{short}/{frame_id}-{number}"),
        });
        let mut candidates = own.into_iter().chain([short.to_owned()]).chain(further);
        let Some(name) = candidates.find(|name| !self.taken.contains(name)) else { return };
        self.taken.insert(name.clone());
        self.names.entry(topic.to_owned()).or_default().insert(frame_id.to_owned(), name);
    }
}

/// Returns the beginning of a topic's name, at most [`MAX_NAME_BYTES`] bytes long.
pub(super) fn truncate_topic(topic: &str) -> &str {
    let ends = (0..=MAX_NAME_BYTES.min(topic.len())).rev();
    ends.filter_map(|end| topic.get(..end)).next().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn named(buses: &mut ForeignBusNames, pairs: &[(&str, &str)]) -> Vec<String> {
        pairs.iter().map(|(topic, frame_id)| buses.name(topic, frame_id).to_owned()).collect()
    }

    #[test]
    fn a_frame_id_of_one_topic_is_the_bus() {
        let mut buses = ForeignBusNames::default();
        let pairs = [("/a", "can0"), ("/a", "can1"), ("/b", "can7"), ("/c", ""), ("/a", "can0")];
        assert_eq!(named(&mut buses, &pairs), ["can0", "can1", "can7", "/c", "can0"]);
        assert!(!buses.is_frame_id_shared());
    }

    #[test]
    fn topics_with_one_frame_id_are_buses_of_their_own() {
        let pairs = [("/can0/in", "can"), ("/can1/in", "can"), ("/can1/in", "other")];
        let mut buses = ForeignBusNames::default();
        assert_eq!(named(&mut buses, &pairs), ["can", "/can1/in", "other"], "of a pipe");
        let mut buses = buses.renamed_with_all_pairs();
        assert_eq!(named(&mut buses, &pairs), ["/can0/in", "/can1/in", "other"], "of a file");
        assert!(buses.is_frame_id_shared());
    }

    proptest! {
        #[test]
        fn two_buses_never_become_one(
            pairs in proptest::collection::vec(("/[ab]{1,2}(/x)?", "(/?[ab]{1,2}|can|/a/x|)"), 1..40), settled: bool
        ) {
            let pairs: Vec<_> = pairs.iter().map(|(topic, name)| (topic.as_str(), name.as_str())).collect();
            let mut buses = ForeignBusNames::default();
            let mut names = named(&mut buses, &pairs);
            if settled {
                buses = buses.renamed_with_all_pairs();
                names = named(&mut buses, &pairs);
            }
            let different: HashSet<_> = pairs.iter().collect();
            prop_assert_eq!(names.iter().collect::<HashSet<_>>().len(), different.len());
            prop_assert_eq!(named(&mut buses, &pairs), names, "and they stay");
        }
    }
}
