"""The first look of a recording in Rerun: views, the eye, colours and names of series."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.blueprint.encodings import TimelineColumn

from skinbus._scene import Cells, Link

Floats = NDArray[np.float64]
Units = Sequence[tuple[str, str]]

_LINK_COLOR = (82, 86, 92)
_ARROW_COLOR = (230, 60, 60)
# Colours of joints, which repeat after the last one.
_JOINT_COLORS = (
    (235, 65, 60), (75, 150, 225), (95, 190, 90), (180, 110, 210), (255, 145, 30), (215, 205, 70),
    (90, 205, 205), (245, 150, 190), (165, 120, 80), (150, 150, 245), (175, 220, 140), (200, 200, 200),
)  # fmt: skip
# Direction from the robot to the eye, half the angle that the eye sees, and the part of it that the robot may fill.
_EYE_DIRECTION = np.array([0.62, -0.88, 0.38])
_EYE_HALF_ANGLE, _EYE_FILL = math.radians(27.5), 0.9
# Time in s that plots of a running bench show, and the part of each plot that its legend covers.
_LIVE_SECONDS, _LEGEND_SHARE = 20.0, 0.22


@dataclass(frozen=True)
class SeriesEntities:
    """The entities of the series of some joints.

    Each has the values of all joints: the time that a viewer needs grows with the number of entities.
    """

    positions: str
    torques: str

    @property
    def distributed(self) -> str:
        return f"{self.torques}/distributed"

    @property
    def central(self) -> str:
        return f"{self.torques}/central"

    @property
    def difference(self) -> str:
        return f"{self.torques}/difference"


# Series by the id of the recording and the joints.
_series: dict[str, dict[tuple[str, ...], SeriesEntities]] = {}


def entity_path(*parts: str) -> str:
    """Returns the path of an entity; other characters than letters and digits are escaped."""
    return rr.new_entity_path(list(parts))


def time_columns(at_ns: Iterable[int] | NDArray[np.int64], began_ns: int) -> list[rr.TimeColumn]:
    """Returns the columns of both timelines."""
    times = np.asarray(at_ns if isinstance(at_ns, np.ndarray) else list(at_ns), np.int64)
    since = (times - began_ns).astype("timedelta64[ns]")
    return [rr.TimeColumn("time", timestamp=times.astype("datetime64[ns]")), rr.TimeColumn("run", duration=since)]


def event_text(at_ns: int, began_ns: int, text: str) -> str:
    """Returns a line of the text log with its time: the viewer's own column of times is too narrow to read."""
    return f"{(at_ns - began_ns) / 1e9:.2f} s: {text}"


def log_robot_style(stream: rr.RecordingStream) -> None:
    """Logs the axes of the robot and the colour of its links, which never change."""
    stream.log("/robot", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log("/robot/links", rr.LineStrips3D.from_fields(colors=_LINK_COLOR), static=True)


def log_patch_style(stream: rr.RecordingStream, cells: Cells) -> None:
    """Logs what never changes of a patch. Labels are shown when the pointer is over a cell."""
    points = rr.Points3D.from_fields(radii=cells.radius, show_labels=False)
    stream.log(entity_path("robot", "cells", cells.patch), points, static=True)
    arrows = rr.Arrows3D.from_fields(radii=cells.radius / 3, colors=_ARROW_COLOR)
    stream.log(entity_path("robot", "forces", cells.patch), arrows, static=True)


def send_clouds(stream: rr.RecordingStream, began_ns: int, clouds: Sequence[Cells], labels: list[str] | None) -> None:
    """Sends cells and forces of a patch at all its times. Labels are sent when they change, because they are large.

    Args:
        stream: The stream.
        began_ns: The time in ns since 1970 at which the timeline "run" begins.
        clouds: The cells by time; at least one.
        labels: The labels that the stream has; None if it has none.
    """
    times, patch = time_columns([cells.at_ns for cells in clouds], began_ns), clouds[0].patch
    cells_entity = entity_path("robot", "cells", patch)
    points = rr.Points3D.columns(
        positions=np.concatenate([cells.positions for cells in clouds]),
        colors=np.concatenate([cells.colors for cells in clouds]),
    )
    points = points.partition([len(cells.positions) for cells in clouds])
    stream.send_columns(cells_entity, indexes=times, columns=points)
    before = [labels, *(cells.labels for cells in clouds)]
    changed = [cells for cells, last in zip(clouds, before, strict=False) if cells.labels != last]
    if changed:
        texts = rr.Points3D.columns(labels=[label for cells in changed for label in cells.labels])
        changes = time_columns([cells.at_ns for cells in changed], began_ns)
        texts = texts.partition([len(cells.labels) for cells in changed])
        stream.send_columns(cells_entity, indexes=changes, columns=texts)
    arrows = rr.Arrows3D.columns(
        origins=np.concatenate([cells.arrow_origins for cells in clouds]),
        vectors=np.concatenate([cells.arrow_vectors for cells in clouds]),
    )
    arrows = arrows.partition([len(cells.arrow_vectors) for cells in clouds])
    stream.send_columns(entity_path("robot", "forces", patch), indexes=times, columns=arrows)


def send_links(stream: rr.RecordingStream, began_ns: int, links: Mapping[int, Sequence[Link]]) -> None:
    """Sends the links at all their times in ns since 1970."""
    drawn = {at_ns: at_once for at_ns, at_once in sorted(links.items()) if at_once}
    if drawn:
        every = [link for at_once in drawn.values() for link in at_once]
        strips = rr.LineStrips3D.columns(strips=[link.points for link in every], radii=[link.radius for link in every])
        strips = strips.partition([len(at_once) for at_once in drawn.values()])
        stream.send_columns("/robot/links", indexes=time_columns(drawn, began_ns), columns=strips)


def log_series_style(stream: rr.RecordingStream, joints: Sequence[str]) -> SeriesEntities:
    """Logs names and colours of series: a joint has one colour in all views. Returns the entities of the series.

    Other joints in the same recording, as of a second robot, have entities of their own.
    """
    known = _series.setdefault(str(stream.get_recording_id()), {})
    number = "" if not known else f"_{len(known) + 1}"
    series = known.setdefault(tuple(joints), SeriesEntities(f"/joints{number}", f"/torques{number}"))
    colors = [_JOINT_COLORS[at % len(_JOINT_COLORS)] for at in range(len(joints))]
    pale = [tuple(int(0.5 * part + 110) for part in color) for color in colors]
    central = [f"{joint} central" for joint in joints]
    for entity, style in (
        (series.positions, rr.SeriesLines(names=joints, colors=colors)),
        (series.distributed, rr.SeriesLines(names=joints, colors=colors, widths=[2] * len(joints))),
        (series.central, rr.SeriesLines(names=central, colors=pale, widths=[1] * len(joints))),
        (series.difference, rr.SeriesLines(names=joints, colors=colors)),
    ):
        stream.log(entity, style, static=True)
    return series


def send_series(
    stream: rr.RecordingStream, began_ns: int, entity: str, at_ns: Iterable[int] | NDArray[np.int64], values: Floats
) -> None:
    """Sends the values of all joints at some times, [times, joints]."""
    columns = rr.Scalars.columns(scalars=values.reshape(-1)).partition([values.shape[1]] * len(values))
    stream.send_columns(entity, indexes=time_columns(at_ns, began_ns), columns=columns)


def eye(cells: Iterable[Cells], links: Iterable[Link], *, is_live: bool = False) -> rrb.EyeControls3D | None:
    """Returns an eye that sees all cells and links; None if there are none.

    A running bench has shown one pose: the eye sees all places above its base that are as far from the base.
    """
    clouds = [*(one.positions for one in cells), *(link.points for link in links)]
    if not clouds:
        return None
    points = np.concatenate([*clouds, np.zeros((1, 3))]).astype(np.float64)
    if is_live:
        # Few poses stretch an arm sideways, and the view has margins.
        reach = 0.85 * float(np.max(np.linalg.norm(points, axis=1)))
        turns = np.linspace(0, 2 * np.pi, 16)[:, np.newaxis]
        rises = np.linspace(0, np.pi / 2, 5)
        ball = (np.cos(turns) * np.cos(rises), np.sin(turns) * np.cos(rises), np.sin(rises) + 0 * turns)
        points = np.concatenate([points, reach * np.stack(ball, axis=-1).reshape(-1, 3)])
    back = _EYE_DIRECTION / np.linalg.norm(_EYE_DIRECTION)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    view = np.array([right, np.cross(back, right), back])
    seen = points @ view.T
    middle = (seen.min(axis=0) + seen.max(axis=0)) / 2
    aside = np.abs(seen - middle)[:, :2].max(axis=1)
    distance = float(np.max(seen[:, 2] - middle[2] + aside / (_EYE_FILL * math.tan(_EYE_HALF_ANGLE))))
    target = middle @ view
    position = target + back * max(distance, 0.1)
    return rrb.EyeControls3D(position=position, look_target=target, eye_up=(0, 0, 1))


def send_view(
    stream: rr.RecordingStream,
    entities: SeriesEntities,
    units: Units,
    *,
    eye: rrb.EyeControls3D | None,
    duration: float | None,
) -> None:
    """Sends the views.

    Args:
        stream: The stream.
        entities: The entities of the series.
        units: The units of position and torque of each joint; empty if they are unknown.
        eye: The eye; None for no view of the robot.
        duration: The duration in s of what the plots show from 0 on; None for the present of a running bench.
    """
    positions, torques = unit_names(units)
    is_live = duration is None
    shown = _LIVE_SECONDS if duration is None else duration
    # Beside the beginning there is room for a legend.
    room = shown * _LEGEND_SHARE / (1 - _LEGEND_SHARE)
    if is_live:
        begin, end = (rrb.TimeRangeBoundary.cursor_relative(seconds=at) for at in (-shown - room, 0.0))
    else:
        begin, end = (rrb.TimeRangeBoundary.absolute(seconds=at) for at in (-room, shown))
    axis = rrb.TimeAxis(view_range=rr.TimeRange(begin, end))
    recent = rrb.VisibleTimeRange("run", start=rrb.TimeRangeBoundary.cursor_relative(seconds=-shown), end=end)

    def plot(origin: str, contents: Sequence[str] | str, name: str, legend: bool = False) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin=origin,
            contents=contents,
            name=name,
            axis_x=axis,
            time_ranges=recent if is_live else None,
            plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend),
        )

    series = rrb.Vertical(
        plot(
            entities.torques,
            [entities.distributed, entities.central],
            f"torques in {torques}, thick: cells, thin: central",
        ),
        plot(entities.torques, entities.difference, f"difference in {torques}"),
        plot(entities.positions, entities.positions, f"joints in {positions}", legend=True),
        rrb.TextLogView(
            origin="/contacts",
            name="contacts",
            columns=rrb.TextLogColumns(
                timeline_columns=[TimelineColumn("run", visible=False)], text_log_columns=["Body"]
            ),
        ),
        row_shares=[3, 2, 3, 2],
    )
    robot = rrb.Spatial3DView(origin="/robot", name="robot", eye_controls=eye)
    stream.send_blueprint(
        rrb.Blueprint(
            series if eye is None else rrb.Horizontal(robot, series, column_shares=[3, 2]),
            rrb.TimePanel(timeline="run", state="collapsed", play_state="following" if is_live else None),
            rrb.SelectionPanel(state="collapsed"),
            rrb.BlueprintPanel(state="collapsed"),
        )
    )


def finish(stream: rr.RecordingStream, *, is_own: bool) -> None:
    """Writes what is left, and completes the file of a stream that nobody else has. Warns if a viewer was closed."""
    try:
        stream.flush()
    except RuntimeError as error:
        if is_own:
            raise
        warnings.warn(f"the viewer did not receive everything: {error}", stacklevel=3)
    finally:
        if is_own:
            stream.disconnect()


def unit_names(units: Units) -> tuple[str, str]:
    """Returns the units of positions and of torques as texts."""
    known = list(units) or [("rad", "Nm"), ("m", "N")]
    positions, torques = (list(dict.fromkeys(each)) for each in zip(*known, strict=True))
    return " or ".join(positions), " or ".join(torques)
