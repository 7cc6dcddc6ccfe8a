"""Running benches in Rerun."""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

import rerun as rr

from skinbus import _rerun_view as view
from skinbus._programs import program_path
from skinbus._rerun_topics import Log, Topics
from skinbus._scene import Silence
from skinbus.bench import Bench
from skinbus.errors import RunFailed, SkinbusError
from skinbus.events import CellState, Contact, Event

# Time in seconds in which the program that follows the buses starts and ends.
_VIEW_TIMEOUT = 30.0
# Time in seconds without a message after which everything that waits for later ones is sent.
_PAUSE = 0.2
_SUBPROTOCOL = "foxglove.websocket.v1"
_MESSAGE_DATA = 1

# Origins of the timeline `run` in ns since 1970, and joints whose views were sent, by the id of the recording: a second
# bench in the same recording neither restarts the timeline nor moves the eye.
_origins: dict[str, int] = {}
_viewed: dict[str, set[tuple[str, ...]]] = {}


class _Socket(Protocol):
    def recv(self, timeout: float | None = None) -> str | bytes: ...
    def send(self, message: str) -> None: ...
    def close(self) -> None: ...


class LiveLog:
    """Logs a bench to Rerun until it ends, or until `close`.

    `skinbus view --foxglove` follows the buses of the bench in a process of its own, so that the bench is not delayed.

    Attributes:
        stream: The stream that the bench is logged to.
    """

    def __init__(self, bench: Bench, stream: rr.RecordingStream, *, is_own: bool) -> None:
        self.stream = stream
        self._is_own = is_own
        self._stack = contextlib.ExitStack()
        recording = str(stream.get_recording_id())
        if recording not in _origins:
            _origins[recording] = time.time_ns()
            stream.send_recording_name(Path(bench.skin).name)
            stream.send_recording_start_time_nanos(_origins[recording])
        self._log = Log(stream, _origins[recording])
        # Two threads log what `close` ends.
        self._lock = threading.Lock()
        self._has_topics = self._has_events = True
        self._is_closing = self._is_closed = False
        self._bench = bench
        events = bench.events()
        self._first_event = events[-1].index + 1 if events else 0
        self._next_event = 0
        self._touched, self._silent = set[str](), set[str]()
        self._view = _start_view(bench)
        try:
            self._socket = _connect(self._view, self._stack)
            self._topics = Topics(self._log, bench.ready.joints, _viewed.setdefault(recording, set()))
            self._names = dict[int, str]()
            self._threads = [
                threading.Thread(target=self._follow_topics, name="skinbus to Rerun", daemon=True),
                threading.Thread(target=self._follow_events, name="skinbus events", daemon=True),
            ]
            for thread in self._threads:
                thread.start()
        except BaseException:
            self._stack.close()
            self._view.kill()
            self._view.wait()
            raise

    def __enter__(self) -> LiveLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Ends the log, and completes the file. Warns if the viewer was closed before."""
        if self._is_closed:
            return
        self._is_closing = True
        self._view.terminate()
        try:
            self._view.wait(_VIEW_TIMEOUT)
        except subprocess.TimeoutExpired:
            self._view.kill()
            self._view.wait()
        self._threads[0].join(_VIEW_TIMEOUT)
        # In a thread of its own, because times of a stream belong to the thread that sets them.
        ending = threading.Thread(target=self._end_log, name="skinbus end of log", daemon=True)
        ending.start()
        ending.join(_VIEW_TIMEOUT)
        self._stack.close()
        for pipe in (self._view.stdin, self._view.stderr):
            if pipe is not None:
                pipe.close()
        view.finish(self.stream, is_own=self._is_own)
        self._is_closed = True

    def _end_log(self) -> None:
        with self._lock:
            if self._has_events:
                # The other thread may not have logged the newest ones yet.
                for event in self._bench.events():
                    self._add_event(event)
                self._has_events = False
                self._end("the log has ended")

    def _end(self, text: str) -> None:
        """Logs an end. The caller holds the lock."""
        at_ns = max(time.time_ns(), self._log.last_ns + 1)
        self._log.add_event(at_ns, text)
        if self._has_topics:
            self._has_topics = False
            self._topics.end(at_ns)

    def _follow_topics(self) -> None:
        """Logs the messages of the view until its end."""
        from websockets.exceptions import ConnectionClosed

        # Either the view has ended, or `close` or the end of the bench has ended it.
        try:
            with contextlib.suppress(ConnectionClosed):
                while True:
                    try:
                        said = self._socket.recv(_PAUSE)
                    except TimeoutError:
                        with self._lock:
                            if self._has_topics:
                                self._topics.send()
                        continue
                    if isinstance(said, str):
                        self._subscribe(json.loads(said))
                    elif said[0] == _MESSAGE_DATA:
                        topic = self._names[int.from_bytes(said[1:5], "little")]
                        with self._lock:
                            if self._has_topics:
                                self._topics.add(topic, said[13:], self._names.values())
        finally:
            with self._lock:
                if self._has_topics and not self._is_closing:
                    self._end("the view has ended")

    def _subscribe(self, said: dict[str, Any]) -> None:
        """Subscribes to the topics that are shown, among those that are advertised."""
        shown = ("/tf", "/tf_static", "/robot_description")
        new = [
            channel
            for channel in said.get("channels", ())
            if channel["topic"] in shown
            or channel["topic"].startswith("/skin/")
            or channel["topic"].endswith(("/joint_states", "/torques"))
        ]
        if said.get("op") != "advertise" or not new:
            return
        self._names |= {channel["id"]: channel["topic"] for channel in new}
        begun = [{"id": channel["id"], "channelId": channel["id"]} for channel in new]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": begun}))

    def _follow_events(self) -> None:
        """Logs contacts and silent cells of the bench until its end, and then ends the view."""
        with contextlib.suppress(RunFailed):
            for event in self._bench.follow():
                with self._lock:
                    if not self._has_events:
                        return
                    self._add_event(event)
        with self._lock:
            if self._has_events:
                self._has_events = False
                self._end("the bench has ended")
        self._view.terminate()

    def _add_event(self, event: Event) -> None:
        """Logs an event, unless it was logged before. The caller holds the lock."""
        if event.index < self._next_event:
            return
        self._next_event = event.index + 1
        if isinstance(event, Contact):
            change = "is touched" if event.touched else "is no longer touched"
            (self._touched.add if event.touched else self._touched.discard)(event.cell)
            self._log.add_event(event.at_ns, f"{event.cell} {change}")
            self.stream.log("/contacts/count", rr.Scalars(float(len(self._touched))))
        elif isinstance(event, CellState) and (event.state == "dead") != (event.cell in self._silent):
            is_back = event.cell in self._silent
            (self._silent.discard if is_back else self._silent.add)(event.cell)
            # The event has no time, so only those from now on are logged.
            if event.index >= self._first_event:
                silence = Silence(time.time_ns(), event.cell, is_back)
                self._log.add_event(silence.at_ns, silence.text)


def _start_view(bench: Bench) -> subprocess.Popen[str]:
    """Starts the program that follows the buses of a bench and serves its topics to this one."""
    environment = dict(os.environ)
    if bench.directory is not None:
        environment["SKINBUS_DIR"] = str(bench.directory)
    # A token in the environment is for a page; the connection of this program has none.
    environment.pop("SKINBUS_TOKEN", None)
    kinds = [f"--bus-kind={one.bus}={one.kind}" for one in bench.ready.buses]
    command = [str(program_path("skinbus")), "view", bench.skin, "--read-only", "--foxglove", "0", *kinds]
    # The program ends with this one and those that it has forked, because they have the other end of the pipe.
    return subprocess.Popen(
        [*command, "--end-with-input"],
        env=environment,
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def _connect(view: subprocess.Popen[str], stack: contextlib.ExitStack) -> _Socket:
    """Connects to a view, when it has told its address."""
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    assert view.stderr is not None
    said = []
    for line in view.stderr:
        said.append(line.rstrip("\n"))
        found = re.match(r"foxglove: (ws://\S+)", line)
        if found is not None:
            # Later lines are read, so that the program never waits for a reader.
            threading.Thread(target=view.stderr.read, daemon=True).start()
            connection = connect(found[1], subprotocols=[Subprotocol(_SUBPROTOCOL)], max_size=None)
            return stack.enter_context(connection)
    raise SkinbusError(said[-1] if said else "skinbus view ended before it served its topics")
