"""The search for the programs."""

from __future__ import annotations

from pathlib import Path

import pytest

from skinbus import ProgramMissing, program_path


def add_program(directory: Path, name: str = "skinbus") -> Path:
    """Creates a program and returns its path."""
    directory.mkdir(parents=True)
    path = directory / name
    path.write_text("#!/bin/sh\n")
    path.chmod(0o755)
    return path


@pytest.fixture(autouse=True)
def _nothing_installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("SKINBUS_PROGRAMS", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path / "path"))
    monkeypatch.setattr("sys.executable", str(tmp_path / "python" / "python3"))

    def script_directory(name: str, scheme: str = "") -> str:
        assert name == "scripts"
        return str(tmp_path / ("user" if scheme else "scripts"))

    monkeypatch.setattr("sysconfig.get_path", script_directory)


def test_the_nearest_program_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for place in ("path", "user", "python", "scripts", "variable"):
        expected = add_program(tmp_path / place)
        if place == "variable":
            monkeypatch.setenv("SKINBUS_PROGRAMS", str(expected.parent))
        assert program_path("skinbus") == expected


def test_a_missing_program_is_an_error_that_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(
        ProgramMissing, match=r"^cell-node is not installed: `pip install` this package, or set SKINBUS"
    ):
        program_path("cell-node")
    add_program(tmp_path / "path")
    add_program(tmp_path / "variable").chmod(0o644)
    monkeypatch.setenv("SKINBUS_PROGRAMS", str(tmp_path / "variable"))
    with pytest.raises(
        ProgramMissing, match=r"variable/skinbus is not a program: correct SKINBUS_PROGRAMS, or unset it$"
    ):
        program_path("skinbus")


def test_only_the_programs_of_the_bench_are_searched() -> None:
    expected = "'sh' is not a program of the bench: use one of skinbus, cell-node, vcan-setup"
    with pytest.raises(ValueError, match=expected):
        program_path("sh")
