//! Finds out which topics of a recording hold frames of other programs, before the recording is read.

use std::collections::HashSet;
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};

use ::mcap::records::op;

use super::buses::ForeignBusNames;
use super::foreign::ForeignMessageType;
use super::read::McapReader;
use super::state::McapState;
use crate::container::{MAGIC, MAX_DESCRIPTION_BYTES, Record, parse, seek_record};

/// The maximum number of topics that are stored.
const MAX_TOPICS: usize = 4_096;

/// The topics of one or more recordings that hold frames of other programs.
#[derive(Debug, Default)]
pub(crate) struct TopicSurvey {
    topics: HashSet<String>,
    /// True once a file had no channel records outside of its chunks, so that its topics are unknown.
    has_hidden_channels: bool,
}

impl TopicSurvey {
    /// Adds the topics of a file from its summary. Changes the position in the file.
    ///
    /// # Errors
    /// Returns an error if the file cannot be read.
    pub(crate) fn add_file(&mut self, file: &mut File) -> io::Result<()> {
        let mut from = BufReader::with_capacity(4 << 10, file);
        from.seek(SeekFrom::Start(MAGIC.len() as u64))?;
        let mut schemas = HashSet::new();
        let mut says = false;
        while let Some((opcode, length)) = seek_record(&mut from, &[op::SCHEMA, op::CHANNEL, op::FOOTER])? {
            if opcode == op::FOOTER {
                self.has_hidden_channels |= !says;
                return Ok(());
            }
            let mut body = Vec::new();
            (&mut from).take(length.min(MAX_DESCRIPTION_BYTES as u64)).read_to_end(&mut body)?;
            if body.len() as u64 != length {
                break;
            }
            match parse(opcode, &body) {
                Ok(Record::Schema { id, name, .. }) => _ = schemas.insert((id, name.to_owned())),
                Ok(Record::Channel { schema, topic, encoding, .. }) => {
                    says = true;
                    let is_of = |name: &&(u16, String)| {
                        name.0 == schema && ForeignMessageType::from_schema(encoding, &name.1).is_some()
                    };
                    if self.topics.len() < MAX_TOPICS && schemas.iter().any(|name| is_of(&name)) {
                        self.topics.insert(topic.to_owned());
                    }
                }
                _ => {}
            }
        }
        self.has_hidden_channels = true;
        Ok(())
    }

    /// Returns true if all messages must be read to find the bus names.
    pub(crate) fn must_read_messages(&self) -> bool {
        self.has_hidden_channels || self.topics.len() > 1
    }

    /// Reads the frames of a recording and returns the `known` bus names with those of these frames.
    pub(crate) fn bus_names_of(
        &self,
        input: Box<dyn Read + Send>,
        known: ForeignBusNames,
    ) -> ForeignBusNames {
        let mut reader = McapReader::new(&[], input, McapState::new(false, None).with_buses(known), None);
        // If the topics are unknown, the types of the first messages show whether there are frames of other programs.
        if self.topics.len() > 1 || reader.has_foreign() {
            // Errors are reported when the recording is read.
            while let Ok(Some(_)) = reader.next() {}
        }
        reader.into_state().into_buses()
    }
}
