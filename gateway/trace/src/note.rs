//! What stands between frames: comments, frames that are missing, lines that are no frame.

/// What stands between frames.
#[derive(Clone, Debug, PartialEq)]
pub struct Note<'a> {
    /// What it is.
    pub kind: NoteKind,
    /// When, in ns since 1970; in a log, the time of the frame before it, 0 before the first one.
    pub nanos: u64,
    /// The bus, when it is about one; else empty.
    pub interface: &'a str,
    /// Its line in a log, from 1; 0 when it comes from none.
    pub line: u64,
    /// The line as it stands in the log, without its end; or words of whoever recorded it.
    pub text: &'a [u8],
}

/// What a note is.
#[derive(Clone, Debug, Eq, PartialEq)]
pub enum NoteKind {
    /// A comment, an empty line, anything that can-utils skip too.
    Text,
    /// So many frames are missing here: whoever took the capture lost them.
    Dropped(u64),
    /// A CAN XL frame, which is not read.
    CanXl,
    /// A line that begins like a frame and is none, and why.
    Unreadable(String),
}

/// What a recorder notes of a bus, as a text: its frames are missing from then to when it works again.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum BusNote {
    /// It was lost.
    Lost,
    /// It works again.
    Back,
}

impl BusNote {
    const ALL: [Self; 2] = [Self::Lost, Self::Back];

    const fn end(self) -> &'static str {
        match self {
            Self::Lost => "' was lost",
            Self::Back => "' works again",
        }
    }

    /// The text.
    #[must_use]
    pub fn text(self, bus: &str) -> String {
        format!("{START}{bus}{}", self.end())
    }

    /// The bus that a note says this of.
    #[must_use]
    pub fn of<'a>(note: &Note<'a>) -> Option<(&'a str, Self)> {
        let text = core::str::from_utf8(note.text).ok().filter(|_| note.kind == NoteKind::Text)?;
        // In a log it is a comment.
        let text = text.strip_prefix("# ").unwrap_or(text);
        let of = |it: Self| Some((text.strip_prefix(START)?.strip_suffix(it.end())?, it));
        Self::ALL.into_iter().find_map(of)
    }
}

const START: &str = "the bus '";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_noted_of_a_bus_is_read_back() {
        let said = |text: &str| {
            let note = Note { kind: NoteKind::Text, nanos: 0, interface: "", line: 0, text: text.as_bytes() };
            BusNote::of(&note).map(|(bus, it)| (bus.to_owned(), it))
        };
        for it in BusNote::ALL {
            let found = Some(("can '0".to_owned(), it));
            assert_eq!(said(&it.text("can '0")), found);
            assert_eq!(said(&format!("# {}", it.text("can '0"))), found);
        }
        assert_eq!(said("the bus 'x' was"), None);
    }
}
