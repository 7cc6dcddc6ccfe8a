"""Events that a run sends, one class for each.

Angles are in rad, lengths in m, forces in N, torques in Nm (of prismatic joints: m and N). `at_ns` is the kernel's time
stamp in ns since 1970. `epoch` is the byte in the packets, 0 to 255. A cell is named "BUS:NODE".
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

Vector: TypeAlias = tuple[float, ...]
Id: TypeAlias = int | str | None


class Torques(NamedTuple):
    """Torques of the robot's joints in Nm, each of shape (joints,); empty before the first complete epoch.

    `central` is also empty while the sensors of a touched cell are unknown.
    """

    distributed: Vector
    central: Vector


@dataclass(frozen=True, kw_only=True)
class Event:
    """Base class of events."""

    index: int
    """Number of the event in its run, from 0."""


@dataclass(frozen=True, kw_only=True)
class BusDescription:
    """Description of a bus of the run."""

    bus: str
    kind: str
    """"embedded" or "socketcan"."""
    format: str
    """"fd" or "classic"."""
    cells: tuple[int, ...]
    """Node ids."""
    joints: tuple[str, ...]
    """Names of the joints of its chain, base to tip."""
    reply: str = "torque"
    """"torque" or "sum"."""
    directory: str | None = None
    """Directory of the embedded bus's socket."""


@dataclass(frozen=True, kw_only=True)
class Ready(Event):
    """The loop runs."""

    version: str
    period_s: float
    """Time between two epochs."""
    joints: tuple[str, ...]
    """Names of the robot's joints."""
    buses: tuple[BusDescription, ...] = field(metadata={"of": BusDescription})


@dataclass(frozen=True, kw_only=True)
class Accepted(Event):
    """A command is carried out."""

    do: str
    id: Id = None
    cell: str | None = None
    force_n: float | None = None
    epoch: int | None = None
    """Of a press: the first epoch that holds the force."""
    text: str | None = None


@dataclass(frozen=True, kw_only=True)
class Refused(Event):
    """A command is refused."""

    text: str
    id: Id = None


@dataclass(frozen=True, kw_only=True)
class Confirmed(Event):
    """The cell's first torque that shows the force of a press."""

    cell: str
    force_n: float
    epoch: int
    at_ns: int
    torque: Vector
    """Shape (joints of the bus's chain,)."""
    id: Id = None


@dataclass(frozen=True, kw_only=True)
class NotConfirmed(Event):
    """No torque shows the force of a press."""

    cell: str
    force_n: float
    reason: str
    text: str
    id: Id = None


@dataclass(frozen=True, kw_only=True)
class Contact(Event):
    """A torque shows that a cell is touched, or is no longer touched."""

    cell: str
    touched: bool
    epoch: int
    at_ns: int


@dataclass(frozen=True, kw_only=True)
class CellState(Event):
    """The state of a cell changes."""

    cell: str
    state: str
    """"dead" (it sends nothing), "alive", "restarted" or "ready" (it answers joints)."""


@dataclass(frozen=True, kw_only=True)
class Halted(Event):
    """The robot is halted."""

    reason: str | None = None


@dataclass(frozen=True, kw_only=True)
class Resumed(Event):
    """The robot goes on after a halt."""


@dataclass(frozen=True, kw_only=True)
class BusState(Event):
    """A bus is lost, or works again."""

    bus: str
    up: bool


@dataclass(frozen=True, kw_only=True)
class Epoch(Event):
    """An epoch of a bus, on request. Positions and torques have shape (joints,)."""

    bus: str
    epoch: int
    number: int
    """Number of the epoch, which counts on beyond 255."""
    at_ns: int
    positions: Vector = ()
    distributed: Vector = ()
    central: Vector = ()


@dataclass(frozen=True, kw_only=True)
class BusReport:
    """State of a bus in a report."""

    bus: str
    up: bool
    halted: bool
    epoch: int | None = None
    """Present epoch; None before the first joints."""
    number: int = 0
    """Number of the present epoch, which counts on beyond 255."""
    dropped_frames: int = 0
    """Frames that the channel to this program read too late."""


@dataclass(frozen=True, kw_only=True)
class CellReport:
    """State of a cell in a report: one that has sent a torque, or has a fault."""

    cell: str
    status: str
    epoch: int | None = None
    torque: Vector = ()
    """Last torque, shape (joints of the bus's chain,)."""


@dataclass(frozen=True, kw_only=True)
class Lateness:
    """Lateness of the loop's ticks in µs."""

    p50: float = 0.0
    p90: float = 0.0
    p99: float = 0.0
    max: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Report(Event):
    """State of the bench, on request. Positions and torques have shape (joints,); empty while they are unknown."""

    id: Id = None
    buses: tuple[BusReport, ...] = field(default=(), metadata={"of": BusReport})
    positions: Vector = ()
    distributed: Vector = ()
    central: Vector = ()
    cells: tuple[CellReport, ...] = field(default=(), metadata={"of": CellReport})
    lateness_us: Lateness | None = field(default=None, metadata={"of": Lateness})
    """Lateness of all ticks up to the last full second; None in the first second."""
    skipped: int = 0
    """Ticks that the loop skipped."""


@dataclass(frozen=True, kw_only=True)
class Dropped(Event):
    """This program read too slowly."""

    count: int
    """Events that were dropped so far."""


@dataclass(frozen=True, kw_only=True)
class Ended(Event):
    """The end of the run; the last event."""

    code: int
    """Exit code."""
    text: str | None = None
    summary: dict[str, Any] | None = None


@dataclass(frozen=True, kw_only=True)
class Unknown(Event):
    """A line that this version of the package does not know."""

    line: str


_CLASSES: dict[str, type[Event]] = {
    "ready": Ready,
    "accepted": Accepted,
    "error": Refused,
    "confirmed": Confirmed,
    "unconfirmed": NotConfirmed,
    "contact": Contact,
    "cell": CellState,
    "halted": Halted,
    "resumed": Resumed,
    "bus": BusState,
    "epoch": Epoch,
    "report": Report,
    "dropped": Dropped,
    "ended": Ended,
}


def parse_event(line: str | bytes, index: int) -> Event:
    """Returns the event of one line; an `Unknown` for a line that is not an event. Ignores unknown fields."""
    try:
        data = json.loads(line)
        kind = _CLASSES[data["event"]]
        return kind(**_fields(kind, data), index=index)
    except (ValueError, TypeError, KeyError, RecursionError):
        text = line if isinstance(line, str) else line.decode(errors="replace")
        return Unknown(index=index, line=text.rstrip("\n"))


def _fields(kind: type[Any], data: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the arguments of a class's constructor. A null stands for the default."""
    found = {}
    for one in dataclasses.fields(kind):
        value = data.get(one.name)
        if value is not None:
            found[one.name] = _value(value, one.metadata.get("of"))
    return found


def _value(value: Any, of: type[Any] | None) -> Any:
    """Turns a list into a tuple, and an object into an instance of `of`."""
    if isinstance(value, list):
        return tuple(_value(item, of) for item in value)
    if of is not None and isinstance(value, dict):
        return of(**_fields(of, value))
    return value
