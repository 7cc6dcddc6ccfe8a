//! System calls without a safe wrapper: batches of datagrams, credentials of a peer, and scheduling. Callers decide
//! what to do on errors.

use std::io;
use std::mem;
use std::os::fd::{AsRawFd, BorrowedFd, FromRawFd, OwnedFd};

use super::slot::{DatagramBuffer, for_each_descriptor};

/// Sets the scheduling policy `SCHED_BATCH` for this thread. Returns true if the system granted it.
pub(super) fn set_sched_batch() -> bool {
    let parameters = libc::sched_param { sched_priority: 0 };
    // SAFETY: the pointer is to a live, initialised struct, which the call only reads.
    unsafe { libc::sched_setscheduler(0, libc::SCHED_BATCH, &raw const parameters) == 0 }
}

/// Returns the id of the process at the other end of a socket, which connected it (`SO_PEERCRED`); `None` if the
/// process is in another pid namespace, for which the kernel reports 0.
pub(super) fn peer_process(fd: BorrowedFd<'_>) -> Option<u32> {
    let mut peer = libc::ucred { pid: 0, uid: 0, gid: 0 };
    let mut len = libc::socklen_t::try_from(size_of_val(&peer)).ok()?;
    let pointer = (&raw mut peer).cast();
    // SAFETY: the pointers are to live variables, and `len` is the size of `peer`, of which every value is valid.
    let result = unsafe {
        libc::getsockopt(fd.as_raw_fd(), libc::SOL_SOCKET, libc::SO_PEERCRED, pointer, &raw mut len)
    };
    if result == 0 { u32::try_from(peer.pid).ok().filter(|pid| *pid > 0) } else { None }
}

/// Calls `recvmmsg` and returns the number of filled slots. If `wait` is true, waits for the first datagram up to the
/// socket's `SO_RCVTIMEO`. Closes file descriptors that come with a datagram.
// Not inlined: a caller's stack frame would grow by the largest N, and all its pages would be touched.
#[inline(never)]
pub(super) fn receive<const N: usize>(
    fd: BorrowedFd<'_>,
    slots: &mut [DatagramBuffer; N],
    wait: bool,
) -> io::Result<usize> {
    let mut vectors = [libc::iovec { iov_base: std::ptr::null_mut(), iov_len: 0 }; N];
    // SAFETY: an `mmsghdr` of zeros is a valid one: null pointers with zero lengths.
    let mut headers: [libc::mmsghdr; N] = unsafe { mem::zeroed() };
    for ((slot, vector), header) in slots.iter_mut().zip(&mut vectors).zip(&mut headers) {
        vector.iov_base = slot.bytes.as_mut_ptr().cast();
        vector.iov_len = slot.bytes.len();
        header.msg_hdr.msg_iov = vector;
        header.msg_hdr.msg_iovlen = 1;
        header.msg_hdr.msg_control = slot.control.as_mut_ptr().cast();
        header.msg_hdr.msg_controllen = size_of_val(&slot.control);
    }
    // SAFETY: `headers` has N entries, which point to buffers of the lengths given that outlive the
    // call and that nothing else refers to; the timeout may be null.
    let count = unsafe {
        libc::recvmmsg(
            fd.as_raw_fd(),
            headers.as_mut_ptr(),
            libc::c_uint::try_from(N).unwrap_or(0),
            libc::MSG_CMSG_CLOEXEC | if wait { libc::MSG_WAITFORONE } else { libc::MSG_DONTWAIT },
            std::ptr::null_mut(),
        )
    };
    let count = usize::try_from(count).map_err(|_| io::Error::last_os_error())?;
    for (slot, header) in slots.iter_mut().zip(&headers).take(count) {
        slot.len = header.msg_len as usize;
        slot.control_len = header.msg_hdr.msg_controllen;
        slot.flags = header.msg_hdr.msg_flags;
        for_each_descriptor(slot, |descriptor| {
            // SAFETY: the kernel has just opened this descriptor for this process, and no other code knows
            // it.
            drop(unsafe { OwnedFd::from_raw_fd(descriptor) });
        });
    }
    Ok(count)
}

/// Calls `sendmmsg` without waiting, with at most N datagrams. Returns the number of datagrams sent.
// Not inlined, for the same reason as `receive`.
#[inline(never)]
pub(super) fn send<'a, const N: usize>(
    fd: BorrowedFd<'_>,
    datagrams: impl ExactSizeIterator<Item = &'a [u8]>,
) -> io::Result<usize> {
    let mut vectors = [libc::iovec { iov_base: std::ptr::null_mut(), iov_len: 0 }; N];
    // SAFETY: an `mmsghdr` of zeros is a valid one: null pointers with zero lengths.
    let mut headers: [libc::mmsghdr; N] = unsafe { mem::zeroed() };
    let target = datagrams.len().min(N);
    for ((datagram, vector), header) in datagrams.zip(&mut vectors).zip(&mut headers) {
        vector.iov_base = datagram.as_ptr().cast_mut().cast();
        vector.iov_len = datagram.len();
        header.msg_hdr.msg_iov = vector;
        header.msg_hdr.msg_iovlen = 1;
    }
    // SAFETY: the first `target` of the N headers point to buffers of the lengths given, borrowed for
    // longer than the call, which only reads them.
    let count = unsafe {
        libc::sendmmsg(
            fd.as_raw_fd(),
            headers.as_mut_ptr(),
            libc::c_uint::try_from(target).unwrap_or(0),
            libc::MSG_DONTWAIT | libc::MSG_NOSIGNAL,
        )
    };
    usize::try_from(count).map_err(|_| io::Error::last_os_error())
}
