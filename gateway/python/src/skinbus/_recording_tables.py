"""The tables of a recording. Their arrays are mapped into memory and read when they are used."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas

Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
Counts = NDArray[np.uint32]
Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Words = NDArray[np.int16]


@dataclass(frozen=True)
class Frames:
    """Frames of all buses, in the order of the recording.

    Attributes:
        at_ns: The time in ns since 1970, [n].
        bus: The bus, as an index of `Recording.buses`, [n].
        id: The identifier of 11 or 29 bits, [n].
        flags: 1: 29 bits, 2: remote frame, 4: error frame, 8: CAN FD, 16: bit rate switch, 32: error state, [n].
        direction: 0: unknown, 1: received, 2: sent by whoever recorded, [n].
        length: Number of data bytes, or of bytes that a remote frame requests, [n].
        raw_dlc: The DLC 9 to 15 of a classic frame with 8 bytes, else 0, [n].
        data: The bytes of all frames of the recording, one after the other.
        begins: The index in `data` of each frame's first byte, [n].
        ends: The index in `data` after each frame's last byte, [n].
    """

    at_ns: Integers
    bus: Words
    id: Counts
    flags: Bytes
    direction: Bytes
    length: Bytes
    raw_dlc: Bytes
    data: Bytes
    begins: Integers
    ends: Integers

    def __len__(self) -> int:
        return len(self.at_ns)

    def payload(self, row: int) -> bytes:
        """Returns the data bytes of a frame."""
        return self.data[self.begins[row] : self.ends[row]].tobytes()

    def to_pandas(self) -> pandas.DataFrame:
        """Returns a table with the payloads as bytes."""
        names = ("bus", "id", "flags", "direction", "length", "raw_dlc")
        columns: dict[str, Any] = {name: getattr(self, name) for name in names}
        columns["data"] = [self.payload(row) for row in range(len(self))]
        return _data_frame(columns, self.at_ns)


@dataclass(frozen=True)
class Notes:
    """Entries between the frames.

    Attributes:
        at_ns: The time in ns since 1970, [n].
        bus: The bus, as an index of `Recording.buses`; -1 for none, [n].
        kind: 0: text, 1: the recorder lost frames, 2: a CAN XL frame, 3: an unreadable line, [n].
        frames: Number of lost frames, [n].
        line: The line in the log, from 1; 0 in a recording, [n].
        text: The texts.
    """

    at_ns: Integers
    bus: Words
    kind: Bytes
    frames: Integers
    line: Integers
    text: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.at_ns)

    def to_pandas(self) -> pandas.DataFrame:
        """Returns a table."""
        names = ("bus", "kind", "frames", "line")
        columns: dict[str, Any] = {name: getattr(self, name) for name in names}
        return _data_frame(columns | {"text": list(self.text)}, self.at_ns)


@dataclass(frozen=True)
class Joints:
    """Joint broadcasts on one bus that begin epochs.

    Attributes:
        at_ns: The time in ns since 1970, [n].
        epoch: The epoch, modulo 256, [n].
        epoch_row: The row of the epoch in `Recording.epochs()`, [n].
        halted: True if the bus was halted, [n].
        words: The positions as sent, [n, joints of the chain].
        positions: The positions in rad or m, [n, joints of the chain].
        names: The joints of the chain.
    """

    at_ns: Integers
    epoch: Bytes
    epoch_row: Integers
    halted: Bools
    words: Words
    positions: Floats
    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.at_ns)

    def to_pandas(self) -> pandas.DataFrame:
        """Returns a table with a column for each joint."""
        columns: dict[str, Any] = {name: getattr(self, name) for name in ("epoch", "epoch_row", "halted")}
        columns |= {f"position_{name}": self.positions[:, at] for at, name in enumerate(self.names)}
        return _data_frame(columns, self.at_ns)


class _WordTable:
    """Base class of tables whose rows are words with a step, one for each joint of a chain."""

    at_ns: Integers
    words: Words
    step: float

    def __len__(self) -> int:
        return len(self.at_ns)

    @property
    def values(self) -> Floats:
        """The values in Nm or N, [n, joints of the chain]."""
        values: Floats = self.words * np.float64(self.step)
        return values

    @property
    def saturated(self) -> Bools:
        """True for words that stand for any larger value, [n, joints of the chain]."""
        return _is_saturated(self.words)


@dataclass(frozen=True)
class Torques(_WordTable):
    """Torques of one cell, each an answer to joints.

    Attributes:
        at_ns: The time in ns since 1970, [n].
        epoch: The epoch that the torque answers, modulo 256, [n].
        joints_row: The row of these joints in `Recording.joints()` of the bus; -1 if the torque is not used, because
            it came too late, is a second answer, or has a node id that the skin does not have, [n].
        words: The torques as sent, [n, joints of the chain].
        step: The value of one step of a word in Nm or N.
        names: The joints of the chain.
        joints_epoch_row: `epoch_row` of all joints of the bus.
    """

    at_ns: Integers
    epoch: Bytes
    joints_row: Integers
    words: Words
    step: float
    names: tuple[str, ...]
    joints_epoch_row: Integers

    @property
    def used(self) -> Bools:
        """True for torques that are in the sum of an epoch, [n]."""
        return self.joints_row >= 0

    @property
    def epoch_row(self) -> Integers:
        """The row of the epoch in `Recording.epochs()`; -1 if the torque is not used, [n]."""
        if len(self.joints_epoch_row) == 0:
            return np.full(len(self), -1, dtype=np.int64)
        return np.where(self.used, self.joints_epoch_row[self.joints_row], np.int64(-1))

    def to_pandas(self) -> pandas.DataFrame:
        """Returns a table with a column for each joint."""
        columns: dict[str, Any] = {"epoch": self.epoch, "epoch_row": self.epoch_row, "used": self.used}
        values = self.values
        columns |= {f"torque_{name}": values[:, at] for at, name in enumerate(self.names)}
        return _data_frame(columns, self.at_ns)


@dataclass(frozen=True)
class Sums(_WordTable):
    """Sums that one cell sent for itself and the cells below it in the tree.

    Attributes:
        at_ns: The time in ns since 1970, [n].
        epoch: The epoch that the sum answers, modulo 256, [n].
        count: Number of cells in the sum, [n].
        words: The sums as sent, [n, joints of the chain].
        step: The value of one step of a word in Nm or N.
        names: The joints of the chain.
    """

    at_ns: Integers
    epoch: Bytes
    count: Bytes
    words: Words
    step: float
    names: tuple[str, ...]

    def to_pandas(self) -> pandas.DataFrame:
        """Returns a table with a column for each joint."""
        columns: dict[str, Any] = {"epoch": self.epoch, "count": self.count}
        values = self.values
        columns |= {f"sum_{name}": values[:, at] for at, name in enumerate(self.names)}
        return _data_frame(columns, self.at_ns)


@dataclass(frozen=True)
class Epochs:
    """The torques of the whole skin in each epoch, as in `skinbus convert RUN.mcap torques.csv`.

    Attributes:
        at_ns: The time of the first joints of the epoch in ns since 1970, [n].
        number: The epoch, continued beyond 255; 0 is that of the first joints, [n].
        epoch: The epoch, modulo 256, [n].
        open_cells: Number of cells whose word or contact state is unknown, [n].
        saturated_cells: Number of cells with a saturated word, [n].
        positions: The positions in rad or m; NaN where no bus had the joint, [n, joints of the robot].
        distributed: The sums of the cells' words in Nm or N; NaN where a bus had no joints, or cells answer with sums,
            [n, joints of the robot].
        central: The central computation in Nm or N; NaN where a bus had no joints, [n, joints of the robot].
        error: `distributed` less `central`, [n, joints of the robot].
        names: The joints of the robot.
        units: The units of position and torque of each joint.
    """

    at_ns: Integers
    number: Integers
    epoch: Bytes
    open_cells: Counts
    saturated_cells: Counts
    positions: Floats
    distributed: Floats
    central: Floats
    error: Floats
    names: tuple[str, ...]
    units: tuple[tuple[str, str], ...]

    def __len__(self) -> int:
        return len(self.at_ns)

    def to_pandas(self) -> pandas.DataFrame:
        """Returns a table whose columns have the names of the CSV file."""
        columns: dict[str, Any] = {"epoch": self.epoch}
        for at, (name, (position, torque)) in enumerate(zip(self.names, self.units, strict=True)):
            columns[f"position_{name}_{position}"] = self.positions[:, at]
            columns[f"distributed_{name}_{torque}"] = self.distributed[:, at]
            columns[f"central_{name}_{torque}"] = self.central[:, at]
            columns[f"error_{name}_{torque}"] = self.error[:, at]
        columns |= {"open_cells": self.open_cells, "saturated_cells": self.saturated_cells}
        return _data_frame(columns, self.at_ns)


@dataclass(frozen=True)
class Contacts:
    """The contacts of one cell or of all cells, by cell and then by time.

    Attributes:
        bus: The bus, as an index of `Recording.buses`, [n].
        node: The node id of the cell, [n].
        begin_ns: The time of the first joints with the contact in ns since 1970, [n].
        end_ns: The time of the first joints without it, or of the last ones, [n].
        ended: False if the recording ends before the contact, [n].
        peak_force: The largest force in N; NaN if the recording does not show it, [n].
    """

    bus: Words
    node: Bytes
    begin_ns: Integers
    end_ns: Integers
    ended: Bools
    peak_force: Floats

    def __len__(self) -> int:
        return len(self.begin_ns)

    def to_pandas(self) -> pandas.DataFrame:
        """Returns a table whose index is the time of the beginnings."""
        import pandas

        columns: dict[str, Any] = {"bus": self.bus, "node": self.node}
        columns["end"] = pandas.to_datetime(np.asarray(self.end_ns), unit="ns", utc=True)
        columns |= {"ended": self.ended, "peak_force": self.peak_force}
        return _data_frame(columns, self.begin_ns)


def _is_saturated(words: Words) -> Bools:
    limits = np.iinfo(np.int16)
    saturated: Bools = (words == limits.min) | (words == limits.max)
    return saturated


def _data_frame(columns: Mapping[str, Any], at_ns: Integers) -> pandas.DataFrame:
    """Returns a table in memory whose index is the time in UTC."""
    try:
        import pandas
    except ImportError as error:
        raise ImportError("to_pandas() needs pandas: `pip install pandas`, or use the arrays") from error
    index = pandas.to_datetime(np.array(at_ns), unit="ns", utc=True)
    # Copies, because a table that is changed must not change the index on the disk.
    values = {name: np.array(it) if isinstance(it, np.ndarray) else it for name, it in columns.items()}
    table: pandas.DataFrame = pandas.DataFrame(values, index=index.rename("time"))
    return table
