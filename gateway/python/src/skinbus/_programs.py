"""Search for the programs of the bench."""

from __future__ import annotations

import os
from pathlib import Path


def program_path(name: str) -> Path:
    """Returns the path of a program in the directory that `SKINBUS_PROGRAMS` names."""
    return Path(os.environ["SKINBUS_PROGRAMS"]) / name
