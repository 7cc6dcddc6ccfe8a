"""A press of a cell, and its confirmation."""

from __future__ import annotations

from skinbus._run import Run
from skinbus.errors import Unconfirmed
from skinbus.events import Accepted, Confirmed, Event, NotConfirmed, Vector


class Press:
    """A press or a release that the run has accepted.

    Attributes:
        cell: The cell, as "BUS:NODE".
        force_n: The force in N; 0 for a release.
        epoch: The first epoch that holds the force, 0 to 255.
    """

    def __init__(self, run: Run, accepted: Accepted, timeout: float) -> None:
        self._run = run
        self._accepted = accepted
        self._timeout = timeout
        self._verdict: Event | None = None
        self.cell = accepted.cell or ""
        self.force_n = accepted.force_n or 0.0
        self.epoch = accepted.epoch or 0

    def __repr__(self) -> str:
        return f"<Press of {self.cell}, {self.force_n:g} N, from epoch {self.epoch}>"

    def wait(self, timeout: float | None = None) -> Confirmed:
        """Waits for the first torque that shows the force, at most `timeout` seconds (default: those of the bench).

        Raises:
            Unconfirmed: No torque shows the force; `reason` and `text` say why.
            RunFailed: The run ended before.
            TimeoutError: Neither came in time.
        """
        __tracebackhide__ = True

        def matches(event: Event) -> bool:
            return isinstance(event, (Confirmed, NotConfirmed)) and event.id == self._accepted.id

        verdict = self._verdict
        if verdict is None:
            limit = self._timeout if timeout is None else timeout
            verdict = self._verdict = self._run.wait(matches, self._accepted.index, limit, repr(self))
        if isinstance(verdict, Confirmed):
            return verdict
        assert isinstance(verdict, NotConfirmed)
        raise Unconfirmed(verdict.cell, verdict.force_n, verdict.reason, verdict.text)

    @property
    def torque(self) -> Vector:
        """Torque that confirms the press in Nm, shape (joints of the bus's chain,). Waits for it, as `wait` does."""
        __tracebackhide__ = True
        return self.wait().torque
