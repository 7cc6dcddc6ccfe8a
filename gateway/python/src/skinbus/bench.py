"""A bench as a context manager: press cells, read torques, cause faults."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, SupportsIndex, TypeAlias, TypeVar, overload

from skinbus._folder import PrivateFolder
from skinbus._programs import program_path
from skinbus._run import Run
from skinbus.errors import CommandRefused, RunFailed, Unconfirmed
from skinbus.events import (
    Accepted,
    CellState,
    Epoch,
    Event,
    Ready,
    Refused,
    Report,
    Torques,
    Vector,
)
from skinbus.press import Press

Cell: TypeAlias = SupportsIndex | str
"""A node id, 1 to 254, or "BUS:NODE", which is needed if several buses have the node."""
Name: TypeAlias = str | os.PathLike[str]
E = TypeVar("E", bound=Event)

# Times in seconds in which a bench on a busy machine starts, answers and ends.
_START_TIMEOUT = 60.0
_ANSWER_TIMEOUT = 10.0
_END_TIMEOUT = 60.0


class Bench:
    """A running bench: cells, their bus, and the control loop.

    A bench runs from `__enter__` or `start` to `__exit__` or `end`. It has a bus folder of its own, so that benches run
    beside each other. If this process is killed, the bench ends and its folder is removed.

    Args:
        skin: The skin's file.
        scenario: The scenario's file: touches, motion, faults.
        spawn: False: real cells, or cells of other processes, are on the bus; none are started.
        duration: Time in s after which the run ends by itself; by default it goes on until `end`, at most 24 h.
        record: A file to record to, as MCAP; it must not exist.
        directory: The directory of embedded buses; by default a private one, and without `spawn` that of other programs
            (`SKINBUS_DIR`).
        options: Further arguments of `skinbus run`.
        timeout: Time in s to wait for an answer or a confirmation.

    The arguments are not checked here; `start` raises `RunFailed` for a skin that has an error.
    """

    def __init__(
        self,
        skin: Name,
        scenario: Name | None = None,
        *,
        spawn: bool = True,
        duration: float | None = None,
        record: Name | None = None,
        directory: Name | None = None,
        options: Sequence[str] = (),
        timeout: float = _ANSWER_TIMEOUT,
    ) -> None:
        arguments = ["run", os.fspath(skin), "--control", "--quiet"]
        if scenario is not None:
            arguments += ["--scenario", os.fspath(scenario)]
        if duration is not None:
            arguments += ["--duration", f"{duration:.9f}".rstrip("0").rstrip(".")]
        if record is not None:
            arguments += ["--record", os.fspath(record)]
        if not spawn:
            arguments.append("--no-spawn")
        elif not any(option.startswith("--bus-kind") for option in options):
            # A bus of the kernel has one name on the whole machine.
            arguments += ["--bus-kind", "embedded"]
        self._arguments = [*arguments, *options]
        self._skin = os.fspath(skin)
        self._timeout = timeout
        self._directory = None if directory is None else Path(directory).absolute()
        self._has_private_directory = spawn and directory is None
        self._folder: PrivateFolder | None = None
        self._owns_folder = True
        self._run: Run | None = None
        self._ready: Ready | None = None
        self._code: int | None = None
        self._counting = threading.Lock()
        self._counters = 0

    def __enter__(self) -> Bench:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end(check=kind is None)

    def _share_folder(self, folder: PrivateFolder) -> None:
        """Lets the bench use a folder that its caller removes."""
        self._folder, self._owns_folder = folder, False

    # Start and end

    def start(self) -> Bench:
        """Starts the bench and returns it when its loop runs.

        Raises:
            RunFailed: The run cannot start; `text` is the program's line.
            ProgramMissing: The program `skinbus` is not installed.
            RuntimeError: The bench was started before.
        """
        if self._run is not None:
            raise RuntimeError("this bench was already started: create another one")
        program = program_path("skinbus")
        environment, descriptors = dict(os.environ), []
        try:
            if self._has_private_directory:
                if self._folder is None:
                    self._folder = PrivateFolder()
                self._directory = self._folder.path / "bus"
                self._directory.mkdir(mode=0o700)
                descriptors.append(self._folder.descriptor)
            if self._directory is not None:
                environment["SKINBUS_DIR"] = str(self._directory)
            self._run = Run([str(program), *self._arguments], environment, descriptors)
            self._ready = self.wait_for(Ready, timeout=_START_TIMEOUT)
        except BaseException:
            self.abort()
            raise
        return self

    def end(self, *, check: bool = True) -> dict[str, Any]:
        """Ends the run in order and returns its summary, see `summary`. Further calls return it again.

        Args:
            check: False: an exit code other than 0 is no exception. The robot being halted at the end is such a code.

        Raises:
            RunFailed: The exit code is not 0.
        """
        run = self._started()
        if self._code is None:
            try:
                self._code = run.end(_END_TIMEOUT)
            except BaseException:
                # Such as a second Ctrl-C.
                self.abort()
                raise
            self._close_folder()
            if check and self._code != 0:
                raise run.failure()
        return self.summary

    def abort(self) -> None:
        """Ends the bench at once, with SIGKILL. It has no summary then."""
        with contextlib.ExitStack() as stack:
            stack.callback(self._close_folder)
            if self._run is not None and self._code is None:
                # The code if Ctrl-C interrupts `kill`. A program that ended before has its own.
                self._code = -9
                self._code = self._run.kill()

    def _close_folder(self) -> None:
        """Removes the private folder, unless another object owns it."""
        if self._folder is not None and self._owns_folder:
            self._folder.close()

    def _started(self) -> Run:
        """Returns the run.

        Raises:
            RuntimeError: The bench was not started.
        """
        if self._run is None:
            raise RuntimeError("the bench was not started: use `with Bench(...) as bench`")
        return self._run

    # What the bench is

    @property
    def ready(self) -> Ready:
        """Description of the running bench: version, period of epochs in s, names of joints, buses."""
        self._started()
        assert self._ready is not None
        return self._ready

    @property
    def skin(self) -> str:
        """Path of the skin's file."""
        return self._skin

    @property
    def directory(self) -> Path | None:
        """Directory of the embedded buses; None if it is that of other programs."""
        return self._directory

    @property
    def notes(self) -> tuple[str, ...]:
        """The last 1 000 lines that the run wrote to its standard error."""
        return self._started().notes

    @property
    def summary(self) -> dict[str, Any]:
        """Figures of the run, after its end, as docs/reference/summary.md explains. Empty if the program was killed.

        Raises:
            RuntimeError: The run has not ended.
        """
        ended = self._started().ended
        if ended is None and self._code is None:
            raise RuntimeError("the run has not ended: call `end` first")
        return {} if ended is None or ended.summary is None else ended.summary

    @property
    def exit_code(self) -> int | None:
        """Exit code of the run, after `end`; negative: the signal that ended it."""
        return self._code

    def name(self, cell: Cell) -> str:
        """Returns a cell's name, "BUS:NODE".

        Raises:
            ValueError: The bench has no such cell, or several.
        """
        if isinstance(cell, str) and ":" in cell:
            buses = [one for one in self.ready.buses if f"{one.bus}:" == cell[: cell.rindex(":") + 1]]
            node = int(cell[cell.rindex(":") + 1 :])
        else:
            buses, node = list(self.ready.buses), int(cell)
        names = [f"{one.bus}:{node}" for one in buses if node in one.cells]
        if len(names) != 1:
            why = f"several buses have it: use one of {', '.join(names)}" if names else "the skin has no such cell"
            raise ValueError(f"cell {cell}: {why}")
        return names[0]

    # Touch

    def press(self, cell: Cell, newton: float, *, confirm: bool = True) -> Press:
        """Presses a cell, until it is pressed again or released.

        Args:
            cell: A node id, or "BUS:NODE".
            newton: The force in N, 0 to 90.
            confirm: Wait until a torque of the cell shows the force; otherwise use `Press.wait`. A press that the cell
                does not answer is repeated twice, because a busy machine delays frames. On a bus whose cells answer
                with sums, no press can be confirmed, nor can 0 N of a cell that is not touched: use `release`.

        Raises:
            Unconfirmed: No torque shows the force; `reason` and `text` say why.
            CommandRefused: There is no such cell, or the force is out of range.
            RunFailed: The run has ended.
        """
        __tracebackhide__ = True
        return self._touch("press", confirm, cell=_cell(cell), force_n=float(newton))

    def release(self, cell: Cell, *, confirm: bool = True) -> Press:
        """Releases a cell.

        Args:
            cell: A node id, or "BUS:NODE".
            confirm: Wait until the cell's torque of zeros ends the contact. A cell that was not touched sends none,
                which is not an error.

        Raises:
            Unconfirmed, CommandRefused, RunFailed: As of `press`.
        """
        __tracebackhide__ = True
        return self._touch("release", confirm, cell=_cell(cell))

    def _touch(self, do: str, confirm: bool, **fields: object) -> Press:
        """Presses or releases a cell, again if the cell did not answer."""
        __tracebackhide__ = True
        for is_last in (False, False, True):
            press = Press(self._started(), self._command(do, **fields), self._timeout)
            if not confirm:
                break
            try:
                press.wait()
                break
            except Unconfirmed as error:
                if do == "release" and error.reason == "not-touched":
                    break
                if is_last or error.reason != "no-answer":
                    raise
        return press

    def release_all(self) -> None:
        """Releases all cells that this bench presses, without waiting for their torques."""
        self._command("release")

    def torque(self, cell: Cell) -> Vector:
        """Returns a cell's last torque in Nm, shape (joints of the bus's chain,); zeros if it has sent none.

        Raises:
            ValueError: The bench has no such cell.
            RunFailed: The run has ended.
        """
        name = self.name(cell)
        (joints,) = (one.joints for one in self.ready.buses if one.bus == name.rpartition(":")[0])
        found = (one.torque for one in self.report().cells if one.cell == name and one.torque)
        return next(found, (0.0,) * len(joints))

    def torques(self) -> Torques:
        """Returns the torques of the robot's joints in Nm at the last complete epoch, each of shape (joints,).

        `distributed` is the sum of the cells' torques, `central` the torque that the gateway computes for comparison;
        it is empty while the sensors of a touched cell are unknown.
        """
        report = self.report()
        return Torques(report.distributed, report.central)

    # Halt and faults

    def halt(self) -> None:
        """Halts all cells and the robot."""
        self._command("halt")

    def resume(self) -> None:
        """Lets cells and robot continue after a halt."""
        self._command("resume")

    def kill(self, cell: Cell) -> None:
        """Kills the process of a cell."""
        self._command("kill", cell=_cell(cell))

    def stop(self, cell: Cell) -> None:
        """Stops the process of a cell (SIGSTOP), as if it hung."""
        self._command("stop", cell=_cell(cell))

    def continue_(self, cell: Cell) -> None:
        """Lets a stopped process of a cell continue."""
        self._command("continue", cell=_cell(cell))

    def restart(self, cell: Cell, *, wait: bool = True) -> None:
        """Starts the process of a cell again, and waits until it answers joints, about 0.3 s.

        Raises:
            TimeoutError: The cell did not answer within the time limit of the bench.
        """
        name = self.name(cell)
        accepted = self._command("restart", cell=_cell(cell))
        if wait:
            self.wait_for(CellState, lambda event: (event.cell, event.state) == (name, "ready"), start=accepted.index)

    def bus_down(self, bus: str | None = None) -> None:
        """Takes a bus down; by default the only one."""
        self._command("bus", bus=self._bus(bus), down=True)

    def bus_up(self, bus: str | None = None) -> None:
        """Brings a bus up again; by default the only one."""
        self._command("bus", bus=self._bus(bus), down=False)

    def link_down(self, cell: Cell, other: Cell) -> None:
        """Takes the link between two cells that sum down."""
        self._command("link", cells=[_cell(cell), _cell(other)], down=True)

    def link_up(self, cell: Cell, other: Cell) -> None:
        """Brings the link between two cells that sum up again."""
        self._command("link", cells=[_cell(cell), _cell(other)], down=False)

    def _bus(self, bus: str | None) -> str:
        """Returns the name of the only bus, unless one is given."""
        if bus is not None:
            return bus
        if len(self.ready.buses) != 1:
            raise ValueError(f"the bus is missing: name one of {', '.join(one.bus for one in self.ready.buses)}")
        return self.ready.buses[0].bus

    # State and events

    def report(self) -> Report:
        """Returns the state of the bench: buses, positions, torques, cells, lateness of the loop."""
        run = self._started()
        start, number = run.send("report")

        def matches(event: Event) -> bool:
            if isinstance(event, Refused) and event.id == number:
                raise CommandRefused(event.text)
            return isinstance(event, Report) and event.id == number

        report = run.wait(matches, start, self._timeout, "report")
        assert isinstance(report, Report)
        return report

    def wait_epochs(self, count: int, *, timeout: float | None = None) -> None:
        """Waits for `count` further epochs of one of the buses.

        Raises:
            RunFailed: The run ended before.
            TimeoutError: They did not come within ten times their period and 10 s, or `timeout` seconds.
        """
        run = self._started()
        if count <= 0:
            return
        counts: Counter[str] = Counter()

        def is_last(event: Event) -> bool:
            if not isinstance(event, Epoch):
                return False
            counts[event.bus] += 1
            return counts[event.bus] >= count

        limit = self._timeout + 10 * count * self.ready.period_s if timeout is None else timeout
        with self._epochs() as start:
            run.wait(is_last, start, limit, f"{count} epochs")

    @contextlib.contextmanager
    def _epochs(self) -> Iterator[int]:
        """Requests an event for every epoch. Yields the number of the first event."""
        with self._counting:
            start = self._command("epochs", every=1).index
            self._counters += 1
        try:
            yield start
        finally:
            with self._counting:
                self._counters -= 1
                if self._counters == 0:
                    with contextlib.suppress(RunFailed, CommandRefused, TimeoutError):
                        self._command("epochs", every=0)

    @overload
    def events(self) -> list[Event]: ...
    @overload
    def events(self, kind: type[E]) -> list[E]: ...
    def events(self, kind: type[Event] = Event) -> list[Event] | list[E]:
        """Returns the events so far, of one class if `kind` is given; at most the last 100 000 of all."""
        return [event for event in self._started().events() if isinstance(event, kind)]

    @overload
    def follow(self, *, start: int = 0, timeout: float | None = None) -> Iterator[Event]: ...
    @overload
    def follow(self, kind: type[E], *, start: int = 0, timeout: float | None = None) -> Iterator[E]: ...
    def follow(
        self, kind: type[Event] = Event, *, start: int = 0, timeout: float | None = None
    ) -> Iterator[Event] | Iterator[E]:
        """Returns an iterator over the events so far and those that come, until the run ends.

        Args:
            kind: A class of events.
            start: `index` of the first event.
            timeout: Time in s without any event after which it raises TimeoutError.
        """
        return (event for event in self._started().follow(start, timeout) if isinstance(event, kind))

    def wait_for(
        self,
        kind: type[E],
        matches: Callable[[E], bool] = lambda event: True,
        *,
        start: int = 0,
        timeout: float | None = None,
    ) -> E:
        """Returns the first event of a class for which `matches` returns true, so far or later.

        Raises:
            RunFailed: The run ended before.
            TimeoutError: There was none for `timeout` seconds (default: those of the bench).
        """

        def is_it(event: Event) -> bool:
            return isinstance(event, kind) and matches(event)

        limit = self._timeout if timeout is None else timeout
        event = self._started().wait(is_it, start, limit, kind.__name__)
        assert isinstance(event, kind)
        return event

    def _command(self, do: str, **fields: object) -> Accepted:
        """Sends a command and returns its answer."""
        __tracebackhide__ = True
        return self._started().command(do, self._timeout, **fields)


def _cell(cell: Cell) -> int | str:
    """Returns a cell as a command has it."""
    return cell if isinstance(cell, str) else cell.__index__()
