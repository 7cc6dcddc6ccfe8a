"""Tests of the interface of python-can against the programs that serve and show a bus."""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import signal
import socket
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

import can
import pytest
from can_tools import (
    TIMEOUT_S,
    Served,
    candump_text,
    fields,
    random_frames,
    receive,
    running,
    serve,
    wait_until,
)

from skinbus._programs import program_path
from skinbus.can_bus import SkinbusBus

FRAMES = 10_000
PROBE = can.Message(arbitration_id=0x1FFF_FFFF)
ERROR_FRAMES = [(0x2000_0004 | number << 6, bytes([number] * 8)) for number in range(3)]


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    """Serves a bus."""
    with serve(tmp_path / "buses") as bus:
        yield bus


def dumped(path: Path) -> list[str]:
    """Returns the frames in the output of `skinbus dump`, without probes and the line that is being written."""
    lines = path.read_text().split("\n")[:-1]
    frames = [line.split("\t")[0].split(" ")[2] for line in lines]
    return [frame for frame in frames if frame != candump_text(PROBE)]


def wait_for_dump(path: Path, count: int) -> None:
    """Waits until the output of `skinbus dump` has a number of frames."""
    wait_until(lambda: len(dumped(path)) >= count)


@contextlib.contextmanager
def dumping(served: Served, path: Path) -> Iterator[None]:
    """Runs `skinbus dump`, which writes to a file, and waits until it is attached."""
    script = f"exec '{program_path('skinbus')}' dump {served.name} > '{path}'"

    def shows_probe() -> bool:
        sender.send(PROBE)
        return path.exists() and path.stat().st_size > 0

    with served.open() as sender, running(["sh", "-c", script], served, shows_probe):
        yield


# Frames


def test_all_kinds_of_frames_pass_in_order(served: Served, tmp_path: Path) -> None:
    """What one connection sends, another one and `skinbus dump` receive; error frames come from a raw client."""
    frames = random_frames(FRAMES, seed=1)
    dump = tmp_path / "dump"
    received: list[can.Message] = []
    raw = served.attach_raw()
    with dumping(served, dump), served.open() as sender, served.open() as receiver:
        thread = threading.Thread(
            target=lambda: received.extend(receive(receiver, len(frames) + len(ERROR_FRAMES))), daemon=True
        )
        thread.start()
        # A busy machine would drop frames for the slower programs.
        for first in range(0, len(frames), 500):
            for frame in frames[first : first + 500]:
                sender.send(frame)
            wait_for_dump(dump, min(first + 500, len(frames)))
        for identifier, data in ERROR_FRAMES:
            raw.send(struct.pack("=I4B8s", identifier, 8, 0, 0, 0, data))
        thread.join(TIMEOUT_S)
        wait_for_dump(dump, len(frames) + len(ERROR_FRAMES))
        assert receiver.dropped == 0
    raw.close()
    errors = [
        can.Message(is_error_frame=True, is_extended_id=False, arbitration_id=identifier & 0x1FFF_FFFF, data=data)
        for identifier, data in ERROR_FRAMES
    ]
    expected = frames + errors
    assert [fields(frame) for frame in received] == [fields(frame) for frame in expected]
    assert dumped(dump) == [candump_text(frame) for frame in expected]
    assert {(frame.channel, frame.is_rx) for frame in received} == {("vcan0", True)}


def test_time_stamps_are_those_of_the_kernel(served: Served) -> None:
    """A frame that waits has the time at which it came, and stamps keep the order."""
    with served.open() as sender, served.open() as receiver:
        before = time.time()
        for frame in random_frames(100, seed=2):
            sender.send(frame)
        wait_until(lambda: bool(select.select([receiver], [], [], 0)[0]))
        time.sleep(0.2)
        after = time.time() - 0.1
        stamps = [frame.timestamp for frame in receive(receiver, 100)]
    assert before - 1e-3 <= stamps[0]
    assert stamps[-1] < after
    assert stamps == sorted(stamps)


def test_own_frames_are_marked(served: Served) -> None:
    """Own frames come only if they are asked for, with `is_rx` False."""
    with served.open(receive_own_messages=True) as both, served.open() as other:
        both.send(can.Message(arbitration_id=1))
        assert [frame.arbitration_id for frame in receive(other, 1)] == [1]
        other.send(can.Message(arbitration_id=2))
        assert [(frame.arbitration_id, frame.is_rx) for frame in receive(both, 2)] == [(1, False), (2, True)]
        assert other.recv(0.05) is None


@pytest.mark.parametrize(
    ("options", "classes"),
    [({}, [4, 0x40]), ({"error_mask": 4}, [4]), ({"error_mask": 0}, []), ({"ignore_rx_error_frames": True}, [])],
)
def test_error_mask_selects_error_frames(served: Served, options: dict[str, object], classes: list[int]) -> None:
    """Error frames of the classes in the mask come, whatever the filters are."""
    with served.open() as sender, served.open(can_filters=[{"can_id": 7, "can_mask": 0x7FF}], **options) as receiver:
        for error in (4, 0x40):
            sender.send(can.Message(is_error_frame=True, is_extended_id=False, arbitration_id=error, data=bytes(8)))
        sender.send(can.Message(arbitration_id=7))
        frames = receive(receiver, len(classes) + 1)
    assert [frame.arbitration_id for frame in frames if frame.is_error_frame] == classes


def test_error_frame_without_class_is_a_bus_error(served: Served) -> None:
    """Error frames of python-can's readers have no class, and would reach nobody."""
    with served.open() as sender, served.open() as receiver:
        sender.send(can.Message(is_error_frame=True))
        (frame,) = receive(receiver, 1)
    assert (frame.is_error_frame, frame.arbitration_id) == (True, 0x80)


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (can.Message(is_fd=True, data=bytes(9)), "cannot have 9 bytes of data: pad it to 12"),
        (can.Message(data=bytes(3), dlc=2), "the DLC and the length of the data must match up"),
        (can.Message(data=bytes(9)), "should be <= 8 for normal CAN frames"),
        (can.Message(arbitration_id=0x800, is_extended_id=False), "must be less than 2^11"),
        (can.Message(is_fd=True, is_remote_frame=True), "does not support remote frames"),
        (can.Message(bitrate_switch=True), "only allowed for CAN FD frames"),
    ],
)
def test_invalid_frames_are_refused(served: Served, frame: can.Message, text: str) -> None:
    """The server would ignore such a frame, so that it fails before."""
    with served.open() as bus, pytest.raises(ValueError, match="vcan0: cannot send this frame") as failure:
        bus.send(frame)
    assert text in str(failure.value)


def test_classic_connection_has_classic_frames_only(served: Served) -> None:
    """With `fd=False` FD frames are neither received nor sent."""
    with served.open() as sender, served.open(fd=False) as classic:
        assert (sender.protocol, classic.protocol) == (can.CanProtocol.CAN_FD, can.CanProtocol.CAN_20)
        sender.send(can.Message(is_fd=True))
        sender.send(can.Message(arbitration_id=5))
        assert [frame.arbitration_id for frame in receive(classic, 1)] == [5]
        with pytest.raises(can.CanOperationError, match="open it with fd=True"):
            classic.send(can.Message(is_fd=True))


# Slow and ending servers


def test_frames_that_are_read_too_slowly_are_counted(served: Served, caplog: pytest.LogCaptureFixture) -> None:
    """The counter has exactly the frames that did not come."""
    with served.open() as sender, served.open(receive_buffer=4096) as slow:
        for number in range(5000):
            sender.send(can.Message(arbitration_id=number))
        received = 0
        while slow.recv(0.5) is not None:
            received += 1
        assert slow.dropped > 1000
        assert received + slow.dropped == 5000
    assert caplog.messages == ["vcan0: frames were dropped: read faster, or attach with a larger receive_buffer"]


def send_many(bus: can.BusABC, count: int, timeout: float) -> None:
    """Sends frames."""
    for _ in range(count):
        bus.send(can.Message(), timeout)


def test_stopped_server_times_out(served: Served) -> None:
    """Sending waits as long as it is told, and opening gives up after 2 s."""
    with served.open() as bus:
        os.kill(served.server.pid, signal.SIGSTOP)
        began = time.monotonic()
        with pytest.raises(can.CanTimeoutError, match=r"accepted no frame within 0\.2 s"):
            send_many(bus, 10_000, timeout=0.2)
        with pytest.raises(can.CanTimeoutError, match="within 0 s"):
            bus.send(can.Message(), timeout=0)
        assert time.monotonic() - began < 2
        with pytest.raises(can.CanInitializationError, match="did not answer within 2 s"):
            served.open()
        os.kill(served.server.pid, signal.SIGCONT)
        bus.send(can.Message())


def test_killed_server_ends_the_bus(served: Served) -> None:
    """What the server had sent before can be read, then each call fails in one line that says why."""
    with served.open() as bus, served.open() as sender:
        sender.send(can.Message(arbitration_id=1))
        wait_until(lambda: bool(select.select([bus], [], [], 0)[0]))
        assert str(bus.state) == "BusState.ACTIVE"
        served.kill()
        with pytest.raises(can.CanOperationError, match=r"vcan0: .*vcan0\.bus was closed: its server ended"):
            bus.send(can.Message())
        assert [frame.arbitration_id for frame in receive(bus, 1)] == [1]
        for _ in range(2):
            with pytest.raises(can.CanOperationError, match="its server ended"):
                bus.recv(TIMEOUT_S)
            with pytest.raises(can.CanOperationError, match="its server ended"):
                bus.send(can.Message())
        assert str(bus.state) == "BusState.ERROR"
        with pytest.raises(can.CanInitializationError, match="start `vcan-setup serve vcan0`"):
            served.open()


def test_frames_sent_before_the_end_arrive(served: Served) -> None:
    """Shutting down loses no frame that was sent, although frames of others were never read."""
    with served.open() as receiver:
        with served.open() as sender:
            for number in range(500):
                receiver.send(can.Message(arbitration_id=number))
                sender.send(can.Message(arbitration_id=number))
        assert [frame.arbitration_id for frame in receive(receiver, 500)] == list(range(500))


def test_shutdown_ends_a_waiting_thread(served: Served) -> None:
    """A thread that waits for frames ends with an error; a second call has no effect."""
    bus = served.open()
    failures: list[can.CanError] = []

    def wait_for_frames() -> None:
        try:
            bus.recv()
        except can.CanError as failure:
            failures.append(failure)

    thread = threading.Thread(target=wait_for_frames)
    thread.start()
    time.sleep(0.1)
    bus.shutdown()
    thread.join(TIMEOUT_S)
    bus.shutdown()
    assert "was shut down" in str(failures[0])
    assert (bus.fileno(), bus.state) == (-1, can.BusState.ERROR)
    with pytest.raises(can.CanOperationError, match="was shut down"):
        bus.send(can.Message())


def test_signals_do_not_end_waiting(served: Served) -> None:
    """A signal handler runs while a call waits, which goes on afterwards."""
    calls: list[int] = []

    def handle(number: int, _: FrameType | None) -> None:
        calls.append(number)

    before = signal.signal(signal.SIGALRM, handle)
    signal.setitimer(signal.ITIMER_REAL, 0.02, 0.02)
    try:
        with served.open() as bus:
            began = time.monotonic()
            assert bus.recv(0.3) is None
            assert time.monotonic() - began >= 0.3
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert len(calls) > 3


# Attach


@pytest.mark.parametrize("name", ["", ".", "..", "a b", "a/b", "a:b", "a\n", "a\0", "sixteen-bytes-16", "äöüäöüäö"])
def test_invalid_names_are_refused(tmp_path: Path, name: str) -> None:
    """A name that no bus has fails before anything is connected to."""
    with pytest.raises(ValueError, match="is not a valid bus name"):
        SkinbusBus(name, directory=tmp_path)


def test_directories_of_others_are_refused(served: Served, tmp_path: Path) -> None:
    """The directory must be private, exist, be short enough and not be a link."""

    def failure(directory: Path) -> str:
        with pytest.raises(can.CanInitializationError) as raised:
            SkinbusBus("vcan0", directory=directory)
        assert str(raised.value).startswith("vcan0: ")
        assert "\n" not in str(raised.value)
        return str(raised.value)

    link = tmp_path / "link"
    link.symlink_to(served.directory)
    assert "cannot use" in failure(link)
    assert "start `vcan-setup serve vcan0`" in failure(tmp_path / "missing")
    assert "is too long for a Unix socket" in failure(tmp_path / ("x" * 100))
    served.directory.chmod(0o750)
    assert "has mode 0750, so other users can open it: run `chmod 700` on it" in failure(served.directory)
    served.directory.chmod(0o700)
    if os.geteuid() == 0:
        os.chown(served.directory, 12345, -1)
        assert "belongs to user 12345, but this program runs as user 0" in failure(served.directory)
        os.chown(served.directory, 0, -1)
    served.open().shutdown()


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (b"skinbus\x03\x01" + bytes(8), "it uses version 3, this package uses version 2"),
        (b"", "has no file descriptors left"),
        (b"hello", "does not serve an embedded bus"),
    ],
)
def test_servers_that_refuse_are_reported(tmp_path: Path, answer: bytes, text: str) -> None:
    """A server of another version, one without room, and one of another program are told apart."""
    tmp_path.chmod(0o700)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
        server.bind(str(tmp_path / "vcan0.bus"))
        server.listen()

        def serve_once() -> None:
            client, _ = server.accept()
            with client:
                client.recv(64)
                if answer:
                    client.send(answer)

        thread = threading.Thread(target=serve_once)
        thread.start()
        with pytest.raises(can.CanInitializationError, match=text):
            SkinbusBus("vcan0", directory=tmp_path)
        thread.join(TIMEOUT_S)


def test_served_buses_are_detected(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """Buses that are served are found, sockets of killed servers are not."""
    monkeypatch.setenv("SKINBUS_DIR", str(served.directory))
    with serve(served.directory, "a.b") as second:
        found = can.detect_available_configs("skinbus")
        assert [one["channel"] for one in found] == ["a.b", "vcan0"]
        with can.Bus(**found[1], bitrate=500_000) as bus:
            assert isinstance(bus, SkinbusBus)
            assert str(bus) == f"skinbus vcan0 at {served.directory}/vcan0.bus"
        second.kill()
        assert [one["channel"] for one in can.detect_available_configs("skinbus")] == ["vcan0"]
    monkeypatch.setenv("SKINBUS_DIR", str(served.directory / "missing"))
    assert can.detect_available_configs("skinbus") == []


# Parts of python-can


def test_notifier_in_an_event_loop(served: Served) -> None:
    """An event loop receives each frame, and the end of the server as one error."""
    errors: list[dict[str, object]] = []

    async def follow() -> list[int]:
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _, context: errors.append(context))
        reader = can.AsyncBufferedReader()
        with served.open() as bus, served.open() as sender:
            notifier = can.Notifier(bus, [reader], loop=loop)
            for number in range(400):
                sender.send(can.Message(arbitration_id=number))
            numbers = [(await asyncio.wait_for(reader.get_message(), TIMEOUT_S)).arbitration_id for _ in range(400)]
            served.kill()
            await asyncio.sleep(0.3)
            notifier.stop()
        return numbers

    assert asyncio.run(follow()) == list(range(400))
    assert [type(error["exception"]) for error in errors] == [can.CanOperationError]


def test_threads_share_a_bus(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """Many threads send on one bus while a notifier's thread reads it."""
    monkeypatch.setenv("SKINBUS_DIR", str(served.directory))
    with can.ThreadSafeBus("vcan0", interface="skinbus", receive_own_messages=True) as bus:
        reader = can.BufferedReader()
        notifier = can.Notifier(bus, [reader], timeout=0.1)

        def send(thread: int) -> None:
            for number in range(100):
                bus.send(can.Message(arbitration_id=thread << 16 | number))

        threads = [threading.Thread(target=send, args=(number,)) for number in range(4)]
        for thread in threads:
            thread.start()
        frames = [reader.get_message(TIMEOUT_S) for _ in range(400)]
        for thread in threads:
            thread.join(TIMEOUT_S)
        notifier.stop()
    numbers = [frame.arbitration_id for frame in frames if frame is not None]
    for number in range(4):
        own = [one & 0xFFFF for one in numbers if one >> 16 == number]
        assert own == list(range(100))


def test_periodic_frames_stop_with_the_bus(served: Served) -> None:
    """A periodic task sends until the bus is shut down."""
    with served.open() as receiver:
        with served.open() as sender:
            sender.send_periodic(can.Message(arbitration_id=9), 0.01)
            assert {frame.arbitration_id for frame in receive(receiver, 5)} == {9}
        time.sleep(0.1)
        while receiver.recv(0) is not None:
            pass
        assert receiver.recv(0.1) is None
