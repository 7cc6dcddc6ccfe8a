//! Firmware images: the identity of a cell is written into the image before it is loaded.

use std::path::{Path, PathBuf};

use object::{Architecture, Object, ObjectSection};
use protocol::factory::{self, FactoryRecord};
use protocol::input;
use thiserror::Error;

/// Address range of the emulated microcontroller's flash.
const FLASH_ADDRESSES: std::ops::Range<u64> = 0..256 << 10;

/// Size limit of a firmware file in bytes; a firmware with full debug information has 4 MB.
const MAX_FILE_BYTES: u64 = 64 << 20;

/// An error of a file that is not the firmware of a cell.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum FirmwareError {
    /// The file cannot be read.
    #[error("--firmware {path}: {source}; docs/how-to/firmware.md explains how to build the firmware")]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// Cause.
        source: std::io::Error,
    },
    /// The file is not for this kind of microcontroller.
    #[error(
        "--firmware {path}: the file is not an ELF file for a 32-bit Arm microcontroller; docs/how-to/firmware.md \
         explains how to build the firmware"
    )]
    NotArm {
        /// Path of the file.
        path: PathBuf,
    },
    /// The file has no section for the factory's record.
    #[error(
        "--firmware {path}: the file has no section {section}, so it is not the firmware of a cell",
        section = factory::SECTION
    )]
    NoCell {
        /// Path of the file.
        path: PathBuf,
    },
    /// The file is for another board.
    #[error(
        "--firmware {path}: no emulator exists for its board; build the firmware with `--features microbit`"
    )]
    OtherBoard {
        /// Path of the file.
        path: PathBuf,
    },
}

/// A firmware image in memory.
#[derive(Clone, Debug)]
pub struct Firmware {
    bytes: Vec<u8>,
    /// Offset of the factory's record in the image in bytes.
    record: usize,
}

impl Firmware {
    /// Reads a firmware file.
    ///
    /// # Errors
    /// Returns [`FirmwareError`] if the file cannot be read or is not the firmware of a cell for the emulated board.
    pub fn read(path: &Path) -> Result<Self, FirmwareError> {
        let path = path.to_owned();
        match input::read_bytes(&path, MAX_FILE_BYTES) {
            Ok(bytes) => Self::parse(path, bytes),
            Err(source) => Err(FirmwareError::Read { path, source }),
        }
    }

    fn parse(path: PathBuf, bytes: Vec<u8>) -> Result<Self, FirmwareError> {
        let elf = match object::File::parse(&*bytes) {
            Ok(elf) if elf.architecture() == Architecture::Arm && !elf.is_64() => elf,
            Ok(_) | Err(_) => return Err(FirmwareError::NotArm { path }),
        };
        let Some(section) = elf.section_by_name(factory::SECTION) else {
            return Err(FirmwareError::NoCell { path });
        };
        if !FLASH_ADDRESSES.contains(&section.address()) {
            return Err(FirmwareError::OtherBoard { path });
        }
        let record = section.file_range().filter(|(_, len)| *len == factory::RECORD_BYTES as u64);
        let record = record.and_then(|(at, _)| usize::try_from(at).ok());
        match record.filter(|at| bytes.get(*at..*at + factory::RECORD_BYTES).is_some()) {
            Some(record) => Ok(Self { bytes, record }),
            None => Err(FirmwareError::NoCell { path }),
        }
    }

    /// Returns the image with the factory's record of one cell.
    #[must_use]
    pub fn image_for_cell(&self, factory: &FactoryRecord) -> Vec<u8> {
        let mut bytes = self.bytes.clone();
        if let Some(record) = bytes.get_mut(self.record..self.record + factory::RECORD_BYTES) {
            record.copy_from_slice(&factory.encode());
        }
        bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error(bytes: &[u8]) -> String {
        Firmware::parse("cell".into(), bytes.to_vec()).unwrap_err().to_string()
    }

    #[test]
    fn what_is_no_firmware_is_named() {
        let missing = Firmware::read(Path::new("/nowhere/cell")).unwrap_err().to_string();
        assert!(missing.starts_with("--firmware /nowhere/cell: No such file"), "{missing}");
        assert!(error(b"nothing").contains("not an ELF file for a 32-bit Arm microcontroller"));
        let own = std::fs::read(std::env::current_exe().unwrap()).unwrap();
        assert!(
            error(&own).contains("not an ELF file for a 32-bit Arm microcontroller"),
            "this test's own program"
        );
    }
}
