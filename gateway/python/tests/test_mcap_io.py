"""Tests of MCAP recordings as a file format of python-can, against the programs that read and write them."""

from __future__ import annotations

import gzip
import io
import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import can
import pytest
from can_tools import TIMEOUT_S, candump_text, fields, random_frames, run, wait_until
from mcap.reader import make_reader

from skinbus._can_frame import CAN_FRAME_DEFINITION, FrameDecoder, FrameEncoder, MessageError, from_nanos, to_nanos
from skinbus._programs import program_path
from skinbus.mcap_io import McapReader, McapReadError, McapWriter

START_S = 1_700_000_000
DEFINITIONS = Path(__file__).parents[2] / "trace" / "msg"


def sample(count: int, seed: int, *, is_fine: bool = False) -> list[can.Message]:
    """Returns frames of two buses with times in whole microseconds, or as fine as a float has them."""
    source = random.Random(seed)
    frames = random_frames(count, seed)
    frames += [
        can.Message(is_error_frame=True, is_extended_id=False, arbitration_id=4 << number, data=source.randbytes(8))
        for number in range(5)
    ]
    source.shuffle(frames)
    for number, frame in enumerate(frames):
        micros = START_S * 1_000_000 + number * 100 + source.randrange(100)
        frame.timestamp = micros / 1_000_000 if not is_fine else micros / 1_000_000 + 2.4e-7
        frame.channel = source.choice(("vcan0", "can1"))
        frame.is_rx = source.random() < 0.8
    return frames


def write(path: Path, frames: list[can.Message]) -> Path:
    """Writes frames to a file, whose name says the format."""
    with can.Logger(path) as writer:
        for frame in frames:
            writer.on_message_received(frame)
    return path


def read(path: Path) -> list[can.Message]:
    """Reads the frames of a file."""
    with can.LogReader(path) as reader:
        return list(reader)


def whole(frame: can.Message) -> tuple[object, ...]:
    """Returns all of a frame."""
    return (*fields(frame), frame.timestamp, frame.channel, frame.is_rx)


def log_line(frame: can.Message) -> str:
    """Returns the line of a frame with six digits in a candump log."""
    return f"({frame.timestamp:.6f}) {frame.channel} {candump_text(frame)} {'R' if frame.is_rx else 'T'}"


def contents(path: Path) -> tuple[object, ...]:
    """Returns what a recording says of itself: profile, metadata, and schema, topic and facts of each channel."""
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        channels = {
            (
                channel.topic,
                channel.message_encoding,
                tuple(sorted(channel.metadata.items())),
                summary.schemas[channel.schema_id].name,
                summary.schemas[channel.schema_id].encoding,
                summary.schemas[channel.schema_id].data,
            )
            for channel in summary.channels.values()
        }
        return reader.get_header().profile, channels


# The message


def test_definition_is_that_of_the_bench() -> None:
    """The text of the schema is the one that the bench writes."""
    if not DEFINITIONS.is_dir():
        pytest.skip("the definitions are in the source of the bench")
    names = ["skinbus_msgs/CanFrame", "std_msgs/Header", "builtin_interfaces/Time"]
    first, *others = [(DEFINITIONS / f"{name}.msg").read_text() for name in names]
    headed = [f"\n{'=' * 80}\nMSG: {name}\n{text}" for name, text in zip(names[1:], others, strict=True)]
    assert first + "".join(headed) == CAN_FRAME_DEFINITION


def test_layout_is_that_of_the_bench() -> None:
    """Each byte stands where the bench's own test has it."""
    frame = can.Message(
        arbitration_id=0x22C, is_extended_id=False, is_fd=True, bitrate_switch=True, data=b"\xaa\xbb", is_rx=False
    )
    encoded = FrameEncoder("vcan0").encode(frame, 5_000_000_007)
    assert encoded == bytes.fromhex(
        "00010000 05000000 07000000 06000000 7663616e30000000 2c020000 00000001 05020002 02000000 aabb"
    )
    back = FrameDecoder().decode(encoded, 5_000_000_007)
    assert (fields(back), back.channel, back.is_rx, back.timestamp) == (fields(frame), "vcan0", False, 5.000000007)


def test_broken_messages_are_refused() -> None:
    """Each cut and each wrong length is an error, never another frame."""
    encoded = FrameEncoder("vcan0").encode(can.Message(data=b"12345678"), 0)
    for end in range(len(encoded)):
        with pytest.raises(MessageError):
            FrameDecoder().decode(encoded[:end], 0)
    with pytest.raises(MessageError, match="begins with 00 00"):
        FrameDecoder().decode(b"\0\0" + encoded[2:], 0)


@pytest.mark.parametrize("scale", [1.0, 1e3, 1e6, 1e9, 4e9])
def test_times_come_back(scale: float) -> None:
    """A float of whole nanoseconds comes back as it was; whole microseconds keep six digits."""
    source = random.Random(scale)
    for _ in range(20_000):
        nanos = int(source.random() * scale * 1e9)
        seconds = nanos / 10**9
        assert from_nanos(to_nanos(seconds)) == seconds
        micros = nanos // 1000
        assert to_nanos(micros / 10**6) == micros * 1000


@pytest.mark.parametrize("seconds", [-1.0, float("nan"), float("inf"), 1e11])
def test_impossible_times_are_refused(seconds: float) -> None:
    """Times that a recording cannot have are errors."""
    with pytest.raises(ValueError, match="cannot be recorded"):
        to_nanos(seconds)


@pytest.mark.parametrize(
    "frame",
    [
        can.Message(is_fd=True, data=bytes(65)),
        can.Message(is_remote_frame=True, dlc=9),
        can.Message(is_remote_frame=True, is_fd=True, dlc=1),
        can.Message(arbitration_id=0x800, is_extended_id=False),
        can.Message(arbitration_id=1 << 29),
    ],
)
def test_impossible_frames_are_refused(frame: can.Message) -> None:
    """Frames that the bench would not read are errors, and the recording goes on."""
    file = io.BytesIO()
    writer = McapWriter(file)
    with pytest.raises(ValueError):  # noqa: PT011
        writer.on_message_received(frame)
    writer.on_message_received(can.Message())


def test_frames_of_other_readers_are_corrected() -> None:
    """CSV loses that a frame is FD, a PEAK trace its length, and ASC makes an empty FD frame a remote one."""
    frames = [
        can.Message(data=bytes(12)),
        can.Message(is_fd=True, data=bytes(12), dlc=9),
        can.Message(is_fd=True, is_remote_frame=True),
    ]
    back = [FrameDecoder().decode(FrameEncoder("can0").encode(frame, 0), 0) for frame in frames]
    assert [(frame.is_fd, frame.is_remote_frame, frame.dlc) for frame in back] == [
        (True, False, 12),
        (True, False, 12),
        (True, False, 0),
    ]


# With the bench


@pytest.mark.parametrize("is_fine", [False, True])
def test_bench_reads_what_is_written(tmp_path: Path, is_fine: bool) -> None:
    """`skinbus convert` and `skinbus dump` read each frame with nothing lost, as does the reader."""
    frames = sample(3000, seed=1, is_fine=is_fine)
    recording = write(tmp_path / "x.mcap", frames)
    assert [whole(frame) for frame in read(recording)] == [whole(frame) for frame in frames]
    log = tmp_path / "x.log"
    run([program_path("skinbus"), "convert", "--direction", "--strict", recording, log])
    lines = log.read_text().splitlines()
    assert [line.split(" ")[1:] for line in lines] == [log_line(frame).split(" ")[1:] for frame in frames]
    assert [float(line[1:].split(")")[0]) for line in lines] == [frame.timestamp for frame in frames]
    if not is_fine:
        assert lines == [log_line(frame) for frame in frames]
    shown = run([program_path("skinbus"), "dump", recording]).splitlines()
    assert [line.split("\t")[0].split(" ")[2] for line in shown] == [candump_text(frame) for frame in frames]


def test_recordings_of_the_bench_have_the_same_contents(tmp_path: Path) -> None:
    """What `skinbus convert` writes from the same frames has the same topics, schemas and facts."""
    frames = sample(500, seed=2)
    log = tmp_path / "x.log"
    log.write_text("".join(f"{log_line(frame)}\n" for frame in frames))
    run([program_path("skinbus"), "convert", log, tmp_path / "bench.mcap"])
    write(tmp_path / "own.mcap", frames)
    assert contents(tmp_path / "own.mcap") == contents(tmp_path / "bench.mcap")
    assert [whole(frame) for frame in read(tmp_path / "bench.mcap")] == [whole(frame) for frame in frames]


def test_notes_and_unknown_directions_of_a_log(tmp_path: Path) -> None:
    """Notes are skipped, a frame without direction counts as received, and a raw DLC is lost."""
    log = tmp_path / "x.log"
    log.write_text(
        "# a comment\n"
        "(1700000000.123456) can0 123#1122334455667788_E\n"
        "DROPCOUNT: dropped 12 CAN frames on 'can0' socket (total drops 40)\n"
        "(1700000000.123456789) notes 00000123##5AABB T\n"
    )
    run([program_path("skinbus"), "convert", log, tmp_path / "x.mcap"])
    first, second = read(tmp_path / "x.mcap")
    assert (first.channel, first.is_rx, first.dlc, first.timestamp) == ("can0", True, 8, 1700000000.123456)
    assert (second.channel, second.is_rx, second.bitrate_switch) == ("notes", False, True)
    # Its topic is not that of the notes.
    write(tmp_path / "again.mcap", [first, second])
    topics = {channel[0] for channel in contents(tmp_path / "again.mcap")[1]}  # type: ignore[attr-defined]
    assert topics == {"/can/can0", "/can/notes_2"}


def test_recording_of_a_run(tmp_path: Path) -> None:
    """Of a run's recording the frames of the buses are read, not its state and other topics."""
    skin, recording, log = (tmp_path / name for name in ("skin.toml", "run.mcap", "run.log"))
    run([program_path("skinbus"), "skin", "generate", "--cells", "4", "-o", skin])
    environment = {**os.environ, "SKINBUS_DIR": str(tmp_path / "buses")}
    command: list[str | Path] = [program_path("skinbus"), "run", skin, "--duration", "1", "--record", recording]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S)
    assert recording.exists(), done.stderr
    run([program_path("skinbus"), "convert", "--direction", recording, log])
    with can.LogReader(log) as reader:
        expected = [whole(frame) for frame in reader]
    assert [whole(frame) for frame in read(recording)] == expected
    assert len(expected) > 100


def test_many_buses_share_a_topic(tmp_path: Path) -> None:
    """From the 65th channel on, frames are on one topic, and keep the names of their buses."""
    frames = [can.Message(timestamp=START_S, channel=f"bus{number % 80}", data=b"1") for number in range(160)]
    recording = write(tmp_path / "x.mcap", frames)
    assert [frame.channel for frame in read(recording)] == [frame.channel for frame in frames]
    channels = contents(recording)[1]
    assert len(channels) == 65  # type: ignore[arg-type]
    assert "/can/further" in {channel[0] for channel in channels}  # type: ignore[attr-defined]
    run([program_path("skinbus"), "convert", recording, tmp_path / "x.log"])
    assert [frame.channel for frame in read(tmp_path / "x.log")] == [frame.channel for frame in frames]


# The file


def test_channels_of_other_interfaces_become_buses(tmp_path: Path) -> None:
    """Numbers and missing channels have the names that python-can's log writer gives them."""
    channels: list[str | int | None] = ["vcan0", 3, "4", None, "a\0b"]
    recording = write(tmp_path / "x.mcap", [can.Message(channel=channel) for channel in channels])
    assert [frame.channel for frame in read(recording)] == ["vcan0", "can3", "can4", "vcan0", "a_b"]


def test_recording_gets_its_name_when_it_is_complete(tmp_path: Path) -> None:
    """An earlier file stays until then; an earlier one without its end stays for ever."""
    path, part = tmp_path / "x.mcap", tmp_path / "x.mcap.part"
    path.write_text("before")
    part.write_text("not complete")
    writer = McapWriter(path)
    writer.on_message_received(can.Message(timestamp=START_S))
    assert path.read_text() == "before"
    writer.stop()
    writer.stop()
    assert len(read(path)) == 1
    assert sorted(file.name for file in tmp_path.iterdir()) == ["x.mcap", "x.mcap.part"]
    assert part.read_text() == "not complete"
    with pytest.raises(ValueError, match="has ended"):
        writer.on_message_received(can.Message())


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    """A recording with contents is not continued, and folders are refused; a link stays one."""
    path = write(tmp_path / "x.mcap", [can.Message()])
    with pytest.raises(ValueError, match="cannot be continued"):
        can.Logger(path, append=True)
    with pytest.raises(OSError, match="is not a regular file"):
        McapWriter(tmp_path)
    with pytest.raises(FileNotFoundError):
        McapWriter(tmp_path / "missing" / "x.mcap")
    link = tmp_path / "link.mcap"
    link.symlink_to(path)
    write(link, [can.Message(), can.Message()])
    assert link.is_symlink()
    assert len(read(path)) == 2
    can.Logger(tmp_path / "new.mcap", append=True).stop()
    assert read(tmp_path / "new.mcap") == []


def test_files_that_are_open_already(tmp_path: Path) -> None:
    """A reader and a writer take open files, compressed ones too."""
    frames = sample(200, seed=3)
    recording = write(tmp_path / "x.mcap", frames)
    compressed = write(tmp_path / "y.mcap.gz", frames)
    with gzip.open(compressed) as file:
        assert [whole(frame) for frame in McapReader(io.BytesIO(file.read()))] == [whole(frame) for frame in frames]
    with McapReader(io.BytesIO(recording.read_bytes())) as reader:
        assert [whole(frame) for frame in reader] == [whole(frame) for frame in frames]


def test_killed_writer_loses_a_second(tmp_path: Path) -> None:
    """What was written before survives in a file that is read as it is, and that `skinbus recover` repairs."""
    script = (
        "import can, sys, time\n"
        "writer = can.Logger(sys.argv[1])\n"
        "for number in range(100_000):\n"
        "    writer.on_message_received(can.Message(timestamp=time.time(), arbitration_id=number))\n"
        "    time.sleep(0.01)\n"
    )
    path, part = tmp_path / "x.mcap", tmp_path / "x.mcap.part"
    program = subprocess.Popen([sys.executable, "-c", script, path])
    try:
        wait_until(lambda: part.exists() and part.stat().st_size > 2000)
    finally:
        program.send_signal(signal.SIGKILL)
        program.wait(TIMEOUT_S)
    assert not path.exists()
    with McapReader(part) as reader:
        numbers = [frame.arbitration_id for frame in reader]
    assert numbers == list(range(len(numbers)))
    assert len(numbers) > 30
    run([program_path("skinbus"), "recover", part, "-o", path])
    assert [frame.arbitration_id for frame in read(path)] == numbers


def test_cut_files_are_read_as_far_as_they_go(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Each file without its end gives the first frames, and a warning unless only the summary is missing."""
    frames = sample(20_000, seed=4)
    whole_file = write(tmp_path / "x.mcap", frames).read_bytes()
    expected = [whole(frame) for frame in frames]
    source = random.Random(5)
    for cut in [9, 40, *(source.randrange(50, len(whole_file)) for _ in range(10))]:
        caplog.clear()
        with McapReader(io.BytesIO(whole_file[:cut])) as reader:
            got = [whole(frame) for frame in reader]
        assert got == expected[: len(got)]
        assert len(got) == len(expected) or caplog.messages == [
            "the recording: its end is missing: only the existing part is read"
        ]


def test_damaged_files_are_reported(tmp_path: Path) -> None:
    """Any changed byte gives the frames before it, all frames, or an error that names the remedy."""
    frames = sample(5000, seed=6)
    intact = write(tmp_path / "x.mcap", frames).read_bytes()
    expected = [whole(frame) for frame in frames]
    source = random.Random(7)
    errors: list[str] = []
    for _ in range(100):
        damaged = bytearray(intact)
        damaged[source.randrange(8, len(intact))] ^= 1 << source.randrange(8)
        got: list[tuple[object, ...]] = []
        try:
            got.extend(whole(frame) for frame in McapReader(io.BytesIO(damaged)))
        except McapReadError as failure:
            errors.append(str(failure))
        assert got == expected[: len(got)]
    assert len(errors) > 50
    assert {error.rsplit(": ", 1)[1] for error in errors} == {
        "`skinbus recover the recording -o NEW.mcap` saves what is intact"
    }
    with pytest.raises(McapReadError, match="is not an MCAP recording"):
        list(McapReader(io.BytesIO(b"LOGG" + bytes(100))))


# Other formats


def survives_itself(frame: can.Message, suffix: str) -> bool:
    """Returns whether python-can writes and reads a frame as one of the same kind in another format."""
    is_empty_fd = frame.is_fd and not frame.data
    return not (suffix == ".asc" and is_empty_fd) and not (suffix == ".trc" and frame.is_error_frame)


@pytest.mark.parametrize("suffix", [".blf", ".asc", ".trc", ".csv", ".log", ".db"])
def test_other_formats_lose_nothing_in_between(tmp_path: Path, suffix: str) -> None:
    """A file becomes the same by way of a recording as by python-can alone, whatever the other format loses."""
    frames = [frame for frame in sample(2000, seed=8) if survives_itself(frame, suffix)]
    original = write(tmp_path / f"original{suffix}", frames)
    direct = write(tmp_path / f"direct{suffix}", read(original))
    recording = write(tmp_path / "x.mcap", read(original))
    indirect = write(tmp_path / f"indirect{suffix}", read(recording))
    assert [whole(frame) for frame in read(indirect)] == [whole(frame) for frame in read(direct)]


def test_recordings_are_converted_by_python_can(tmp_path: Path) -> None:
    """`can.logconvert` takes recordings as input and output."""
    frames = sample(100, seed=9)
    recording = write(tmp_path / "x.mcap", frames)
    for source, target in [("x.mcap", "x.blf"), ("x.blf", "y.mcap")]:
        run([sys.executable, "-m", "can.logconvert", tmp_path / source, tmp_path / target])
    assert [fields(frame) for frame in read(tmp_path / "y.mcap")] == [fields(frame) for frame in read(recording)]
