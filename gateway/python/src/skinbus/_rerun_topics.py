"""Topics of a running bench in Rerun."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np
import rerun as rr

from skinbus import _rerun_view as view
from skinbus import _ros2
from skinbus._rerun_view import entity_path, time_columns
from skinbus._scene import Cells, Scene

# Values of series are sent together after this time in ns: a chunk for each value would slow the viewer down.
_BATCH_NS = 200_000_000
# Time in ns after which the views are sent even if cells of a patch are missing.
_SCENE_TIMEOUT_NS = 2_000_000_000


class Log:
    """A stream with both timelines."""

    def __init__(self, stream: rr.RecordingStream, began_ns: int) -> None:
        self.stream = stream
        self.began_ns = began_ns
        self.last_ns = began_ns

    def set_time(self, at_ns: int) -> None:
        self.last_ns = max(self.last_ns, at_ns)
        self.stream.set_time("time", timestamp=np.datetime64(at_ns, "ns"))
        self.stream.set_time("run", duration=np.timedelta64(at_ns - self.began_ns, "ns"))

    def add_event(self, at_ns: int, text: str) -> None:
        """Logs a line of text, and sets the time."""
        self.set_time(at_ns)
        self.stream.log("/contacts", rr.TextLog(view.event_text(at_ns, self.began_ns, text)))


class _Series:
    """Values of series that are sent together."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self._oldest_ns: int | None = None
        self._rows: dict[str, tuple[list[int], list[float]]] = {}

    def add(self, at_ns: int, values: Iterable[tuple[str, float]]) -> None:
        """Adds a value of some series at a time. Sends all of them if the oldest has waited long enough."""
        for path, value in values:
            row = self._rows.setdefault(path, ([], []))
            row[0].append(at_ns)
            row[1].append(value)
        self._log.last_ns = max(self._log.last_ns, at_ns)
        if self._oldest_ns is None:
            self._oldest_ns = at_ns
        elif at_ns - self._oldest_ns >= _BATCH_NS:
            self._send()

    def end(self, at_ns: int) -> None:
        """Ends the lines of all series, so that none reaches to the values of a later bench."""
        self.add(at_ns, [(path, float("nan")) for path in self._rows])
        self._send()

    def _send(self) -> None:
        for path, (times, values) in self._rows.items():
            if times:
                columns = rr.Scalars.columns(scalars=values)
                self._log.stream.send_columns(path, indexes=time_columns(times, self._log.began_ns), columns=columns)
                times.clear()
                values.clear()
        self._oldest_ns = None


class Topics:
    """Logs the messages of a view. `viewed` has the joints whose views were sent to the stream."""

    def __init__(self, log: Log, joints: Sequence[str], viewed: set[tuple[str, ...]]) -> None:
        self._log = log
        self._joints = tuple(joints)
        self._viewed = viewed
        self._series = _Series(log)
        self._scene = Scene()
        self._first: dict[str, Cells] = {}
        self._links_ns = 0
        self._units: list[tuple[str, str]] = []
        view.log_robot_style(log.stream)
        view.log_series_style(log.stream, joints)

    def add(self, topic: str, message: bytes, topics: Collection[str]) -> None:
        """Logs a message on one of some topics."""
        if topic == "/robot_description":
            if 'type="prismatic"' not in _ros2.string(message):
                self._units = [("rad", "Nm")] * len(self._joints)
        elif topic.endswith("/joint_states"):
            state = _ros2.joint_state(message)
            paths = [entity_path("joints", name) for name in state.names]
            self._series.add(state.at_ns, zip(paths, state.positions.tolist(), strict=False))
        elif topic.endswith("/torques"):
            self._add_torques(_ros2.torques(message))
        else:
            cells, _ = self._scene.add(topic, message)
            if cells is not None:
                self._add_cells(cells)
        if self._joints not in self._viewed and self._is_complete(topics):
            self._viewed.add(self._joints)
            eye = view.eye(self._first.values(), self._scene.links(), is_live=True)
            view.send_view(self._log.stream, self._joints, self._units, eye=eye, duration=None)

    def end(self, at_ns: int) -> None:
        """Ends the series, and clears what would stand as current. The time of the log is set."""
        self._series.end(at_ns)
        for entity in ("/torques", "/joints", "/robot"):
            self._log.stream.log(entity, rr.Clear(recursive=True))

    def _is_complete(self, topics: Collection[str]) -> bool:
        """Returns true if the whole robot was logged, or if a part of it does not come."""
        patches = sum(topic.startswith("/skin/") and topic.endswith("/points") for topic in topics)
        if len(self._first) >= patches > 0:
            return True
        begin = min((cells.at_ns for cells in self._first.values()), default=self._log.last_ns)
        return self._log.last_ns - begin > _SCENE_TIMEOUT_NS

    def _add_torques(self, torques: _ros2.Torques) -> None:
        """Logs torques. The central ones are unknown before the touches are, and show no error while a reply misses."""
        unknown = np.full(len(torques.distributed), np.nan)
        central = torques.central if len(torques.central) else unknown
        difference = unknown if self._scene.is_incomplete else torques.distributed - central
        values = {"distributed": torques.distributed, "central": central, "difference": difference}
        for series, each in values.items():
            paths = [entity_path("torques", name, series) for name in self._joints]
            self._series.add(torques.at_ns, zip(paths, each.tolist(), strict=False))

    def _add_cells(self, cells: Cells) -> None:
        stream = self._log.stream
        if cells.patch not in self._first:
            self._first[cells.patch] = cells
            view.log_patch_style(stream, cells)
        self._log.set_time(cells.at_ns)
        points = rr.Points3D.from_fields(positions=cells.positions, colors=cells.colors, labels=cells.labels)
        stream.log(entity_path("robot", "cells", cells.patch), points)
        arrows = rr.Arrows3D.from_fields(origins=cells.arrow_origins, vectors=cells.arrow_vectors)
        stream.log(entity_path("robot", "forces", cells.patch), arrows)
        if cells.at_ns != self._links_ns:
            self._links_ns = cells.at_ns
            links = self._scene.links()
            strips = rr.LineStrips3D.from_fields(
                strips=[link.points for link in links], radii=[link.radius for link in links]
            )
            stream.log("/robot/links", strips)
