"""The robot in 3D: poses of its links, and the cells and forces on them, from the topics of a recording."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from skinbus import _ros2

# Length of an arrow in m per N.
_ARROW_M_PER_N = 0.02
# Forces from this one on have the brightest colour, in N.
_BRIGHT_N = 10.0
_DARK, _BRIGHT = np.array([70, 100, 140]), np.array([254, 232, 56])
_UNKNOWN, _DEAD = np.array([145, 145, 145]), np.array([205, 60, 190])
# Radii of cells in m: a share of the distance between neighbours, within limits.
_PITCH_SHARE, _CELL_RADIUS_M, _SMALLEST_CELL_M, _LARGEST_CELL_M = 0.45, 0.008, 0.003, 0.015
# Radii of links in m: a share of the distance between the cells and their axis, within a limit.
_AXIS_SHARE, _LINK_RADIUS_M, _LARGEST_LINK_M = 0.6, 0.035, 0.045
# Fewer cells than this do not show the axis of their link.
_MIN_AXIS_CELLS = 6

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Cells:
    """The cells of a patch at a moment.

    Attributes:
        at_ns: The time in ns since 1970.
        patch: The name of the patch, such as "link2".
        radius: The radius of a cell in m.
        positions: The positions in the robot's base frame in m, [n, 3].
        forces: The forces in N; NaN while they are unknown, [n].
        colors: The colours by force and status, [n, 3].
        labels: The names and forces, [n].
        arrow_origins: For each touched cell, the beginning of its arrow, [m, 3].
        arrow_vectors: For each touched cell, its arrow to the surface of the cell, in the direction of the force,
            [m, 3].
    """

    at_ns: int
    patch: str
    radius: float
    positions: NDArray[np.float32]
    forces: NDArray[np.float32]
    colors: NDArray[np.uint8]
    labels: list[str]
    arrow_origins: Floats
    arrow_vectors: Floats


@dataclass(frozen=True)
class Link:
    """A link that a joint moves.

    Attributes:
        points: The line that is drawn, in the robot's base frame in m, [n, 3].
        radius: The radius of the line in m.
    """

    points: Floats
    radius: float


@dataclass(frozen=True)
class Axis:
    """The axis of the cells around a link, in the frame of the link, and their distance from it in m."""

    point: Floats
    direction: Floats
    distance: float

    def nearest(self, point: Floats) -> Floats:
        """Returns the nearest point on the axis."""
        near: Floats = self.point + self.direction * ((point - self.point) @ self.direction)
        return near


@dataclass(frozen=True)
class Silence:
    """A cell falls silent, or is back."""

    at_ns: int
    cell: str
    is_back: bool

    @property
    def text(self) -> str:
        """The line in the log."""
        return f"{self.cell} {'is back' if self.is_back else 'has fallen silent'}"


@dataclass
class Scene:
    """The poses of frames, and the patches, as far as messages have reported them."""

    _frames: dict[str, tuple[str, Floats]] = field(default_factory=dict)
    _moving: set[str] = field(default_factory=set)
    _patches: dict[str, _ros2.Patch] = field(default_factory=dict)
    _cell_frames: dict[str, list[str]] = field(default_factory=dict)
    _radii: dict[str, float] = field(default_factory=dict)
    _axes: dict[str, Axis | None] = field(default_factory=dict)

    def add(self, topic: str, message: bytes) -> tuple[Cells | None, list[Silence]]:
        """Adds a message. Returns the cells of a point cloud, and those that have fallen silent or are back."""
        if topic in ("/tf", "/tf_static"):
            self.add_transforms(message, is_static=topic == "/tf_static")
        elif topic.startswith("/skin/") and topic.endswith("/points"):
            return self.cells(topic, message), []
        elif topic.startswith("/skin/"):
            return None, self.add_patch(topic, message)
        return None, []

    def add_transforms(self, message: bytes, *, is_static: bool) -> None:
        """Stores the poses in a message on `/tf` or `/tf_static`."""
        for transform in _ros2.transforms(message):
            self._frames[transform.child] = (transform.parent, transform.pose)
            if not is_static:
                self._moving.add(transform.child)
        if is_static:
            self._cell_frames.clear()
            self._axes.clear()

    def add_patch(self, topic: str, message: bytes) -> list[Silence]:
        """Stores the state of a patch. Returns the cells that have fallen silent since, or are back."""
        before, patch = self._patches.get(topic), _ros2.patch(message)
        self._patches[topic] = patch
        is_dead = patch.statuses == _ros2.DEAD
        was_dead = np.zeros_like(is_dead) if before is None else before.statuses == _ros2.DEAD
        return [
            Silence(patch.at_ns, self._name(topic, int(at)), is_back=not is_dead[at])
            for at in np.nonzero(is_dead != was_dead)[0]
        ]

    @property
    def is_incomplete(self) -> bool:
        """True while the torque of a cell is missing: a cell in contact did not reply, or a cell is silent."""
        missing = (_ros2.STALE, _ros2.DEAD)
        return any(bool(np.isin(patch.statuses, missing).any()) for patch in self._patches.values())

    def links(self) -> list[Link]:
        """Returns a line for each link that a joint moves: from the origin of its parent to its own.

        A link may lie beside that line, such as the upper arm of a UR5: the line runs along the axis of its cells.
        """
        links = []
        for child in sorted(self._moving):
            parent, own = self._frames[child]
            pose, end, axis = self.pose(parent), own[:3, 3], self._axis(parent)
            points, radius = [np.zeros(3), end], _LINK_RADIUS_M
            if axis is not None:
                points[1:1] = [axis.nearest(points[0]), axis.nearest(end)]
                radius = min(_LARGEST_LINK_M, _AXIS_SHARE * axis.distance)
            links.append(Link(np.array(points) @ pose[:3, :3].T + pose[:3, 3], radius))
        return links

    def pose(self, frame: str) -> Floats:
        """Returns the pose of a frame in the robot's base frame."""
        pose = np.identity(4)
        # A chain of frames is no longer than all of them.
        for _ in range(len(self._frames)):
            if frame not in self._frames:
                break
            frame, own = self._frames[frame]
            pose = own @ pose
        return pose

    def cells(self, topic: str, message: bytes) -> Cells:
        """Returns the cells in a message on `/skin/PATCH/points`."""
        cloud = _ros2.points(message)
        topic = topic.removesuffix("/points")
        patch = self._patches.get(topic)
        is_dead = np.zeros(len(cloud.forces), np.bool_) if patch is None else patch.statuses == _ros2.DEAD
        frames = self._frames_of(topic)
        touched = [int(at) for at in np.nonzero((cloud.forces > 0) & ~is_dead)[0] if frames and frames[at]]
        normals = np.array([self.pose(frames[at])[:3, 2] for at in touched]).reshape(-1, 3)
        if topic not in self._radii:
            self._radii[topic] = _cell_radius(cloud.positions)
        radius = self._radii[topic]
        lengths = normals * (cloud.forces[touched, np.newaxis] * _ARROW_M_PER_N)
        return Cells(
            cloud.at_ns,
            topic.removeprefix("/skin/"),
            radius,
            cloud.positions,
            cloud.forces,
            cell_colors(cloud.forces, is_dead),
            [self._label(topic, at, float(force), bool(is_dead[at])) for at, force in enumerate(cloud.forces)],
            cloud.positions[touched] + normals * radius + lengths,
            -lengths,
        )

    def _label(self, topic: str, at: int, force: float, is_dead: bool) -> str:
        state = "silent" if is_dead else "force unknown" if np.isnan(force) else f"{force:.2f} N"
        return f"{self._name(topic, at)}, {state}"

    def _name(self, topic: str, at: int) -> str:
        """Returns the name of a cell of a patch, "BUS:NODE"; while its bus is unknown, with the name of the patch."""
        frames, patch = self._frames_of(topic), self._patches.get(topic)
        if frames and frames[at]:
            return ":".join(frames[at].rsplit("/", 1))
        return f"{topic.removeprefix('/skin/')}:{at if patch is None else patch.nodes[at]}"

    def _frames_of(self, topic: str) -> list[str]:
        """Returns the frames of the cells of a patch; "" where it is unknown. Empty before the state of the patch."""
        patch = self._patches.get(topic)
        if patch is None:
            return []
        found = self._cell_frames.get(topic)
        if found is None:
            on_link = [name for name, (parent, _) in self._frames.items() if parent == patch.link and "/" in name]
            # A patch has the name of its bus if several buses have cells on the link.
            named = [name for name in on_link if topic.endswith("_" + name.rpartition("/")[0])]
            frames = {name.rpartition("/")[2]: name for name in (*reversed(on_link), *reversed(named))}
            found = [frames.get(str(node), "") for node in patch.nodes]
            self._cell_frames[topic] = found
        return found

    def _axis(self, link: str) -> Axis | None:
        if link not in self._axes:
            poses = [pose for name, (parent, pose) in self._frames.items() if parent == link and "/" in name]
            self._axes[link] = _axis_of(np.array(poses).reshape(-1, 4, 4))
        return self._axes[link]


def _axis_of(poses: Floats) -> Axis | None:
    """Returns the axis that the normals of cells meet; None if they do not lie around one."""
    if len(poses) < _MIN_AXIS_CELLS:
        return None
    positions, normals = poses[:, :3, 3], poses[:, :3, 2]
    _, spread, directions = np.linalg.svd(normals, full_matrices=False)
    is_round = spread[2] < 0.3 * spread[1] and spread[1] > 0.3 * spread[0]
    if not is_round:
        return None
    across = np.identity(3) - normals[:, :, np.newaxis] * normals[:, np.newaxis, :]
    offsets = (across @ positions[:, :, np.newaxis]).reshape(-1)
    point = np.asarray(np.linalg.lstsq(across.reshape(-1, 3), offsets, rcond=None)[0], np.float64)
    direction = np.asarray(directions[2], np.float64)
    line = Axis(point, direction, 0.0)
    apart = [float(np.linalg.norm(position - line.nearest(position))) for position in positions]
    return Axis(point, direction, float(np.median(apart)))


def _cell_radius(positions: NDArray[np.float32]) -> float:
    """Returns the radius of a cell by the distances between neighbours."""
    if len(positions) < 2:
        return _CELL_RADIUS_M
    some = positions[:: max(1, len(positions) // 100)]
    apart = np.linalg.norm(some[:, np.newaxis] - positions[np.newaxis], axis=2)
    pitch = float(np.median(np.partition(apart, 1, axis=1)[:, 1]))
    return min(_LARGEST_CELL_M, max(_SMALLEST_CELL_M, _PITCH_SHARE * pitch))


def cell_colors(forces: NDArray[np.float32], is_dead: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Returns the colours of cells, [n, 3]: by force, grey while it is unknown, magenta for silent cells."""
    share = np.clip(np.nan_to_num(forces) / _BRIGHT_N, 0, 1)[:, np.newaxis]
    colors = np.where(np.isnan(forces)[:, np.newaxis], _UNKNOWN, _DARK + share * (_BRIGHT - _DARK))
    return np.asarray(np.rint(np.where(is_dead[:, np.newaxis], _DEAD, colors)), np.uint8)
