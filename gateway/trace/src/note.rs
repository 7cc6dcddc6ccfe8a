//! Notes of a capture: comments, reports of lost frames, and lines that are not frames.

/// An entry of a capture that is not a frame but has a position between frames.
#[derive(Clone, Debug, PartialEq)]
pub struct CaptureNote<'a> {
    /// The kind of the note.
    pub kind: NoteKind,
    /// The time, in ns since 1970. In a log this is the time of the preceding frame, or 0 before the first frame.
    pub nanos: u64,
    /// The bus that the note is about; empty if it is about none.
    pub interface: &'a str,
    /// The line number in a log, from 1; 0 if the note does not come from a log.
    pub line: u64,
    /// The line of the log without its line end, or the text that the recorder wrote.
    pub text: &'a [u8],
}

/// The kind of a note.
#[derive(Clone, Debug, Eq, PartialEq)]
pub enum NoteKind {
    /// A comment, an empty line, or another line that can-utils ignore too.
    Text,
    /// A report that the recorder lost this number of frames here.
    Dropped(u64),
    /// A CAN XL frame, which is not decoded.
    CanXl,
    /// A line that begins like a frame but cannot be parsed, with the reason.
    Unreadable(String),
}

/// A change in the state of a bus, as noted by the recorder. The capture has no frames of the bus between
/// [`BusNote::Lost`] and [`BusNote::Back`].
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum BusNote {
    /// The bus was lost.
    Lost,
    /// The bus works again.
    Back,
}

impl BusNote {
    const ALL: [Self; 2] = [Self::Lost, Self::Back];

    const fn text_suffix(self) -> &'static str {
        match self {
            Self::Lost => "' was lost",
            Self::Back => "' works again",
        }
    }

    /// Returns the text of the note.
    #[must_use]
    pub fn text(self, bus: &str) -> String {
        format!("{BUS_NOTE_PREFIX}{bus}{}", self.text_suffix())
    }

    /// Parses a note. Returns the bus and its new state, or `None` if the note is not about the state of a bus.
    #[must_use]
    pub fn parse<'a>(note: &CaptureNote<'a>) -> Option<(&'a str, Self)> {
        let text = core::str::from_utf8(note.text).ok().filter(|_| note.kind == NoteKind::Text)?;
        // In a log the note is a comment.
        let text = text.strip_prefix("# ").unwrap_or(text);
        let of = |it: Self| Some((text.strip_prefix(BUS_NOTE_PREFIX)?.strip_suffix(it.text_suffix())?, it));
        Self::ALL.into_iter().find_map(of)
    }
}

const BUS_NOTE_PREFIX: &str = "the bus '";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_noted_of_a_bus_is_read_back() {
        let said = |text: &str| {
            let note =
                CaptureNote { kind: NoteKind::Text, nanos: 0, interface: "", line: 0, text: text.as_bytes() };
            BusNote::parse(&note).map(|(bus, it)| (bus.to_owned(), it))
        };
        for it in BusNote::ALL {
            let found = Some(("can '0".to_owned(), it));
            assert_eq!(said(&it.text("can '0")), found);
            assert_eq!(said(&format!("# {}", it.text("can '0"))), found);
        }
        assert_eq!(said("the bus 'x' was"), None);
    }
}
