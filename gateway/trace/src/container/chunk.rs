//! Decompresses and checks the chunks of a file, and splits them into records.

use std::fmt;
use std::io::{self, Read};

use lz4_flex::frame::FrameDecoder;
use zstd::zstd_safe::{self, DCtx, ErrorCode, get_error_name};

use super::field::Fields;
use super::{FormatError, MAX_RECORD_BYTES};

/// The total size in bytes that the chunks of any file may decompress to, even if the file is short.
const BASE_LIMIT_BYTES: u64 = 256 << 20;
/// The number of decompressed bytes that are allowed for each byte of the file, in addition to [`BASE_LIMIT_BYTES`].
const MAX_EXPANSION_RATIO: u64 = 1_000;
/// The total number of records that the chunks of any file may hold, even if the file is short.
const BASE_LIMIT_RECORDS: u64 = 1 << 17;
/// The number of records that are allowed for each byte of the file, in addition to [`BASE_LIMIT_RECORDS`]. A real
/// recording has an index entry of 16 bytes for each record.
const MAX_RECORDS_PER_BYTE: u64 = 1;
/// The length of a record's header in bytes: operation code and length.
const RECORD_HEADER_BYTES: usize = 9;

/// The chunk that was decompressed last. The whole chunk is checked before any record is returned: its length, its
/// checksum, and that its last record ends where the chunk ends.
#[derive(Default)]
pub struct Chunk {
    bytes: Vec<u8>,
    /// The offset of the next record in the decompressed bytes.
    at: usize,
    /// The length of the contents of the record that was returned last.
    body: usize,
    /// The total size of all chunks so far after decompression, in bytes.
    total_bytes: u64,
    total_records: u64,
    is_checked: bool,
    zstd: Option<DCtx<'static>>,
}

impl fmt::Debug for Chunk {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Chunk")
            .field("bytes", &self.bytes.len())
            .field("at", &self.at)
            .finish_non_exhaustive()
    }
}

impl Chunk {
    /// Decompresses a chunk record. `read` is the number of bytes read from the file so far, which limits the
    /// decompressed size.
    ///
    /// # Errors
    /// Returns [`FormatError`] if the chunk is invalid. It then has no records.
    pub fn unpack(&mut self, record: &[u8], read: u64) -> Result<(), FormatError> {
        self.rewind();
        let unpacked = self.decompress_and_check(record, read);
        if unpacked.is_err() {
            self.bytes.clear();
        }
        unpacked
    }

    /// Returns the operation code and the contents of the next record.
    #[expect(
        clippy::should_implement_trait,
        reason = "a record borrows from the chunk; an iterator's cannot"
    )]
    pub fn next(&mut self) -> Option<(u8, &[u8])> {
        let (opcode, body, rest) = split_record(self.bytes.get(self.at..)?)?.ok()?;
        (self.at, self.body) = (self.bytes.len() - rest, body.len());
        Some((opcode, body))
    }

    /// Returns the contents of the record that was returned last.
    #[must_use]
    pub fn body(&self) -> &[u8] {
        self.bytes.get(self.at - self.body..self.at).unwrap_or_default()
    }

    /// Returns true if the current chunk has a checksum. [`Chunk::unpack`] has then found it correct.
    #[must_use]
    pub const fn has_checksum(&self) -> bool {
        self.is_checked
    }

    /// Goes back to the first record.
    pub const fn rewind(&mut self) {
        (self.at, self.body) = (0, 0);
    }

    fn decompress_and_check(&mut self, record: &[u8], read: u64) -> Result<(), FormatError> {
        let mut from = Fields::new("chunk", record);
        from.u64("start time")?;
        from.u64("end time")?;
        let claimed = from.u64("uncompressed size")?;
        let saved = from.u32("checksum")?;
        let compression = from.text("compression")?;
        let packed = from.u64("compressed size")?;
        let packed = from.bytes(packed, "records")?;
        if claimed > MAX_RECORD_BYTES {
            return Err(FormatError::TooLong {
                what: "chunk, unpacked,",
                bytes: claimed,
                limit: MAX_RECORD_BYTES,
            });
        }
        let limit = BASE_LIMIT_BYTES.saturating_add(read.saturating_mul(MAX_EXPANSION_RATIO));
        self.total_bytes = self.total_bytes.saturating_add(claimed);
        if self.total_bytes > limit {
            return Err(FormatError::Bomb { read, limit, what: "bytes" });
        }
        self.bytes.clear();
        match compression {
            "" => self.bytes.extend_from_slice(packed),
            "zstd" => self.unpack_zstd(packed, claimed)?,
            "lz4" => self.unpack_lz4(packed, claimed)?,
            other => return Err(FormatError::Compression(other.chars().take(20).collect())),
        }
        let found = self.bytes.len() as u64;
        if found != claimed {
            return Err(FormatError::Unpacked { claimed, found });
        }
        self.is_checked = saved != 0;
        if saved != 0 {
            let found = crc32fast::hash(&self.bytes);
            if found != saved {
                return Err(FormatError::Checksum { what: "a chunk", saved, found });
            }
        }
        let mut rest = self.bytes.as_slice();
        while let Some(record) = split_record(rest) {
            let (_, _, leftover) = record?;
            rest = rest.get(rest.len() - leftover..).unwrap_or_default();
            self.total_records += 1;
        }
        let limit = BASE_LIMIT_RECORDS.saturating_add(read.saturating_mul(MAX_RECORDS_PER_BYTE));
        if self.total_records > limit {
            return Err(FormatError::Bomb { read, limit, what: "records" });
        }
        Ok(())
    }

    /// Decompresses each zstd frame into the same buffer, which has the size that the chunk claims. The window size
    /// that a frame requests is therefore not allocated.
    fn unpack_zstd(&mut self, mut packed: &[u8], claimed: u64) -> Result<(), FormatError> {
        let wrong = |code: ErrorCode| FormatError::Unpack(get_error_name(code).to_owned());
        let context = self.zstd.get_or_insert_with(DCtx::create);
        while !packed.is_empty() && (self.bytes.len() as u64) < claimed {
            let frame = zstd_safe::find_frame_compressed_size(packed).map_err(wrong)?;
            let (frame, rest) = packed.split_at_checked(frame).unwrap_or((packed, &[]));
            packed = rest;
            let room = usize::try_from(claimed).unwrap_or(0) - self.bytes.len();
            // Memory that is reserved and not written takes no space, so a small chunk that claims a large size costs
            // nothing.
            if self.bytes.is_empty() {
                self.bytes.reserve_exact(room);
                context.decompress(&mut self.bytes, frame).map_err(wrong)?;
            } else {
                let mut more = Vec::with_capacity(room);
                context.decompress(&mut more, frame).map_err(wrong)?;
                self.bytes.append(&mut more);
            }
        }
        Ok(())
    }

    fn unpack_lz4(&mut self, mut packed: &[u8], claimed: u64) -> Result<(), FormatError> {
        let wrong = |error: io::Error| FormatError::Unpack(error.to_string());
        while !packed.is_empty() && (self.bytes.len() as u64) < claimed {
            let before = (packed.len(), self.bytes.len());
            let mut decoder = FrameDecoder::new(packed);
            let leftover = claimed - self.bytes.len() as u64;
            (&mut decoder).take(leftover).read_to_end(&mut self.bytes).map_err(wrong)?;
            packed = decoder.into_inner();
            if before == (packed.len(), self.bytes.len()) {
                break;
            }
        }
        Ok(())
    }
}

/// A record's operation code, its contents, and the number of bytes after it.
type SplitRecord<'a> = (u8, &'a [u8], usize);

/// Splits the first record off a sequence of records.
fn split_record(records: &[u8]) -> Option<Result<SplitRecord<'_>, FormatError>> {
    if records.is_empty() {
        return None;
    }
    let leftover = records.len() as u64;
    let Some((&[opcode, ref length @ ..], rest)) = records.split_first_chunk::<RECORD_HEADER_BYTES>() else {
        return Some(Err(FormatError::Overrun { bytes: RECORD_HEADER_BYTES as u64, leftover }));
    };
    let bytes = u64::from_le_bytes(*length);
    let whole = usize::try_from(bytes).ok().and_then(|bytes| rest.split_at_checked(bytes));
    let whole = whole.ok_or(FormatError::Overrun { bytes, leftover: rest.len() as u64 });
    Some(whole.map(|(body, rest)| (opcode, body, rest.len())))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Builds a chunk record that claims to decompress to `claimed` bytes.
    fn chunk(claimed: u64, checksum: u32, compression: &str, packed: &[u8]) -> Vec<u8> {
        let name = u32::try_from(compression.len()).unwrap().to_le_bytes();
        let packed = [&(packed.len() as u64).to_le_bytes()[..], packed].concat();
        let head = [[0; 8], [0; 8], claimed.to_le_bytes()].concat();
        [&head[..], &checksum.to_le_bytes(), &name, compression.as_bytes(), &packed].concat()
    }

    fn record(claimed: u64, body: &[u8]) -> Vec<u8> {
        [&[5][..], &claimed.to_le_bytes(), body].concat()
    }

    fn lz4(bytes: &[u8]) -> Vec<u8> {
        let mut encoder = lz4_flex::frame::FrameEncoder::new(Vec::new());
        io::Write::write_all(&mut encoder, bytes).unwrap();
        encoder.finish().unwrap()
    }

    fn unpacked(record: &[u8]) -> Result<Vec<(u8, Vec<u8>)>, FormatError> {
        let mut chunk = Chunk::default();
        chunk.unpack(record, 1_000)?;
        Ok(std::iter::from_fn(|| chunk.next().map(|(code, body)| (code, body.to_vec()))).collect())
    }

    #[test]
    fn whatever_its_compression_a_chunk_has_its_records() {
        let two = [record(3, b"abc"), record(0, b"")].concat();
        let length = two.len() as u64;
        let checksum = crc32fast::hash(&two);
        let zstd = zstd::bulk::compress(&two, 1).unwrap();
        // The data is split into two zstd frames. In one case, bytes follow the second frame.
        let (first, second) = two.split_at(7);
        let frames = [first, second].map(|part| zstd::bulk::compress(part, 1).unwrap()).concat();
        let lz4 = [first, second].map(lz4).concat();
        let expected = Ok(vec![(5, b"abc".to_vec()), (5, Vec::new())]);
        for (compression, packed) in
            [("", two.clone()), ("zstd", zstd), ("zstd", [&frames[..], b"more"].concat()), ("lz4", lz4)]
        {
            assert_eq!(unpacked(&chunk(length, checksum, compression, &packed)), expected);
            assert_eq!(unpacked(&chunk(length, 0, compression, &packed)), expected, "no checksum");
            let wrong = FormatError::Checksum { what: "a chunk", saved: 1, found: checksum };
            assert_eq!(unpacked(&chunk(length, 1, compression, &packed)), Err(wrong));
        }
    }

    #[test]
    fn what_a_chunk_claims_is_compared_with_what_is_there() {
        let one = record(3, b"abc");
        let long = record(u64::MAX, b"abc");
        assert_eq!(
            unpacked(&chunk(12, 0, "", &long)),
            Err(FormatError::Overrun { bytes: u64::MAX, leftover: 3 })
        );
        assert_eq!(
            unpacked(&chunk(5, 0, "", &one[..5])),
            Err(FormatError::Overrun { bytes: 9, leftover: 5 })
        );
        assert_eq!(unpacked(&chunk(11, 0, "", &one)), Err(FormatError::Unpacked { claimed: 11, found: 12 }));
        let none =
            FormatError::TooLong { what: "chunk, unpacked,", bytes: u64::MAX, limit: MAX_RECORD_BYTES };
        assert_eq!(unpacked(&chunk(u64::MAX, 0, "zstd", &one)), Err(none));
        assert!(matches!(unpacked(&chunk(12, 0, "zstd", &one)), Err(FormatError::Unpack(_))));
        assert!(matches!(unpacked(&chunk(12, 0, "lz4", &one)), Err(FormatError::Unpack(_))));
        assert_eq!(unpacked(&chunk(12, 0, "br", &one)), Err(FormatError::Compression("br".to_owned())));
        // A reader needs no more than the last block of an LZ4 frame; the four bytes after it are spare.
        for (compression, packed, spare) in
            [("zstd", zstd::bulk::compress(&one, 1).unwrap(), 0), ("lz4", lz4(&one), 4)]
        {
            let whole = chunk(12, 0, compression, &packed);
            let length = 32 + compression.len();
            for end in 0..whole.len() - spare {
                let mut cut = whole[..end].to_vec();
                assert!(unpacked(&cut).is_err(), "{compression} {end}");
                // The truncated chunk must also fail if its length field is adapted to the truncation.
                if let Some((bytes, left)) = cut.split_at_mut_checked(length + 8) {
                    bytes[length..].copy_from_slice(&(left.len() as u64).to_le_bytes());
                }
                assert!(unpacked(&cut).is_err(), "{compression} {end}");
            }
        }
    }

    #[test]
    fn chunks_may_not_unpack_to_far_more_than_their_file() {
        let zeros = vec![0; 100 << 20];
        let packed = zstd::bulk::compress(&record(zeros.len() as u64, &zeros), 1).unwrap();
        let record = chunk(zeros.len() as u64 + 9, 0, "zstd", &packed);
        let mut chunk = Chunk::default();
        assert_eq!((chunk.unpack(&record, 0), chunk.unpack(&record, 0)), (Ok(()), Ok(())));
        let bomb = FormatError::Bomb { read: 0, limit: BASE_LIMIT_BYTES, what: "bytes" };
        assert_eq!(chunk.unpack(&record, 0), Err(bomb));
        assert_eq!(chunk.next(), None);
    }
}
