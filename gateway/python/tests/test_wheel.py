"""The wheel: its programs, its tag, and what it says to python-can and pytest."""

from __future__ import annotations

import configparser
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1]
PROGRAMS = ("skinbus", "cell-node", "vcan-setup")


def build(*arguments: str, programs: Path, output: Path) -> subprocess.CompletedProcess[str]:
    """Builds the package with programs that are compiled already."""
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(output), *arguments, str(PACKAGE)]
    environment = {**os.environ, "SKINBUS_PROGRAMS": str(programs)}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with small programs that have the names of the bench's."""
    pytest.importorskip("build")
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("programs")
    for name in PROGRAMS:
        shutil.copy("/bin/true", folder / name)
    return folder


def test_a_wheel_has_the_programs(programs: Path, tmp_path: Path) -> None:
    done = build("--wheel", programs=programs, output=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name.startswith("skinbus-")
    assert "-py3-none-manylinux_2_" in wheel.name
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        for program in PROGRAMS:
            (name,) = [name for name in names if name.endswith(f".data/scripts/{program}")]
            assert archive.getinfo(name).external_attr >> 16 & 0o111
        (entries,) = [name for name in names if name.endswith("/entry_points.txt")]
        points = configparser.ConfigParser()
        points.read_string(archive.read(entries).decode())
    assert "skinbus/py.typed" in names
    assert points["can.interface"]["skinbus"] == "skinbus.can_bus:SkinbusBus"
    assert points["can.io.message_reader"][".mcap"] == "skinbus.mcap_io:McapReader"
    assert points["can.io.message_writer"][".mcap"] == "skinbus.mcap_io:McapWriter"
    assert points["pytest11"]["skinbus"] == "skinbus.pytest_plugin"
    target = tmp_path / "installed"
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*install, "--target", str(target), str(wheel)], check=True)
    for program in PROGRAMS:
        subprocess.run([target / "bin" / program], check=True)


def test_missing_programs_and_a_source_distribution_are_refused(programs: Path, tmp_path: Path) -> None:
    done = build("--sdist", programs=programs, output=tmp_path)
    assert done.returncode != 0
    assert "skinbus is built from its tree" in done.stdout + done.stderr
    done = build("--wheel", programs=tmp_path, output=tmp_path)
    assert done.returncode != 0
    assert "vcan-setup missing: build them, or unset the variable" in done.stdout + done.stderr
    assert not list(tmp_path.iterdir())
