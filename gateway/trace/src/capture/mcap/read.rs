//! The entries of an MCAP recording, and what else it has.

use std::io::{BufReader, Chain, Cursor, Read};

use ::mcap::records::op;

use super::Fault;
use super::buses::Buses;
use super::state::{KEPT, State, Target};
use crate::capture::{Extras, Item};
use crate::container::{Chunk, Damage, Framed, LONGEST, MAGIC, Record, Source, parse};

/// Bytes that are read at once.
const PIECE: usize = 1 << 18;

type Input = BufReader<Chain<Cursor<Vec<u8>>, Box<dyn Read + Send>>>;

/// Reads the entries of a recording.
pub(crate) struct McapReader {
    source: Source<Input>,
    chunk: Chunk,
    place: Place,
    state: State,
    /// What was read when it was opened: the first requested message, or why there is none.
    first: Option<Result<Target, Fault>>,
    /// Where the record begins from which the next messages are, and how many of its messages were given out.
    anchor: (u64, u32),
}

/// Where a reader is in its file.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Place {
    Magic,
    Records,
    InChunk,
    Over,
}

impl McapReader {
    /// Goes on behind `head`, which has been read already.
    pub(crate) fn new(head: &[u8], input: Box<dyn Read + Send>, state: State) -> Self {
        let input = BufReader::with_capacity(PIECE, Cursor::new(head.to_vec()).chain(input));
        let (source, chunk) = (Source::new(input, KEPT as u64), Chunk::default());
        let mut reader = Self { source, chunk, place: Place::Magic, state, first: None, anchor: (0, 0) };
        // What stands before the first message is known from the beginning.
        reader.first = reader.advance().transpose();
        reader
    }

    /// Goes on at a record, which begins behind so many bytes, with what is known of the file.
    pub(crate) fn at(bytes: u64, input: Box<dyn Read + Send>, state: State) -> Self {
        let input = BufReader::with_capacity(PIECE, Cursor::new(Vec::new()).chain(input));
        let (source, chunk) = (Source::at(bytes, input, KEPT as u64), Chunk::default());
        Self { source, chunk, place: Place::Records, state, first: None, anchor: (bytes, 0) }
    }

    pub(crate) fn into_state(self) -> State {
        self.state
    }

    /// Where the record begins from which the next message is, unless it is from a later one, and how many of its
    /// messages come before.
    pub(crate) const fn anchor(&self) -> (u64, u32) {
        self.anchor
    }

    pub(crate) const fn extras(&self) -> &Extras {
        self.state.extras()
    }

    pub(crate) const fn buses(&self) -> &Buses {
        self.state.buses()
    }

    /// Returns true when a channel so far has frames of another program's type.
    pub(crate) fn has_foreign(&self) -> bool {
        self.state.has_foreign()
    }

    /// Whether nothing more comes. Reads on up to the next message, which [`McapReader::next`] then gives out.
    pub(crate) fn is_at_its_end(&mut self) -> Result<bool, Fault> {
        if self.first.is_none() {
            self.first = self.advance()?.map(Ok);
        }
        Ok(self.first.is_none())
    }

    /// The next entry, or message of another topic where these are requested. Never panics.
    pub(crate) fn next(&mut self) -> Result<Option<Item<'_>>, Fault> {
        let target = match self.first.take() {
            Some(first) => Some(first?),
            None => self.advance()?,
        };
        let Some(Target { channel, times, in_chunk }) = target else { return Ok(None) };
        self.anchor.1 += 1;
        let body = if in_chunk { self.chunk.body() } else { self.source.body() };
        let Ok(Record::Message { data, .. }) = parse(op::MESSAGE, body) else { return Ok(None) };
        Ok(Some(self.state.item(channel, times, data)))
    }

    /// Reads up to the next requested message.
    fn advance(&mut self) -> Result<Option<Target>, Fault> {
        while self.place != Place::Over {
            match self.step() {
                Ok(None) => {}
                Ok(target) => return Ok(target),
                Err(fault) => {
                    self.place = Place::Over;
                    return Err(fault);
                }
            }
        }
        Ok(None)
    }

    /// Reads on by a record.
    fn step(&mut self) -> Result<Option<Target>, Fault> {
        let Self { source, chunk, place, state, anchor, .. } = self;
        let began = source.read();
        match place {
            Place::Over => {}
            Place::Magic => {
                *place = Place::Records;
                self.take_magic()?;
            }
            Place::InChunk => match chunk.next() {
                Some((opcode @ (op::SCHEMA | op::CHANNEL | op::MESSAGE), body)) => {
                    return state.take(opcode, body, true);
                }
                Some(_) => {}
                None => *place = Place::Records,
            },
            Place::Records => match source.next()? {
                Framed::Record(op::CHUNK) => {
                    chunk.unpack(source.body(), source.read())?;
                    (*place, *anchor) = (Place::InChunk, (began, 0));
                }
                Framed::Record(op::DATA_END) => source.check_section(op::DATA_END)?,
                Framed::Record(op::FOOTER) => {
                    *place = Place::Over;
                    self.take_magic()?;
                }
                Framed::Record(opcode) => {
                    let target = state.take(opcode, source.body(), false)?;
                    if target.is_some() {
                        *anchor = (began, 0);
                    }
                    return Ok(target);
                }
                Framed::Long(op::ATTACHMENT, _) => state.attachment(source.attachment_name(), &[]),
                Framed::Long(_, bytes) => {
                    return Err(Damage::Long { what: "record", bytes, limit: LONGEST }.into());
                }
                Framed::Unknown(..) => {}
                Framed::End(_) => self.truncated(),
            },
        }
        Ok(None)
    }

    /// The magic bytes, which have to be here.
    fn take_magic(&mut self) -> Result<(), Fault> {
        if !self.source.magic()? {
            if !MAGIC.starts_with(self.source.body()) {
                return Err(Damage::Magic.into());
            }
            self.truncated();
        }
        Ok(())
    }

    fn truncated(&mut self) {
        self.place = Place::Over;
        self.state.truncated(self.source.read());
    }
}
