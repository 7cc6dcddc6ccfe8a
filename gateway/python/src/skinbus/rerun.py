"""Recordings and running benches in the viewer Rerun. Needs `pip install "skinbus[rerun]"`.

    skinbus.to_rerun("run.mcap", save="run.rrd")  # then `rerun run.rrd`

    rerun.init("my bench", spawn=True)
    with Bench("skin.toml") as bench, skinbus.to_rerun(bench):
        bench.press(12, 3.0)

| entity | content |
|---|---|
| `/joints` | positions of all joints in rad or m |
| `/torques/distributed`, `central`, `difference` | torques of all joints in Nm or N |
| `/contacts` | text: a cell is touched, falls silent, or is back; `/contacts/count`: number of touched cells |
| `/robot/links` | a line for each link that moves |
| `/robot/cells/PATCH` | cells, coloured by force: grey while it is unknown, magenta if the cell is silent |
| `/robot/forces/PATCH` | an arrow for each touched cell |

Series of other joints in the same Rerun recording, as of a second robot, are `/joints_2`, `/torques_2/...`, and so on.

Central torques and differences have gaps while they are unknown, differences also while replies of cells are missing.
When a bench or its log ends, its joints, torques and robot are cleared.

The timeline `time` has the time in UTC, and `run` the time since the first tick of a recorded run; of benches, the time
since the log of the first one began.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import overload

from skinbus.bench import Bench
from skinbus.recording import read

try:
    import rerun as rr

    from skinbus import _rerun_view as view
    from skinbus._rerun_live import LiveLog
    from skinbus._rerun_recording import log_recording
except ImportError as error:
    raise ImportError('skinbus.to_rerun needs the package rerun-sdk: `pip install "skinbus[rerun]"`') from error

__all__ = ["LiveLog", "to_rerun"]

PathLike = str | os.PathLike[str]

_APPLICATION = "skinbus"


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
        log_recording(stream, recorded, paths)
    view.finish(stream, is_own=recording is None and save is not None)
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
    return stream
