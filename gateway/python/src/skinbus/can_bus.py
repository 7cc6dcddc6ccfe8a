"""The embedded bus as an interface of python-can.

`can.Bus(interface="skinbus", channel="vcan0")` attaches to the bus that `vcan-setup serve vcan0` serves. The page
`docs/reference/embedded-bus.md` describes each byte of the protocol.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NoReturn

import can
from can.typechecking import AutoDetectedConfig, CanFilters

from skinbus import _bus_socket
from skinbus._bus_socket import SO_TIMESTAMPNS, AttachError, default_directory
from skinbus._can_filters import EXTENDED_FLAG, IDENTIFIER_MASK, FrameFilter

_LOG = logging.getLogger("can.skinbus")

_DROP_NOTICE: Final = struct.Struct("<sI")
_HEAD: Final = struct.Struct("=I4B")
_CLASSIC: Final = struct.Struct("=I4B8s")
_FD: Final = struct.Struct("=I4B64s")
_TIMESPEC: Final = struct.Struct("@ll")
_CONTROL_BYTES: Final = socket.CMSG_SPACE(_TIMESPEC.size)
_NANOS_PER_SECOND: Final = 1_000_000_000

_REMOTE_FLAG: Final = 0x4000_0000
_ERROR_FLAG: Final = 0x2000_0000
_STANDARD_MASK: Final = 0x7FF
_BUS_ERROR_CLASS: Final = 0x80
_BRS: Final = 1
_ESI: Final = 2
_FDF: Final = 4

_RETRY_INTERVAL_S: Final = 0.005
_FD_LENGTHS: Final = (*range(9), 12, 16, 20, 24, 32, 48, 64)

ALL_ERRORS: Final = 0x1FFF_FFFF
"""The error mask that passes error frames of each class."""


class SkinbusBus(can.BusABC):
    """A connection to an embedded bus.

    Attributes:
        channel: The name of the bus.
        dropped: The number of frames that the server dropped because they were read too slowly.
        receive_buffer: The bytes that may wait in the socket as the kernel counts them: 768 for an FD frame.
    """

    def __init__(
        self,
        channel: str | int = "",
        can_filters: CanFilters | None = None,
        *,
        fd: bool = True,
        receive_own_messages: bool = False,
        error_mask: int = ALL_ERRORS,
        ignore_rx_error_frames: bool = False,
        directory: str | os.PathLike[str] | None = None,
        receive_buffer: int = 4 << 20,
        **kwargs: object,
    ) -> None:
        """Attaches to a bus that is served.

        Args:
            channel: The name of the bus, 1 to 15 bytes.
            can_filters: The filters of `set_filters`; they apply from the first frame on. None passes all frames.
            fd: Send and receive CAN FD frames, too. A bus has no bit rate, so this is on unless it is turned off.
            receive_own_messages: Receive the frames that this connection sends, with `is_rx` False.
            error_mask: The classes of error frames to receive, bits of `linux/can/error.h`; 0 for none.
            ignore_rx_error_frames: Receive no error frames, as in the interface `socketcan`.
            directory: The directory of the bus' socket; by default that of `default_directory`.
            receive_buffer: The bytes that may wait in the socket; the server grants at most 64 MiB.
            **kwargs: Options of other interfaces, such as `bitrate`. They have no effect.

        Raises:
            ValueError: An argument is out of range.
            can.CanInitializationError: The bus is not served, its directory is not private to this user, or the
                server does not accept the connection.
        """
        self.channel = str(channel)
        _bus_socket.check_name(self.channel)
        if not 0 <= error_mask <= ALL_ERRORS:
            raise ValueError(f"{self.channel}: error_mask is {error_mask:#x}; allowed: 0 to {ALL_ERRORS:#x}")
        if not 0 <= receive_buffer < 1 << 63:
            raise ValueError(f"{self.channel}: receive_buffer is {receive_buffer}; allowed: 0 to 64 MiB")
        own_directory = default_directory() if directory is None else Path(directory)
        self._path = _bus_socket.socket_path(own_directory, self.channel)
        self._fd = bool(fd)
        self._filter = FrameFilter(can_filters)
        self._filter_lock = threading.Lock()
        self._last_drop_count = 0
        self._end: str | None = None
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        self.channel_info = f"skinbus {self.channel} at {self._path}"
        self.dropped = 0

        try:
            self._socket, self.receive_buffer = _bus_socket.attach(
                own_directory,
                self.channel,
                own_frames=bool(receive_own_messages),
                fd=self._fd,
                error_mask=0 if ignore_rx_error_frames else error_mask,
                receive_buffer=receive_buffer,
                filters=self._filter.encode(),
            )
        except AttachError as error:
            raise can.CanInitializationError(f"{self.channel}: {error}", error.code) from error
        try:
            # Event loops watch this descriptor. It stops being readable when the socket is unregistered, so the end of
            # the server wakes a loop once, not for ever.
            self._readable = select.epoll()
        except BaseException:
            self._socket.close()
            raise
        try:
            self._readable.register(self._socket, select.EPOLLIN)
            super().__init__(channel=self.channel, can_filters=can_filters, **kwargs)
        except BaseException:
            self._close()
            raise

    # Filters

    def set_filters(self, filters: CanFilters | None = None) -> None:
        """Replaces the filters; None or an empty list passes all frames.

        A filter passes a data or remote frame if identifier and `can_id` are equal in the 29 bits of `can_mask`, and,
        with the key `extended`, if the frame has 29 bits or not, accordingly. Error frames are selected by
        `error_mask` alone. The server filters; with more than 512 different filters this process does. Frames that
        wait in the socket already have passed the former filters.

        Raises:
            ValueError: A `can_id` has more than 29 bits. Flags of SocketCAN are not part of filters of python-can.
            can.CanOperationError: The server has ended.
        """
        FrameFilter(filters)
        super().set_filters(filters)

    def _apply_filters(self, filters: CanFilters | None) -> None:
        new = FrameFilter(filters)
        with self._filter_lock:
            if new.encode() != self._filter.encode():
                for part in new.encode_parts():
                    self._send_datagram(part, None)
            self._filter = new

    # Receive

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        end = None if timeout is None else time.monotonic() + timeout
        while True:
            message = self._receive_now()
            if message is not None:
                return message, True
            wait = None if end is None else end - time.monotonic()
            if wait is not None and wait <= 0:
                return None, True
            self._wait(select.POLLIN, wait)

    def _receive_now(self) -> can.Message | None:
        """Returns the next frame that passes the filters, or None if no datagram waits."""
        while True:
            if self._end is not None:
                self._raise_ended(None)
            try:
                datagram, notes, _, _ = self._socket.recvmsg(_FD.size, _CONTROL_BYTES)
            except BlockingIOError:
                return None
            except ConnectionResetError:
                continue  # The server ended before it read all frames; those that it sent can still be read.
            except OSError as error:
                if error.errno in (errno.ENOMEM, errno.ENOBUFS):
                    time.sleep(_RETRY_INTERVAL_S)
                    return None
                self._raise_ended(error)
            size = len(datagram)
            if size == 0:
                self._raise_ended(None)
            elif size in (_CLASSIC.size, _FD.size):
                message = self._decode(datagram, notes)
                if self._filter.is_for_server or self._filter.passes(message):
                    return message
            elif size == _DROP_NOTICE.size and datagram[:1] == b"D":
                self._count_dropped(_DROP_NOTICE.unpack(datagram)[1])

    def _decode(self, datagram: bytes, notes: Sequence[tuple[int, int, bytes]]) -> can.Message:
        identifier, length, flags, own, _ = _HEAD.unpack_from(datagram)
        is_fd = len(datagram) == _FD.size
        is_extended = identifier & EXTENDED_FLAG != 0
        is_remote = identifier & _REMOTE_FLAG != 0
        is_error = identifier & _ERROR_FLAG != 0
        timestamp = None
        for level, kind, value in notes:
            if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS and len(value) >= _TIMESPEC.size:
                seconds, nanos = _TIMESPEC.unpack_from(value)
                timestamp = (seconds * _NANOS_PER_SECOND + nanos) / _NANOS_PER_SECOND
        return can.Message(
            timestamp=time.time() if timestamp is None else timestamp,
            arbitration_id=identifier & (IDENTIFIER_MASK if is_extended or is_error else _STANDARD_MASK),
            is_extended_id=is_extended,
            is_remote_frame=is_remote,
            is_error_frame=is_error,
            channel=self.channel,
            dlc=length,
            data=None if is_remote else datagram[_HEAD.size : _HEAD.size + length],
            is_fd=is_fd,
            is_rx=own != 1,
            bitrate_switch=is_fd and flags & _BRS != 0,
            error_state_indicator=is_fd and flags & _ESI != 0,
        )

    def _count_dropped(self, count: int) -> None:
        """Adds the frames since the last notice, whose counter has 32 bits and wraps."""
        if self.dropped == 0:
            _LOG.warning("%s: frames were dropped: read faster, or attach with a larger receive_buffer", self.channel)
        self.dropped += (count - self._last_drop_count) & 0xFFFF_FFFF
        self._last_drop_count = count

    # Send

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Sends a frame; returns when the kernel has it.

        An error frame without a class, as readers of other formats make it, is sent as a bus error (0x80): without a
        class nobody would receive it.

        Args:
            msg: The frame. Its channel and time are not used.
            timeout: The seconds to wait while the server is too slow; None waits until it is not.

        Raises:
            ValueError: The frame is not valid: its length, identifier or flags.
            can.CanTimeoutError: The server has not made room in time.
            can.CanOperationError: The server has ended, or an FD frame is sent on a bus opened with `fd=False`.
        """
        self._send_datagram(self._encode(msg), timeout)

    def _encode(self, msg: can.Message) -> bytes:
        try:
            msg._check()
        except ValueError as error:
            raise ValueError(f"{self.channel}: cannot send this frame: {error}") from None
        identifier = msg.arbitration_id
        if msg.is_error_frame and identifier == 0:
            identifier = _BUS_ERROR_CLASS
        if msg.is_extended_id:
            identifier |= EXTENDED_FLAG
        if msg.is_remote_frame:
            identifier |= _REMOTE_FLAG
        if msg.is_error_frame:
            identifier |= _ERROR_FLAG
        if not msg.is_fd:
            return _CLASSIC.pack(identifier, msg.dlc, 0, 0, 0, bytes(msg.data))
        if not self._fd:
            raise can.CanOperationError(
                f"{self.channel}: a CAN FD frame cannot be sent, because the bus was opened for classic frames only: "
                "open it with fd=True"
            )
        if msg.dlc not in _FD_LENGTHS:
            raise ValueError(
                f"{self.channel}: cannot send this frame: a CAN FD frame cannot have {msg.dlc} bytes of data: pad it "
                f"to {min(length for length in _FD_LENGTHS if length > msg.dlc)}"
            )
        flags = _FDF | (_BRS if msg.bitrate_switch else 0) | (_ESI if msg.error_state_indicator else 0)
        return _FD.pack(identifier, msg.dlc, flags, 0, 0, bytes(msg.data))

    def _send_datagram(self, datagram: bytes, timeout: float | None) -> None:
        end = None if timeout is None else time.monotonic() + timeout
        while True:
            try:
                self._socket.send(datagram, socket.MSG_NOSIGNAL)
                return
            except OSError as error:
                wait = None if end is None else end - time.monotonic()
                lacks_memory = error.errno in (errno.ENOMEM, errno.ENOBUFS)
                if not (isinstance(error, BlockingIOError) or lacks_memory):
                    self._raise_ended(error)
                if wait is not None and wait <= 0:
                    raise can.CanTimeoutError(
                        f"{self.channel}: the server at {self._path} accepted no frame within {timeout:g} s: "
                        "check that it runs"
                    ) from None
                if lacks_memory:
                    time.sleep(_RETRY_INTERVAL_S)
                else:
                    self._wait(select.POLLOUT, wait)

    # The end

    def _raise_ended(self, error: OSError | None) -> NoReturn:
        """Raises the error for a connection that has ended, now and in each later call."""
        if self._is_shutdown:
            raise can.CanOperationError(f"{self.channel}: the bus was shut down: open it again") from error
        is_gone = error is None or isinstance(error, ConnectionError)
        why = "its server ended, or disconnected this program" if is_gone or error is None else str(error.strerror)
        text = f"{self.channel}: the embedded bus at {self._path} was closed: {why}: open it again"
        # After an error of sending, frames that the server sent before can still be read.
        if self._end is None and (error is None or not is_gone):
            self._end = text
            # Another thread may have shut the bus down.
            with contextlib.suppress(OSError, ValueError):
                self._readable.unregister(self._socket)
        raise can.CanOperationError(self._end or text) from error

    def _wait(self, events: int, timeout: float | None) -> None:
        try:
            _bus_socket.wait(self._socket, events, timeout)
        except ValueError:
            self._raise_ended(None)

    @property
    def state(self) -> can.BusState:
        """The state: active, or error once the server has ended or the bus was shut down."""
        return can.BusState.ERROR if self._is_shutdown or self._end is not None else can.BusState.ACTIVE

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        if new_state is not can.BusState.ACTIVE:
            raise NotImplementedError(
                f"{self.channel}: an embedded bus is always active: nothing is acknowledged on it"
            )

    def fileno(self) -> int:
        """Returns a descriptor that is readable while frames wait, or -1 after `shutdown`."""
        return -1 if self._is_shutdown else self._readable.fileno()

    def shutdown(self) -> None:
        """Stops periodic tasks and closes the connection. A second call has no effect."""
        if not self._is_shutdown:
            super().shutdown()
            self._close()

    def _close(self) -> None:
        # Wakes a thread that waits for frames. Fails if the server has ended before.
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._readable.close()
        self._socket.close()

    @staticmethod
    def _detect_available_configs() -> list[AutoDetectedConfig]:
        """Returns a configuration for each bus that is served in the default directory, by name."""
        directory = default_directory()
        try:
            _bus_socket.check_private(directory)
            names = sorted(path.stem for path in directory.glob("*.bus") if path.is_socket())
        except (AttachError, OSError):
            return []
        return [
            {"interface": "skinbus", "channel": name}
            for name in names
            if _bus_socket.is_served(_bus_socket.socket_path(directory, name))
        ]
