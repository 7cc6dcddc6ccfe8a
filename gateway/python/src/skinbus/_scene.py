"""The robot in 3D: poses of its links, and the cells and forces on them, from the topics of a recording."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from skinbus import _ros2

# An arrow is this long per N, in m.
_ARROW_M_PER_N = 0.02
# A cell has the colour of this force from it on, in N.
_BRIGHT_N = 10.0
_DARK, _BRIGHT = np.array([0, 34, 78]), np.array([254, 232, 56])
_UNKNOWN = np.array([128, 128, 128])

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Cells:
    """The cells of a patch at a moment.

    Attributes:
        at_ns: The time in ns since 1970.
        patch: The name of the patch, such as "link2".
        positions: The positions in the robot's base frame in m, [n, 3].
        forces: The forces in N; NaN while they are unknown, [n].
        colors: The colours by force, [n, 3].
        arrow_origins: For each touched cell, the beginning of its arrow, [m, 3].
        arrow_vectors: For each touched cell, its arrow to the cell, in the direction of the force, [m, 3].
    """

    at_ns: int
    patch: str
    positions: NDArray[np.float32]
    forces: NDArray[np.float32]
    colors: NDArray[np.uint8]
    arrow_origins: Floats
    arrow_vectors: Floats


@dataclass
class Scene:
    """The poses of frames, and the patches, as far as messages have told them."""

    _frames: dict[str, tuple[str, Floats]] = field(default_factory=dict)
    _moving: set[str] = field(default_factory=set)
    _patches: dict[str, _ros2.Patch] = field(default_factory=dict)

    def add_transforms(self, message: bytes, *, is_static: bool) -> None:
        """Stores the poses in a message on `/tf` or `/tf_static`."""
        for transform in _ros2.transforms(message):
            self._frames[transform.child] = (transform.parent, transform.pose)
            if not is_static:
                self._moving.add(transform.child)

    def add_patch(self, topic: str, message: bytes) -> None:
        """Stores the link and the nodes of a patch. They never change."""
        if topic not in self._patches:
            self._patches[topic] = _ros2.patch(message)

    def links(self) -> list[Floats]:
        """Returns a line for each link that a joint moves: from the origin of its parent to its own, [2, 3]."""
        ends = ((self._frames[child][0], child) for child in sorted(self._moving))
        return [np.array([self.pose(parent)[:3, 3], self.pose(child)[:3, 3]]) for parent, child in ends]

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
        patch_topic = topic.removesuffix("/points")
        normals = self._normals(patch_topic, np.nonzero(cloud.forces > 0)[0])
        touched = np.array(sorted(normals), np.int64)
        outward = np.array([normals[at] for at in sorted(normals)]).reshape(-1, 3)
        lengths = outward * (cloud.forces[touched, np.newaxis] * _ARROW_M_PER_N)
        return Cells(
            cloud.at_ns,
            patch_topic.removeprefix("/skin/"),
            cloud.positions,
            cloud.forces,
            force_colors(cloud.forces),
            cloud.positions[touched] + lengths,
            -lengths,
        )

    def _normals(self, topic: str, places: NDArray[np.intp]) -> dict[int, Floats]:
        """Returns the outward direction of cells of a patch, by their places in it, as far as it is known."""
        patch = self._patches.get(topic)
        if patch is None:
            return {}
        normals = {}
        for place in places:
            names = [name for name in self._frames if name.rpartition("/")[2] == str(patch.nodes[place])]
            on_link = [name for name in names if self._frames[name][0] == patch.link and "/" in name]
            # A patch has the name of its bus if several buses have cells on the link.
            named = [name for name in on_link if topic.endswith("_" + name.rpartition("/")[0])]
            for name in (named or on_link)[:1]:
                normals[int(place)] = self.pose(name)[:3, 2]
        return normals


def force_colors(forces: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Returns the colours of forces, [n, 3]; grey while a force is unknown."""
    share = np.clip(np.nan_to_num(forces) / _BRIGHT_N, 0, 1)[:, np.newaxis]
    colors = np.where(np.isnan(forces)[:, np.newaxis], _UNKNOWN, _DARK + share * (_BRIGHT - _DARK))
    return np.asarray(np.rint(colors), np.uint8)
