"""The message `skinbus_msgs/msg/CanFrame` of recordings: its definition, and its encoding in CDR."""

from __future__ import annotations

import struct
from decimal import ROUND_HALF_EVEN, Decimal
from math import isfinite
from typing import Final

import can

CAN_FRAME_TYPE: Final = "skinbus_msgs/msg/CanFrame"
_SEPARATOR: Final = f"\n{'=' * 80}\nMSG: "
CAN_FRAME_DEFINITION: Final = f"""\
std_msgs/Header header      # when it was on the bus, by the kernel; frame_id is the bus
uint32 id                   # 11 or 29 bits, without flags
bool is_extended            # 29 bits
bool is_rtr                 # remote frame
bool is_error               # error frame: a message of the driver
bool is_fd
uint8 flags                 # of an FD frame: 1 BRS, 2 ESI, 4 FDF
uint8 length                # bytes of data, or those that a remote frame asks for
uint8 raw_dlc               # DLC 9..15 of a classic frame of 8 bytes, else 0
uint8 direction             # 0 unknown, 1 received, 2 sent by whoever took the capture
uint8[] data
{_SEPARATOR}std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_SEPARATOR}builtin_interfaces/Time
int32 sec
uint32 nanosec
"""

_NANOS_PER_SECOND: Final = 1_000_000_000
_MICROS_PER_SECOND: Final = 1_000_000
_MAX_NANOS: Final = (1 << 64) - 1
_MAX_SECONDS: Final = (1 << 31) - 1

_PREFIX: Final = struct.Struct("<4siI")
_COUNT: Final = struct.Struct("<I")
_BODY: Final = struct.Struct("<I4?4BI")
_ENCAPSULATION: Final = b"\0\1\0\0"
_NAME_OFFSET: Final = _PREFIX.size + _COUNT.size
_BRS: Final = 1
_ESI: Final = 2
_FDF: Final = 4
_RECEIVED: Final = 1
_SENT: Final = 2


class MessageError(Exception):
    """The bytes of a message are not a `CanFrame`."""


def to_nanos(seconds: float) -> int:
    """Returns a time of python-can in ns since 1970. `from_nanos` returns the same number again, to the nanosecond.

    The digits are those of the shortest text of the number: 1700000000.123456 gives whole microseconds.

    Raises:
        ValueError: The time is before 1970, or not a number.
    """
    if not isfinite(seconds) or not 0 <= seconds <= _MAX_NANOS / _NANOS_PER_SECOND - 1:
        raise ValueError(f"the time {seconds} s cannot be recorded: it must be from 1970 to 2554")
    micros = round(seconds * _MICROS_PER_SECOND)
    if micros / _MICROS_PER_SECOND == seconds:
        return micros * 1000
    return int((Decimal(repr(seconds)) * _NANOS_PER_SECOND).to_integral_value(ROUND_HALF_EVEN))


def from_nanos(nanos: int) -> float:
    """Returns the seconds nearest to a time in ns."""
    return nanos / _NANOS_PER_SECOND


class FrameEncoder:
    """An encoder for the frames of one bus."""

    def __init__(self, bus: str) -> None:
        name = bus.encode() + b"\0"
        padding = b"\0" * (-len(name) % 4)
        self._name = _COUNT.pack(len(name)) + name + padding

    def encode(self, message: can.Message, nanos: int) -> bytes:
        """Returns a frame as a message with its time in ns.

        Readers of other formats give frames that cannot be. What is certain counts: the length of the data, not `dlc`;
        a frame of more than 8 bytes is a CAN FD frame; and a CAN FD frame of no bytes is no remote frame.

        Raises:
            ValueError: No frame can have these bytes of data, this identifier or these flags.
        """
        is_fd = message.is_fd or len(message.data) > 8
        is_remote = message.is_remote_frame and not (is_fd and message.dlc == 0)
        data = b"" if is_remote else bytes(message.data)
        length = message.dlc if is_remote else len(data)
        if not 0 <= length <= (64 if is_fd else 8):
            raise ValueError(f"a frame with {length} bytes of data cannot be recorded: {message}")
        if is_fd and is_remote:
            raise ValueError(f"a remote frame cannot be a CAN FD frame: {message}")
        has_29_bits = message.is_extended_id or message.is_error_frame
        if not 0 <= message.arbitration_id < (1 << 29 if has_29_bits else 1 << 11):
            raise ValueError(f"an identifier of {message.arbitration_id:#x} is too large: {message}")
        flags = 0
        if is_fd:
            flags = _FDF | (_BRS if message.bitrate_switch else 0) | (_ESI if message.error_state_indicator else 0)
        seconds, rest = divmod(nanos, _NANOS_PER_SECOND)
        head = _PREFIX.pack(_ENCAPSULATION, min(seconds, _MAX_SECONDS), rest)
        body = _BODY.pack(
            message.arbitration_id,
            message.is_extended_id,
            is_remote,
            message.is_error_frame,
            is_fd,
            flags,
            length,
            0,
            _RECEIVED if message.is_rx else _SENT,
            len(data),
        )
        return head + self._name + body + data


class FrameDecoder:
    """A decoder for frames of any bus."""

    def __init__(self) -> None:
        self._buses: dict[bytes, str] = {}

    def decode(self, message: bytes, nanos: int) -> can.Message:
        """Returns a message as a frame with its time in ns.

        The raw DLC of a classic frame is lost: messages of python-can have none.

        Raises:
            MessageError: The bytes are not a frame.
        """
        if message[:2] != _ENCAPSULATION[:2]:
            raise MessageError(f"it begins with {message[:2].hex(' ')}, not with 00 01: only little-endian CDR is read")
        try:
            (name_bytes,) = _COUNT.unpack_from(message, _PREFIX.size)
            name_end = _NAME_OFFSET + name_bytes
            bus = self._bus(message[_NAME_OFFSET:name_end])
            at = name_end + -name_end % 4
            values = _BODY.unpack_from(message, at)
        except struct.error:
            raise MessageError(f"it ends at byte {len(message)}, in the middle of a field") from None
        identifier, is_extended, is_remote, is_error, is_fd, flags, length, _, direction, count = values
        data = message[at + _BODY.size : at + _BODY.size + count]
        if len(data) != count or count != (0 if is_remote else length) or length > (64 if is_fd else 8):
            raise MessageError(f"its length {length} does not fit its {len(data)} bytes of data")
        return can.Message(
            timestamp=from_nanos(nanos),
            arbitration_id=identifier,
            is_extended_id=is_extended,
            is_remote_frame=is_remote,
            is_error_frame=is_error,
            channel=bus,
            dlc=length,
            data=data,
            is_fd=is_fd,
            is_rx=direction != _SENT,
            bitrate_switch=flags & _BRS != 0,
            error_state_indicator=flags & _ESI != 0,
        )

    def _bus(self, name: bytes) -> str:
        """Returns the name of a bus, decoded once."""
        bus = self._buses.get(name)
        if bus is None:
            bus = name.removesuffix(b"\0").decode(errors="replace")
            self._buses[name] = bus
        return bus
