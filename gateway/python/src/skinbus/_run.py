"""The process `skinbus run --control`: commands, events, and its end."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import select
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import IO

from skinbus.errors import CommandRefused, RunFailed
from skinbus.events import Accepted, Ended, Event, Refused, parse_event

# The events and the lines of standard error that are kept; 100 000 epochs are half an hour at 62.5 Hz.
_MAX_EVENTS = 100_000
_MAX_NOTES = 1_000
# The time in seconds in which a program ends after a signal.
_SIGNAL_TIMEOUT = 5.0


class Run:
    """A running program. All methods may be called by any thread.

    Two threads read its standard output and its standard error, so that it never waits for its reader.
    """

    def __init__(self, arguments: Sequence[str], environment: Mapping[str, str], descriptors: Sequence[int]) -> None:
        self._ids = itertools.count(1)
        self._sending = threading.Lock()
        self._changed = threading.Condition()
        self._events: deque[Event] = deque(maxlen=_MAX_EVENTS)
        self._count = 0
        self._ended: Ended | None = None
        self._has_ended = False
        self._notes: deque[str] = deque(maxlen=_MAX_NOTES)
        # In a session of its own: Ctrl-C reaches this process, which ends the run in order.
        self._process = subprocess.Popen(
            arguments,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=dict(environment),
            pass_fds=descriptors,
            start_new_session=True,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        self._input: IO[bytes] = self._process.stdin
        notes, events = (self._process.stderr,), (self._process.stdout,)
        self._readers = (
            threading.Thread(target=self._read_notes, args=notes, name="skinbus notes", daemon=True),
            threading.Thread(target=self._read_events, args=events, name="skinbus events", daemon=True),
        )
        for reader in self._readers:
            reader.start()

    @property
    def has_ended(self) -> bool:
        """Tells if the program sends no more events."""
        with self._changed:
            return self._has_ended

    @property
    def ended(self) -> Ended | None:
        """The last event, after the end."""
        with self._changed:
            return self._ended

    @property
    def count(self) -> int:
        """Number of events received so far."""
        with self._changed:
            return self._count

    @property
    def notes(self) -> tuple[str, ...]:
        """The last lines of the program's standard error."""
        with self._changed:
            return tuple(self._notes)

    def events(self) -> list[Event]:
        """Returns the events so far, at most the last 100 000."""
        with self._changed:
            return list(self._events)

    def follow(self, start: int, timeout: float | None) -> Iterator[Event]:
        """Returns the events from number `start` on, as they come, until the run ends.

        Raises:
            TimeoutError: No event came for `timeout` seconds.
        """
        while True:
            with self._changed:
                while self._count <= start:
                    if self._has_ended:
                        return
                    if not self._changed.wait(timeout) and self._count <= start and not self._has_ended:
                        raise TimeoutError(f"the bench sent no event for {timeout:g} s")
                event = self._at(start)
            start = event.index + 1
            yield event

    def wait(self, matches: Callable[[Event], bool], start: int, timeout: float, what: str) -> Event:
        """Returns the first event from number `start` on for which `matches` returns true.

        Raises:
            RunFailed: The run ended before.
            TimeoutError: There was no such event for `timeout` seconds. Its text begins with `what`.
        """
        __tracebackhide__ = True
        deadline = time.monotonic() + timeout
        with self._changed:
            while True:
                while self._count > start:
                    event = self._at(start)
                    if matches(event):
                        return event
                    start = event.index + 1
                if self._has_ended:
                    break
                remaining = deadline - time.monotonic()
                if remaining <= 0:
                    raise TimeoutError(f"{what}: the bench did not answer for {timeout:g} s")
                self._changed.wait(remaining)
        raise self.failure()

    def command(self, do: str, timeout: float, **fields: object) -> Accepted:
        """Sends a command and returns its answer.

        Raises:
            CommandRefused: The run refuses it.
            RunFailed: The run has ended.
            TimeoutError: There was no answer for `timeout` seconds.
        """
        __tracebackhide__ = True
        start, number = self.send(do, **fields)

        def matches(event: Event) -> bool:
            return isinstance(event, (Accepted, Refused)) and event.id == number

        answer = self.wait(matches, start, timeout, do)
        if isinstance(answer, Refused):
            raise CommandRefused(answer.text)
        assert isinstance(answer, Accepted)
        return answer

    def send(self, do: str, **fields: object) -> tuple[int, int]:
        """Sends a command. Returns the number of the first event that can answer it, and its id.

        Raises:
            RunFailed: The run has ended.
            ValueError: A number is infinite or not a number.
        """
        number = next(self._ids)
        line = json.dumps({"do": do, "id": number} | fields, allow_nan=False).encode() + b"\n"
        with self._sending:
            start = self.count
            try:
                # Without a buffer, which `end` would have to write.
                descriptor = self._input.fileno()
                while line:
                    line = line[os.write(descriptor, line) :]
            except (BrokenPipeError, ValueError):
                # A closed pipe, by the program or by `end`.
                self._wait_for_readers()
                raise self.failure() from None
        return start, number

    def failure(self) -> RunFailed:
        """Returns the exception for a run that has ended."""
        code = self._process.wait()
        ended, notes = self.ended, self.notes
        if ended is not None:
            text = ended.text or "the run has ended"
            code = ended.code
        else:
            text = next((note for note in reversed(notes) if note.strip()), "the run ended without a reason")
        return RunFailed(text.strip(), code, notes)

    def end(self, timeout: float) -> int:
        """Ends the run in order, or with signals after `timeout` seconds. Returns its exit code.

        A program that is stopped and reads no more commands is ended by the signals, too.
        """
        deadline = time.monotonic() + timeout
        self._end_input(timeout, b'{"do":"end"}\n')
        for number in (signal.SIGTERM, signal.SIGKILL):
            try:
                self._process.wait(max(0.0, deadline - time.monotonic()))
                break
            except subprocess.TimeoutExpired:
                deadline = time.monotonic() + _SIGNAL_TIMEOUT
                self._process.send_signal(number)
        return self._finish()

    def kill(self) -> int:
        """Ends the program at once, and returns its exit code. Its cells end when their parent does."""
        self._process.kill()
        return self._finish()

    def _finish(self) -> int:
        """Waits for the end of the program and of its output. Returns its exit code."""
        code = self._process.wait()
        self._end_input(_SIGNAL_TIMEOUT)
        self._wait_for_readers()
        return code

    def _end_input(self, timeout: float, last: bytes = b"") -> None:
        """Writes a last line and closes the input, unless commands fill the pipe for `timeout` seconds.

        The line is for programs that this process has forked: they hold the pipe open.
        """
        deadline = time.monotonic() + timeout
        if not self._sending.acquire(timeout=timeout):
            return
        try:
            if last and not self._input.closed:
                poll = select.poll()
                poll.register(self._input, select.POLLOUT)
                # A pipe that can be written takes a short line at once.
                if poll.poll(max(0.0, deadline - time.monotonic()) * 1000):
                    with contextlib.suppress(BrokenPipeError):
                        os.write(self._input.fileno(), last)
            self._input.close()
        finally:
            self._sending.release()

    def _wait_for_readers(self) -> None:
        """Waits until everything that the program sent is read, unless another process holds its output open."""
        for reader in self._readers:
            reader.join(_SIGNAL_TIMEOUT)

    def _at(self, index: int) -> Event:
        """Returns the event with a number below `count`, or the oldest one that is kept."""
        first = self._count - len(self._events)
        return self._events[max(0, index - first)]

    def _read_events(self, output: IO[bytes]) -> None:
        """Reads events until the program closes its output."""
        with output:
            for line in output:
                event = parse_event(line, self._count)
                with self._changed:
                    self._events.append(event)
                    self._count += 1
                    if isinstance(event, Ended):
                        self._ended = event
                    self._changed.notify_all()
        # The notes before the end, so that an exception has them.
        self._readers[0].join(_SIGNAL_TIMEOUT)
        with self._changed:
            self._has_ended = True
            self._changed.notify_all()

    def _read_notes(self, errors: IO[bytes]) -> None:
        """Reads lines of standard error until the program closes it."""
        with errors:
            for line in errors:
                with self._changed:
                    self._notes.append(line.decode(errors="replace").rstrip("\n"))
