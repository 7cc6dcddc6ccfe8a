//! Flash of an emulated cell in a file of the host, accessed with Arm semihosting. The command line of the emulated
//! program is the path of the file. A new image is written to a second file, which then replaces the first, so that
//! killing the emulator leaves either the old or the new image.

use cortex_m_semihosting::syscall;

/// Size of the path buffer in bytes, including the suffix.
const MAX_PATH: usize = 256;
/// Suffix of the file to which a new image is written.
const PART_SUFFIX: &[u8] = b".part";
/// Modes of OPEN: `rb` and `wb`.
const READ: usize = 1;
const WRITE: usize = 5;
/// The result of a semihosting call that failed.
const FAILED: usize = usize::MAX;

/// A path with a terminating 0.
struct Path {
    bytes: [u8; MAX_PATH],
    len: usize,
}

impl Path {
    /// Returns the path on the command line; `None` if the emulator was started without one.
    fn from_command_line() -> Option<Self> {
        let mut bytes = [0; MAX_PATH];
        // SAFETY: the buffer is on this stack frame, and its size is passed.
        let answer = unsafe { syscall!(GET_CMDLINE, bytes.as_mut_ptr(), MAX_PATH - PART_SUFFIX.len() - 1) };
        let len = bytes.iter().position(|byte| *byte == 0)?;
        (answer == 0 && len > 0).then_some(Self { bytes, len })
    }

    /// Returns the path of the file to which a new image is written.
    fn part_path(&self) -> Self {
        let mut bytes = self.bytes;
        bytes.iter_mut().skip(self.len).zip(PART_SUFFIX).for_each(|(byte, part)| *byte = *part);
        Self { bytes, len: self.len + PART_SUFFIX.len() }
    }

    fn open(&self, mode: usize) -> Option<File> {
        // SAFETY: the path ends with 0, and its length is passed.
        let handle = unsafe { syscall!(OPEN, self.bytes.as_ptr(), mode, self.len) };
        (handle != FAILED).then_some(File(handle))
    }
}

/// The handle of an open file.
struct File(usize);

impl Drop for File {
    fn drop(&mut self) {
        // SAFETY: the handle is open.
        unsafe { syscall!(CLOSE, self.0) };
    }
}

/// Reads the file into `into`, as far as there is room. Returns the number of bytes read; `None` if there is no file.
#[inline(never)]
pub(super) fn load(into: &mut [u8]) -> Option<usize> {
    let file = Path::from_command_line()?.open(READ)?;
    // SAFETY: the buffer and its size are passed.
    let left = unsafe { syscall!(READ, file.0, into.as_mut_ptr(), into.len()) };
    into.len().checked_sub(left)
}

/// Replaces the content of the file by an image. Returns true on success.
// Not inlined, to keep the paths off the caller's stack.
#[inline(never)]
pub(super) fn store(image: &[u8]) -> bool {
    let Some(path) = Path::from_command_line() else { return false };
    let part = path.part_path();
    let Some(file) = part.open(WRITE) else { return false };
    // SAFETY: the buffer and its size are passed.
    let left = unsafe { syscall!(WRITE, file.0, image.as_ptr(), image.len()) };
    drop(file);
    // SAFETY: both paths end with 0, and their lengths are passed.
    let renamed = unsafe { syscall!(RENAME, part.bytes.as_ptr(), part.len, path.bytes.as_ptr(), path.len) };
    left == 0 && renamed == 0
}
