//! Parameters in two pages of flash. A new image is written to the page that does not hold the newest image, and marked
//! as complete last. A loss of power at any moment thus leaves either the old or the new image.
//!
//! ```text
//!   byte 0..3  which image this is: the higher number is the newer one      4..7  bytes of the image
//!        8..   the image, filled up with 0xFF to a multiple of 8
//!        last  8 bytes: "COMPLETE"
//! ```
//!
//! Flash is written in units of 8 bytes, each at most once after its page was erased, as an STM32 requires.

/// Size in bytes of the unit in which flash is written.
pub const WRITE_SIZE: usize = 8;
/// Maximum size of an image in bytes.
pub const MAX_IMAGE: usize = 496;

const COMPLETE: &[u8; WRITE_SIZE] = b"COMPLETE";
const ERASED: [u8; WRITE_SIZE] = [0xFF; WRITE_SIZE];

/// The error for a failed write to flash.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct WriteError;

/// One of the two flash pages for parameters.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Page {
    /// The first page.
    A,
    /// The second page.
    B,
}

impl Page {
    /// Returns the other page.
    #[must_use]
    pub const fn other(self) -> Self {
        match self {
            Self::A => Self::B,
            Self::B => Self::A,
        }
    }
}

/// Two pages of flash of at least 512 bytes.
pub trait Flash {
    /// Reads the unit of 8 bytes at this offset, a multiple of 8.
    fn unit(&self, page: Page, at: usize) -> [u8; WRITE_SIZE];

    /// Erases a page: sets all of its bytes to 0xFF. The processor may stall until this is done.
    ///
    /// # Errors
    /// Returns an error if the flash controller reports a failure.
    fn erase(&mut self, page: Page) -> Result<(), WriteError>;

    /// Writes a unit of 8 bytes that is erased.
    ///
    /// # Errors
    /// Returns an error if the flash controller reports a failure.
    fn program(&mut self, page: Page, at: usize, unit: [u8; WRITE_SIZE]) -> Result<(), WriteError>;
}

/// The content found in the two pages.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum StoredImage {
    /// There is no image: the pages are erased, or the first image was never completed.
    Nothing,
    /// The newest image, with this many bytes.
    Image(usize),
    /// A page contains neither an image nor erased flash.
    Damaged,
}

/// The header of a page with a complete image.
#[derive(Clone, Copy, Debug)]
struct PageHeader {
    number: u32,
    len: usize,
}

impl PageHeader {
    /// Returns the offset of the mark "COMPLETE" in the page.
    const fn mark_offset(&self) -> usize {
        WRITE_SIZE + self.len.next_multiple_of(WRITE_SIZE)
    }
}

/// Reads the header of a page. Returns `None` for an erased page or an incomplete image, and an error for any
/// other content.
fn head(flash: &impl Flash, page: Page) -> Result<Option<PageHeader>, WriteError> {
    let unit = flash.unit(page, 0);
    if unit == ERASED {
        return Ok(None);
    }
    let [n0, n1, n2, n3, l0, l1, l2, l3] = unit;
    let len = usize::try_from(u32::from_le_bytes([l0, l1, l2, l3])).unwrap_or(usize::MAX);
    if len > MAX_IMAGE {
        return Err(WriteError);
    }
    let head = PageHeader { number: u32::from_le_bytes([n0, n1, n2, n3]), len };
    match flash.unit(page, head.mark_offset()) {
        mark if mark == *COMPLETE => Ok(Some(head)),
        ERASED => Ok(None),
        _ => Err(WriteError),
    }
}

/// Returns the page with the newest image and its header, and true if a page is damaged.
fn newest(flash: &impl Flash) -> (Option<(Page, PageHeader)>, bool) {
    let (a, b) = (head(flash, Page::A), head(flash, Page::B));
    let damaged = a.is_err() || b.is_err();
    let held = |page, head: Result<Option<PageHeader>, _>| head.ok().flatten().map(|head| (page, head));
    let newest = match (held(Page::A, a), held(Page::B, b)) {
        (Some(a), Some(b)) if b.1.number.wrapping_sub(a.1.number).cast_signed() > 0 => Some(b),
        (a, b) => a.or(b),
    };
    (newest, damaged)
}

/// Reads the newest image into `into`. If a page is damaged, returns [`StoredImage::Damaged`], because that page may
/// have held a newer image.
pub fn read(flash: &impl Flash, into: &mut [u8]) -> StoredImage {
    let (newest, damaged) = newest(flash);
    if damaged {
        return StoredImage::Damaged;
    }
    let Some((page, PageHeader { len, .. })) = newest else { return StoredImage::Nothing };
    let Some(into) = into.get_mut(..len) else { return StoredImage::Damaged };
    for (index, bytes) in into.chunks_mut(WRITE_SIZE).enumerate() {
        let unit = flash.unit(page, WRITE_SIZE * (index + 1));
        bytes.copy_from_slice(unit.get(..bytes.len()).unwrap_or_default());
    }
    StoredImage::Image(len)
}

/// Writes an image to the page that does not hold the newest image, and verifies it.
///
/// # Errors
/// Returns an error if the image is too long, or if flash does not hold the image afterwards. The old image remains
/// valid then.
pub fn write(flash: &mut impl Flash, image: &[u8]) -> Result<(), WriteError> {
    let (newest, damaged) = newest(flash);
    let (page, number) = match newest {
        Some((page, head)) => (page.other(), head.number.wrapping_add(1)),
        None => (Page::A, 1),
    };
    let len = u32::try_from(image.len()).ok().filter(|_| image.len() <= MAX_IMAGE).ok_or(WriteError)?;
    let mut unit = [0; WRITE_SIZE];
    let (first, second) = unit.split_at_mut(WRITE_SIZE / 2);
    first.copy_from_slice(&number.to_le_bytes());
    second.copy_from_slice(&len.to_le_bytes());
    flash.erase(page)?;
    program(flash, page, 0, unit)?;
    for (index, bytes) in image.chunks(WRITE_SIZE).enumerate() {
        let mut unit = ERASED;
        unit.iter_mut().zip(bytes).for_each(|(unit, byte)| *unit = *byte);
        program(flash, page, WRITE_SIZE * (index + 1), unit)?;
    }
    program(flash, page, WRITE_SIZE + image.len().next_multiple_of(WRITE_SIZE), *COMPLETE)?;
    // Erased last, so that the damage stays detectable until a sound image exists.
    if damaged { flash.erase(page.other()) } else { Ok(()) }
}

/// Writes a unit and verifies it. A unit of 0xFF bytes is left erased, because some flash cannot be written again after
/// a write of 0xFF.
fn program(flash: &mut impl Flash, page: Page, at: usize, unit: [u8; WRITE_SIZE]) -> Result<(), WriteError> {
    if unit != ERASED {
        flash.program(page, at, unit)?;
    }
    if flash.unit(page, at) == unit { Ok(()) } else { Err(WriteError) }
}

#[cfg(test)]
mod tests;
