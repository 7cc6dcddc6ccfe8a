//! Collects the schemas and channels of a damaged file from all places that describe them.
//!
//! A writer may describe a schema or channel in the chunk of its first message, again between chunks, and in the
//! summary. Descriptions of the same number may differ if the file is damaged. One that a checksum covers has
//! precedence over all others; among those without a checksum the most frequent one is used. If two are equally
//! frequent, neither is used, because a message under a wrong topic is worse than a lost one.

use std::collections::BTreeMap;
use std::io::{self, Write};

use crate::capture::is_foreign_frame;
use crate::container::{FormatError, NameBudget, Record, parse};
use crate::recording::file::{FileWriter, is_frame_channel};
use mcap::records::op;

/// The reliability of a description, by the checksum that covers it.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum DescriptionTrust {
    /// A correct checksum covers it.
    Certain,
    /// No checksum covers it.
    Unchecked,
    /// The checksum over it is wrong.
    Doubtful,
}

/// A description of a schema or channel, as its record stores it, and how often it occurs.
#[derive(Debug)]
struct Description {
    body: Vec<u8>,
    /// The number of occurrences that a correct checksum covers, and the number that no wrong checksum covers.
    certain: u32,
    times: u32,
}

/// All descriptions of each schema or channel, by its number.
type Descriptions = BTreeMap<u16, Vec<Description>>;

/// The descriptions of all schemas and channels in a file.
#[derive(Debug, Default)]
pub(super) struct DescriptionSet {
    schemas: Descriptions,
    channels: Descriptions,
    names: NameBudget,
}

impl DescriptionSet {
    /// Adds a description, if the record is a schema or a channel.
    pub(super) fn add(&mut self, code: u8, body: &[u8], trust: DescriptionTrust) -> Result<(), FormatError> {
        let (id, statements) = match parse(code, body)? {
            Record::Schema { id, .. } => (id, &mut self.schemas),
            Record::Channel { id, .. } => (id, &mut self.channels),
            Record::Header { .. }
            | Record::Message { .. }
            | Record::Attachment { .. }
            | Record::Metadata { .. }
            | Record::DataEnd { .. }
            | Record::Footer { .. }
            | Record::Other => return Ok(()),
        };
        let known = statements.entry(id).or_default();
        let place = known.iter().position(|it| it.body == body);
        let place = match place {
            Some(place) => place,
            None => {
                self.names.add(body.len())?;
                known.push(Description { body: body.to_vec(), certain: 0, times: 0 });
                known.len() - 1
            }
        };
        if let Some(statement) = known.get_mut(place) {
            statement.times = statement.times.saturating_add(u32::from(trust != DescriptionTrust::Doubtful));
            statement.certain =
                statement.certain.saturating_add(u32::from(trust == DescriptionTrust::Certain));
        }
        Ok(())
    }

    /// Writes the selected descriptions into a new file. Returns the numbers of the channels, each with true if its
    /// messages are frames.
    pub(super) fn write<W: Write>(&self, writer: &mut FileWriter<W>) -> io::Result<BTreeMap<u16, bool>> {
        let mut types = BTreeMap::new();
        for body in self.schemas.values().filter_map(|all| choose_description(all)) {
            if let Ok(Record::Schema { id, name, encoding, data }) = parse(op::SCHEMA, body)
                && id != 0
            {
                writer.add_schema_with_id(id, (name, encoding), data)?;
                types.insert(id, name.to_owned());
            }
        }
        let mut topics = BTreeMap::new();
        for body in self.channels.values().filter_map(|all| choose_description(all)) {
            let Ok(Record::Channel { id, schema, topic, encoding, facts }) = parse(op::CHANNEL, body) else {
                continue;
            };
            let of = types.get(&schema).map(String::as_str);
            if schema == 0 || of.is_some() {
                writer.add_channel_with_id((id, schema), (topic, encoding), &facts.into())?;
                let is_frames =
                    of.is_some_and(|of| is_frame_channel(topic, of) || is_foreign_frame(encoding, of));
                topics.insert(id, is_frames);
            }
        }
        Ok(topics)
    }
}

/// Returns the description to be used; `None` if two are equally reliable.
fn choose_description(all: &[Description]) -> Option<&[u8]> {
    let weight = |it: &Description| (it.certain, it.times);
    let best = all.iter().max_by_key(|it| weight(it))?;
    let equal = all.iter().filter(|it| weight(it) == weight(best)).count();
    (equal == 1).then_some(best.body.as_slice())
}
