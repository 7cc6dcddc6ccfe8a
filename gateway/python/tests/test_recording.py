"""`skinbus.read`, compared with `skinbus convert` and `skinbus dump`."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import skinbus
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
    assert again.index == recording.index == tmp_path / "split-1.mcap+2.columns"
    assert len(read(parts[0]).epochs()) < 150


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
    with pytest.raises(ReadFailed, match="it is a folder of other files"):
        read(file)


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
        epochs = recording.epochs()
        folder = recording.index
        assert folder.exists()
    assert not folder.exists()
    assert not folder.parent.exists()
    assert len(epochs) == 100
    assert np.any(epochs.central != 0), "arrays in use stay valid"
    assert os.listdir(tmp_path) == ["fd.mcap"]


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
