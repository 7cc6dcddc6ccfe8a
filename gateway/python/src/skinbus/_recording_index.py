"""The index of a recording: a folder of NumPy files that `skinbus convert` makes, and that is used again."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from skinbus._programs import program_path
from skinbus.errors import SkinbusError

FORMAT_VERSION = 1
DESCRIPTION_FILE = "columns.json"
LOGGER = logging.getLogger("skinbus")


class ReadFailed(SkinbusError):
    """A recording cannot be read. The text is the line in which `skinbus convert` gives its reason."""


def open_index(files: Sequence[Path], skin: Path | None) -> tuple[Path, dict[str, Any]]:
    """Returns the index of a recording and its description. Makes the index if it is missing or stale.

    The index is `FILE.columns` beside the first file, of several files `FILE+N.columns`. If that folder is not
    writable, the index is in the user's cache.
    """
    path = _index_path(files)
    description = _usable_description(path, files, skin)
    if description is None and not os.access(path.parent, os.W_OK):
        path = _cache_path(path)
        description = _usable_description(path, files, skin)
    if description is None:
        convert(files, path, skin)
        description = load_description(path)
    return path, description


def convert(files: Sequence[Path], index: Path, skin: Path | None) -> None:
    """Runs `skinbus convert`, and logs its notes. Replaces an index that is there."""
    command: list[str | Path] = [program_path("skinbus"), "convert"]
    if skin is not None:
        command += ["--skin", skin.absolute()]
    command += ["--overwrite", "--", *(file.absolute() for file in files), index.absolute()]
    silent = subprocess.DEVNULL
    process = subprocess.Popen(command, stdin=silent, stdout=silent, stderr=subprocess.PIPE)
    try:
        _, notes = process.communicate()
    except BaseException:
        # The program removes what it has written.
        process.terminate()
        process.wait()
        raise
    lines = notes.decode(errors="replace").strip().splitlines()
    for line in lines:
        LOGGER.info("%s", line)
    if process.returncode != 0:
        text = lines[-1].removeprefix("skinbus: ") if lines else f"skinbus convert ended with {process.returncode}"
        raise ReadFailed(text.replace("name one with --skin", "name one with skin="))


def load_description(index: Path) -> dict[str, Any]:
    """Reads the description of an index."""
    text = (index / DESCRIPTION_FILE).read_text(encoding="utf-8")
    description: dict[str, Any] = json.loads(text)
    return description


def _usable_description(index: Path, files: Sequence[Path], skin: Path | None) -> dict[str, Any] | None:
    """Returns the description of an index, unless the index is missing or stale."""
    try:
        description = load_description(index)
    except (OSError, ValueError):
        return None
    recorded = description.get("skin_file")
    is_current = (
        description.get("skinbus_columns") == FORMAT_VERSION
        and [_recorded_state(source) for source in description["sources"]] == [_state(file) for file in files]
        and (recorded and _recorded_state(recorded)) == (skin and _state(skin))
    )
    return description if is_current else None


def _state(path: Path) -> tuple[int, int, int]:
    """Returns the size, the time of the last change in ns, and the inode of a file."""
    about = path.stat()
    return about.st_size, about.st_mtime_ns, about.st_ino


def _recorded_state(source: dict[str, Any]) -> tuple[int, int, int]:
    return source["bytes"], source["modified_ns"], source["inode"]


def _index_path(files: Sequence[Path]) -> Path:
    first, *others = files
    further = f"+{len(others)}" if others else ""
    return first.with_name(f"{first.name}{further}.columns")


def _cache_path(beside: Path) -> Path:
    """Returns the path of an index that cannot be beside its recording."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    name = hashlib.sha256(os.fsencode(beside.absolute())).hexdigest()[:16]
    for folder in (Path(home) / "skinbus", Path(tempfile.gettempdir()) / f"skinbus-{os.getuid()}"):
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK) and folder.stat().st_uid == os.getuid():
            return folder / f"{name}.columns"
    raise ReadFailed(
        f"{beside.parent} is not writable, nor is {home}: name a writable one in XDG_CACHE_HOME, or use index=False"
    )
