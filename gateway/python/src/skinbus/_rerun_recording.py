"""Recordings in Rerun."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rerun as rr
from mcap.reader import make_reader

from skinbus import _rerun_view as view
from skinbus._rerun_view import time_columns
from skinbus._scene import Cells, Link, Scene, Silence
from skinbus.recording import Recording

_NANOS = 1e-9


@dataclass
class _Moments:
    """Cells and links of a recording at all times, and the cells that fell silent."""

    clouds: dict[str, list[Cells]] = field(default_factory=dict)
    links: dict[int, list[Link]] = field(default_factory=dict)
    silences: list[Silence] = field(default_factory=list)


def log_recording(stream: rr.RecordingStream, recorded: Recording, paths: Sequence[Path]) -> None:
    """Logs a recording or a candump log, and sends its views."""
    stream.send_recording_name(paths[0].name)
    stream.send_recording_start_time_nanos(recorded.began_ns)
    moments = _moments(paths)
    series = view.log_series_style(stream, recorded.joint_names)
    duration = _log_epochs(stream, recorded, series)
    _log_contacts(stream, recorded, moments.silences)
    _log_moments(stream, moments, recorded.began_ns)
    clouds = [cells for cells_of_patch in moments.clouds.values() for cells in cells_of_patch]
    eye = view.eye(clouds, [link for links in moments.links.values() for link in links])
    view.send_view(stream, series, recorded.joint_units, eye=eye, duration=duration)


def _log_epochs(stream: rr.RecordingStream, recorded: Recording, series: view.SeriesEntities) -> float:
    """Logs positions and torques of all epochs. Returns the time of the last one in s.

    There is no difference in epochs with missing replies: it would show their torques, not an error of computation.
    """
    epochs = recorded.epochs()
    differences = np.where(np.asarray(epochs.open_cells)[:, np.newaxis] > 0, np.nan, epochs.error)
    for entity, values in (
        (series.positions, epochs.positions),
        (series.distributed, epochs.distributed),
        (series.central, epochs.central),
        (series.difference, differences),
    ):
        view.send_series(stream, recorded.began_ns, entity, np.array(epochs.at_ns), np.array(values))
    return (int(epochs.at_ns[-1]) - recorded.began_ns) * _NANOS if len(epochs) else 1.0


def _log_contacts(stream: rr.RecordingStream, recorded: Recording, silences: Sequence[Silence]) -> None:
    """Logs the beginnings and ends of all contacts, the number of touched cells, and the cells that fell silent."""
    contacts = recorded.contacts()
    changes = [(silence.at_ns, 0, silence.text) for silence in silences]
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
    times = time_columns((at for at, _, _ in changes), recorded.began_ns)
    texts = [view.event_text(at, recorded.began_ns, text) for at, _, text in changes]
    stream.send_columns("/contacts", indexes=times, columns=rr.TextLog.columns(text=texts))
    counts = np.cumsum([change for _, change, _ in changes]).astype(np.float64)
    stream.send_columns("/contacts/count", indexes=times, columns=rr.Scalars.columns(scalars=counts))


def _log_moments(stream: rr.RecordingStream, moments: _Moments, began_ns: int) -> None:
    """Logs links, cells and forces."""
    view.log_robot_style(stream)
    for clouds in moments.clouds.values():
        view.log_patch_style(stream, clouds[0])
        view.send_clouds(stream, began_ns, clouds, labels=None)
    view.send_links(stream, began_ns, moments.links)


def _moments(paths: Sequence[Path]) -> _Moments:
    """Returns the cells and links of a recording. A candump log has none."""
    scene, moments = Scene(), _Moments()
    for topic, message in _messages(paths):
        cells, silences = scene.add(topic, message)
        moments.silences += silences
        if cells is not None:
            moments.clouds.setdefault(cells.patch, []).append(cells)
            if cells.at_ns not in moments.links:
                moments.links[cells.at_ns] = scene.links()
    return moments


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
