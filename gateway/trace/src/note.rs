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
