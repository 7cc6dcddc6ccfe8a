//! Bytes of a serial line become frames, commands and acknowledgements.

#[cfg(feature = "host")]
use super::Report;
use super::{BEL, CR, Command, MAX_LINE, digit, dlc_len, number};
use crate::can::{
    BIT_RATE_SWITCH, ERROR_STATE, EXTENDED, EXTENDED_MASK, FD_FORMAT, Format, Frame, STANDARD_MASK,
};

/// What a line says.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Line {
    /// A frame: of the bus when an adapter writes it, for the bus when a host does. Its time stamp is passed over.
    Frame(Frame),
    /// A host's command.
    Command(Command),
    /// An empty line: done. Hosts send it as well, for nothing.
    Done,
    /// `z` or `Z`: the adapter has taken a frame to send.
    Sent,
    /// BEL: the adapter refused a line.
    Failed,
    /// A fault, or a state of the adapter's bus. A board's own line has no adapter behind it.
    #[cfg(feature = "host")]
    Reported(Report),
    /// A line of printable characters that is none of these, such as an adapter's version: to be passed over.
    Other,
    /// A line that cannot be used; [`Decoder::refused`] has counted it.
    Refused(Refusal),
}

/// Why a line is refused.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub enum Refusal {
    /// A byte that no line has, or a frame with what is no hexadecimal digit.
    Garbage,
    /// More bytes than a line has, or than the DLC and a time stamp say.
    Long,
    /// Fewer digits than the DLC says, or no DLC.
    Short,
    /// A classic frame with a DLC above 8.
    Dlc,
    /// An identifier above 7FF, or above 1FFFFFFF.
    Identifier,
}

/// How many lines were refused, by reason. The counts stop at their maximum.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Refused {
    /// [`Refusal::Garbage`].
    pub garbage: u32,
    /// [`Refusal::Long`].
    pub long: u32,
    /// [`Refusal::Short`].
    pub short: u32,
    /// [`Refusal::Dlc`].
    pub dlc: u32,
    /// [`Refusal::Identifier`].
    pub identifier: u32,
}

impl Refused {
    /// All of them.
    #[must_use]
    pub fn total(&self) -> u64 {
        let Self { garbage, long, short, dlc, identifier } = *self;
        [garbage, long, short, dlc, identifier].into_iter().map(u64::from).sum()
    }

    const fn count(&mut self, refusal: Refusal) {
        let counter = match refusal {
            Refusal::Garbage => &mut self.garbage,
            Refusal::Long => &mut self.long,
            Refusal::Short => &mut self.short,
            Refusal::Dlc => &mut self.dlc,
            Refusal::Identifier => &mut self.identifier,
        };
        *counter = counter.saturating_add(1);
    }
}

/// Takes the bytes of a serial line one by one. Never allocates, never panics; after whatever came, the next line that
/// is sound is read.
///
/// ```
/// use protocol::can::Frame;
/// use protocol::slcan::{Decoder, Line};
///
/// let mut decoder = Decoder::new();
/// let lines: Vec<_> = b"?!\rt1232AABB\r".iter().filter_map(|&byte| decoder.push(byte)).collect();
/// assert_eq!(lines, [Line::Other, Line::Frame(Frame::classic(0x123, &[0xAA, 0xBB]).unwrap())]);
/// ```
#[derive(Clone, Debug, Default)]
pub struct Decoder {
    /// What has come of this line.
    line: heapless::Vec<u8, MAX_LINE>,
    /// The line is refused when it ends.
    fault: Option<Refusal>,
    refused: Refused,
    endings: Endings,
}

/// Tells by earlier frames whether an adapter's frames end with a digit for the state of their sender. Either all of them
/// do or none: so a line that lost a byte is not mistaken for one that ends otherwise.
#[derive(Clone, Debug, Default)]
struct Endings {
    has_state: bool,
    /// Number of frames in succession that ended in this way.
    same: u8,
    /// The last one ended in the other way.
    other: bool,
}

impl Endings {
    /// Frames after which one that ends otherwise is refused, unless another one follows it.
    const SURE: u8 = 16;

    const fn new() -> Self {
        Self { has_state: false, same: 0, other: false }
    }

    /// Takes the end of a frame; whether it is to be believed.
    const fn take(&mut self, has_state: bool) -> bool {
        if self.has_state == has_state {
            self.same = self.same.saturating_add(1);
            self.other = false;
            return true;
        }
        let is_sure = self.same >= Self::SURE && !self.other;
        if is_sure {
            self.other = true;
        } else {
            *self = Self { has_state, same: 1, other: false };
        }
        !is_sure
    }
}

impl Decoder {
    /// Before the first byte.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            line: heapless::Vec::new(),
            fault: None,
            refused: Refused { garbage: 0, long: 0, short: 0, dlc: 0, identifier: 0 },
            endings: Endings::new(),
        }
    }

    /// Takes a byte; the line that it ends. Bounded work.
    ///
    /// CR ends a line, and so does LF, but an empty line that LF ends is none. BEL is a line of its own: what came
    /// before it without an end is counted as garbage.
    pub fn push(&mut self, byte: u8) -> Option<Line> {
        match byte {
            CR => Some(self.end()),
            b'\n' => (!self.is_empty()).then(|| self.end()),
            BEL => {
                if !self.is_empty() {
                    self.refused.count(Refusal::Garbage);
                }
                self.clear();
                Some(Line::Failed)
            }
            b' '..=b'~' => {
                if self.line.push(byte).is_err() {
                    self.fault.get_or_insert(Refusal::Long);
                }
                None
            }
            _ => {
                self.fault.get_or_insert(Refusal::Garbage);
                None
            }
        }
    }

    /// How many lines were refused so far.
    #[must_use]
    pub const fn refused(&self) -> Refused {
        self.refused
    }

    /// Forgets a line that has begun, because its sender is gone; whether there was one. It is counted as short.
    pub fn restart(&mut self) -> bool {
        let begun = !self.is_empty();
        if begun {
            self.refused.count(Refusal::Short);
        }
        self.clear();
        begun
    }

    fn is_empty(&self) -> bool {
        self.line.is_empty() && self.fault.is_none()
    }

    fn clear(&mut self) {
        self.line.clear();
        self.fault = None;
    }

    fn end(&mut self) -> Line {
        let endings = &mut self.endings;
        let line = self.fault.map_or_else(|| read(&self.line, endings), Line::Refused);
        if let Line::Refused(refusal) = line {
            self.refused.count(refusal);
        }
        self.clear();
        line
    }
}

/// What a line of printable characters, without its end, says.
fn read(line: &[u8], endings: &mut Endings) -> Line {
    let [kind, rest @ ..] = line else { return Line::Done };
    let flags = match kind.to_ascii_lowercase() {
        b't' | b'r' => None,
        b'd' => Some(FD_FORMAT),
        b'b' => Some(FD_FORMAT | BIT_RATE_SWITCH),
        b'z' if rest.is_empty() => return Line::Sent,
        _ => {
            #[cfg(feature = "host")]
            if let Some(report) = Report::read(line) {
                return Line::Reported(report);
            }
            return Command::decode(line).map_or(Line::Other, Line::Command);
        }
    };
    let is_remote = kind.eq_ignore_ascii_case(&b'r');
    match frame(rest, kind.is_ascii_uppercase(), flags, is_remote, endings) {
        Ok(frame) => Line::Frame(frame),
        Err(refusal) => Line::Refused(refusal),
    }
}

/// A frame from behind its letter; `flags` are those of an FD frame.
fn frame(
    text: &[u8],
    is_extended: bool,
    flags: Option<u8>,
    is_remote: bool,
    endings: &mut Endings,
) -> Result<Frame, Refusal> {
    let (digits, flag, max) = if is_extended { (8, EXTENDED, EXTENDED_MASK) } else { (3, 0, STANDARD_MASK) };
    let (id, rest) = text.split_at_checked(digits).ok_or(Refusal::Short)?;
    let id = number(id).ok_or(Refusal::Garbage)?;
    if id > max {
        return Err(Refusal::Identifier);
    }
    let id = id | flag;
    let (&dlc, rest) = rest.split_first().ok_or(Refusal::Short)?;
    let dlc = digit(dlc).ok_or(Refusal::Garbage)?;
    if flags.is_none() && dlc > 8 {
        return Err(Refusal::Dlc);
    }
    let len = if is_remote { 0 } else { dlc_len(dlc) };
    let (text, rest) = rest.split_at_checked(2 * len).ok_or(Refusal::Short)?;
    let (time, state) = match rest {
        [time @ .., b'S'] => (time, Some(b'S')),
        // Whoever ends so writes capitals, and a small one may begin the next line, whose CR was lost.
        [time @ .., state @ b'0'..=b'1']
            if time.len().is_multiple_of(4) && !time.iter().any(u8::is_ascii_lowercase) =>
        {
            (time, Some(*state))
        }
        time => (time, None),
    };
    if !matches!(time.len(), 0 | 4 | 8) {
        return Err(Refusal::Long);
    }
    number(time).ok_or(Refusal::Garbage)?;
    let mut data = [0; 64];
    let (pairs, _) = text.as_chunks();
    for (byte, &[high, low]) in data.iter_mut().zip(pairs) {
        *byte = (digit(high).ok_or(Refusal::Garbage)? << 4) | digit(low).ok_or(Refusal::Garbage)?;
    }
    // A letter cannot be a digit of what stands before it.
    let has_state = matches!(state, Some(b'0' | b'1'));
    if state != Some(b'S') && !endings.take(has_state) {
        return Err(if has_state { Refusal::Long } else { Refusal::Short });
    }
    let passive = if matches!(state, Some(b'1' | b'S')) { ERROR_STATE } else { 0 };
    let frame = match flags {
        None if is_remote => Frame::remote(id, dlc),
        None => Frame::filled(id, Format::Classic, 0, data, len),
        Some(flags) => Frame::filled(id, Format::Fd, flags | passive, data, len),
    };
    frame.map_err(|_| Refusal::Dlc)
}
