"""Buses, programs and frames for the tests of the interface and the file format of python-can."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import can

from skinbus._programs import program_path
from skinbus.can_bus import SkinbusBus

TIMEOUT_S = 30.0
FD_LENGTHS = (0, 1, 5, 8, 12, 16, 20, 24, 32, 48, 64)


@dataclass
class Served:
    """A bus with a server of its own."""

    name: str
    directory: Path
    server: subprocess.Popen[str]

    def environment(self) -> dict[str, str]:
        """Returns the environment in which programs find the bus."""
        return {**os.environ, "SKINBUS_DIR": str(self.directory)}

    def open(self, **options: object) -> SkinbusBus:
        """Attaches to the bus."""
        return SkinbusBus(self.name, directory=self.directory, **options)  # type: ignore[arg-type]

    def attach_raw(self) -> socket.socket:
        """Attaches without the package, to send what python-can does not."""
        client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        client.connect(str(self.directory / f"{self.name}.bus"))
        client.send(struct.pack("<7s3BIQB", b"skinbus", 2, 0, 1, 0, 1 << 20, 0))
        assert client.recv(64)[:9] == b"skinbus\2\0"
        return client

    def kill(self) -> None:
        """Kills the server."""
        self.server.send_signal(signal.SIGKILL)
        self.server.wait(TIMEOUT_S)


@contextlib.contextmanager
def serve(directory: Path, name: str = "vcan0") -> Iterator[Served]:
    """Serves a bus, and ends its server."""
    environment = {**os.environ, "SKINBUS_DIR": str(directory)}
    command: list[str | Path] = [program_path("vcan-setup"), "serve", name, "--until-eof"]
    server = subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert server.stdout is not None
        assert server.stdout.readline().startswith(f"serving {name} at ")
        yield Served(name, directory, server)
    finally:
        if server.poll() is None:
            server.send_signal(signal.SIGCONT)
            server.terminate()
        server.communicate(timeout=TIMEOUT_S)


@contextlib.contextmanager
def running(
    command: Sequence[str | Path], served: Served, until: Callable[[], bool]
) -> Iterator[subprocess.Popen[str]]:
    """Runs a program on a bus; `until` tells when it is ready. Ends it as Ctrl-C does."""
    program = subprocess.Popen(
        list(command), env=served.environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        wait_until(lambda: until() or program.poll() is not None)
        yield program
    finally:
        if program.poll() is None:
            program.send_signal(signal.SIGINT)
            try:
                program.communicate(timeout=TIMEOUT_S)
            except subprocess.TimeoutExpired:
                program.kill()
                program.communicate()


def run(command: Sequence[str | Path], served: Served | None = None) -> str:
    """Runs a program to its end. Returns its output."""
    environment = None if served is None else served.environment()
    done = subprocess.run(list(command), env=environment, capture_output=True, text=True, timeout=2 * TIMEOUT_S)
    assert done.returncode == 0, done.stderr
    return done.stdout


def python(*arguments: str | Path) -> list[str | Path]:
    """Returns the command for a module of this interpreter."""
    return [sys.executable, "-m", *arguments]


def wait_until(is_true: Callable[[], bool]) -> None:
    """Waits until something is true."""
    end = time.monotonic() + TIMEOUT_S
    while not is_true():
        assert time.monotonic() < end, "it did not become true in time"
        time.sleep(0.01)


def receive(bus: can.BusABC, count: int) -> list[can.Message]:
    """Receives frames."""
    frames: list[can.Message] = []
    while len(frames) < count:
        frame = bus.recv(TIMEOUT_S)
        assert frame is not None, f"only {len(frames)} of {count} frames came"
        frames.append(frame)
    return frames


def random_frame(source: random.Random) -> can.Message:
    """Returns a classic, FD or remote frame with 11 or 29 bits."""
    kind = source.choice(("classic", "fd", "remote"))
    is_extended = source.random() < 0.5
    identifier = source.getrandbits(29 if is_extended else 11)
    if kind == "remote":
        return can.Message(
            arbitration_id=identifier, is_extended_id=is_extended, is_remote_frame=True, dlc=source.randrange(9)
        )
    if kind == "classic":
        data = source.randbytes(source.randrange(9))
        return can.Message(arbitration_id=identifier, is_extended_id=is_extended, data=data)
    return can.Message(
        arbitration_id=identifier,
        is_extended_id=is_extended,
        data=source.randbytes(source.choice(FD_LENGTHS)),
        is_fd=True,
        bitrate_switch=source.random() < 0.5,
        error_state_indicator=source.random() < 0.5,
    )


def random_frames(count: int, seed: int) -> list[can.Message]:
    """Returns frames of all kinds."""
    source = random.Random(seed)
    return [random_frame(source) for _ in range(count)]


def fields(message: can.Message) -> tuple[object, ...]:
    """Returns what identifies a frame, without its time, channel and direction."""
    return (
        message.arbitration_id,
        message.is_extended_id,
        message.is_remote_frame,
        message.is_error_frame,
        message.is_fd,
        message.bitrate_switch,
        message.error_state_indicator,
        message.dlc,
        bytes(message.data),
    )


def candump_text(message: can.Message, fdf: int = 4) -> str:
    """Returns a frame as `candump -L` prints it; `fdf` is the flag of FD frames, 4 or 0."""
    identifier = message.arbitration_id | (message.is_error_frame << 29)
    text = f"{identifier:0{8 if message.is_extended_id or message.is_error_frame else 3}X}#"
    if message.is_remote_frame:
        return f"{text}R{message.dlc}" if message.dlc else f"{text}R"
    if message.is_fd:
        text += f"#{fdf | message.bitrate_switch | message.error_state_indicator << 1:X}"
    return text + message.data.hex().upper()
