//! The decoder of slcan: from bytes to frames, commands and acknowledgements.

#[cfg(feature = "host")]
use super::AdapterReport;
use super::{BEL, CR, MAX_LINE, SlcanCommand, digit, dlc_len, number};
use crate::can::{
    BIT_RATE_SWITCH, ERROR_STATE, EXTENDED, EXTENDED_MASK, FD_FORMAT, Format, Frame, STANDARD_MASK,
};

/// A decoded line.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum SlcanLine {
    /// A frame. If an adapter wrote the line, the frame was received from the bus; if a host did, it is to be sent. A
    /// time stamp is ignored.
    Frame(Frame),
    /// A command of a host.
    Command(SlcanCommand),
    /// An empty line. From an adapter it is an acknowledgement; from a host it has no meaning.
    Done,
    /// `z` or `Z`: the adapter has accepted a frame for sending.
    Sent,
    /// BEL: the adapter refused a line.
    Failed,
    /// A fault or the bus state, reported by an adapter. Only hosts decode such lines; the firmware of a cell ignores
    /// them.
    #[cfg(feature = "host")]
    Reported(AdapterReport),
    /// Any other line of printable characters, such as the version of an adapter. The caller ignores it.
    Other,
    /// An invalid line, which [`Decoder::rejected_lines`] counts.
    Refused(LineRefusal),
}

/// The reason for which the decoder refused a line.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub enum LineRefusal {
    /// The line contains an unprintable byte, or a frame contains a byte that is not a hexadecimal digit.
    Garbage,
    /// The line is longer than [`MAX_LINE`], or longer than a frame with its DLC and a time stamp.
    Long,
    /// The frame has fewer digits than its DLC requires, or has no DLC.
    Short,
    /// A classic frame has a DLC above 8.
    Dlc,
    /// The identifier is above 7FF, or above 1FFFFFFF in an extended frame.
    Identifier,
}

/// Numbers of refused lines, by reason. Each counter saturates.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct RejectedLines {
    /// Number of lines refused as [`LineRefusal::Garbage`].
    pub garbage: u32,
    /// Number of lines refused as [`LineRefusal::Long`].
    pub long: u32,
    /// Number of lines refused as [`LineRefusal::Short`].
    pub short: u32,
    /// Number of lines refused as [`LineRefusal::Dlc`].
    pub dlc: u32,
    /// Number of lines refused as [`LineRefusal::Identifier`].
    pub identifier: u32,
}

impl RejectedLines {
    /// Returns the sum of all counters.
    #[must_use]
    pub fn total(&self) -> u64 {
        let Self { garbage, long, short, dlc, identifier } = *self;
        [garbage, long, short, dlc, identifier].into_iter().map(u64::from).sum()
    }

    const fn count_refusal(&mut self, refusal: LineRefusal) {
        let counter = match refusal {
            LineRefusal::Garbage => &mut self.garbage,
            LineRefusal::Long => &mut self.long,
            LineRefusal::Short => &mut self.short,
            LineRefusal::Dlc => &mut self.dlc,
            LineRefusal::Identifier => &mut self.identifier,
        };
        *counter = counter.saturating_add(1);
    }
}

/// A decoder for a serial line, byte by byte. It never allocates and never panics. After any invalid input, it decodes
/// the next valid line.
///
/// ```
/// use protocol::can::Frame;
/// use protocol::slcan::{Decoder, SlcanLine};
///
/// let mut decoder = Decoder::new();
/// let lines: Vec<_> = b"?!\rt1232AABB\r".iter().filter_map(|&byte| decoder.push(byte)).collect();
/// assert_eq!(lines, [SlcanLine::Other, SlcanLine::Frame(Frame::classic(0x123, &[0xAA, 0xBB]).unwrap())]);
/// ```
#[derive(Clone, Debug, Default)]
pub struct Decoder {
    /// The bytes of the current line so far.
    line: heapless::Vec<u8, MAX_LINE>,
    /// The reason for which the current line will be refused, if an error was found in it.
    fault: Option<LineRefusal>,
    refused: RejectedLines,
    endings: ErrorStateDigitDetector,
}

/// Detects from earlier frames whether the adapter appends a digit for the sender's error state to each frame. Adapters
/// do so for all frames or for none. A line that lost a byte is thus not mistaken for a line of the other form.
#[derive(Clone, Debug, Default)]
struct ErrorStateDigitDetector {
    has_state: bool,
    /// Number of consecutive frames of the same form.
    run_length: u8,
    /// True if the last frame had the other form.
    deviated: bool,
}

impl ErrorStateDigitDetector {
    /// Number of frames of one form after which a single frame of the other form is refused. Two in a row are accepted.
    const CONFIRMED_AFTER_FRAMES: u8 = 16;

    const fn new() -> Self {
        Self { has_state: false, run_length: 0, deviated: false }
    }

    /// Records the form of a frame. Returns true if the form is plausible after the earlier frames.
    const fn record_frame_form(&mut self, has_state: bool) -> bool {
        if self.has_state == has_state {
            self.run_length = self.run_length.saturating_add(1);
            self.deviated = false;
            return true;
        }
        let is_sure = self.run_length >= Self::CONFIRMED_AFTER_FRAMES && !self.deviated;
        if is_sure {
            self.deviated = true;
        } else {
            *self = Self { has_state, run_length: 1, deviated: false };
        }
        !is_sure
    }
}

impl Decoder {
    /// Creates a decoder that has received nothing yet.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            line: heapless::Vec::new(),
            fault: None,
            refused: RejectedLines { garbage: 0, long: 0, short: 0, dlc: 0, identifier: 0 },
            endings: ErrorStateDigitDetector::new(),
        }
    }

    /// Processes one byte. Returns the line that ends with it, if any. The work per byte is bounded.
    ///
    /// CR and LF both end a line; an empty line that ends with LF is ignored, so that CR LF ends only one. BEL is a
    /// line of its own, and an unfinished line before it counts as garbage.
    pub fn push(&mut self, byte: u8) -> Option<SlcanLine> {
        match byte {
            CR => Some(self.finish_line()),
            b'\n' => (!self.is_empty()).then(|| self.finish_line()),
            BEL => {
                if !self.is_empty() {
                    self.refused.count_refusal(LineRefusal::Garbage);
                }
                self.clear();
                Some(SlcanLine::Failed)
            }
            b' '..=b'~' => {
                if self.line.push(byte).is_err() {
                    self.fault.get_or_insert(LineRefusal::Long);
                }
                None
            }
            _ => {
                self.fault.get_or_insert(LineRefusal::Garbage);
                None
            }
        }
    }

    /// Returns the numbers of refused lines so far.
    #[must_use]
    pub const fn rejected_lines(&self) -> RejectedLines {
        self.refused
    }

    /// Discards an unfinished line, for example when the connection was lost, and counts it as short. Returns true if
    /// there was one.
    pub fn discard_unfinished(&mut self) -> bool {
        let begun = !self.is_empty();
        if begun {
            self.refused.count_refusal(LineRefusal::Short);
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

    fn finish_line(&mut self) -> SlcanLine {
        let endings = &mut self.endings;
        let line = self.fault.map_or_else(|| decode_line(&self.line, endings), SlcanLine::Refused);
        if let SlcanLine::Refused(refusal) = line {
            self.refused.count_refusal(refusal);
        }
        self.clear();
        line
    }
}

/// Decodes a line of printable characters, given without its line ending.
fn decode_line(line: &[u8], endings: &mut ErrorStateDigitDetector) -> SlcanLine {
    let [kind, rest @ ..] = line else { return SlcanLine::Done };
    let flags = match kind.to_ascii_lowercase() {
        b't' | b'r' => None,
        b'd' => Some(FD_FORMAT),
        b'b' => Some(FD_FORMAT | BIT_RATE_SWITCH),
        b'z' if rest.is_empty() => return SlcanLine::Sent,
        _ => {
            #[cfg(feature = "host")]
            if let Some(report) = AdapterReport::parse_report(line) {
                return SlcanLine::Reported(report);
            }
            return SlcanCommand::decode(line).map_or(SlcanLine::Other, SlcanLine::Command);
        }
    };
    let is_remote = kind.eq_ignore_ascii_case(&b'r');
    match decode_frame(rest, kind.is_ascii_uppercase(), flags, is_remote, endings) {
        Ok(frame) => SlcanLine::Frame(frame),
        Err(refusal) => SlcanLine::Refused(refusal),
    }
}

/// Decodes the part of a frame after its first letter. `flags` are the FD flags, or `None` for a classic frame.
fn decode_frame(
    text: &[u8],
    is_extended: bool,
    flags: Option<u8>,
    is_remote: bool,
    endings: &mut ErrorStateDigitDetector,
) -> Result<Frame, LineRefusal> {
    let (digits, flag, max) = if is_extended { (8, EXTENDED, EXTENDED_MASK) } else { (3, 0, STANDARD_MASK) };
    let (id, rest) = text.split_at_checked(digits).ok_or(LineRefusal::Short)?;
    let id = number(id).ok_or(LineRefusal::Garbage)?;
    if id > max {
        return Err(LineRefusal::Identifier);
    }
    let id = id | flag;
    let (&dlc, rest) = rest.split_first().ok_or(LineRefusal::Short)?;
    let dlc = digit(dlc).ok_or(LineRefusal::Garbage)?;
    if flags.is_none() && dlc > 8 {
        return Err(LineRefusal::Dlc);
    }
    let len = if is_remote { 0 } else { dlc_len(dlc) };
    let (text, rest) = rest.split_at_checked(2 * len).ok_or(LineRefusal::Short)?;
    let (time, state) = match rest {
        [time @ .., b'S'] => (time, Some(b'S')),
        // Adapters that append a state write upper case; a lower-case digit may belong to the next line after
        // a lost CR.
        [time @ .., state @ b'0'..=b'1']
            if time.len().is_multiple_of(4) && !time.iter().any(u8::is_ascii_lowercase) =>
        {
            (time, Some(*state))
        }
        time => (time, None),
    };
    if !matches!(time.len(), 0 | 4 | 8) {
        return Err(LineRefusal::Long);
    }
    number(time).ok_or(LineRefusal::Garbage)?;
    let mut data = [0; 64];
    let (pairs, _) = text.as_chunks();
    for (byte, &[high, low]) in data.iter_mut().zip(pairs) {
        *byte = (digit(high).ok_or(LineRefusal::Garbage)? << 4) | digit(low).ok_or(LineRefusal::Garbage)?;
    }
    // `S` cannot be mistaken for a digit, so it is always plausible.
    let has_state = matches!(state, Some(b'0' | b'1'));
    if state != Some(b'S') && !endings.record_frame_form(has_state) {
        return Err(if has_state { LineRefusal::Long } else { LineRefusal::Short });
    }
    let passive = if matches!(state, Some(b'1' | b'S')) { ERROR_STATE } else { 0 };
    let frame = match flags {
        None if is_remote => Frame::remote(id, dlc),
        None => Frame::with_buffer(id, Format::Classic, 0, data, len),
        Some(flags) => Frame::with_buffer(id, Format::Fd, flags | passive, data, len),
    };
    frame.map_err(|_| LineRefusal::Dlc)
}
