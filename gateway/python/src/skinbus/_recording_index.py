"""The index of a recording: a folder of NumPy files that `skinbus convert` makes, and that is used again."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skinbus._programs import program_path
from skinbus.errors import ProgramMissing, SkinbusError

FORMAT_VERSION = 2
DESCRIPTION_FILE = "columns.json"
LOGGER = logging.getLogger("skinbus")
# A column up to this size is read at once: each mapping needs a file descriptor, and an index has 43 columns.
_SMALL_BYTES = 256 << 10
# The attempts to map an index that other programs replace, and the time in seconds between them.
_ATTEMPTS = 3
_RETRY_DELAY = 0.05


class ReadFailed(SkinbusError):
    """A recording cannot be read. The text is the line in which `skinbus convert` gives its reason."""


@dataclass(frozen=True)
class Index:
    """An index in memory. It stays as it is when its folder is replaced or removed.

    Attributes:
        path: Its folder.
        description: The contents of `columns.json`.
        columns: The columns, as "TABLE.COLUMN"; they are read-only.
    """

    path: Path
    description: Mapping[str, Any]
    columns: Mapping[str, NDArray[Any]]


def open_index(files: Sequence[Path], skin: Path | None) -> Index:
    """Returns the index of a recording. Makes it if it is missing or stale.

    The index is `FILE.columns` beside the first file, of several files `FILE+N-HASH.columns`. If that folder is not
    writable, the index is in the user's cache.
    """
    path = _index_path(files)
    index = _usable_index(path, files, skin)
    if index is None and not os.access(path.parent, os.W_OK):
        path = _cache_path(path)
        index = _usable_index(path, files, skin)
    if index is None:
        convert(files, path, skin)
        index = load_index(path)
    return index


def convert(files: Sequence[Path], index: Path, skin: Path | None, descriptors: Sequence[int] = ()) -> None:
    """Runs `skinbus convert`, which inherits `descriptors`, and logs its notes. Replaces an index that is there."""
    command: list[str | Path] = [program_path("skinbus"), "convert"]
    if skin is not None:
        command += ["--skin", skin.absolute()]
    command += ["--overwrite", "--", *(file.absolute() for file in files), index.absolute()]
    silent = subprocess.DEVNULL
    process = subprocess.Popen(command, stdin=silent, stdout=silent, stderr=subprocess.PIPE, pass_fds=descriptors)
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


def load_index(path: Path) -> Index:
    """Maps an index into memory. Begins again if another program replaces it meanwhile.

    Raises:
        ReadFailed: The index is replaced again and again.
        OSError, ValueError, EOFError: The index is missing or damaged.
    """
    for attempt in range(_ATTEMPTS):
        if attempt > 0:
            time.sleep(_RETRY_DELAY)
        is_last = attempt == _ATTEMPTS - 1
        try:
            before = _read_description(path)
            columns = {file.stem: _load_column(file) for file in path.glob("*.npy")}
            if _read_description(path) == before:
                return Index(path, json.loads(before[0]), columns)
        except FileNotFoundError:
            # Without an exchange of names, the name is free for a moment.
            if is_last or not path.parent.exists():
                raise
    raise ReadFailed(f"other programs replaced {path} while it was read: try again")


def _read_description(path: Path) -> tuple[bytes, int, int]:
    """Returns the description of an index, and what tells its file from that of another index with the same text."""
    with (path / DESCRIPTION_FILE).open("rb") as file:
        about = os.fstat(file.fileno())
        return file.read(), about.st_ino, about.st_mtime_ns


def _load_column(file: Path) -> NDArray[Any]:
    """Maps a column into memory, or reads a small one."""
    if file.stat().st_size > _SMALL_BYTES:
        mapped: NDArray[Any] = np.load(file, mmap_mode="r", allow_pickle=False)
        # Slices of a plain array are much faster than those of a memmap.
        return mapped.view(np.ndarray)
    column: NDArray[Any] = np.load(file, allow_pickle=False)
    column.flags.writeable = False
    return column


def _usable_index(path: Path, files: Sequence[Path], skin: Path | None) -> Index | None:
    """Returns an index, unless it is missing, stale, or made by another version of the program."""
    try:
        if not _is_current(json.loads(_read_description(path)[0]), files, skin):
            return None
        return load_index(path)
    except (OSError, ValueError, EOFError):
        return None


def _is_current(description: Mapping[str, Any], files: Sequence[Path], skin: Path | None) -> bool:
    """Returns whether an index is that of these files, and has what the program in use would write."""
    if description.get("skinbus_columns") != FORMAT_VERSION:
        return False
    version = program_version()
    recorded = description.get("skin_file")
    return (
        version in (None, description.get("program"))
        and [_recorded_state(source) for source in description["sources"]] == [_state(file) for file in files]
        and (recorded and _recorded_state(recorded)) == (skin and _state(skin))
    )


def program_version() -> str | None:
    """Returns the version of the program `skinbus`; None if it is missing or does not tell."""
    try:
        return _version_of(program_path("skinbus"))
    except ProgramMissing:
        return None


@cache
def _version_of(program: Path) -> str | None:
    """Runs a program once to learn its version."""
    try:
        done = subprocess.run([program, "--version"], stdin=subprocess.DEVNULL, capture_output=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    words = done.stdout.decode(errors="replace").split()
    return words[1] if words[:1] == ["skinbus"] and len(words) > 1 else None


def _state(path: Path) -> tuple[int, int, int]:
    """Returns the size, the time of the last change in ns, and the inode of a file."""
    about = path.stat()
    return about.st_size, about.st_mtime_ns, about.st_ino


def _recorded_state(source: dict[str, Any]) -> tuple[int, int, int]:
    return source["bytes"], source["modified_ns"], source["inode"]


def _index_path(files: Sequence[Path]) -> Path:
    first, *others = files
    if not others:
        return first.with_name(f"{first.name}.columns")
    names = sorted(os.fsencode(file.resolve()) for file in files)
    digits = hashlib.sha256(b"\0".join(names)).hexdigest()[:8]
    return first.with_name(f"{first.name}+{len(others)}-{digits}.columns")


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
