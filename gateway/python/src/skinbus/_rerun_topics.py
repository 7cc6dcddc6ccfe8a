"""Topics of a running bench in Rerun."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
import rerun as rr

from skinbus import _rerun_view as view
from skinbus import _ros2
from skinbus._rerun_view import Floats
from skinbus._scene import Cells, Link, Scene

# Messages within this time in ns are sent together: Rerun's viewer takes in few chunks in each of its frames, so it
# would lag behind with a chunk for each message.
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


class _Batch:
    """Values, cells and links that are sent together."""

    def __init__(self, log: Log, joints: int) -> None:
        self._log = log
        self._unknown = np.full(joints, np.nan)
        self._oldest_ns: int | None = None
        self._series: dict[str, tuple[list[int], list[Floats]]] = {}
        self._clouds: dict[str, list[Cells]] = {}
        self._links: dict[int, list[Link]] = {}
        self._linked_ns = 0
        # The labels that the stream has, by patch.
        self._labels: dict[str, list[str]] = {}

    def add_values(self, at_ns: int, entity: str, values: Floats) -> None:
        """Adds the values of all joints at a time."""
        times, rows = self._series.setdefault(entity, ([], []))
        times.append(at_ns)
        rows.append(values)
        self._add_time(at_ns)

    def add_cells(self, cells: Cells, scene: Scene) -> None:
        """Adds the cells of a patch, and the links at the same time."""
        self._clouds.setdefault(cells.patch, []).append(cells)
        if cells.at_ns != self._linked_ns:
            self._linked_ns = cells.at_ns
            self._links[cells.at_ns] = scene.links()
        self._add_time(cells.at_ns)

    def end(self, at_ns: int) -> None:
        """Ends the lines of all series, so that none reaches to the values of a later bench, and sends everything."""
        for times, rows in self._series.values():
            times.append(at_ns)
            rows.append(self._unknown)
        self._log.last_ns = max(self._log.last_ns, at_ns)
        self.send()

    def send(self) -> None:
        """Sends everything that waits."""
        stream, began_ns = self._log.stream, self._log.began_ns
        for entity, (times, rows) in self._series.items():
            if times:
                view.send_series(stream, began_ns, entity, times, np.array(rows))
                times.clear()
                rows.clear()
        for patch, clouds in self._clouds.items():
            view.send_clouds(stream, began_ns, clouds, self._labels.get(patch))
            self._labels[patch] = clouds[-1].labels
        self._clouds.clear()
        view.send_links(stream, began_ns, self._links)
        self._links.clear()
        self._oldest_ns = None

    def _add_time(self, at_ns: int) -> None:
        """Sends everything if the oldest has waited long enough, or if the clock was set back."""
        self._log.last_ns = max(self._log.last_ns, at_ns)
        if self._oldest_ns is None:
            self._oldest_ns = at_ns
        elif not 0 <= at_ns - self._oldest_ns < _BATCH_NS:
            self.send()


class Topics:
    """Logs the messages of a view. `viewed` has the joints whose views were sent to the stream."""

    def __init__(self, log: Log, joints: Sequence[str], viewed: set[tuple[str, ...]]) -> None:
        self._log = log
        self._joints = tuple(joints)
        self._viewed = viewed
        self._batch = _Batch(log, len(joints))
        self._scene = Scene()
        self._first: dict[str, Cells] = {}
        self._units: list[tuple[str, str]] = []
        view.log_robot_style(log.stream)
        self._entities = view.log_series_style(log.stream, joints)

    def add(self, topic: str, message: bytes, topics: Collection[str]) -> None:
        """Logs a message on one of some topics."""
        if topic == "/robot_description":
            if 'type="prismatic"' not in _ros2.string(message):
                self._units = [("rad", "Nm")] * len(self._joints)
        elif topic.endswith("/joint_states"):
            state = _ros2.joint_state(message)
            of_joint = dict(zip(state.names, state.positions.tolist(), strict=False))
            positions = np.array([of_joint.get(name, np.nan) for name in self._joints])
            self._batch.add_values(state.at_ns, self._entities.positions, positions)
        elif topic.endswith("/torques"):
            self._add_torques(_ros2.torques(message))
        else:
            cells, _ = self._scene.add(topic, message)
            if cells is not None:
                self._add_cells(cells)
        if self._joints not in self._viewed and self._is_complete(topics):
            self._viewed.add(self._joints)
            eye = view.eye(self._first.values(), self._scene.links(), is_live=True)
            view.send_view(self._log.stream, self._entities, self._units, eye=eye, duration=None)

    def send(self) -> None:
        """Sends everything that waits for later messages."""
        self._batch.send()

    def end(self, at_ns: int) -> None:
        """Ends the series, and clears what would stand as current. The time of the log is set."""
        self._batch.end(at_ns)
        for entity in (self._entities.torques, self._entities.positions, "/robot"):
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
        for entity, values in (
            (self._entities.distributed, torques.distributed),
            (self._entities.central, central),
            (self._entities.difference, difference),
        ):
            self._batch.add_values(torques.at_ns, entity, values)

    def _add_cells(self, cells: Cells) -> None:
        if cells.patch not in self._first:
            self._first[cells.patch] = cells
            view.log_patch_style(self._log.stream, cells)
        self._batch.add_cells(cells, self._scene)
