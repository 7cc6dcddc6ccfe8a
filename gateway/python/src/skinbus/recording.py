"""Recordings as numpy arrays.

    recording = skinbus.read("run.mcap")
    torques = recording.torques("vcan0:17", start_ns=recording.began_ns + 2_000_000_000)
    torques.at_ns, torques.values            # ns since 1970; Nm or N, one column for each joint
    recording.epochs().to_pandas()           # as `skinbus convert run.mcap torques.csv`

The first call converts the recording into an index beside it, `run.mcap.columns`, in about the time of
`skinbus convert`. Later calls map that index into memory and read only what is used, until the recording or the version
of `skinbus` changes.
"""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from skinbus._folder import PrivateFolder
from skinbus._recording_index import Index, ReadFailed, convert, load_index, open_index
from skinbus._recording_tables import Contacts, Epochs, Frames, Joints, Notes, Sums, Torques

if TYPE_CHECKING:
    import pandas

__all__ = [
    "Accounts",
    "BusAccount",
    "CellAccount",
    "CellInfo",
    "Contacts",
    "Epochs",
    "Frames",
    "Joints",
    "Notes",
    "ReadFailed",
    "Recording",
    "Sums",
    "Torques",
    "read",
]

PathLike = str | os.PathLike[str]
CellName = str | int | tuple[str, int]
Rows = slice | NDArray[np.bool_]


@dataclass(frozen=True)
class CellInfo:
    """A cell of the skin.

    Attributes:
        bus: The name of its bus.
        node: Its node id on the bus.
        serial: Its serial number.
        joint: The name of the joint that moves it.
    """

    bus: str
    node: int
    serial: int
    joint: str

    def __str__(self) -> str:
        return f"{self.bus}:{self.node}"


@dataclass(frozen=True)
class BusAccount:
    """Counts of one bus: frames, decoded packets, torques and those used in epochs, sums, and lost frames."""

    name: str
    frames: int
    packets: int
    torques: int
    used: int
    sums: int
    lost: int


@dataclass(frozen=True)
class CellAccount:
    """Counts of one cell, as "BUS:NODE": torques and those used in epochs, sums, heartbeats."""

    cell: str
    torques: int
    used: int
    sums: int
    heartbeats: int


@dataclass(frozen=True)
class Accounts:
    """Counts of a recording.

    Attributes:
        frames: Number of frames.
        lost: Number of frames that the recorder lost.
        unreadable: Number of lines and messages that cannot be read.
        can_xl: Number of CAN XL frames, which are not decoded.
        epochs: Number of epochs.
        buses: The counts of each bus.
        cells: The counts of each cell that sent something.
    """

    frames: int
    lost: int
    unreadable: int
    can_xl: int
    epochs: int
    buses: tuple[BusAccount, ...]
    cells: tuple[CellAccount, ...]


def read(*files: PathLike, skin: PathLike | None = None, index: bool = True) -> Recording:
    """Reads a recording, or all parts of a split recording, or candump logs.

    Args:
        files: The files of one capture, in any order.
        skin: The skin file. A recording has its own skin; a log needs one.
        index: Keep the converted recording beside the file, as `FILE.columns`, and use it the next time. If the folder
            is not writable, it is kept in the user's cache. False: convert into a temporary folder, which is removed
            whatever happens; its disk space is free when the recording and its arrays are no longer used.

    Raises:
        ReadFailed: The files are not one capture, the capture does not fit the skin, or the index cannot be written.
        FileNotFoundError: One of the files does not exist.
        ProgramMissing: The program `skinbus` is not installed.
    """
    if not files:
        raise TypeError("name the recording: skinbus.read(FILE)")
    paths = sorted(Path(file) for file in files)
    skin_path = None if skin is None else Path(skin)
    for path in [*paths, *([skin_path] if skin_path else [])]:
        path.stat()
    if index:
        return Recording(open_index(paths, skin_path))
    with contextlib.closing(PrivateFolder(for_sockets=False)) as folder:
        place = folder.path / "recording.columns"
        convert(paths, place, skin_path, descriptors=[folder.descriptor])
        return Recording(load_index(place))


class Recording:
    """A recording whose tables are mapped into memory. All arrays are read-only; copy them to change them.

    Times are ns since 1970. A range of times has its start, but not its end. A cell is named "BUS:NODE", (BUS, NODE),
    or by its node id alone if only one bus has cells.

    Attributes:
        index: The folder of the converted recording; with `index=False` it was removed.
        skin: The name of the skin.
        robot: The name of the robot.
        began_ns: The time from which commands count seconds: the first tick of the run, else the first frame.
        broadcast_hz: The rate of joint broadcasts by the skin.
        unfinished: What is missing at the end of a recording that was not finished, else None.
        buses: The names of the buses: first those of the skin, then others.
        joint_names: The joints of the robot.
        joint_units: The units of position and torque of each joint.
        cells: The cells of the skin.
        accounts: Counts by bus and by cell.
        metadata: The metadata records of the recording.
    """

    def __init__(self, index: Index) -> None:
        description = index.description
        self.index = index.path
        self._tables: Mapping[str, Any] = description["tables"]
        self._buses: list[dict[str, Any]] = description["buses"]
        self._columns = dict(index.columns)
        self._is_open = True
        self._in_order: dict[tuple[str, int, int], bool] = {}
        self.skin: str = description["skin"]
        self.robot: str = description["robot"]
        self.began_ns: int = description["began_ns"]
        self.broadcast_hz: float = description["broadcast_hz"]
        self.unfinished: str | None = description["unfinished"]
        self.buses: tuple[str, ...] = tuple(bus["name"] for bus in self._buses)
        joints = description["joints"]
        self.joint_names: tuple[str, ...] = tuple(joint["name"] for joint in joints)
        self.joint_units: tuple[tuple[str, str], ...] = tuple(
            (joint["position_unit"], joint["torque_unit"]) for joint in joints
        )
        self.cells: tuple[CellInfo, ...] = tuple(
            CellInfo(self.buses[cell["bus"]], cell["node"], cell["serial"], self.joint_names[cell["joint"]])
            for cell in description["cells"]
        )
        self.accounts = _accounts(description["accounts"])
        self.metadata: Mapping[str, Mapping[str, str]] = description["metadata"]
        self._groups: dict[str, dict[tuple[int, int], tuple[int, int]]] = {
            table: {(it["bus"], it["node"]): (it["begin"], it["end"]) for it in facts.get("groups", ())}
            for table, facts in self._tables.items()
        }

    def __repr__(self) -> str:
        return f"<Recording {self.index}: {self.accounts.frames} frames, {self.accounts.epochs} epochs>"

    def __enter__(self) -> Recording:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Releases the tables; later calls of methods raise ValueError. Arrays that are in use stay valid."""
        self._is_open = False
        self._columns.clear()

    def frames(self, start_ns: int | None = None, end_ns: int | None = None, bus: str | None = None) -> Frames:
        """Returns the frames of all buses, or of one."""
        rows = self._rows("frames", (0, self._tables["frames"]["rows"]), start_ns, end_ns)
        if bus is not None:
            chosen = self._column("frames", "bus")[rows] == self._bus_index(bus)
            rows = _mask(rows, chosen, self._tables["frames"]["rows"])
        names = ("at_ns", "bus", "id", "flags", "direction", "length", "raw_dlc")
        offsets = self._column("frames", "data_offsets")
        return Frames(
            **{name: self._column("frames", name)[rows] for name in names},
            data=self._column("frames", "data"),
            begins=offsets[:-1][rows],
            ends=offsets[1:][rows],
        )

    def notes(self) -> Notes:
        """Returns the entries between the frames, such as reports of lost frames."""
        names = ("at_ns", "bus", "kind", "frames", "line")
        text, offsets = self._column("notes", "text"), self._column("notes", "text_offsets")
        texts = (text[begin:end].tobytes() for begin, end in itertools.pairwise(offsets))
        return Notes(
            **{name: self._column("notes", name) for name in names},
            text=tuple(it.decode(errors="replace") for it in texts),
        )

    def joints(self, bus: str | None = None, start_ns: int | None = None, end_ns: int | None = None) -> Joints:
        """Returns the joint broadcasts on a bus. The name may be left out if the skin has one bus with cells."""
        number = self._bus_index(bus) if bus is not None else self._only_bus()
        rows = self._group_rows("joints", (number, 0), start_ns, end_ns)
        names = ("at_ns", "epoch", "epoch_row", "halted")
        wide = {name: self._column("joints", name)[rows, : self._width(number)] for name in ("words", "positions")}
        return Joints(**{name: self._column("joints", name)[rows] for name in names}, **wide, names=self._chain(number))

    def torques(self, cell: CellName, start_ns: int | None = None, end_ns: int | None = None) -> Torques:
        """Returns the torques that a cell sent on its own."""
        bus, node = self._cell(cell)
        rows = self._group_rows("torques", (bus, node), start_ns, end_ns)
        begin, end = self._groups["joints"].get((bus, 0), (0, 0))
        return Torques(
            **{name: self._column("torques", name)[rows] for name in ("at_ns", "epoch", "joints_row")},
            words=self._column("torques", "words")[rows, : self._width(bus)],
            step=self._buses[bus]["torque_step"],
            names=self._chain(bus),
            joints_epoch_row=self._column("joints", "epoch_row")[begin:end],
        )

    def sums(self, cell: CellName, start_ns: int | None = None, end_ns: int | None = None) -> Sums:
        """Returns the sums that a cell sent for itself and the cells below it in the tree."""
        bus, node = self._cell(cell)
        rows = self._group_rows("sums", (bus, node), start_ns, end_ns)
        return Sums(
            **{name: self._column("sums", name)[rows] for name in ("at_ns", "epoch", "count")},
            words=self._column("sums", "words")[rows, : self._width(bus)],
            step=self._buses[bus]["sum_step"],
            names=self._chain(bus),
        )

    def epochs(self, start_ns: int | None = None, end_ns: int | None = None) -> Epochs:
        """Returns the distributed and central torques of the whole skin in each epoch."""
        rows = self._rows("epochs", (0, self._tables["epochs"]["rows"]), start_ns, end_ns)
        names = ("at_ns", "number", "epoch", "open_cells", "saturated_cells")
        wide = ("positions", "distributed", "central", "error")
        return Epochs(
            **{name: self._column("epochs", name)[rows] for name in (*names, *wide)},
            names=self.joint_names,
            units=self.joint_units,
        )

    def contacts(self, cell: CellName | None = None) -> Contacts:
        """Returns the contacts of all cells, or of one."""
        groups = self._groups["contacts"]
        rows = slice(0, self._tables["contacts"]["rows"])
        if cell is not None:
            key = self._cell(cell)
            begin, end = groups.get(key, (0, 0))
            rows, groups = slice(begin, end), {key: (begin, end)}
        counts = [end - begin for begin, end in groups.values()]
        names = ("begin_ns", "end_ns", "ended", "peak_force")
        return Contacts(
            bus=np.repeat(np.array([bus for bus, _ in groups], dtype=np.int16), counts),
            node=np.repeat(np.array([node for _, node in groups], dtype=np.uint8), counts),
            **{name: self._column("contacts", name)[rows] for name in names},
        )

    def to_pandas(self) -> pandas.DataFrame:
        """Returns the epochs as a table, with the columns of `skinbus convert RUN.mcap torques.csv`."""
        return self.epochs().to_pandas()

    def _column(self, table: str, name: str) -> NDArray[Any]:
        """Returns a column."""
        if not self._is_open:
            raise ValueError("the recording is closed")
        column = self._columns.get(f"{table}.{name}")
        if column is None:
            raise ReadFailed(f"{self.index} lacks {table}.{name}.npy: remove this folder, and read the recording again")
        return column

    def _group_rows(self, table: str, group: tuple[int, int], start_ns: int | None, end_ns: int | None) -> Rows:
        return self._rows(table, self._groups[table].get(group, (0, 0)), start_ns, end_ns)

    def _rows(self, table: str, whole: tuple[int, int], start_ns: int | None, end_ns: int | None) -> Rows:
        """Returns the rows of a range of times: a slice, or a mask if a clock was set back."""
        begin, end = whole
        if start_ns is None and end_ns is None:
            return slice(begin, end)
        every = self._column(table, "at_ns")
        times = every[begin:end]
        key = (table, begin, end)
        if key not in self._in_order:
            self._in_order[key] = bool(np.all(times[1:] >= times[:-1]))
        if self._in_order[key]:
            first = 0 if start_ns is None else int(np.searchsorted(times, start_ns))
            last = len(times) if end_ns is None else int(np.searchsorted(times, end_ns))
            return slice(begin + first, begin + max(first, last))
        chosen = np.ones(len(times), dtype=np.bool_)
        if start_ns is not None:
            chosen &= times >= start_ns
        if end_ns is not None:
            chosen &= times < end_ns
        return _mask(slice(begin, end), chosen, len(every))

    def _bus_index(self, name: str) -> int:
        if name in self.buses:
            return self.buses.index(name)
        raise KeyError(f"the recording has no bus {name!r}; its buses are {', '.join(self.buses)}")

    def _only_bus(self) -> int:
        buses = sorted({cell.bus for cell in self.cells})
        if len(buses) == 1:
            return self._bus_index(buses[0])
        raise ValueError(f"several buses have cells: name one of {', '.join(buses)}")

    def _cell(self, cell: CellName) -> tuple[int, int]:
        """Returns the bus and the node id of a cell."""
        if isinstance(cell, tuple):
            bus, node = self._bus_index(cell[0]), cell[1]
        elif isinstance(cell, int):
            bus, node = self._only_bus(), cell
        else:
            name, colon, digits = str(cell).rpartition(":")
            if not digits.isdecimal():
                raise ValueError(f'{cell!r} is not a cell: name it as "BUS:NODE", such as {self._example()}')
            bus, node = (self._bus_index(name) if colon else self._only_bus()), int(digits)
        is_known = any((it.bus, it.node) == (self.buses[bus], node) for it in self.cells)
        if not is_known and not any((bus, node) in self._groups[table] for table in ("torques", "sums")):
            raise KeyError(f"the skin has no cell {self.buses[bus]}:{node}; one of its cells is {self._example()}")
        return bus, node

    def _example(self) -> str:
        return str(next(iter(self.cells), "vcan0:1"))

    def _width(self, bus: int) -> int:
        return len(self._buses[bus]["joints"])

    def _chain(self, bus: int) -> tuple[str, ...]:
        return tuple(self.joint_names[joint] for joint in self._buses[bus]["joints"])


def _mask(rows: Rows, chosen: NDArray[np.bool_], count: int) -> NDArray[np.bool_]:
    """Returns the chosen ones of some rows as a mask of all rows."""
    mask = np.zeros(count, dtype=np.bool_)
    mask[rows] = chosen
    return mask


def _accounts(facts: Mapping[str, Any]) -> Accounts:
    buses = tuple(BusAccount(**bus) for bus in facts["buses"])

    def of_cells(cells: Iterable[Mapping[str, Any]]) -> Iterable[CellAccount]:
        for cell in cells:
            counts = {name: cell[name] for name in ("torques", "used", "sums", "heartbeats")}
            yield CellAccount(cell=f"{buses[cell['bus']].name}:{cell['node']}", **counts)

    return Accounts(
        frames=facts["frames"],
        lost=facts["lost"],
        unreadable=facts["unreadable_lines"] + facts["unreadable_messages"],
        can_xl=facts["can_xl"],
        epochs=facts["epochs"],
        buses=buses,
        cells=tuple(of_cells(facts["cells"])),
    )
