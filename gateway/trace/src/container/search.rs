//! Finds the next intact record after damage.
//!
//! After a wrong length, reading would continue at an arbitrary offset. The search therefore accepts only what cannot
//! be there by chance: a chunk or an attachment, whose length fields agree with each other, or several records in a
//! row, each of which begins where the one before it ends.

use std::io::{self, Read, Seek, SeekFrom};

use mcap::records::op;

use super::field::Fields;
use super::{MAGIC, MAX_RECORD_BYTES, read_uninterrupted};

/// The length of a record's header in bytes: operation code and length.
pub const RECORD_HEADER_BYTES: usize = 9;
/// The number of bytes that are read and searched at once.
const SEARCH_WINDOW_BYTES: usize = 1 << 20;
/// The maximum number of bytes at the beginning of a record by which it is identified.
const MAX_PREFIX_BYTES: usize = 512;
/// The number of consecutive records that are not considered a coincidence.
const MIN_CONSECUTIVE_RECORDS: usize = 4;
/// The length in bytes of the fields of a message record before the message itself.
const MESSAGE_HEADER_BYTES: u64 = 22;

/// Returns true if the operation code is defined by MCAP, or is free for applications (0x80 and above).
#[must_use]
pub(super) const fn is_known_opcode(opcode: u8) -> bool {
    matches!(opcode, 0x01..=0x0F | 0x80..)
}

/// Returns the minimum length of a record with this operation code, in bytes.
const fn min_length(opcode: u8) -> Option<u64> {
    Some(match opcode {
        op::HEADER | op::METADATA => 8,
        op::FOOTER => 20,
        op::SCHEMA => 14,
        op::CHANNEL => 16,
        op::MESSAGE => MESSAGE_HEADER_BYTES,
        op::CHUNK => 40,
        op::MESSAGE_INDEX => 6,
        op::CHUNK_INDEX => 64,
        op::ATTACHMENT => 36,
        op::ATTACHMENT_INDEX => 48,
        op::STATISTICS => 46,
        op::METADATA_INDEX => 20,
        op::SUMMARY_OFFSET => 17,
        op::DATA_END => 4,
        _ => return None,
    })
}

/// Returns true if a record can begin at `at`: its operation code is known, and it ends within the file.
///
/// # Errors
/// Returns an error if the input fails.
pub fn can_begin_record(input: &mut (impl Read + Seek), at: u64, size: u64) -> io::Result<bool> {
    Ok(at == size || read_record_header(input, at, size)?.is_some())
}

/// Returns the offset of the first record that begins at or after `from` and before `until`. Finds only chunks and
/// attachments unless `any` is true.
/// unless `any` is true.
///
/// # Errors
/// Returns an error if the input fails or is not seekable.
pub fn first_record(
    input: &mut (impl Read + Seek),
    mut from: u64,
    until: u64,
    any: bool,
) -> io::Result<Option<u64>> {
    let size = input.seek(SeekFrom::End(0))?;
    let mut window = Vec::new();
    while from < until.min(size) {
        input.seek(SeekFrom::Start(from))?;
        window.clear();
        input.by_ref().take((SEARCH_WINDOW_BYTES + MAX_PREFIX_BYTES) as u64).read_to_end(&mut window)?;
        let starts = usize::try_from(until - from)
            .unwrap_or(SEARCH_WINDOW_BYTES)
            .min(SEARCH_WINDOW_BYTES)
            .min(window.len());
        for start in 0..starts {
            let at = from + start as u64;
            let bytes = window.get(start..(start + MAX_PREFIX_BYTES).min(window.len())).unwrap_or_default();
            if is_chunk_or_attachment(bytes, size - at)
                || (any
                    && parse_record_header(bytes, size - at).is_some()
                    && is_record_sequence(input, at, size)?)
            {
                return Ok(Some(at));
            }
        }
        from += starts.max(1) as u64;
    }
    Ok(None)
}

/// Returns the operation code and the length of the record that begins with these bytes. Returns `None` if they are not
/// possible, or if the record is longer than `leftover` bytes.
fn parse_record_header(bytes: &[u8], leftover: u64) -> Option<(u8, u64)> {
    let &[opcode, ref length @ ..] = bytes.first_chunk::<RECORD_HEADER_BYTES>()?;
    let length = u64::from_le_bytes(*length);
    (min_length(opcode).is_some_and(|min| length >= min)
        && length <= leftover.checked_sub(RECORD_HEADER_BYTES as u64)?)
    .then_some((opcode, length))
}

/// Returns true if a chunk or an attachment begins with these bytes. Each of its lengths is stored twice.
fn is_chunk_or_attachment(bytes: &[u8], leftover: u64) -> bool {
    let Some((opcode, length)) = parse_record_header(bytes, leftover) else { return false };
    let body = bytes.get(RECORD_HEADER_BYTES..).unwrap_or_default();
    let is_of_two = opcode == op::ATTACHMENT || (opcode == op::CHUNK && length <= MAX_RECORD_BYTES);
    is_of_two && length_by_fields(opcode, body) == Some(length)
}

/// Returns the length of a record as computed from its own fields. Returns `None` for a kind of record whose length
/// cannot be computed, or if the bytes end too early.
#[must_use]
pub fn length_by_fields(opcode: u8, body: &[u8]) -> Option<u64> {
    match opcode {
        op::CHUNK => chunk_length(body),
        op::ATTACHMENT => attachment_length(body),
        op::HEADER => length_with_strings(body, 0, "ss"),
        op::SCHEMA => length_with_strings(body, 2, "sss"),
        op::CHANNEL => length_with_strings(body, 4, "sss"),
        op::METADATA => length_with_strings(body, 0, "ss"),
        op::MESSAGE_INDEX => length_with_strings(body, 2, "s").filter(|own| own % INDEX_ENTRY_BYTES == 6),
        op::DATA_END => Some(4),
        op::FOOTER => Some(20),
        op::SUMMARY_OFFSET => Some(17),
        op::STATISTICS => length_with_strings(body, 42, "s"),
        op::METADATA_INDEX => length_with_strings(body, 16, "s"),
        op::ATTACHMENT_INDEX => length_with_strings(body, 40, "ss"),
        _ => None,
    }
}

/// The length of an entry in a message index, in bytes.
const INDEX_ENTRY_BYTES: u64 = 16;

/// Returns the length of `fixed` bytes and the strings after them. Each string is preceded by its length in 32 bits.
fn length_with_strings(body: &[u8], fixed: u64, strings: &str) -> Option<u64> {
    strings.bytes().try_fold(fixed, |at, _| {
        let from = usize::try_from(at).ok()?;
        let length = body.get(from..)?.first_chunk::<4>()?;
        Some(at + 4 + u64::from(u32::from_le_bytes(*length)))
    })
}

/// Returns the length of a chunk record as computed from its fields.
fn chunk_length(body: &[u8]) -> Option<u64> {
    let mut from = Fields::new("chunk", body);
    let (start, end, unpacked) = (from.u64("").ok()?, from.u64("").ok()?, from.u64("").ok()?);
    from.u32("").ok()?;
    let compression = from.text("").ok()?;
    let packed = from.u64("").ok()?;
    let fields = 40 + compression.len() as u64;
    (start <= end && unpacked <= MAX_RECORD_BYTES && matches!(compression, "" | "zstd" | "lz4"))
        .then(|| packed.checked_add(fields))?
}

/// Returns true if a chunk's records are not compressed.
#[must_use]
pub(super) fn is_uncompressed(chunk: &[u8]) -> bool {
    chunk.get(28..32).is_some_and(|length| length == [0; 4])
}

/// Returns the length of an attachment record as computed from its fields.
fn attachment_length(body: &[u8]) -> Option<u64> {
    let mut from = Fields::new("attachment", body);
    from.u64("").and_then(|_| from.u64("")).ok()?;
    let (name, media_type) = (from.text("").ok()?, from.text("").ok()?);
    let data = from.u64("").ok()?;
    data.checked_add(36 + name.len() as u64 + media_type.len() as u64)
}

/// Returns true if a record with an application's operation code has the contents of a chunk, an attachment or
/// metadata. A bit of the operation code was then changed.
#[must_use]
pub(super) fn has_wrong_opcode(body: &[u8], length: u64) -> bool {
    let kinds = [op::CHUNK, op::ATTACHMENT, op::METADATA];
    length > 8 && kinds.iter().any(|&code| length_by_fields(code, body) == Some(length))
}

/// Returns true if a message ends with several consecutive records. Its length field is then wrong and spans them.
#[must_use]
pub(super) fn ends_with_records(message: &[u8]) -> bool {
    let first = usize::try_from(MESSAGE_HEADER_BYTES).unwrap_or(usize::MAX);
    (first..message.len().saturating_sub(RECORD_HEADER_BYTES)).any(|start| {
        let mut rest = message.get(start..).unwrap_or_default();
        let mut row = 0;
        while let Some((_, length)) = parse_record_header(rest, rest.len() as u64) {
            row += 1;
            rest = usize::try_from(length)
                .ok()
                .and_then(|length| rest.get(RECORD_HEADER_BYTES + length..))
                .unwrap_or_default();
        }
        row >= MIN_CONSECUTIVE_RECORDS || (row > 0 && rest.is_empty())
    })
}

/// Returns true if several consecutive records begin at `at`, or if records follow each other up to the end of the
/// file.
fn is_record_sequence(input: &mut (impl Read + Seek), mut at: u64, size: u64) -> io::Result<bool> {
    for before in 0..MIN_CONSECUTIVE_RECORDS {
        if before > 0 && at == size {
            return Ok(true);
        }
        let Some((opcode, end)) = read_record_header(input, at, size)? else { return Ok(false) };
        if opcode == op::FOOTER {
            return Ok(end + MAGIC.len() as u64 == size);
        }
        at = end;
    }
    Ok(true)
}

/// Returns the operation code of the record that begins at `at`, and the offset of its end.
fn read_record_header(input: &mut (impl Read + Seek), at: u64, size: u64) -> io::Result<Option<(u8, u64)>> {
    let mut bytes = [0; RECORD_HEADER_BYTES];
    input.seek(SeekFrom::Start(at))?;
    let mut read = 0;
    while let came @ 1.. = read_uninterrupted(input, bytes.get_mut(read..).unwrap_or_default())? {
        read += came;
    }
    let there = bytes.get(..read).unwrap_or_default();
    Ok(parse_record_header(there, size.saturating_sub(at))
        .map(|(opcode, length)| (opcode, at + RECORD_HEADER_BYTES as u64 + length)))
}
