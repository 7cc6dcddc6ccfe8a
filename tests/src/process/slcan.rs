//! Test ends of serial lines, which stand for adapters or cells: pseudoterminals and sockets.
#![allow(
    dead_code,
    clippy::unwrap_used,
    clippy::panic,
    reason = "each test file uses its part of it, and a test may stop"
)]

use std::fs::File;
use std::io::{ErrorKind, Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use protocol::can::Frame;
use protocol::slcan::{Decoder, SlcanLine, encode};
use rustix::fs::{Mode, OFlags};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

use crate::process::until;

/// The other end of a line: an adapter, or a cell.
pub struct Peer {
    file: File,
    decoder: Decoder,
    /// All bytes so far.
    pub bytes: Vec<u8>,
    lines: Vec<SlcanLine>,
}

/// A pseudoterminal: the path that a program opens, and the test's end.
pub struct Pty {
    pub peer: Peer,
    pub path: PathBuf,
    /// The program's end, kept open so that the test's end can be read also while no program has opened it.
    pub slave: OwnedFd,
}

impl Pty {
    /// Opens a pseudoterminal that passes bytes unchanged.
    pub fn new() -> Self {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).unwrap();
        grantpt(&master).unwrap();
        unlockpt(&master).unwrap();
        let name = ptsname(&master, Vec::new()).unwrap();
        let path = PathBuf::from(std::ffi::OsStr::from_bytes(name.as_bytes()));
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC;
        let slave = rustix::fs::open(&path, flags, Mode::empty()).unwrap();
        let mut settings = tcgetattr(&slave).unwrap();
        settings.make_raw();
        tcsetattr(&slave, OptionalActions::Now, &settings).unwrap();
        Self { peer: Peer::new(master), path, slave }
    }

    /// Opens a pseudoterminal under this path, which is replaced.
    pub fn under(path: &Path) -> Self {
        let pty = Self::new();
        let _ = std::fs::remove_file(path);
        std::os::unix::fs::symlink(&pty.path, path).unwrap();
        pty
    }
}

impl Peer {
    pub fn new(fd: impl Into<OwnedFd>) -> Self {
        let fd = fd.into();
        rustix::io::ioctl_fionbio(&fd, true).unwrap();
        Self { file: File::from(fd), decoder: Decoder::new(), bytes: Vec::new(), lines: Vec::new() }
    }

    /// Reads the available bytes; returns true while the line is open.
    pub fn read_available(&mut self) -> bool {
        let mut buffer = [0; 4_096];
        loop {
            match self.file.read(&mut buffer) {
                Ok(0) => return false,
                Ok(count) => {
                    let bytes = &buffer.get(..count).unwrap();
                    self.bytes.extend_from_slice(bytes);
                    self.lines.extend(bytes.iter().filter_map(|&byte| self.decoder.push(byte)));
                }
                Err(error) if error.kind() == ErrorKind::WouldBlock => return true,
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(_) => return false,
            }
        }
    }

    /// Waits until this text has come over the line.
    pub fn wait_for_text(&mut self, text: &str) {
        until(text, || {
            self.read_available();
            self.bytes.windows(text.len()).any(|bytes| bytes == text.as_bytes()).then_some(())
        });
    }

    /// Returns the frames so far.
    pub fn frames(&self) -> Vec<Frame> {
        let frame = |line: &SlcanLine| if let SlcanLine::Frame(frame) = line { Some(*frame) } else { None };
        self.lines.iter().filter_map(frame).collect()
    }

    /// Waits until this number of frames has come over the line, and returns them.
    pub fn receives(&mut self, count: usize) -> Vec<Frame> {
        until("frames at the line", || {
            self.read_available();
            (self.frames().len() >= count).then_some(())
        });
        self.frames()
    }

    /// Writes all bytes, and waits while the line has no room.
    pub fn write_bytes(&mut self, bytes: &[u8]) {
        let mut rest = bytes;
        until("the line to take bytes", || {
            match self.file.write(rest) {
                Ok(count) => rest = rest.get(count..).unwrap(),
                Err(error) => {
                    assert!(matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted), "{error}")
                }
            }
            rest.is_empty().then_some(())
        });
    }

    pub fn sends(&mut self, frames: &[Frame]) {
        let text: Vec<u8> =
            frames.iter().flat_map(|frame| encode(frame).unwrap().as_bytes().to_vec()).collect();
        self.write_bytes(&text);
    }
}

/// Forwards bytes from one end to the other, until the first is closed.
pub fn carry(from: &Peer, to: &Peer) {
    let (mut from, mut to) = (from.file.try_clone().unwrap(), to.file.try_clone().unwrap());
    std::thread::spawn(move || {
        let mut buffer = [0; 4_096];
        let pause = || std::thread::sleep(Duration::from_micros(200));
        loop {
            let count = match from.read(&mut buffer) {
                Ok(count) => count,
                Err(error) if error.kind() == ErrorKind::WouldBlock => {
                    pause();
                    continue;
                }
                Err(_) => return,
            };
            let mut rest = &buffer[..count];
            while !rest.is_empty() {
                match to.write(rest) {
                    Ok(count) => rest = &rest[count..],
                    Err(error) if error.kind() == ErrorKind::WouldBlock => pause(),
                    Err(_) => return,
                }
            }
        }
    });
}
