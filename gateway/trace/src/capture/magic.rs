//! Recognition of a file's format by its first bytes.

use std::fs::File;
use std::io::{self, Read, Seek};
use std::os::unix::fs::FileExt;

use ::mcap::records::op;

use super::text_kinds::ASC_KIND;
use crate::container::{self, read_uninterrupted};

/// The number of bytes at a file's beginning within which the header record of a recording must end.
const HEADER_SEARCH_BYTES: usize = 4 << 10;
const UNPACK_ADVICE: &str = "unpack it first";
const EXPORT_ADVICE: &str = "convert it to a recording with `can_logconvert FILE NEW.mcap` (pip install the Python \
                             package in gateway/python), or to a candump log with `can_logconvert FILE NEW.log` (pip \
                             install python-can)";

/// The first bytes of known formats. Everything else is treated as text.
const MAGIC: &[(&[u8], InputFormat)] = &[
    (b"\x89MCAP", InputFormat::Mcap),
    (b"PK\x03\x04", InputFormat::Other("a zip archive", UNPACK_ADVICE)),
    (b"PK\x05\x06", InputFormat::Other("an empty zip archive", UNPACK_ADVICE)),
    (b"\x1F\x8B", InputFormat::Other("a gzip file", UNPACK_ADVICE)),
    (b"\x28\xB5\x2F\xFD", InputFormat::Other("a zstd file", UNPACK_ADVICE)),
    (b"\xFD7zXZ", InputFormat::Other("an xz file", UNPACK_ADVICE)),
    (b"BZh", InputFormat::Other("a bzip2 file", UNPACK_ADVICE)),
    (b"\x04\x22\x4D\x18", InputFormat::Other("an lz4 file", UNPACK_ADVICE)),
    (b"\xD4\xC3\xB2\xA1", PCAP),
    (b"\xA1\xB2\xC3\xD4", PCAP),
    (b"\x4D\x3C\xB2\xA1", PCAP),
    (b"\xA1\xB2\x3C\x4D", PCAP),
    (b"\x0A\x0D\x0D\x0A", PCAP),
    (b"LOGG", InputFormat::Other("a BLF file", EXPORT_ADVICE)),
    (b"MDF  ", MDF),
    (b"UnFinMF ", MDF),
    (b"date ", InputFormat::Other(ASC_KIND.0, ASC_KIND.1)),
    (b";$FILEVERSION", TRC),
    (b"\xEF\xBB\xBF;$FILEVERSION", TRC),
    (b"timestamp,", CSV),
    (b"Timestamp,", CSV),
    (b"Timestamp;", CSV),
    (b"Time Stamp", CSV),
    (b"\xEF\xBB\xBFTime", CSV),
    (
        b"version https://git-lfs",
        InputFormat::Other("a Git LFS pointer to a file", "fetch it with `git lfs pull`"),
    ),
    (
        b"#ROSBAG V",
        InputFormat::Other(
            "a ROS 1 bag",
            "convert it to MCAP with `rosbags-convert --src FILE --dst NEW --dst-storage mcap` (pip install \
             rosbags), and name NEW/NEW.mcap",
        ),
    ),
    (
        b"SQLite format 3",
        InputFormat::Other(
            "an SQLite database",
            "convert a ROS 2 bag to MCAP with `rosbags-convert --src FOLDER --dst NEW --dst-storage mcap` (pip \
             install rosbags), and name NEW/NEW.mcap; convert a database of python-can to a candump log with \
             `can_logconvert FILE NEW.log`",
        ),
    ),
    (b"\xFF\xFE", UTF_16),
    (b"\xFE\xFF", UTF_16),
];

const MDF: InputFormat = InputFormat::Other(
    "an MDF file",
    "convert it to a recording with `can_logconvert FILE NEW.mcap` (pip install the Python package in gateway/python \
     and python-can[mf4]), or to a candump log with `can_logconvert FILE NEW.log` (pip install python-can[mf4])",
);
const TRC: InputFormat = InputFormat::Other("a PEAK trace", EXPORT_ADVICE);
const CSV: InputFormat = InputFormat::Other(
    "a table in CSV",
    "convert a table of python-can to a candump log with `can_logconvert FILE NEW.log`; from other tables, write \
     lines like `(1700000000.123456) can0 123#00`",
);
const PCAP: InputFormat = InputFormat::Other(
    "a packet capture",
    "write lines like `(1700000000.123456) can0 123#00` from the output of `tshark -T fields -e frame.time_epoch -e \
     can.id -e data.data -r FILE` (its identifiers are decimal), or take the capture with `candump -l`",
);
const UTF_16: InputFormat = InputFormat::Other(
    "text in UTF-16",
    "save it as UTF-8, for example with `iconv -f utf-16 -t utf-8 FILE > NEW.log`",
);

/// The format of an input, by its first bytes.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum InputFormat {
    Text,
    Mcap,
    /// A format that is not read, by its name, with advice to the user.
    Other(&'static str, &'static str),
}

/// Recognises the format of an input, and returns it with the bytes that were read for it. Reads as few bytes as
/// necessary, so that a pipe whose first line arrives slowly does not block longer than needed.
pub(super) fn detect_format(input: &mut impl Read) -> io::Result<(InputFormat, Vec<u8>)> {
    let mut head = Vec::new();
    let longest = MAGIC.iter().map(|(magic, _)| magic.len()).max().unwrap_or(0);
    let mut room = vec![0; longest];
    loop {
        if let Some((_, kind)) = MAGIC.iter().find(|(magic, _)| head.starts_with(magic)) {
            return Ok((*kind, head));
        }
        let open = MAGIC.iter().any(|(magic, _)| magic.starts_with(&head));
        let free = room.get_mut(head.len()..).unwrap_or_default();
        if !open || free.is_empty() {
            return Ok((InputFormat::Text, head));
        }
        let got = read_uninterrupted(input, free)?;
        if got == 0 {
            return Ok((InputFormat::Text, head));
        }
        head.extend_from_slice(free.get(..got).unwrap_or_default());
    }
}

/// Returns true if the file begins or ends with the magic bytes of MCAP. Rewinds the file.
pub(super) fn is_mcap(file: &mut File) -> io::Result<bool> {
    let (kind, _) = detect_format(file)?;
    if kind == InputFormat::Mcap {
        file.rewind()?;
        return Ok(true);
    }
    let (mut first, mut last) = (vec![0; HEADER_SEARCH_BYTES], [0; container::MAGIC.len()]);
    let size = file.metadata()?.len();
    if kind == InputFormat::Text && size > 2 * container::MAGIC.len() as u64 {
        let came = file.read_at(&mut first, 0)?;
        first.truncate(came);
        file.read_exact_at(&mut last, size - container::MAGIC.len() as u64)?;
    }
    file.rewind()?;
    // A damaged recording is recognised by intact magic bytes at its end, by most of those at its beginning, or by a
    // header record after them.
    let alike = first.iter().zip(container::MAGIC).filter(|(one, other)| one == other).count();
    Ok(last == *container::MAGIC
        || alike > container::MAGIC.len() / 2
        || is_header(first.get(container::MAGIC.len()..).unwrap_or_default()))
}

/// Returns true if the bytes begin with a complete header record.
fn is_header(bytes: &[u8]) -> bool {
    let Some((&[code, ref length @ ..], body)) =
        bytes.split_first_chunk::<{ container::RECORD_HEADER_BYTES }>()
    else {
        return false;
    };
    code == op::HEADER && container::length_by_fields(code, body) == Some(u64::from_le_bytes(*length))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Cursor;

    #[test]
    fn files_are_told_by_their_first_bytes() {
        let kind = |bytes: &[u8]| detect_format(&mut Cursor::new(bytes)).unwrap();
        assert_eq!(kind(mcap::MAGIC).0, InputFormat::Mcap);
        assert_eq!(kind(b"PK\x03\x04 and more").0, InputFormat::Other("a zip archive", UNPACK_ADVICE));
        assert_eq!(kind(b"(1.000000) can0 123#").0, InputFormat::Text);
        for text in [&b""[..], b"P", b"PK\x03", b"\n", b"#", b"#ROS", b"BZ"] {
            assert_eq!(kind(text), (InputFormat::Text, text.to_vec()));
        }
        for (magic, expected) in MAGIC {
            assert_eq!(kind(magic).0, *expected);
            assert_eq!(kind(magic).0 == InputFormat::Mcap, *magic == b"\x89MCAP");
            assert_ne!(kind(magic).0, InputFormat::Text, "{magic:?}");
        }
    }

    #[test]
    fn hints_name_a_program_that_reads_the_kind() {
        let hint = |bytes: &[u8]| match detect_format(&mut Cursor::new(bytes)).unwrap().0 {
            InputFormat::Other(_, hint) => hint,
            kind @ (InputFormat::Text | InputFormat::Mcap) => panic!("{kind:?}"),
        };
        // can_logconvert reads an ASC file with the header of other programs as empty, so asc2log is advised.
        assert!(hint(b"date Mon Dec 6 11:21:13 am 2021\n").contains("asc2log"));
        assert!(hint(b"MDF     4.11").contains("python-can[mf4]"));
        assert!(hint(b"LOGG").contains("can_logconvert FILE NEW.log"));
        assert!(hint(b"#ROSBAG V2.0").ends_with("name NEW/NEW.mcap"));
    }

    #[test]
    fn of_a_pipe_no_more_is_taken_than_tells_what_it_is() {
        /// A reader that returns its bytes one by one, and panics if more are requested.
        struct Slow(&'static [u8]);
        impl Read for Slow {
            fn read(&mut self, room: &mut [u8]) -> io::Result<usize> {
                let (first, rest) = self.0.split_first().expect("enough was there");
                self.0 = rest;
                room[0] = *first;
                Ok(1)
            }
        }
        // The magic of skippable zstd frames begins with a parenthesis too.
        assert_eq!(detect_format(&mut Slow(b"(1")).unwrap(), (InputFormat::Text, b"(1".to_vec()));
        assert_eq!(
            detect_format(&mut Slow(b"PK\x03\x04")).unwrap().0,
            InputFormat::Other("a zip archive", UNPACK_ADVICE)
        );
    }
}
