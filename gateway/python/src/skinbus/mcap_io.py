"""MCAP recordings as a file format of python-can.

`can.logger -f run.mcap`, `can.player run.mcap` and `can_logconvert run.mcap run.blf` use these classes. The files are
those of `skinbus convert`; `docs/how-to/captures.md` describes what a frame becomes.
"""

from __future__ import annotations

import itertools
import logging
import os
import struct
import time
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from io import BufferedIOBase, BytesIO
from pathlib import Path
from typing import IO, Any, BinaryIO, Final, cast

import can
from can.io.generic import BinaryIOMessageReader, BinaryIOMessageWriter
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC, Writer

from skinbus._can_frame import CAN_FRAME_DEFINITION, CAN_FRAME_TYPE, FrameDecoder, FrameEncoder, MessageError, to_nanos

_LOG = logging.getLogger("can.skinbus")

_BUS_TOPIC_PREFIX: Final = "/can/"
_STATE_TOPIC_PREFIX: Final = "/state/"
_NOTES_TOPIC: Final = "/can/notes"
_FURTHER_BUSES: Final = "further"
_MAX_CHANNELS: Final = 64
_CHUNK_BYTES: Final = 256 << 10
_FLUSH_INTERVAL_S: Final = 1.0
_MAX_RECORD_BYTES: Final = 128 << 20
_SKIP_BYTES: Final = 1 << 20
_NANOS_PER_MICROSECOND: Final = 1000

_RECORD_HEAD: Final = struct.Struct("<BQ")
_MESSAGE_HEAD: Final = struct.Struct("<HIQQ")


class McapReadError(can.CanError):
    """A file is not an MCAP recording, or it is damaged."""


class McapReader(BinaryIOMessageReader):
    """An iterator over the frames of a recording.

    Frames of all buses come in the order of the file, which is that of their log time; `channel` is the name of the
    bus. Other topics and notes are skipped. The parts of a recording are files of their own. A file without its end is
    read as far as it goes, which is logged as a warning.
    """

    def __init__(self, file: str | os.PathLike[str] | BinaryIO | BufferedIOBase, **kwargs: Any) -> None:
        """Opens a recording: a path, or a file that is opened for reading bytes.

        Raises:
            OSError: The file cannot be opened.
        """
        self._name = _file_name(file)
        super().__init__(file, mode="rb")

    def __iter__(self) -> Iterator[can.Message]:
        """Yields the frames.

        Raises:
            McapReadError: The file is not an MCAP recording, or the part that comes next is damaged.
        """
        if self.file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise McapReadError(
                f"{self._name} is not an MCAP recording: python-can chooses the format by the file's name"
            )
        try:
            yield from self._frames()
        except (McapError, MessageError, ValueError, struct.error) as error:
            raise McapReadError(
                f"{self._name} is damaged: {error}: `skinbus recover {self._name} -o NEW.mcap` saves what is intact"
            ) from error

    def _frames(self) -> Iterator[can.Message]:
        channels = _FrameChannels()
        decode = FrameDecoder().decode
        for opcode, record in self._records():
            for kind, begin, end in (
                _records_of_chunk(record) if opcode == Opcode.CHUNK else ((opcode, 0, len(record)),)
            ):
                if kind == Opcode.MESSAGE:
                    channel, _, _, published = _MESSAGE_HEAD.unpack_from(record, begin)
                    if channel in channels.ids:
                        yield decode(record[begin + _MESSAGE_HEAD.size : end], published)
                else:
                    channels.add(kind, record[begin:end])

    def _records(self) -> Iterator[tuple[int, bytes]]:
        """Yields opcode and body of each record up to the summary; of a chunk, its unpacked records."""
        wanted = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK)
        while True:
            head = self.file.read(_RECORD_HEAD.size)
            if len(head) < _RECORD_HEAD.size:
                return self._warn_cut_off()
            opcode, length = _RECORD_HEAD.unpack(head)
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                return None
            if opcode not in wanted:
                if not self._skip(length):
                    return self._warn_cut_off()
                continue
            if length > _MAX_RECORD_BYTES:
                raise McapError(f"a record claims to have {length} bytes, at most {_MAX_RECORD_BYTES} are allowed")
            record = self.file.read(length)
            if len(record) < length:
                return self._warn_cut_off()
            yield opcode, _unpack(record) if opcode == Opcode.CHUNK else record

    def _skip(self, length: int) -> bool:
        """Skips bytes, and returns False if the file ends before."""
        while length > 0:
            skipped = len(self.file.read(min(length, _SKIP_BYTES)))
            if skipped == 0:
                return False
            length -= skipped
        return True

    def _warn_cut_off(self) -> None:
        _LOG.warning("%s: its end is missing: only the existing part is read", self._name)


class _FrameChannels:
    """The channels of a recording that hold frames of buses.

    Attributes:
        ids: The channels' numbers.
    """

    def __init__(self) -> None:
        self.ids: set[int] = set()
        self._schemas: dict[int, str] = {}

    def add(self, opcode: int, record: bytes) -> None:
        """Adds a schema or a channel; ignores other records."""
        stream = ReadDataStream(BytesIO(record))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema.name
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            is_frames = self._schemas.get(channel.schema_id) == CAN_FRAME_TYPE and channel.message_encoding == "cdr"
            if is_frames and not channel.topic.startswith(_STATE_TOPIC_PREFIX):
                self.ids.add(channel.id)


def _unpack(record: bytes) -> bytes:
    """Returns the records of a chunk after checking its checksum."""
    chunk = Chunk.read(ReadDataStream(BytesIO(record)))
    if chunk.uncompressed_size > _MAX_RECORD_BYTES:
        raise McapError(f"a chunk claims to have {chunk.uncompressed_size} bytes, more than {_MAX_RECORD_BYTES}")
    if chunk.uncompressed_size == 0:
        return b""
    try:
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    except Exception as error:  # Each compression has exceptions of its own.
        raise McapError(f"a chunk cannot be unpacked: {error}") from error
    return stream.read(length)


def _records_of_chunk(records: bytes) -> Iterator[tuple[int, int, int]]:
    """Yields opcode, beginning and end of each record."""
    at = 0
    while at < len(records):
        opcode, length = _RECORD_HEAD.unpack_from(records, at)
        begin = at + _RECORD_HEAD.size
        at = begin + length
        if at > len(records):
            raise McapError("a record extends beyond its chunk")
        yield opcode, begin, at


class McapWriter(BinaryIOMessageWriter):
    """A writer of recordings.

    The file is called `NAME.part` until `stop`, and then replaces a file of its name. A frame that comes more
    than a second after the last writing writes all frames so far. Those survive if the program is killed: `skinbus
    recover NAME.part -o NAME`. Frames before a silence of the bus are written by the next frame, or by `stop`.
    """

    def __init__(
        self,
        file: str | os.PathLike[str] | BinaryIO | BufferedIOBase,
        channel: str = "vcan0",
        append: bool = False,
        **kwargs: Any,
    ) -> None:
        """Begins a recording.

        Args:
            file: A path, or a file that is opened for writing bytes.
            channel: The bus of frames without a channel. Channels that are numbers become `can0`, `can1`, ...
            append: Allowed for a file that does not exist yet: a recording cannot be continued.
            **kwargs: Options of other formats. They have no effect.

        Raises:
            OSError: The file cannot be made.
            ValueError: `append` is set, and the file has contents.
        """
        self._part: Path | None = None
        self._path: Path | None = None
        if isinstance(file, (str, os.PathLike)):
            # A link keeps pointing to the file that it names.
            self._path = Path(os.path.realpath(file))
            if append and self._path.exists() and self._path.stat().st_size > 0:
                raise ValueError(
                    f"{self._path} cannot be continued, because recordings have their index at the end: write another "
                    "file; `skinbus convert` reads several as one"
                )
            if self._path.exists() and not self._path.is_file():
                raise OSError(f"{self._path} is not a regular file: name another file")
            file, self._part = _create_part(self._path)
        super().__init__(file, mode="wb")
        self._default_bus = channel
        self._buses: dict[str | None, _Bus] = {}
        self._channels: dict[tuple[str, bool], _Channel] = {}
        self._topics: dict[str, str] = {}
        self._last_flush_s = time.monotonic()
        self._writer: Writer | None = Writer(
            cast("IO[bytes]", self.file), chunk_size=_CHUNK_BYTES, enable_data_crcs=True
        )
        self._writer.start(profile="ros2", library=f"skinbus {_package_version()}")
        self._writer.add_metadata("capture", {"from": "python-can"})
        self._schema = self._writer.register_schema(CAN_FRAME_TYPE, "ros2msg", CAN_FRAME_DEFINITION.encode())

    def on_message_received(self, msg: can.Message) -> None:
        """Writes a frame. Its length is that of `data`, whatever `dlc` is; with more than 8 bytes it is a CAN FD frame.

        Raises:
            ValueError: No frame can have this time, length, identifier or flags; or the recording has ended.
            OSError: The file cannot be written.
        """
        writer = self._writer
        if writer is None:
            raise ValueError(f"{self._path or _file_name(self.file)}: the recording has ended")
        nanos = to_nanos(msg.timestamp)
        has_micros = nanos % _NANOS_PER_MICROSECOND == 0
        name = None if msg.channel is None else str(msg.channel)
        bus = self._buses.get(name)
        if bus is None:
            bus = self._buses[name] = _Bus(_bus_name(self._default_bus if name is None else name), has_micros)
        data = bus.encoder.encode(msg, nanos)
        if bus.channel is None or (bus.has_micros and not has_micros):
            bus.has_micros = has_micros
            bus.channel = self._channel(writer, bus.name, has_micros)
        channel = bus.channel
        writer.add_message(channel.id, nanos, data, nanos, channel.sequence)
        channel.sequence = (channel.sequence + 1) & 0xFFFF_FFFF
        now = time.monotonic()
        if now - self._last_flush_s > _FLUSH_INTERVAL_S:
            writer.flush()  # type: ignore[no-untyped-call]
            self._last_flush_s = now

    def stop(self) -> None:
        """Completes the recording and gives it its name. A second call has no effect.

        Raises:
            OSError: The file cannot be written; what there is of it keeps the name with `.part`.
        """
        writer, self._writer = self._writer, None
        if writer is None:
            return
        try:
            writer.finish()  # type: ignore[no-untyped-call]
        finally:
            super().stop()
        if self._part is not None and self._path is not None:
            self._part.replace(self._path)

    def _channel(self, writer: Writer, bus: str, has_micros: bool) -> _Channel:
        """Returns the channel for frames of a bus, one for each form of times."""
        if (bus, has_micros) not in self._channels and len(self._channels) >= _MAX_CHANNELS:
            bus = _FURTHER_BUSES
        channel = self._channels.get((bus, has_micros))
        if channel is None:
            about = {"offered_qos_profiles": "", "time_digits": "6" if has_micros else "9"}
            channel = _Channel(writer.register_channel(self._topic(bus), "cdr", self._schema, about))
            self._channels[bus, has_micros] = channel
        return channel

    def _topic(self, bus: str) -> str:
        """Returns the topic of a bus. A name that another topic has gets a number."""
        if bus not in self._topics:
            name = _BUS_TOPIC_PREFIX + bus.lstrip("/")
            names = itertools.chain([name], (f"{name}_{number}" for number in itertools.count(2)))
            taken = {_NOTES_TOPIC, *self._topics.values()}
            self._topics[bus] = next(name for name in names if name not in taken)
        return self._topics[bus]


class _Channel:
    """A channel of the file that is written.

    Attributes:
        id: Its number.
        sequence: The number of its next message.
    """

    def __init__(self, number: int) -> None:
        self.id = number
        self.sequence = 0


class _Bus:
    """A bus whose frames are written.

    Attributes:
        name: Its name.
        encoder: The encoder for its frames.
        has_micros: Tells if all times so far are whole microseconds.
        channel: The channel for its frames; None before the first one.
    """

    def __init__(self, name: str, has_micros: bool) -> None:
        self.name = name
        self.encoder = FrameEncoder(name)
        self.has_micros = has_micros
        self.channel: _Channel | None = None


def _bus_name(channel: str) -> str:
    """Returns the name of the bus for a channel of python-can, as its own log writer does."""
    name = channel.replace("\0", "_").encode(errors="replace").decode()
    return f"can{name}" if name.isdecimal() else name


def _create_part(path: Path) -> tuple[BinaryIO, Path]:
    """Creates the file for a recording that is not complete; leaves those of earlier recordings alone."""
    for number in itertools.count(1):
        part = path.with_name(f"{path.name}.part" if number == 1 else f"{path.name}.{number}.part")
        try:
            return part.open("xb"), part
        except FileExistsError:
            _LOG.warning("%s is a recording without its end: `skinbus recover` repairs it", part)
    raise AssertionError("numbers do not end")


def _file_name(file: object) -> str:
    """Returns the name of a file for texts of errors."""
    if isinstance(file, (str, os.PathLike)):
        return os.fspath(file)
    return str(getattr(file, "name", "the recording"))


def _package_version() -> str:
    try:
        return version("skinbus")
    except PackageNotFoundError:
        return "unknown"
