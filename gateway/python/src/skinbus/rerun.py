"""Recordings and running benches in the viewer Rerun. Needs `pip install "skinbus[rerun]"`.

    skinbus.to_rerun("run.mcap", save="run.rrd")  # then `rerun run.rrd`

    rerun.init("my bench", spawn=True)
    with Bench("skin.toml") as bench, skinbus.to_rerun(bench):
        bench.press(12, 3.0)

| entity | content |
|---|---|
| `/joints/NAME` | position in rad or m |
| `/torques/NAME/distributed`, `central`, `difference` | torques in Nm or N |
| `/contacts` | text: a cell is touched, or is no longer touched; `/contacts/count`: number of touched cells |
| `/robot/links` | a line for each link that moves |
| `/robot/cells/PATCH` | cells, coloured by force |
| `/robot/forces/PATCH` | an arrow for each touched cell |

The timeline `time` has the time in UTC, and `run` the time since the first tick of the run.
"""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import threading
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, overload

import numpy as np
from mcap.reader import make_reader
from numpy.typing import NDArray

from skinbus import _ros2
from skinbus._programs import program_path
from skinbus._scene import Cells, Scene
from skinbus.bench import Bench
from skinbus.errors import RunFailed, SkinbusError
from skinbus.events import Contact
from skinbus.recording import Recording, read

try:
    import rerun as rr
    import rerun.blueprint as rrb
except ImportError as error:
    raise ImportError('skinbus.to_rerun needs the package rerun-sdk: `pip install "skinbus[rerun]"`') from error

__all__ = ["LiveLog", "to_rerun"]

PathLike = str | os.PathLike[str]

_APPLICATION = "skinbus"
_CELL_RADIUS_M = 0.008
_LINK_RADIUS_M = 0.012
_LINK_COLOR = (150, 150, 150)
_ARROW_COLOR = (230, 60, 60)
_NANOS = 1e-9
# Time in seconds in which the program that follows the buses starts and ends.
_VIEW_TIMEOUT = 30.0
_SUBPROTOCOL = "foxglove.websocket.v1"
_MESSAGE_DATA = 1


@overload
def to_rerun(
    source: Bench, *, save: PathLike | None = None, recording: rr.RecordingStream | None = None
) -> LiveLog: ...
@overload
def to_rerun(
    source: PathLike,
    *more: PathLike,
    save: PathLike | None = None,
    recording: rr.RecordingStream | None = None,
    skin: PathLike | None = None,
) -> rr.RecordingStream: ...
def to_rerun(
    source: PathLike | Bench,
    *more: PathLike,
    save: PathLike | None = None,
    recording: rr.RecordingStream | None = None,
    skin: PathLike | None = None,
) -> rr.RecordingStream | LiveLog:
    """Logs a recording, or a bench that runs, to Rerun.

    Args:
        source: A recording, or a candump log, whose cells are not shown in 3D; or a bench, which is followed until it
            ends.
        more: The further parts of a split recording.
        save: A file to write, `*.rrd`. It is complete when the function returns; of a bench, when it was closed.
        recording: The stream to log to; by default a new one with `save`, else the stream of `rerun.init`.
        skin: The skin file of a candump log.

    Returns:
        The stream; of a bench, a context manager, which ends it.

    Raises:
        ValueError: There is neither a file nor a stream to log to.
        ReadFailed, FileNotFoundError: As of `skinbus.read`.
        RunFailed: The bench does not run.
    """
    stream = _stream(save, recording)
    if isinstance(source, Bench):
        return LiveLog(source, stream, is_own=recording is None and save is not None)
    paths = [Path(path) for path in (source, *more)]
    with read(*paths, skin=skin, index=False) as recorded:
        _log_epochs(stream, recorded)
        _log_contacts(stream, recorded)
        _log_messages(stream, paths, recorded.began_ns)
    _finish(stream, is_own=recording is None and save is not None)
    return stream


def _stream(save: PathLike | None, recording: rr.RecordingStream | None) -> rr.RecordingStream:
    stream = recording
    if stream is None and save is None:
        stream = rr.get_data_recording()
        if stream is None:
            raise ValueError("there is nothing to log to: name a file with save=, or call rerun.init before")
    if stream is None:
        stream = rr.RecordingStream(_APPLICATION)
    if save is not None:
        stream.save(os.fspath(save))
    stream.send_blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="/robot", name="robot"),
            rrb.Vertical(
                rrb.TimeSeriesView(origin="/torques", name="torques"),
                rrb.TimeSeriesView(origin="/joints", name="joints"),
                rrb.TextLogView(origin="/contacts", name="contacts"),
            ),
            column_shares=[3, 2],
        )
    )
    return stream


def _finish(stream: rr.RecordingStream, *, is_own: bool) -> None:
    """Writes what is left. Completes the file of a stream that nobody else has."""
    stream.flush()
    if is_own:
        stream.disconnect()


def _path(*parts: str) -> str:
    return rr.new_entity_path(list(parts))


def _times(at_ns: Iterable[int] | NDArray[np.int64], began_ns: int) -> list[rr.TimeColumn]:
    """Returns the columns of both timelines."""
    times = np.asarray(at_ns if isinstance(at_ns, np.ndarray) else list(at_ns), np.int64)
    since = (times - began_ns).astype("timedelta64[ns]")
    return [rr.TimeColumn("time", timestamp=times.astype("datetime64[ns]")), rr.TimeColumn("run", duration=since)]


def _log_epochs(stream: rr.RecordingStream, recorded: Recording) -> None:
    """Logs positions and torques of all epochs."""
    epochs = recorded.epochs()
    times = _times(np.array(epochs.at_ns), recorded.began_ns)
    for at, name in enumerate(epochs.names):
        for path, values in (
            (_path("joints", name), epochs.positions),
            (_path("torques", name, "distributed"), epochs.distributed),
            (_path("torques", name, "central"), epochs.central),
            (_path("torques", name, "difference"), epochs.error),
        ):
            stream.send_columns(path, indexes=times, columns=rr.Scalars.columns(scalars=np.array(values[:, at])))


def _log_contacts(stream: rr.RecordingStream, recorded: Recording) -> None:
    """Logs the beginnings and ends of all contacts, and the number of touched cells."""
    contacts = recorded.contacts()
    changes: list[tuple[int, int, str]] = []
    for bus, node, begin, end, ended, peak in zip(
        contacts.bus,
        contacts.node,
        contacts.begin_ns,
        contacts.end_ns,
        contacts.ended,
        contacts.peak_force,
        strict=True,
    ):
        cell = f"{recorded.buses[bus]}:{node}"
        changes.append((int(begin), 1, f"{cell} is touched"))
        if ended:
            force = "" if np.isnan(peak) else f"; its largest force was {peak:.2f} N"
            changes.append((int(end), -1, f"{cell} is no longer touched{force}"))
    if not changes:
        return
    changes.sort()
    times = _times((at for at, _, _ in changes), recorded.began_ns)
    texts = rr.TextLog.columns(text=[text for _, _, text in changes])
    stream.send_columns("/contacts", indexes=times, columns=texts)
    counts = np.cumsum([change for _, change, _ in changes]).astype(np.float64)
    stream.send_columns("/contacts/count", indexes=times, columns=rr.Scalars.columns(scalars=counts))


def _log_messages(stream: rr.RecordingStream, paths: Sequence[Path], began_ns: int) -> None:
    """Logs links, cells and forces from the messages of a recording. A candump log has none."""
    scene, clouds, links = Scene(), dict[str, list[Cells]](), dict[int, list[NDArray[np.float64]]]()
    for topic, message in _messages(paths):
        cells = _add_to_scene(scene, topic, message)
        if cells is not None:
            clouds.setdefault(cells.patch, []).append(cells)
            links[cells.at_ns] = scene.links()
    _style(stream, clouds)
    for patch, moments in clouds.items():
        times = _times((cells.at_ns for cells in moments), began_ns)
        points = rr.Points3D.columns(
            positions=np.concatenate([cells.positions for cells in moments]),
            colors=np.concatenate([cells.colors for cells in moments]),
        )
        counts = [len(cells.positions) for cells in moments]
        stream.send_columns(_path("robot", "cells", patch), indexes=times, columns=points.partition(counts))
        arrows = rr.Arrows3D.columns(
            origins=np.concatenate([cells.arrow_origins for cells in moments]),
            vectors=np.concatenate([cells.arrow_vectors for cells in moments]),
        )
        counts = [len(cells.arrow_vectors) for cells in moments]
        stream.send_columns(_path("robot", "forces", patch), indexes=times, columns=arrows.partition(counts))
    drawn = {at: lines for at, lines in sorted(links.items()) if lines}
    if drawn:
        lines = [line for lines in drawn.values() for line in lines]
        strips = rr.LineStrips3D.columns(strips=lines).partition([len(lines) for lines in drawn.values()])
        stream.send_columns("/robot/links", indexes=_times(drawn, began_ns), columns=strips)


def _style(stream: rr.RecordingStream, patches: Iterable[str]) -> None:
    """Logs sizes and colours that never change."""
    stream.log("robot", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log("/robot/links", rr.LineStrips3D.from_fields(radii=_LINK_RADIUS_M, colors=_LINK_COLOR), static=True)
    for patch in patches:
        stream.log(_path("robot", "cells", patch), rr.Points3D.from_fields(radii=_CELL_RADIUS_M), static=True)
        stream.log(_path("robot", "forces", patch), rr.Arrows3D.from_fields(colors=_ARROW_COLOR), static=True)


def _add_to_scene(scene: Scene, topic: str, message: bytes) -> Cells | None:
    """Adds a message to the scene. Returns the cells of a point cloud."""
    if topic in ("/tf", "/tf_static"):
        scene.add_transforms(message, is_static=topic == "/tf_static")
    elif topic.startswith("/skin/") and topic.endswith("/points"):
        return scene.cells(topic, message)
    elif topic.startswith("/skin/"):
        scene.add_patch(topic, message)
    return None


def _messages(paths: Sequence[Path]) -> Iterator[tuple[str, bytes]]:
    """Returns the messages of a recording's robot and skin, by their times."""
    parts = []
    for path in paths:
        with path.open("rb") as file:
            if file.read(1) != b"\x89":
                return
            file.seek(0)
            summary = make_reader(file).get_summary()
        begins = summary.statistics.message_start_time if summary is not None and summary.statistics is not None else 0
        topics = {channel.topic for channel in summary.channels.values()} if summary is not None else set[str]()
        shown = [topic for topic in topics if topic.startswith("/skin/") or topic in ("/tf", "/tf_static")]
        parts.append((begins, path, shown))
    for _, path, shown in sorted(parts):
        with path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages(topics=shown):
                yield channel.topic, message.data


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
        self._began_ns: int | None = None
        self._view = _start_view(bench)
        try:
            self._socket = _connect(self._view, self._stack)
            self._topics = dict[int, str]()
            self._threads = [
                threading.Thread(target=self._follow_topics, name="skinbus to Rerun", daemon=True),
                threading.Thread(target=self._follow_contacts, args=(bench,), name="skinbus contacts", daemon=True),
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
        """Ends the log, and completes the file."""
        self._view.terminate()
        try:
            self._view.wait(_VIEW_TIMEOUT)
        except subprocess.TimeoutExpired:
            self._view.kill()
            self._view.wait()
        self._threads[0].join(_VIEW_TIMEOUT)
        self._stack.close()
        _finish(self.stream, is_own=self._is_own)

    def _set_time(self, at_ns: int) -> None:
        if self._began_ns is None:
            self._began_ns = at_ns
        self.stream.set_time("time", timestamp=np.datetime64(at_ns, "ns"))
        self.stream.set_time("run", duration=(at_ns - self._began_ns) * _NANOS)

    def _follow_topics(self) -> None:
        """Logs the messages of the view until its end."""
        import json

        from websockets.exceptions import ConnectionClosed

        scene, names, patches = Scene(), tuple[str, ...](), set[str]()
        try:
            while True:
                said = self._socket.recv()
                if isinstance(said, str):
                    self._subscribe(json.loads(said))
                    continue
                if said[0] != _MESSAGE_DATA:
                    continue
                topic, message = self._topics[int.from_bytes(said[1:5], "little")], said[13:]
                if topic.endswith("/joint_states"):
                    state = _ros2.joint_state(message)
                    names = state.names
                    self._set_time(state.at_ns)
                    for name, position in zip(names, state.positions, strict=False):
                        self.stream.log(_path("joints", name), rr.Scalars(position))
                elif topic.endswith("/torques"):
                    self._log_torques(names, _ros2.torques(message))
                else:
                    self._log_scene(scene, topic, message, patches)
        except ConnectionClosed:
            # The view has ended, or the bench.
            return

    def _log_torques(self, names: tuple[str, ...], torques: _ros2.Torques) -> None:
        self._set_time(torques.at_ns)
        for name, distributed, central in zip(names, torques.distributed, torques.central, strict=False):
            self.stream.log(_path("torques", name, "distributed"), rr.Scalars(distributed))
            self.stream.log(_path("torques", name, "central"), rr.Scalars(central))
            self.stream.log(_path("torques", name, "difference"), rr.Scalars(distributed - central))

    def _log_scene(self, scene: Scene, topic: str, message: bytes, patches: set[str]) -> None:
        cells = _add_to_scene(scene, topic, message)
        if cells is None:
            return
        if cells.patch not in patches:
            patches.add(cells.patch)
            _style(self.stream, [cells.patch])
        self._set_time(cells.at_ns)
        points = rr.Points3D.from_fields(positions=cells.positions, colors=cells.colors)
        self.stream.log(_path("robot", "cells", cells.patch), points)
        arrows = rr.Arrows3D.from_fields(origins=cells.arrow_origins, vectors=cells.arrow_vectors)
        self.stream.log(_path("robot", "forces", cells.patch), arrows)
        self.stream.log("/robot/links", rr.LineStrips3D.from_fields(strips=scene.links()))

    def _subscribe(self, said: dict[str, Any]) -> None:
        """Subscribes to the topics that are shown, among those that are advertised."""
        import json

        shown = ("/tf", "/tf_static")
        new = [
            channel
            for channel in said.get("channels", ())
            if channel["topic"] in shown
            or channel["topic"].startswith("/skin/")
            or channel["topic"].endswith(("/joint_states", "/torques"))
        ]
        if said.get("op") != "advertise" or not new:
            return
        self._topics |= {channel["id"]: channel["topic"] for channel in new}
        begun = [{"id": channel["id"], "channelId": channel["id"]} for channel in new]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": begun}))

    def _follow_contacts(self, bench: Bench) -> None:
        """Logs the contacts of the bench until its end."""
        touched = set[str]()
        try:
            for contact in bench.follow(Contact):
                change = "is touched" if contact.touched else "is no longer touched"
                (touched.add if contact.touched else touched.discard)(contact.cell)
                self._set_time(contact.at_ns)
                self.stream.log("/contacts", rr.TextLog(f"{contact.cell} {change}"))
                self.stream.log("/contacts/count", rr.Scalars(float(len(touched))))
        except RunFailed:
            return


def _start_view(bench: Bench) -> subprocess.Popen[str]:
    """Starts the program that follows the buses of a bench and serves its topics to this one."""
    environment = dict(os.environ)
    if bench.directory is not None:
        environment["SKINBUS_DIR"] = str(bench.directory)
    # A token in the environment is for a page; the connection of this program has none.
    environment.pop("SKINBUS_TOKEN", None)
    kinds = [f"--bus-kind={one.bus}={one.kind}" for one in bench.ready.buses]
    command = [str(program_path("skinbus")), "view", bench.skin, "--read-only", "--foxglove", "0", *kinds]
    return subprocess.Popen(
        command, env=environment, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
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
