//! One column: a NumPy file that is written row by row.

use std::fs::File;
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::Path;

/// Number of bytes written at once.
const WRITE_BYTES: usize = 128 << 10;
/// Length of the header in bytes: a multiple of 64 with room for any number of rows.
const HEADER_BYTES: usize = 128;
/// Length in bytes of the magic string, the version and the length field before the header's text.
const PREFIX_BYTES: usize = 10;

/// Type of the elements of a column, each little-endian.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Element {
    /// A truth value in one byte.
    Bool,
    /// An unsigned integer of 8 bits.
    U8,
    /// An unsigned integer of 32 bits.
    U32,
    /// A signed integer of 16 bits.
    I16,
    /// A signed integer of 64 bits.
    I64,
    /// A number of double precision.
    F64,
}

impl Element {
    /// Returns the name of the type in the header of the file.
    const fn description(self) -> &'static str {
        match self {
            Self::Bool => "|b1",
            Self::U8 => "|u1",
            Self::U32 => "<u4",
            Self::I16 => "<i2",
            Self::I64 => "<i8",
            Self::F64 => "<f8",
        }
    }

    /// Returns the size of an element in bytes.
    #[must_use]
    pub const fn size(self) -> usize {
        match self {
            Self::Bool | Self::U8 => 1,
            Self::I16 => 2,
            Self::U32 => 4,
            Self::I64 | Self::F64 => 8,
        }
    }
}

/// A NumPy file that is being written. Its header gets the number of rows at the end.
#[derive(Debug)]
pub struct NpyFile {
    out: BufWriter<File>,
    element: Element,
    /// Number of elements of a row; `None` for an array of one dimension.
    width: Option<usize>,
    bytes: u64,
}

impl NpyFile {
    /// Creates a file, which must not exist.
    ///
    /// # Errors
    /// Returns an error if the file cannot be created or written.
    pub fn create(path: &Path, element: Element, width: Option<usize>) -> io::Result<Self> {
        let file = File::options().write(true).create_new(true).open(path)?;
        let mut out = BufWriter::with_capacity(WRITE_BYTES, file);
        out.write_all(&[0; HEADER_BYTES])?;
        Ok(Self { out, element, width, bytes: 0 })
    }

    /// Appends whole rows, given by the bytes of their elements.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.bytes += bytes.len() as u64;
        self.out.write_all(bytes)
    }

    /// Writes the header and the file to the disk. Returns the number of rows.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn finish(mut self) -> io::Result<u64> {
        let row_bytes = self.element.size() * self.width.unwrap_or(1);
        let rows = self.bytes.checked_div(row_bytes as u64).unwrap_or_default();
        self.out.seek(SeekFrom::Start(0))?;
        self.out.write_all(&header(self.element, rows, self.width)?)?;
        self.out.flush()?;
        self.out.get_ref().sync_all()?;
        Ok(rows)
    }
}

/// Returns the header of a file of format 1.0: the magic string, the version, the length, and a Python dictionary that
/// blanks and a line feed fill up.
fn header(element: Element, rows: u64, width: Option<usize>) -> io::Result<Vec<u8>> {
    let shape = width.map_or_else(|| format!("({rows},)"), |width| format!("({rows}, {width})"));
    let text =
        format!("{{'descr': '{}', 'fortran_order': False, 'shape': {shape}, }}", element.description());
    let room = HEADER_BYTES - PREFIX_BYTES - 1;
    if text.len() > room {
        return Err(io::Error::other(format!("{rows} rows do not fit the header of an NPY file")));
    }
    let mut header = b"\x93NUMPY\x01\x00".to_vec();
    header.extend(u16::try_from(room + 1).unwrap_or_default().to_le_bytes());
    header.extend(format!("{text:<room$}\n").bytes());
    Ok(header)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_has_the_header_of_numpy_and_its_rows() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("words.npy");
        let mut file = NpyFile::create(&path, Element::I16, Some(3)).unwrap();
        for row in [[1_i16, -2, 3], [i16::MIN, 0, i16::MAX]] {
            row.iter().for_each(|word| file.append(&word.to_le_bytes()).unwrap());
        }
        assert_eq!(file.finish().unwrap(), 2);
        let bytes = std::fs::read(path).unwrap();
        let (head, rest) = bytes.split_at(HEADER_BYTES);
        assert_eq!(&head[..10], b"\x93NUMPY\x01\x00\x76\x00");
        let text = std::str::from_utf8(&head[10..]).unwrap();
        assert!(
            text.starts_with("{'descr': '<i2', 'fortran_order': False, 'shape': (2, 3), } ")
                && text.ends_with(" \n"),
            "{text:?}"
        );
        assert_eq!(rest, [1, 0, 254, 255, 3, 0, 0, 128, 0, 0, 255, 127]);
    }

    #[test]
    fn the_header_has_room_for_any_number_of_rows() {
        assert_eq!(header(Element::F64, u64::MAX, Some(254)).unwrap().len(), HEADER_BYTES);
        assert_eq!(header(Element::Bool, 0, None).unwrap().len(), HEADER_BYTES);
    }

    #[test]
    fn an_existing_file_is_not_overwritten() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.npy");
        std::fs::write(&path, "mine").unwrap();
        assert!(NpyFile::create(&path, Element::U8, None).is_err());
    }
}
