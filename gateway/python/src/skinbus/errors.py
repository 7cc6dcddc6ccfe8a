"""Exceptions of this package."""

from __future__ import annotations


class SkinbusError(Exception):
    """Base class of this package's exceptions."""


class ProgramMissing(SkinbusError, FileNotFoundError):
    """A program of the bench is not installed. The text says what to do."""


class RunFailed(SkinbusError):
    """A run ended with an error, or before it carried out a command.

    Attributes:
        text: The line in which the program gives its reason.
        code: The program's exit code; negative if a signal ended it.
        notes: The last lines of the program's standard error.
    """

    def __init__(self, text: str, code: int, notes: tuple[str, ...] = ()) -> None:
        super().__init__(text, code, notes)
        self.text = text
        self.code = code
        self.notes = notes

    def __str__(self) -> str:
        return f"{self.text} (exit code {self.code})"


class CommandRefused(SkinbusError):
    """The run refused a command: no such cell, a force out of range.

    Attributes:
        text: The line in which the run gives its reason.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.text = text


class Unconfirmed(SkinbusError):
    """No torque of the cell shows the force.

    Attributes:
        cell: The cell, as "BUS:NODE".
        force_n: The force in N; 0 for a release.
        reason: One word, such as "below-threshold", "dead" or "no-answer".
        text: The line in which the run explains the reason.
    """

    def __init__(self, cell: str, force_n: float, reason: str, text: str) -> None:
        super().__init__(cell, force_n, reason, text)
        self.cell = cell
        self.force_n = force_n
        self.reason = reason
        self.text = text

    def __str__(self) -> str:
        return f"{self.cell}, {self.force_n:g} N: {self.reason}: {self.text}"
