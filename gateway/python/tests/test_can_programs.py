"""Tests of programs of python-can and cantools on a bus and on recordings."""

from __future__ import annotations

import os
import pty
import re
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from can_tools import (
    TIMEOUT_S,
    Served,
    candump_text,
    fields,
    python,
    random_frames,
    receive,
    run,
    running,
    serve,
)

from skinbus._programs import program_path

cantools = pytest.importorskip("cantools")


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    """Serves a bus."""
    with serve(tmp_path / "buses") as bus:
        yield bus


@pytest.mark.parametrize("name", ["x.log", "x.mcap", "x.mcap.gz", "x.blf"])
def test_logger_and_player_keep_all_frames(served: Served, tmp_path: Path, name: str) -> None:
    """What `can.logger` writes from a bus, `can.player` sends again; `skinbus dump` shows the same frames."""
    frames = random_frames(2000, seed=3)
    if name == "x.log":
        # The writer of logs leaves the length of a remote frame out.
        frames = [frame for frame in frames if not frame.is_remote_frame]
    file = tmp_path / name
    output = tmp_path / "output"
    script = f"exec '{sys.executable}' -u -m can.logger -i skinbus -c {served.name} -f '{file}' > '{output}'"
    with running(
        ["sh", "-c", script], served, lambda: output.exists() and "Connected to" in output.read_text()
    ) as logger:
        with served.open() as sender:
            for number, frame in enumerate(frames):
                sender.send(frame)
                if number % 100 == 0:
                    time.sleep(0.02)
            # Nothing shows when the logger has written all frames; Ctrl-C ends it before.
            time.sleep(2)
        assert logger.poll() is None
    assert logger.returncode == 0
    with can.LogReader(file) as reader:
        logged = list(reader)
    assert [fields(frame) for frame in logged] == [fields(frame) for frame in frames]

    command = python("can.player", "-i", "skinbus", "-c", served.name, "--ignore-timestamps", "-g", "0", file)
    with served.open() as receiver, running(command, served, lambda: True) as player:
        played = receive(receiver, len(logged))
        assert player.wait(TIMEOUT_S) == 0
    assert [fields(frame) for frame in played] == [fields(frame) for frame in logged]
    if name in ("x.log", "x.mcap"):
        shown = run([program_path("skinbus"), "dump", file]).splitlines()
        texts = [line.split("\t")[0].split(" ")[2] for line in shown]
        # The writer of logs leaves out the flag of FD frames.
        fdf = 0 if name == "x.log" else 4
        assert texts == [candump_text(frame, fdf) for frame in frames]


def test_viewer_shows_frames(served: Served) -> None:
    """The viewer of python-can starts in a terminal, shows a frame, and ends with `q`."""
    main, terminal = pty.openpty()
    environment = {**served.environment(), "TERM": "xterm", "LINES": "24", "COLUMNS": "80"}
    command = python("can.viewer", "-i", "skinbus", "-c", served.name)
    viewer = subprocess.Popen(command, env=environment, stdin=terminal, stdout=terminal, stderr=terminal)
    os.close(terminal)
    shown = b""
    try:
        with served.open() as sender:
            end = time.monotonic() + TIMEOUT_S
            while b"ABCDEF" not in shown and time.monotonic() < end:
                sender.send(can.Message(arbitration_id=0x1ABCDEF, data=b"\x12\x34"))
                if select.select([main], [], [], 0.1)[0]:
                    shown += os.read(main, 4096)
        os.write(main, b"q")
        assert b"ABCDEF" in shown
        assert viewer.wait(TIMEOUT_S) == 0
    finally:
        viewer.kill()
        viewer.wait()
        os.close(main)


def test_cantools_decodes_frames(served: Served, tmp_path: Path) -> None:
    """`cantools decode` gives frames of a skin names and values by the file that `skinbus skin dbc` writes."""
    skin, description, log = (tmp_path / name for name in ("skin.toml", "skin.dbc", "x.log"))
    run([program_path("skinbus"), "skin", "generate", "--cells", "4", "-o", skin])
    run([program_path("skinbus"), "skin", "dbc", skin, "-o", description])
    joints = cantools.database.load_file(description).get_message_by_name("joints")
    positions = {signal.name: 0.125 for signal in joints.signals if signal.name.startswith("position_")}
    data = joints.encode(joints.decode_simple(bytes(joints.length)) | positions | {"count": len(positions)})
    with served.open() as sender, served.open() as receiver, can.CanutilsLogWriter(log) as writer:
        sender.send(can.Message(arbitration_id=joints.frame_id, is_extended_id=False, is_fd=True, data=data))
        writer.on_message_received(*receive(receiver, 1))
    with log.open() as lines:
        decoded = subprocess.run(
            python("cantools", "decode", "--single-line", description), stdin=lines, capture_output=True, text=True
        ).stdout
    values = dict(re.findall(r"(\w+): ([-0-9.]+)", decoded.split("joints(")[1]))
    assert {name: float(values[name]) for name in positions} == pytest.approx(positions, abs=1e-3)
