"""`skinbus.read`, compared with `skinbus convert` and `skinbus dump`."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import skinbus
from skinbus import _recording_index
from skinbus.recording import ReadFailed, Recording, read

RECORDINGS = Path(__file__).parents[3] / "tests" / "recordings"


def run(*words: str | Path) -> str:
    """Runs the program and returns its standard output."""
    command = [skinbus.program_path("skinbus"), *words]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a run of three seconds."""
    folder = tmp_path_factory.mktemp("demo")
    environment = os.environ | {"SKINBUS_DIR": str(folder / "bus")}
    (folder / "bus").mkdir(mode=0o700)
    words = ["demo", "--duration", "3", "--record", str(folder / "run.mcap")]
    command = [str(skinbus.program_path("skinbus")), *words]
    subprocess.run(command, check=True, capture_output=True, env=environment, cwd=folder)
    return folder / "run.mcap"


def copied(folder: Path, *names: str) -> list[Path]:
    return [Path(shutil.copy(RECORDINGS / name, folder)) for name in names]


def wait_until(is_true: Callable[[], bool], limit: float = 20.0) -> None:
    """Waits for a state."""
    end = time.monotonic() + limit
    while not is_true():
        assert time.monotonic() < end
        time.sleep(0.02)


def attached_skin(recording: Path) -> bytes:
    """Returns the skin in a recording: an attachment is a name, a type and its bytes, each behind its length."""
    text = recording.read_bytes()
    at = text.index(b"\x09\0\0\0skin.toml") + 13
    at += 4 + int.from_bytes(text[at : at + 4], "little")
    length = int.from_bytes(text[at : at + 8], "little")
    return text[at + 8 : at + 8 + length]


def check_against_csv(recording: Recording, table: Path) -> None:
    """Compares all values of the epochs with those of the CSV file."""
    epochs = recording.epochs()
    with table.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(epochs) > 0
    columns: dict[str, Any] = {
        "epoch": epochs.epoch,
        "open_cells": epochs.open_cells,
        "saturated_cells": epochs.saturated_cells,
    }
    for at, (name, (position, torque)) in enumerate(zip(epochs.names, epochs.units, strict=True)):
        columns[f"position_{name}_{position}"] = epochs.positions[:, at]
        columns[f"distributed_{name}_{torque}"] = epochs.distributed[:, at]
        columns[f"central_{name}_{torque}"] = epochs.central[:, at]
        columns[f"error_{name}_{torque}"] = epochs.error[:, at]
    assert {"time_s", *columns} == set(rows[0])
    for name, values in columns.items():
        expected = np.array([float(row[name] or "nan") for row in rows])
        np.testing.assert_array_equal(np.asarray(values, dtype=np.float64), expected, err_msg=name)
    seconds = [f"{(at - recording.began_ns) / 1e9:.9f}" for at in epochs.at_ns.tolist()]
    assert seconds == [row["time_s"] for row in rows]


def check_against_dump(recording: Recording, lines: list[dict[str, Any]]) -> None:
    """Compares frames, torques and sums with the lines of `skinbus dump --json`."""
    frames = recording.frames()
    assert len(frames) == len(lines) == recording.accounts.frames > 0
    torques: Counter[str] = Counter()
    for row, line in enumerate(lines):
        assert recording.buses[frames.bus[row]] == line["bus"]
        separator = f"##{frames.flags[row] >> 4 | 4}" if frames.flags[row] & 8 else "#"
        assert line["raw"] == f"{frames.id[row]:03X}{separator}{frames.payload(row).hex().upper()}"
        assert line["time_ns"] == frames.at_ns[row]
        assert line["direction"] == "-RT"[frames.direction[row]]
        torques[f"{line['bus']}:{line.get('node')}"] += line.get("kind") == "torque"
    sent = {cell.cell: cell.torques for cell in recording.accounts.cells if cell.torques}
    assert sent == {cell: count for cell, count in torques.items() if count}


def check_sums_of_cells(recording: Recording) -> None:
    """Compares the sums of all used torques with the distributed torques."""
    epochs = recording.epochs()
    total = np.zeros(epochs.distributed.shape)
    for cell in recording.cells:
        torques = recording.torques(str(cell))
        used = torques.used
        joints = [recording.joint_names.index(name) for name in torques.names]
        np.add.at(total, (torques.epoch_row[used][:, None], np.array(joints)[None]), torques.values[used])
    np.testing.assert_array_equal(total, epochs.distributed)
    assert np.any(total != 0)


def test_a_run_has_the_values_of_the_csv_file_and_of_the_dump(demo: Path, tmp_path: Path) -> None:
    run("convert", demo, tmp_path / "torques.csv")
    recording = read(demo)
    check_against_csv(recording, tmp_path / "torques.csv")
    check_sums_of_cells(recording)
    lines = [json.loads(line) for line in run("dump", demo, "--json").splitlines()]
    check_against_dump(recording, lines)
    assert recording.index == demo.with_name("run.mcap.columns")
    assert recording.metadata["program"]["program"]
    assert recording.unfinished is None


@pytest.mark.parametrize("name", ["fd", "classic", "two", "sums"])
def test_kept_recordings_have_the_values_of_the_csv_file(name: str, tmp_path: Path) -> None:
    (file,) = copied(tmp_path, f"{name}.mcap")
    run("convert", file, tmp_path / "torques.csv")
    recording = read(file)
    check_against_csv(recording, tmp_path / "torques.csv")
    if name == "sums":
        sums = [recording.sums(str(cell)) for cell in recording.cells]
        assert sum(len(it) for it in sums) == sum(bus.sums for bus in recording.accounts.buses) > 0
        assert all(it.step == 1 / 256 for it in sums)
        assert np.all(np.isnan(recording.epochs().distributed))
    else:
        check_sums_of_cells(recording)


def test_parts_are_one_recording_in_any_order(tmp_path: Path) -> None:
    parts = copied(tmp_path, "split.mcap", "split-1.mcap", "split-2.mcap")
    run("convert", *parts, tmp_path / "torques.csv")
    recording = read(*reversed(parts))
    check_against_csv(recording, tmp_path / "torques.csv")
    assert len(recording.epochs()) == 150
    again = read(parts[1], parts[2], parts[0])
    assert again.index == recording.index
    assert re.fullmatch(r"split-1\.mcap\+2-[0-9a-f]{8}\.columns", recording.index.name)
    assert len(read(parts[0]).epochs()) < 150


def test_captures_with_the_same_first_file_have_their_own_indexes(tmp_path: Path) -> None:
    one, two, three = (tmp_path / name for name in ("a.mcap", "b.mcap", "c.mcap"))
    names = {_recording_index._index_path(files) for files in ([one], [one, two], [one, three], [one, two, three])}
    assert len(names) == 4
    assert _recording_index._index_path([one, two]) == _recording_index._index_path([one, tmp_path / "." / "b.mcap"])


def test_a_log_needs_a_skin(tmp_path: Path, demo: Path) -> None:
    log, skin = tmp_path / "run.log", tmp_path / "skin.toml"
    run("convert", demo, log)
    with pytest.raises(ReadFailed, match=r"run.log contains no skin: name one with skin="):
        read(log)
    skin.write_bytes(attached_skin(demo))
    recording = read(log, skin=skin)
    np.testing.assert_array_equal(recording.frames().at_ns, read(demo).frames().at_ns)
    np.testing.assert_array_equal(recording.epochs().central, read(demo).epochs().central)
    made = recording.index.stat().st_ino
    assert read(log, skin=skin).index.stat().st_ino == made, "the index is used again"
    os.utime(skin, ns=(1, 1))
    assert read(log, skin=skin).index.stat().st_ino != made, "the skin was changed"


def test_ranges_of_times_have_their_start_but_not_their_end(demo: Path) -> None:
    recording = read(demo)
    frames = recording.frames()
    start, end = int(frames.at_ns[100]), int(frames.at_ns[200])
    chosen = recording.frames(start, end)
    expected = (frames.at_ns >= start) & (frames.at_ns < end)
    np.testing.assert_array_equal(chosen.at_ns, frames.at_ns[expected])
    np.testing.assert_array_equal(chosen.begins, frames.begins[expected])
    assert chosen.payload(0) == frames.payload(int(np.argmax(expected)))
    cell = str(max(recording.cells, key=lambda it: len(recording.torques(str(it)))))
    torques = recording.torques(cell)
    middle = int(torques.at_ns[len(torques) // 2])
    before, after = recording.torques(cell, end_ns=middle), recording.torques(cell, start_ns=middle)
    assert len(before) + len(after) == len(torques) > 1
    assert len(recording.torques(cell, middle, middle - 1)) == 0
    assert len(recording.epochs(recording.began_ns, recording.began_ns + 1_000_000_000)) in range(60, 66)
    (bus, *_) = recording.buses
    assert len(recording.frames(bus=bus)) == recording.accounts.buses[0].frames


def test_times_that_run_backwards_are_chosen_too(tmp_path: Path) -> None:
    (file,) = copied(tmp_path, "fd.mcap")
    recording = read(file)
    times = np.array(recording.frames().at_ns)
    recording._columns["frames.at_ns"] = np.concatenate([times[200:], times[:200]])
    chosen = recording.frames(int(times[100]), int(times[300]))
    assert len(chosen) == 200
    assert len(recording.frames(int(times[100]), int(times[300]), bus="vcan0")) == 200


@pytest.mark.parametrize("name", ["fd", "classic", "two"])
def test_contacts_cover_the_times_in_which_a_cell_answers(name: str, tmp_path: Path) -> None:
    recording = read(*copied(tmp_path, f"{name}.mcap"))
    contacts = recording.contacts()
    assert len(contacts) > 0
    assert np.all(contacts.end_ns >= contacts.begin_ns)
    assert np.nanmax(contacts.peak_force) > 0
    for cell in recording.cells:
        torques, own = recording.torques(str(cell)), recording.contacts(str(cell))
        answered = recording.joints(cell.bus).at_ns[torques.joints_row[torques.used]]
        inside = (answered[:, None] >= own.begin_ns) & (answered[:, None] <= own.end_ns)
        assert np.all(inside.any(axis=1)), cell


def test_the_index_is_used_again_until_the_file_changes(tmp_path: Path) -> None:
    (file,) = copied(tmp_path, "fd.mcap")
    made = read(file).index.stat().st_ino
    assert read(file).index.stat().st_ino == made
    os.utime(file, ns=(1, 1))
    assert read(file).index.stat().st_ino != made
    (tmp_path / "fd.mcap.columns" / "columns.json").write_text("{")
    with pytest.raises(ReadFailed, match="the folder contains other files"):
        read(file)


@pytest.mark.parametrize("small", [0, 1 << 30])
def test_an_open_recording_stays_when_its_index_is_replaced(
    small: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_recording_index, "_SMALL_BYTES", small)
    file, other = copied(tmp_path, "fd.mcap", "two.mcap")
    expected, cells = read(other, index=False), [str(cell) for cell in read(other).cells]
    recording = read(other)
    shutil.copy(file, other)
    assert read(other).index == recording.index
    assert len(read(other).epochs()) != len(expected.epochs()) or read(other).cells != recording.cells
    np.testing.assert_array_equal(recording.epochs().central, expected.epochs().central)
    for cell in cells:
        np.testing.assert_array_equal(recording.torques(cell).values, expected.torques(cell).values)


def test_an_index_that_is_replaced_while_it_is_mapped_is_mapped_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, other = copied(tmp_path, "fd.mcap", "two.mcap")
    place, next_one = read(file).index, read(other).index
    count = len(list(place.glob("*.npy")))
    load, replacements = _recording_index._load_column, [1, count + 5]

    def replaced(column: Path) -> np.ndarray[Any, Any]:
        loaded = load(column)
        replacements[0] -= 1
        if replacements[0] == 0:
            place.rename(tmp_path / "old")
            next_one.rename(place)
            (tmp_path / "old").rename(next_one)
            replacements.pop(0)
            replacements.append(1 << 30)
        return loaded

    monkeypatch.setattr(_recording_index, "_load_column", replaced)
    # Replaced in the first and the second attempt.
    index = _recording_index.load_index(place)
    assert index.description == json.loads((place / "columns.json").read_text())
    assert set(index.columns) == {path.stem for path in place.glob("*.npy")}
    for name, column in index.columns.items():
        np.testing.assert_array_equal(column, np.load(place / f"{name}.npy"))
    replacements[:] = [1, count, count]
    with pytest.raises(ReadFailed, match=r"other programs replaced .* while it was read"):
        _recording_index.load_index(place)


def test_many_recordings_need_few_file_descriptors(tmp_path: Path) -> None:
    (file,) = copied(tmp_path, "fd.mcap")
    before = len(os.listdir("/proc/self/fd"))
    recordings = [read(file) for _ in range(20)]
    assert len(os.listdir("/proc/self/fd")) - before < len(recordings)


def test_an_index_of_another_version_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (file,) = copied(tmp_path, "fd.mcap")
    place = read(file).index / "columns.json"
    description = json.loads(place.read_text())
    version = _recording_index.program_version()
    assert description["program"] == version
    # The program may be one with the format of an earlier version.
    monkeypatch.setattr(_recording_index, "FORMAT_VERSION", description["skinbus_columns"])
    made = place.stat().st_ino
    read(file)
    assert place.stat().st_ino == made
    place.write_text(json.dumps(description | {"program": "0.0.1"}))
    read(file)
    assert json.loads(place.read_text()) == description
    for key, value in {"program": "0.0.1", "skinbus_columns": 0}.items():
        place.write_text(json.dumps(description | {key: value}))
        monkeypatch.setattr(_recording_index, "program_version", lambda: None)
        read(file)
        assert json.loads(place.read_text()).get(key) == (value if key == "program" else description[key])


def test_a_version_that_is_not_available_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SKINBUS_PROGRAMS", str(tmp_path))
    assert _recording_index.program_version() is None
    for text, expected in {"exit 1": None, "echo skinbus 7.8.9": "7.8.9", "echo another 1": None}.items():
        folder = tmp_path / text.replace(" ", "-")
        folder.mkdir()
        (folder / "skinbus").write_text(f"#!/bin/sh\n{text}\n")
        (folder / "skinbus").chmod(0o755)
        monkeypatch.setenv("SKINBUS_PROGRAMS", str(folder))
        assert _recording_index.program_version() == expected


def test_a_damaged_index_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (file,) = copied(tmp_path, "fd.mcap")
    index = read(file).index
    description = json.loads((index / "columns.json").read_text())
    monkeypatch.setattr(_recording_index, "FORMAT_VERSION", description["skinbus_columns"])
    for damage in (b"", b"\x93NUMPY\x01\0"):
        (index / "frames.id.npy").write_bytes(damage)
        assert len(read(file).frames().id) == 431
    (index / "frames.id.npy").unlink()
    with pytest.raises(ReadFailed, match=r"lacks frames.id.npy: remove this folder"):
        read(file).frames()


def test_an_interrupted_conversion_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (file,) = copied(tmp_path, "fd.mcap")

    def interrupted(process: subprocess.Popen[bytes]) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess.Popen, "communicate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        read(file)
    monkeypatch.undo()
    assert not [name for name in os.listdir(tmp_path) if name.endswith(".part")]


def test_notes_of_the_conversion_are_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (file,) = copied(tmp_path, "sums.mcap")
    with caplog.at_level("INFO", logger="skinbus"):
        read(file)
    assert "the cells on vcan0 answer with sums" in caplog.text


def test_without_an_index_nothing_stays(tmp_path: Path) -> None:
    (file,) = copied(tmp_path, "fd.mcap")
    with read(file, index=False) as recording:
        assert not recording.index.parent.exists()
        epochs = recording.epochs()
    with pytest.raises(ValueError, match="the recording is closed"):
        recording.epochs()
    assert len(epochs) == 100
    assert np.any(epochs.central != 0), "arrays in use stay valid"
    assert os.listdir(tmp_path) == ["fd.mcap"]


def test_without_an_index_nothing_stays_of_a_process_that_is_killed(tmp_path: Path) -> None:
    (file,) = copied(tmp_path, "fd.mcap")
    temporary, programs = tmp_path / "temporary", tmp_path / "programs"
    temporary.mkdir()
    programs.mkdir()
    # A conversion that lasts.
    (programs / "skinbus").write_text('#!/bin/sh\nfor place; do :; done\nmkdir "$place"; exec sleep 2\n')
    (programs / "skinbus").chmod(0o755)
    environment = os.environ | {"TMPDIR": str(temporary), "SKINBUS_PROGRAMS": str(programs)}
    script = f"import skinbus; skinbus.read({str(file)!r}, index=False)"
    process = subprocess.Popen([sys.executable, "-c", script], env=environment)
    wait_until(lambda: list(temporary.glob("skinbus-*/recording.columns")) != [])
    process.kill()
    process.wait()
    wait_until(lambda: os.listdir(temporary) == [])


def test_the_index_of_a_folder_that_is_not_writable_is_in_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sealed = tmp_path / "sealed"
    sealed.mkdir()
    (file,) = copied(sealed, "fd.mcap")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: path != sealed and access(path, mode))
    recording = read(file)
    assert recording.index.parent == tmp_path / "cache" / "skinbus"
    assert read(file).index == recording.index
    assert os.listdir(sealed) == ["fd.mcap"]


def test_a_recording_without_its_end_is_read_up_to_there(tmp_path: Path) -> None:
    (file,) = copied(tmp_path, "fd.mcap")
    part = tmp_path / "cut.mcap.part"
    part.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    shutil.copy(file, tmp_path / "skin.mcap")
    recording = read(part)
    assert recording.unfinished is not None
    assert 0 < len(recording.epochs()) < 100


def test_what_cannot_be_read_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "empty.log").touch()
    (file,) = copied(tmp_path, "fd.mcap")
    with pytest.raises(ReadFailed, match=r"empty.log: the file is empty"):
        read(tmp_path / "empty.log")
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "none.mcap")
    with pytest.raises(TypeError, match="name the recording"):
        read()
    recording = read(file)
    with pytest.raises(KeyError, match="the skin has no cell vcan0:250; one of its cells is vcan0:1"):
        recording.torques(250)
    with pytest.raises(KeyError, match="the recording has no bus 'can9'; its buses are vcan0"):
        recording.torques("can9:1")
    with pytest.raises(ValueError, match='is not a cell: name it as "BUS:NODE"'):
        recording.torques("left")


def test_arrays_are_read_only(tmp_path: Path) -> None:
    (file,) = copied(tmp_path, "fd.mcap")
    epochs = read(file).epochs()
    with pytest.raises(ValueError, match="read-only"):
        epochs.central[0] = 1.0


def test_tables_of_pandas_have_the_same_values(demo: Path, tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    run("convert", demo, tmp_path / "torques.csv")
    recording = read(demo)
    table = recording.to_pandas()
    with (tmp_path / "torques.csv").open() as file:
        assert list(table.columns) == next(csv.reader(file))[1:]
    name = table.columns[2]
    np.testing.assert_array_equal(table[name], recording.epochs().distributed[:, 0])
    assert table.index[0] == pandas.Timestamp(int(recording.epochs().at_ns[0]), tz="UTC")
    cell = str(recording.cells[0])
    for it in (
        recording.frames(),
        recording.notes(),
        recording.joints(),
        recording.torques(cell),
        recording.sums(cell),
        recording.contacts(),
    ):
        assert len(it.to_pandas()) == len(it)
