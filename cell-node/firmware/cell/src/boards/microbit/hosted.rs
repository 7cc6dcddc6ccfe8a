//! Flash of an emulated cell: a file of the host, by Arm's semihosting. Its path is the program's command line. A new
//! image goes into a file beside it, which then takes its place, so that an emulator that is killed leaves the old
//! one or the new one.

use cortex_m_semihosting::syscall;

/// Bytes of a path, with what is added to it.
const MAX_PATH: usize = 256;
/// Behind the path of a file that is being written.
const PART: &[u8] = b".part";
/// Modes of opening: `rb` and `wb`.
const READ: usize = 1;
const WRITE: usize = 5;
/// What a call answers that failed.
const FAILED: usize = usize::MAX;

/// A path with a 0 at its end.
struct Path {
    bytes: [u8; MAX_PATH],
    len: usize,
}

impl Path {
    /// The file's path; `None` where the emulator was given none.
    fn given() -> Option<Self> {
        let mut bytes = [0; MAX_PATH];
        // SAFETY: a buffer of this frame, and its size.
        let answer = unsafe { syscall!(GET_CMDLINE, bytes.as_mut_ptr(), MAX_PATH - PART.len() - 1) };
        let len = bytes.iter().position(|byte| *byte == 0)?;
        (answer == 0 && len > 0).then_some(Self { bytes, len })
    }

    /// The path of the file that is being written.
    fn part(&self) -> Self {
        let mut bytes = self.bytes;
        bytes.iter_mut().skip(self.len).zip(PART).for_each(|(byte, part)| *byte = *part);
        Self { bytes, len: self.len + PART.len() }
    }

    fn open(&self, mode: usize) -> Option<File> {
        // SAFETY: a path that ends with 0, and its length.
        let handle = unsafe { syscall!(OPEN, self.bytes.as_ptr(), mode, self.len) };
        (handle != FAILED).then_some(File(handle))
    }
}

/// An open file.
struct File(usize);

impl Drop for File {
    fn drop(&mut self) {
        // SAFETY: a handle that is open.
        unsafe { syscall!(CLOSE, self.0) };
    }
}

/// What the file holds, as far as there is room; `None` where there is no file.
#[inline(never)]
pub(super) fn load(into: &mut [u8]) -> Option<usize> {
    let file = Path::given()?.open(READ)?;
    // SAFETY: a buffer and its size.
    let left = unsafe { syscall!(READ, file.0, into.as_mut_ptr(), into.len()) };
    into.len().checked_sub(left)
}

/// Puts the image in the file's place; whether it is there.
// Not inlined, so that the paths are off the stack of whoever calls it.
#[inline(never)]
pub(super) fn store(image: &[u8]) -> bool {
    let Some(path) = Path::given() else { return false };
    let part = path.part();
    let Some(file) = part.open(WRITE) else { return false };
    // SAFETY: a buffer and its size.
    let left = unsafe { syscall!(WRITE, file.0, image.as_ptr(), image.len()) };
    drop(file);
    // SAFETY: two paths that end with 0, and their lengths.
    let renamed = unsafe { syscall!(RENAME, part.bytes.as_ptr(), part.len, path.bytes.as_ptr(), path.len) };
    left == 0 && renamed == 0
}
