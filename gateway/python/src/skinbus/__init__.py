"""Benches of robot skin on CAN, from Python.

`Bench` runs a bench and presses its cells; the fixture `bench` does it in pytest; `read` reads a recording;
python-can opens a bus with `can.Bus(interface="skinbus", channel="vcan0")`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from skinbus._programs import program_path
from skinbus.bench import Bench, Cell
from skinbus.errors import CommandRefused, ProgramMissing, RunFailed, SkinbusError, Unconfirmed
from skinbus.events import (
    Accepted,
    BusState,
    CellState,
    Confirmed,
    Contact,
    Dropped,
    Ended,
    Epoch,
    Event,
    Halted,
    NotConfirmed,
    Ready,
    Refused,
    Report,
    Resumed,
    Torques,
)
from skinbus.press import Press

__all__ = [
    "Accepted",
    "Bench",
    "BusState",
    "Cell",
    "CellState",
    "CommandRefused",
    "Confirmed",
    "Contact",
    "Dropped",
    "Ended",
    "Epoch",
    "Event",
    "Halted",
    "NotConfirmed",
    "Press",
    "ProgramMissing",
    "Ready",
    "Refused",
    "Report",
    "Resumed",
    "RunFailed",
    "SkinbusError",
    "Torques",
    "Unconfirmed",
    "program_path",
    "read",
    "to_rerun",
]

if TYPE_CHECKING:
    from skinbus.recording import read
    from skinbus.rerun import to_rerun


def __getattr__(name: str) -> Any:
    """Imports `read` and `to_rerun` when they are used, with numpy: tests that only press cells start sooner."""
    if name == "read":
        from skinbus.recording import read

        return read
    if name == "to_rerun":
        from skinbus.rerun import to_rerun

        return to_rerun
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
