//! Batches of datagrams, received and sent with one system call. Clients and servers of embedded buses use them, and
//! SocketCAN.
//!
//! Only functions whose documentation says so wait. Nothing allocates after [`ReceiveBatch::new`].

use std::io;
use std::os::fd::AsFd;

use rustix::io::Errno;
use rustix::net::SendFlags;

use super::calls;
use super::slot::DatagramBuffer;
use super::slot::{MAX_FRAME_DATAGRAM_BYTES, STAMP_BYTES};
use crate::can::FD_BYTES;

pub use super::slot::DatagramInfo;

/// Maximum number of datagrams per system call.
pub const MAX_BATCH_DATAGRAMS: usize = 64;
/// Number of datagrams of the first receive call. Most calls return one or two, and preparing 64 slots costs
/// more than receiving a datagram.
const FIRST_BATCH_SIZE: usize = 4;
/// Capacity of the smaller of the two send calls, which suffices for most sends. Preparing fewer slots is faster; see
/// [`FIRST_BATCH_SIZE`].
pub(super) const SMALL_BATCH_SIZE: usize = 8;

/// A receive buffer for up to [`MAX_BATCH_DATAGRAMS`] datagrams of at most 80 bytes.
pub struct ReceiveBatch {
    slots: Box<[DatagramBuffer; MAX_BATCH_DATAGRAMS]>,
    count: usize,
    /// The error that followed the datagrams of the last receive. It is stored because the kernel reports it only once.
    failure: Option<io::Error>,
}

impl ReceiveBatch {
    /// Creates an empty buffer.
    #[must_use]
    pub fn new() -> Self {
        let slot = || DatagramBuffer {
            bytes: [0; MAX_FRAME_DATAGRAM_BYTES],
            control: [0; 8],
            len: 0,
            control_len: 0,
            flags: 0,
        };
        Self { slots: Box::new(std::array::from_fn(|_| slot())), count: 0, failure: None }
    }

    /// Receives the pending datagrams of a socket, replacing the contents of the buffer, and returns their number.
    /// Never waits.
    ///
    /// # Errors
    /// Returns the error of `recvmmsg`: [`io::ErrorKind::WouldBlock`] if nothing is pending.
    pub fn receive(&mut self, fd: impl AsFd) -> io::Result<usize> {
        (self.count, self.failure) = (0, None);
        let (fd, slots) = (fd.as_fd(), self.slots.as_mut_slice());
        let Some((few, rest)) = slots.split_first_chunk_mut::<FIRST_BATCH_SIZE>() else { return Ok(0) };
        self.count = retry_on_interrupt(|| calls::receive(fd, few, false))?;
        if let (FIRST_BATCH_SIZE, Some(many)) =
            (self.count, rest.first_chunk_mut::<{ MAX_BATCH_DATAGRAMS - FIRST_BATCH_SIZE }>())
        {
            match retry_on_interrupt(|| calls::receive(fd, many, false)) {
                Ok(count) => self.count += count,
                Err(error) => self.failure = Some(error).filter(|it| it.kind() != io::ErrorKind::WouldBlock),
            }
        }
        Ok(self.count)
    }

    /// Removes and returns the error that followed the last received datagrams.
    pub(super) const fn take_failure(&mut self) -> Option<io::Error> {
        self.failure.take()
    }

    #[cfg(test)]
    pub(super) fn fail_after(&mut self, error: io::Error) {
        self.failure = Some(error);
    }

    /// Receives one datagram, waiting up to the socket's `SO_RCVTIMEO`. It does not try to receive a second one,
    /// because a receiver that wakes up for each datagram rarely finds another.
    pub(super) fn receive_one(&mut self, fd: impl AsFd) -> io::Result<usize> {
        (self.count, self.failure) = (0, None);
        let Some((one, _)) = self.slots.split_first_chunk_mut::<1>() else { return Ok(0) };
        self.count = calls::receive(fd.as_fd(), one, true)?;
        Ok(self.count)
    }

    /// Returns the datagrams of the last receive, in order of arrival.
    pub fn datagrams(&self) -> impl ExactSizeIterator<Item = Datagram<'_>> {
        self.slots.iter().take(self.count).map(Datagram)
    }
}

impl Default for ReceiveBatch {
    fn default() -> Self {
        Self::new()
    }
}

impl std::fmt::Debug for ReceiveBatch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Batch").field("count", &self.count).finish_non_exhaustive()
    }
}

/// One datagram in a [`ReceiveBatch`].
#[derive(Clone, Copy)]
pub struct Datagram<'a>(&'a DatagramBuffer);

impl<'a> Datagram<'a> {
    /// Returns the bytes of the datagram; `None` if it was truncated because it is longer than 80 bytes.
    #[must_use]
    pub fn bytes(self) -> Option<&'a [u8]> {
        if self.0.flags & libc::MSG_TRUNC == 0 { self.0.bytes.get(..self.0.len) } else { None }
    }

    /// Returns true if the datagram was sent by the receiving socket itself (`MSG_CONFIRM`).
    #[must_use]
    pub const fn is_own(self) -> bool {
        self.0.flags & libc::MSG_CONFIRM != 0
    }

    /// Returns the datagram's time of arrival and the socket's drop count. Each is `None` if the kernel did not report
    /// it.
    #[must_use]
    pub fn info(self) -> DatagramInfo {
        let words = self.0.control.map(u64::to_ne_bytes);
        DatagramInfo::decode(words.as_flattened().get(..self.0.control_len).unwrap_or_default())
    }
}

impl std::fmt::Debug for Datagram<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Datagram").field(&self.bytes()).finish()
    }
}

/// A send buffer for up to N datagrams of at most 72 bytes, each with a time stamp if it has one.
pub struct Outgoing<const N: usize = MAX_BATCH_DATAGRAMS> {
    bytes: [[u8; MAX_FRAME_DATAGRAM_BYTES]; N],
    lens: [usize; N],
    count: usize,
}

impl<const N: usize> Outgoing<N> {
    /// Creates an empty buffer.
    #[must_use]
    pub const fn new() -> Self {
        Self { bytes: [[0; MAX_FRAME_DATAGRAM_BYTES]; N], lens: [0; N], count: 0 }
    }

    /// Removes all datagrams from the buffer.
    pub const fn clear(&mut self) {
        self.count = 0;
    }

    /// Appends a datagram of the first `len` of these bytes (at most 72). Returns false if the buffer is full.
    pub fn push(&mut self, bytes: &[u8; FD_BYTES], len: usize) -> bool {
        let room = self.bytes.get_mut(self.count).zip(self.lens.get_mut(self.count));
        let Some((to, to_len)) = room else { return false };
        if let Some((to, _)) = to.split_first_chunk_mut() {
            *to = *bytes;
        }
        *to_len = len.min(FD_BYTES);
        self.count += 1;
        true
    }

    /// Appends the time stamp of a timed bus to the last datagram.
    pub fn append_stamp(&mut self, nanos: u64) {
        let last = self.count.wrapping_sub(1);
        let Some((bytes, len)) = self.bytes.get_mut(last).zip(self.lens.get_mut(last)) else { return };
        if let Some((to, _)) = bytes.get_mut(*len..).and_then(<[u8]>::split_first_chunk_mut) {
            *to = nanos.to_le_bytes();
            *len += STAMP_BYTES;
        }
    }

    /// Sends all datagrams in order without waiting, and returns the number that the socket accepted.
    ///
    /// # Errors
    /// Returns the error of `sendmmsg` if no datagram was sent: [`io::ErrorKind::WouldBlock`] if the socket
    /// is full.
    pub fn send(&self, fd: impl AsFd) -> io::Result<usize> {
        let datagrams = self.bytes.iter().zip(&self.lens).take(self.count);
        let mut datagrams = datagrams.map(|(bytes, &len)| bytes.get(..len).unwrap_or(bytes));
        match self.count {
            0 => Ok(0),
            1 => send_one(fd, datagrams.next().unwrap_or_default()),
            2..=SMALL_BATCH_SIZE => {
                retry_on_interrupt(|| calls::send::<SMALL_BATCH_SIZE>(fd.as_fd(), datagrams.clone()))
            }
            _ => retry_on_interrupt(|| calls::send::<N>(fd.as_fd(), datagrams.clone())),
        }
    }
}

/// Sends one datagram without waiting, and returns 1.
///
/// # Errors
/// Returns the error of `send`: [`io::ErrorKind::WouldBlock`] if the socket is full.
pub fn send_one(fd: impl AsFd, bytes: &[u8]) -> io::Result<usize> {
    let flags = SendFlags::DONTWAIT | SendFlags::NOSIGNAL;
    rustix::io::retry_on_intr(|| rustix::net::send(&fd, bytes, flags))?;
    Ok(1)
}

/// Returns true if an error means a temporary shortage of memory, unrelated to the socket.
#[must_use]
pub fn is_memory_shortage(error: &io::Error) -> bool {
    let errno = error.raw_os_error().map(Errno::from_raw_os_error);
    matches!(errno, Some(Errno::NOMEM | Errno::NOBUFS))
}

/// Repeats a non-blocking call that a signal interrupted.
fn retry_on_interrupt(mut call: impl FnMut() -> io::Result<usize>) -> io::Result<usize> {
    loop {
        match call() {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            done => return done,
        }
    }
}

impl<const N: usize> Default for Outgoing<N> {
    fn default() -> Self {
        Self::new()
    }
}

impl<const N: usize> std::fmt::Debug for Outgoing<N> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Outgoing").field("count", &self.count).finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::net::{AddressFamily, SocketFlags, SocketType, socketpair};

    #[test]
    fn a_batch_comes_in_order_with_its_lengths() {
        let (a, b) =
            socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None).unwrap();
        let mut outgoing = <Outgoing>::new();
        for len in 1..=MAX_BATCH_DATAGRAMS {
            assert!(outgoing.push(&[u8::try_from(len).unwrap(); FD_BYTES], len));
        }
        assert!(!outgoing.push(&[0; FD_BYTES], 1), "64 fit, a 65th does not");
        assert_eq!(outgoing.send(&a).unwrap(), MAX_BATCH_DATAGRAMS);

        let mut batch = ReceiveBatch::new();
        assert_eq!(batch.receive(&b).unwrap(), MAX_BATCH_DATAGRAMS);
        let lens: Vec<_> = batch.datagrams().map(|datagram| datagram.bytes().unwrap().len()).collect();
        assert_eq!(lens, (1..=MAX_BATCH_DATAGRAMS).collect::<Vec<_>>());
        assert_eq!(batch.receive(&b).unwrap_err().kind(), io::ErrorKind::WouldBlock);
    }

    fn sent_whole_and_in_order<const N: usize>() {
        let (a, b) =
            socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None).unwrap();
        let (mut outgoing, mut batch) = (Outgoing::<N>::new(), ReceiveBatch::new());
        assert_eq!(outgoing.send(&a).unwrap(), 0);
        for count in 1..=N {
            outgoing.clear();
            for len in 1..=count {
                assert!(outgoing.push(&[u8::try_from(len).unwrap(); FD_BYTES], len));
            }
            assert_eq!(outgoing.send(&a).unwrap(), count);
            assert_eq!(batch.receive(&b).unwrap(), count);
            let bytes = batch.datagrams().map(|datagram| datagram.bytes().unwrap());
            assert!(bytes.eq((1..=count).map(|len| vec![u8::try_from(len).unwrap(); len])), "{count}");
        }
    }

    #[test]
    fn each_number_of_datagrams_is_sent_whole_and_in_order() {
        sent_whole_and_in_order::<SMALL_BATCH_SIZE>();
        sent_whole_and_in_order::<MAX_BATCH_DATAGRAMS>();
    }

    #[test]
    fn what_is_too_long_is_told_apart_from_what_fits() {
        let (a, b) =
            socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None).unwrap();
        rustix::net::send(&a, &[1; 81], SendFlags::empty()).unwrap();
        rustix::net::send(&a, &[2; 80], SendFlags::empty()).unwrap();
        let mut batch = ReceiveBatch::new();
        assert_eq!(batch.receive(&b).unwrap(), 2);
        let bytes: Vec<_> = batch.datagrams().map(Datagram::bytes).collect();
        assert_eq!(bytes, [None, Some(&[2; 80][..])]);
    }

    #[test]
    fn passed_descriptors_are_closed_and_time_stamps_beside_them_read() {
        use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, sendmsg};
        use socketcan::SocketOptions;
        use std::mem::MaybeUninit;

        let (a, b) =
            socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None).unwrap();
        let b = socketcan::CanFdSocket::from(b);
        b.set_recv_timestamp(true).unwrap();
        let mut batch = ReceiveBatch::new();
        for count in 1..=5 {
            let (read, write) = io::pipe().unwrap();
            rustix::io::ioctl_fionbio(&read, true).unwrap();
            let passed = vec![write.as_fd(); count];
            let mut space = [MaybeUninit::uninit(); 128];
            let mut control = SendAncillaryBuffer::new(&mut space);
            assert!(control.push(SendAncillaryMessage::ScmRights(&passed)));
            sendmsg(&a, &[io::IoSlice::new(&[7; 16])], &mut control, SendFlags::empty()).unwrap();
            drop(write);
            assert_eq!(batch.receive(&b).unwrap(), 1);
            let datagram = batch.datagrams().next().unwrap();
            assert_eq!(datagram.bytes().unwrap(), [7; 16]);
            assert!(datagram.info().at_nanos.is_some());
            // All write ends of the pipe are closed, so the read returns 0.
            assert_eq!(rustix::io::read(&read, &mut [0]).unwrap(), 0, "{count}");
        }
    }
}
