"""Decodes the ROS 2 messages of recordings that `skinbus.to_rerun` shows. They are encoded as CDR, little-endian."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_NANOS = 1_000_000_000
# The bytes before a message that name its encoding: CDR, little-endian.
_ENCAPSULATION = b"\x00\x01\x00\x00"


@dataclass(frozen=True)
class JointState:
    """`sensor_msgs/JointState`: names, positions in rad or m, torques in Nm or N."""

    at_ns: int
    names: tuple[str, ...]
    positions: NDArray[np.float64]


@dataclass(frozen=True)
class Torques:
    """`skinbus_msgs/Torques`, in Nm or N; `central` is empty in ticks without this computation."""

    at_ns: int
    distributed: NDArray[np.float64]
    central: NDArray[np.float64]


# Values of `PatchState.status`: in contact without a reply to the last epoch; silent for longer than the timeout.
STALE, DEAD = 3, 4


@dataclass(frozen=True)
class Patch:
    """`skinbus_msgs/PatchState`: the link, and the node ids and statuses of the cells of a patch."""

    at_ns: int
    link: str
    nodes: tuple[int, ...]
    statuses: NDArray[np.uint8]


@dataclass(frozen=True)
class Points:
    """`sensor_msgs/PointCloud2` of a patch: positions in m, [n, 3], and forces in N, [n]."""

    at_ns: int
    positions: NDArray[np.float32]
    forces: NDArray[np.float32]


@dataclass(frozen=True)
class Transform:
    """The pose of a frame in its parent frame, as a matrix [4, 4]."""

    parent: str
    child: str
    pose: NDArray[np.float64]


class Reader:
    """Reads the fields of a message one after the other."""

    def __init__(self, message: bytes) -> None:
        if message[:4] != _ENCAPSULATION:
            raise ValueError(f"a message begins with {message[:4].hex()}, not with {_ENCAPSULATION.hex()}")
        self._bytes = memoryview(message)[4:]
        self._at = 0

    def number(self, kind: str) -> int | float:
        """Reads a number; `kind` is its letter for `struct`."""
        size = struct.calcsize(kind)
        self._at += -self._at % size
        (value,) = struct.unpack_from(f"<{kind}", self._bytes, self._at)
        self._at += size
        assert isinstance(value, int | float)
        return value

    def count(self) -> int:
        """Reads the length of a sequence or a text."""
        return int(self.number("I"))

    def text(self) -> str:
        """Reads a text."""
        length = self.count()
        text = bytes(self._bytes[self._at : self._at + length]).rstrip(b"\0")
        self._at += length
        return text.decode(errors="replace")

    def stamp(self) -> int:
        """Reads the time of a header, in ns since 1970."""
        seconds, nanos = int(self.number("i")), int(self.number("I"))
        return seconds * _NANOS + nanos

    def array(self, kind: str, count: int | None = None) -> NDArray[np.generic]:
        """Reads an array; its length stands before it, unless it is given."""
        length = self.count() if count is None else count
        of = np.dtype(kind).newbyteorder("<")
        if length:
            self._at += -self._at % of.itemsize
        values = np.frombuffer(self._bytes, of, length, self._at)
        self._at += length * of.itemsize
        return values


def joint_state(message: bytes) -> JointState:
    """Decodes `sensor_msgs/JointState`."""
    reader = Reader(message)
    at_ns, _ = reader.stamp(), reader.text()
    names = tuple(reader.text() for _ in range(reader.count()))
    return JointState(at_ns, names, np.asarray(reader.array("f8"), np.float64))


def torques(message: bytes) -> Torques:
    """Decodes `skinbus_msgs/Torques`."""
    reader = Reader(message)
    at_ns, _ = reader.stamp(), reader.text()
    both = [np.asarray(reader.array("f8"), np.float64) for _ in range(2)]
    return Torques(at_ns, both[0], both[1])


def patch(message: bytes) -> Patch:
    """Decodes `skinbus_msgs/PatchState` without forces and proximities."""
    reader = Reader(message)
    at_ns, link = reader.stamp(), reader.text()
    reader.number("B")
    nodes = tuple(int(node) for node in np.asarray(reader.array("u2"), np.int64))
    for _ in ("force", "proximity"):
        reader.array("f4")
    return Patch(at_ns, link, nodes, np.asarray(reader.array("u1"), np.uint8))


def string(message: bytes) -> str:
    """Decodes `std_msgs/String`."""
    return Reader(message).text()


def points(message: bytes) -> Points:
    """Decodes `sensor_msgs/PointCloud2` with the fields x, y, z and force."""
    reader = Reader(message)
    at_ns, _ = reader.stamp(), reader.text()
    reader.number("I")
    width = reader.count()
    fields = []
    for _ in range(reader.count()):
        fields.append(reader.text())
        reader.number("I")
        reader.number("B")
        reader.number("I")
    if fields != ["x", "y", "z", "force"]:
        raise ValueError(f"a cloud has the fields {', '.join(fields)}, not x, y, z, force")
    reader.number("B")
    reader.number("I")
    reader.number("I")
    reader.count()
    values = np.asarray(reader.array("f4", 4 * width), np.float32).reshape(width, 4)
    return Points(at_ns, values[:, :3], values[:, 3])


def transforms(message: bytes) -> list[Transform]:
    """Decodes `tf2_msgs/TFMessage`."""
    reader = Reader(message)
    found = []
    for _ in range(reader.count()):
        reader.stamp()
        parent, child = reader.text(), reader.text()
        x, y, z, qx, qy, qz, qw = (float(value) for value in np.asarray(reader.array("f8", 7), np.float64))
        pose = np.identity(4)
        pose[:3, 3] = x, y, z
        pose[:3, :3] = [
            [1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qz * qw), 2 * (qx * qz + qy * qw)],
            [2 * (qx * qy + qz * qw), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qx * qw)],
            [2 * (qx * qz - qy * qw), 2 * (qy * qz + qx * qw), 1 - 2 * (qx * qx + qy * qy)],
        ]
        found.append(Transform(parent, child, pose))
    return found
