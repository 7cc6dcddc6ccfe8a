//! A look at the topics of a recording for frames of other programs, before it is read.

use std::collections::HashSet;
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};

use ::mcap::records::op;

use super::buses::Buses;
use super::foreign::Foreign;
use super::read::McapReader;
use super::state::State;
use crate::container::{LONGEST_DESCRIPTION, MAGIC, Record, find, parse};

/// Topics that are counted.
const TOPICS: usize = 4_096;

/// Finds out the buses of recordings whose frames other programs wrote.
#[derive(Debug, Default)]
pub(crate) struct Survey {
    topics: HashSet<String>,
    /// Set by a file without channels outside of its chunks.
    is_silent: bool,
}

impl Survey {
    /// Takes in the topics of a file, which its summary repeats; its place is moved.
    ///
    /// # Errors
    /// When it cannot be read.
    pub(crate) fn look(&mut self, file: &mut File) -> io::Result<()> {
        let mut from = BufReader::with_capacity(4 << 10, file);
        from.seek(SeekFrom::Start(MAGIC.len() as u64))?;
        let mut schemas = HashSet::new();
        let mut says = false;
        while let Some((opcode, length)) = find(&mut from, &[op::SCHEMA, op::CHANNEL, op::FOOTER])? {
            if opcode == op::FOOTER {
                self.is_silent |= !says;
                return Ok(());
            }
            let mut body = Vec::new();
            (&mut from).take(length.min(LONGEST_DESCRIPTION as u64)).read_to_end(&mut body)?;
            if body.len() as u64 != length {
                break;
            }
            match parse(opcode, &body) {
                Ok(Record::Schema { id, name, .. }) => _ = schemas.insert((id, name.to_owned())),
                Ok(Record::Channel { schema, topic, encoding, .. }) => {
                    says = true;
                    let is_of =
                        |name: &&(u16, String)| name.0 == schema && Foreign::of(encoding, &name.1).is_some();
                    if self.topics.len() < TOPICS && schemas.iter().any(|name| is_of(&name)) {
                        self.topics.insert(topic.to_owned());
                    }
                }
                _ => {}
            }
        }
        self.is_silent = true;
        Ok(())
    }

    /// Returns true when only reading all messages tells the buses.
    pub(crate) fn is_needed(&self) -> bool {
        self.is_silent || self.topics.len() > 1
    }

    /// Reads the frames of a recording for their buses, beside those that are known.
    pub(crate) fn buses_of(&self, input: Box<dyn Read + Send>, known: Buses) -> Buses {
        let mut reader = McapReader::new(&[], input, State::new(false, None).with_buses(known), None);
        // Where topics are not known, the first messages are of the frames' type.
        if self.topics.len() > 1 || reader.has_foreign() {
            // Its faults are reported when it is read.
            while let Ok(Some(_)) = reader.next() {}
        }
        reader.into_state().into_buses()
    }
}
