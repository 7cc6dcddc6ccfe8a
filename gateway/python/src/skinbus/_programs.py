"""Search for the programs of the bench."""

from __future__ import annotations

import os
import shutil
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path

from skinbus.errors import ProgramMissing

VARIABLE = "SKINBUS_PROGRAMS"
NAMES = ("skinbus", "cell-node", "vcan-setup")


def program_path(name: str) -> Path:
    """Returns the path of a program of the bench: "skinbus", "cell-node" or "vcan-setup".

    If the environment variable `SKINBUS_PROGRAMS` names a directory, the program must be there. Otherwise it is
    searched beside this interpreter, where pip installs programs, and then on `PATH`.

    Raises:
        ProgramMissing: The program is in none of these places. The text says what to do.
        ValueError: `name` is not a program of the bench.
    """
    if name not in NAMES:
        raise ValueError(f"{name!r} is not a program of the bench: use one of {', '.join(NAMES)}")
    named = os.environ.get(VARIABLE)
    if named:
        path = Path(named) / name
        if not _is_program(path):
            raise ProgramMissing(f"{path} is not a program: correct {VARIABLE}, or unset it")
        return path.absolute()
    for directory in _script_directories():
        if _is_program(directory / name):
            return directory / name
    found = shutil.which(name)
    if found is None:
        raise ProgramMissing(
            f"{name} is not installed: `pip install` this package, or set {VARIABLE} to the directory that has it"
        )
    return Path(found).absolute()


def _script_directories() -> Iterator[Path]:
    """Returns the directories in which pip installs programs."""
    yield Path(sysconfig.get_path("scripts"))
    yield Path(sys.executable).parent
    yield Path(sysconfig.get_path("scripts", sysconfig.get_preferred_scheme("user")))


def _is_program(path: Path) -> bool:
    """Returns whether a file exists and can be executed."""
    return path.is_file() and os.access(path, os.X_OK)
