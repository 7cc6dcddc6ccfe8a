"""`skinbus.to_rerun`: the file that it writes is read back by Rerun, and compared with `skinbus.read`."""

from __future__ import annotations

import itertools
import os
import re
import signal
import struct
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

import skinbus
from skinbus._ros2 import Reader

rr = pytest.importorskip("rerun", reason='rerun-sdk is not installed: pip install "skinbus[rerun]"')
from skinbus._rerun_live import LiveLog  # noqa: E402
from skinbus._rerun_topics import Log, Topics  # noqa: E402
from skinbus._rerun_view import eye, finish, unit_names  # noqa: E402
from skinbus._scene import Link  # noqa: E402

RECORDINGS = Path(__file__).parents[3] / "tests" / "recordings"
# Colours of cells without a force, with an unknown one, and of silent cells.
QUIET, UNKNOWN, DEAD = 0x46648CFF, 0x919191FF, 0xCD3CBEFF
SKIN = Path(__file__).parents[3] / "gateway" / "examples" / "ur5-253.toml"


class Logged:
    """The columns of a file of Rerun, by entity."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        self._rows: dict[str, dict[str, list[tuple[int, int, Any]]]] = {}
        self._static: dict[str, dict[str, list[Any]]] = {}
        self.chunks = Counter[str]()
        for chunk in RrdReader(path).stream():
            batch = chunk.to_record_batch()
            self.chunks[chunk.entity_path] += 1
            # Times in ns have no equal in Python.
            times = {
                name: batch.column(name).cast("int64").to_pylist()
                for name in batch.schema.names
                if name in ("time", "run")
            }
            for name in batch.schema.names:
                # Other columns have no component, such as times and row ids.
                if ":" not in name:
                    continue
                values = batch.column(name)
                if chunk.is_static:
                    self._static.setdefault(chunk.entity_path, {}).setdefault(name, []).extend(values.to_pylist())
                    continue
                rows = zip(times["time"], times["run"], values.to_pylist(), strict=True)
                components = self._rows.setdefault(chunk.entity_path, {})
                components.setdefault(name, []).extend(row for row in rows if row[2] is not None)

    @property
    def entities(self) -> set[str]:
        """The entities with values that change."""
        return set(self._rows)

    @property
    def static(self) -> set[str]:
        """The entities with values that never change."""
        return set(self._static)

    def static_values(self, entity: str, component: str) -> list[Any]:
        """Returns the values of a component that never change."""
        return self._static[entity][component]

    def times(self, entity: str) -> NDArray[np.int64]:
        """Returns the times of an entity in ns since 1970, without those at which it is cleared."""
        return np.array([at_ns for at_ns, _, _ in self._first_rows(entity)], np.int64)

    def runs(self, entity: str) -> NDArray[np.int64]:
        """Returns the same times in ns since the beginning of the run."""
        return np.array([run_ns for _, run_ns, _ in self._first_rows(entity)], np.int64)

    def cleared_at(self, entity: str) -> int:
        """Returns the last time in ns since 1970 at which an entity and all below it are cleared."""
        at_ns, _, is_recursive = self._rows[entity]["Clear:is_recursive"][-1]
        assert is_recursive == [True]
        return at_ns

    def _first_rows(self, entity: str) -> list[tuple[int, int, Any]]:
        """Returns the rows of the first component."""
        return next(rows for name, rows in self._rows[entity].items() if not name.startswith("Clear:"))

    def values(self, entity: str, component: str) -> list[Any]:
        """Returns the values of a component, one list of instances for each time."""
        return [value for _, _, value in self._rows[entity][component]]

    def shown(self, entity: str, component: str, at_ns: np.int64) -> Any:
        """Returns what a viewer shows of a component at a time: the last value until then."""
        return max((row for row in self._rows[entity][component] if row[0] <= at_ns), key=lambda row: row[0])[2]

    def scalars(self, entity: str) -> NDArray[np.float64]:
        """Returns the scalars of all times: [n] of entities with one series, otherwise [n, series]."""
        scalars = np.array(self.values(entity, "Scalars:scalars"), np.float64)
        return scalars[:, 0] if scalars.shape[1] == 1 else scalars


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a run of three seconds."""
    folder = tmp_path_factory.mktemp("demo")
    environment = os.environ | {"SKINBUS_DIR": str(folder / "bus")}
    (folder / "bus").mkdir(mode=0o700)
    command = [str(skinbus.program_path("skinbus")), "demo", "--duration", "3", "--record", str(folder / "run.mcap")]
    subprocess.run(command, check=True, capture_output=True, env=environment, cwd=folder)
    return folder / "run.mcap"


@pytest.fixture(scope="module")
def logged(demo: Path, tmp_path_factory: pytest.TempPathFactory) -> Logged:
    path = tmp_path_factory.mktemp("rerun") / "run.rrd"
    skinbus.to_rerun(demo, save=path)
    return Logged(path)


def test_the_series_are_those_of_read(demo: Path, logged: Logged) -> None:
    with skinbus.read(demo) as recording:
        epochs = recording.epochs()
        assert len(epochs) > 30
        for entity, expected in (
            ("/joints", epochs.positions),
            ("/torques/distributed", epochs.distributed),
            ("/torques/central", epochs.central),
            ("/torques/difference", np.where(epochs.open_cells[:, np.newaxis] > 0, np.nan, epochs.error)),
        ):
            np.testing.assert_array_equal(logged.times(entity), epochs.at_ns)
            np.testing.assert_array_equal(logged.scalars(entity), expected)


def test_contacts_are_those_of_read(demo: Path, logged: Logged) -> None:
    with skinbus.read(demo) as recording:
        contacts = recording.contacts()
        texts = [text for (text,) in logged.values("/contacts", "TextLog:text")]
        ended = int(np.count_nonzero(contacts.ended))
        assert len(contacts) > 0
        assert sum(text.endswith(" is touched") for text in texts) == len(contacts)
        assert sum(" is no longer touched" in text for text in texts) == ended
        assert logged.scalars("/contacts/count")[-1] == len(contacts) - ended


def test_cells_and_forces_are_where_the_recording_has_them(demo: Path, logged: Logged) -> None:
    patches = {entity for entity in logged.entities if entity.startswith("/robot/cells/")}
    with skinbus.read(demo) as recording:
        cells = sum(len(logged.values(entity, "Points3D:positions")[0]) for entity in patches)
        assert cells == len(recording.cells)
    touched = 0
    for entity in patches:
        forces = entity.replace("/cells/", "/forces/")
        ((radius,),) = logged.static_values(entity, "Points3D:radii")
        assert 0.003 < radius < 0.015
        every = zip(
            logged.values(entity, "Points3D:positions"),
            logged.values(entity, "Points3D:colors"),
            logged.values(forces, "Arrows3D:origins"),
            logged.values(forces, "Arrows3D:vectors"),
            strict=True,
        )
        for positions, colors, origins, vectors in every:
            assert len(colors) == len(positions)
            assert len(vectors) == len(origins) == sum(color not in (QUIET, UNKNOWN) for color in colors)
            for origin, vector in zip(origins, vectors, strict=True):
                # An arrow ends at the surface of its cell, in the direction of the cell.
                tip, direction = np.array(origin) + np.array(vector), np.array(vector) / np.linalg.norm(vector)
                distances = np.linalg.norm(np.array(positions) - (tip + direction * radius), axis=1)
                assert distances.min() < 1e-5
                touched += 1
        assert {entity, forces} <= logged.static
    assert touched > 0


def test_links_move_with_the_joints(logged: Logged) -> None:
    every = logged.values("/robot/links", "LineStrips3D:strips")
    assert len(every) > 20
    assert all(len(strips) == 6 for strips in every)
    lengths = [np.concatenate([np.linalg.norm(np.diff(strip, axis=0), axis=1) for strip in strips]) for strips in every]
    np.testing.assert_allclose(lengths, np.broadcast_to(lengths[0], (len(lengths), len(lengths[0]))), atol=1e-6)
    # The two links with cells run along the axis of their cells.
    assert sorted(len(strip) for strip in every[0]) == [2, 2, 2, 2, 4, 4]


def test_cells_have_names_and_forces(demo: Path, logged: Logged) -> None:
    with skinbus.read(demo) as recording:
        names = {str(cell) for cell in recording.cells}
    patches = [entity for entity in logged.entities if entity.startswith("/robot/cells/")]
    labels = [label for entity in patches for label in logged.values(entity, "Points3D:labels")[-1]]
    assert {label.split(", ")[0] for label in labels} == names
    assert all(re.fullmatch(r"\S+, (\d+\.\d\d N|force unknown|silent)", label) for label in labels)
    assert all(logged.static_values(entity, "Points3D:show_labels") == [[False]] for entity in patches)
    # Only changes are sent.
    for entity in patches:
        sent = logged.values(entity, "Points3D:labels")
        assert 1 <= len(sent) < len(logged.times(entity))
        assert all(before != after for before, after in itertools.pairwise(sent))


def test_a_recording_has_a_name_and_a_beginning(demo: Path, logged: Logged) -> None:
    with skinbus.read(demo) as recording:
        assert ["run.mcap"] in logged.static_values("/__properties", "RecordingInfo:name")
        assert [recording.began_ns] in logged.static_values("/__properties", "RecordingInfo:start_time")


def test_a_joint_has_one_colour_and_its_name_in_all_views(logged: Logged) -> None:
    names = [f"joint{at}" for at in range(1, 7)]
    entities = ["/joints", "/torques/distributed", "/torques/difference"]
    assert all(logged.static_values(entity, "SeriesLines:names") == [names] for entity in entities)
    every = [logged.static_values(entity, "SeriesLines:colors")[0] for entity in entities]
    assert len(set(every[0])) == 6
    assert every[1:] == every[:-1]


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a bench whose cell 12 is touched, dies and comes back."""
    path = tmp_path_factory.mktemp("faulty") / "run.mcap"
    with skinbus.Bench(SKIN, record=path) as bench:
        cell_dies_and_is_back(bench)
    return path


def cell_dies_and_is_back(bench: skinbus.Bench) -> None:
    bench.press(12, 3.0)
    bench.kill(12)
    bench.wait_for(skinbus.CellState, lambda event: event.state == "dead")
    bench.wait_epochs(30)
    bench.restart(12)
    bench.wait_epochs(30)


def assert_cell_is_silent_and_back(logged: Logged) -> None:
    texts = [text.partition(": ")[2] for (text,) in logged.values("/contacts", "TextLog:text")]
    assert [text for text in texts if text.startswith("vcan0:12 ") and "touched" not in text] == [
        "vcan0:12 has fallen silent",
        "vcan0:12 is back",
    ]
    silent = 0
    for entity in logged.entities:
        if entity.startswith("/robot/cells/"):
            forces = entity.replace("/cells/", "/forces/")
            for at_ns, shown in zip(logged.times(entity), logged.values(entity, "Points3D:colors"), strict=True):
                if DEAD not in shown:
                    continue
                silent += 1
                labels = logged.shown(entity, "Points3D:labels", at_ns)
                assert labels[shown.index(DEAD)] == "vcan0:12, silent"
                assert not logged.shown(forces, "Arrows3D:vectors", at_ns)
    assert silent > 3


def test_a_silent_cell_looks_silent(faulty: Path, tmp_path: Path) -> None:
    skinbus.to_rerun(faulty, save=tmp_path / "run.rrd")
    logged = Logged(tmp_path / "run.rrd")
    assert_cell_is_silent_and_back(logged)
    with skinbus.read(faulty, index=False) as recording:
        epochs = recording.epochs()
        is_open = np.asarray(epochs.open_cells) > 0
        assert is_open.any()
        assert not np.isnan(epochs.error[is_open]).all()
        shown = logged.scalars("/torques/difference")[:, 0]
        assert np.isnan(shown[is_open]).all()
        assert not np.isnan(shown[~is_open]).all()


def test_a_log_has_series_and_parts_are_one_recording(tmp_path: Path) -> None:
    parts = [RECORDINGS / name for name in ("split-2.mcap", "split.mcap", "split-1.mcap")]
    skinbus.to_rerun(*parts, save=tmp_path / "split.rrd")
    with skinbus.read(*parts, index=False) as recording:
        split = Logged(tmp_path / "split.rrd")
        np.testing.assert_array_equal(split.scalars("/joints"), recording.epochs().positions)
    assert any(entity.startswith("/robot/cells/") for entity in split.entities)


def test_there_must_be_something_to_log_to() -> None:
    if rr.get_global_data_recording() is None:
        with pytest.raises(ValueError, match="name a file with save="):
            skinbus.to_rerun(RECORDINGS / "fd.mcap")


@pytest.fixture
def live(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    path = tmp_path / "live.rrd"
    with skinbus.Bench(SKIN) as bench:
        with skinbus.to_rerun(bench, save=path):
            press = bench.press(120, 4.0)
            bench.wait_epochs(60)
            bench.release(120)
            bench.wait_epochs(30)
        yield path, press.cell


def test_a_bench_is_logged_while_it_runs(live: tuple[Path, str]) -> None:
    path, cell = live
    logged = Logged(path)
    texts = [text for (text,) in logged.values("/contacts", "TextLog:text")]
    assert [text.partition(": ")[2] for text in texts] == [
        f"{cell} is touched",
        f"{cell} is no longer touched",
        "the log has ended",
    ]
    # The run began before the log.
    times = logged.runs("/joints")
    assert 0 < times[0] < 60e9
    np.testing.assert_array_equal(np.diff(times), np.diff(logged.times("/joints")))
    assert_is_cleared(logged)
    assert logged.scalars("/joints").shape == (len(times), 6)
    assert len(times) > 30
    forces = [entity for entity in logged.entities if entity.startswith("/robot/forces/")]
    arrows = [vectors for entity in forces for vectors in logged.values(entity, "Arrows3D:vectors") if vectors]
    # Sent together: a chunk holds several clouds.
    cells = [entity for entity in logged.entities if entity.startswith("/robot/")]
    assert all(3 * logged.chunks[entity] < 2 * len(logged.times(entity)) for entity in [*cells, "/robot/links"])
    # 4 N, at 0.02 m for each N.
    assert arrows
    np.testing.assert_allclose([np.linalg.norm(vectors[0]) for vectors in arrows], 0.08, rtol=1e-2)
    assert np.nanmax(np.abs(logged.scalars("/torques/distributed"))) > 0.1


def assert_is_cleared(logged: Logged) -> None:
    """Nothing stands as current at the end, and no line leads on."""
    ends = {logged.cleared_at(entity) for entity in ("/torques", "/joints", "/robot")}
    assert len(ends) == 1
    for entity in ("/joints", "/torques/distributed", "/torques/central", "/torques/difference"):
        assert np.isnan(logged.scalars(entity)[-1]).all()
        assert {logged.times(entity)[-1]} == ends


@pytest.fixture
def live_bench(tmp_path: Path) -> Iterator[tuple[skinbus.Bench, LiveLog, Path]]:
    """A bench that is killed, and its log."""
    path = tmp_path / "live.rrd"
    bench = skinbus.Bench(SKIN).start()
    try:
        log = skinbus.to_rerun(bench, save=path)
        bench.wait_epochs(30)
        yield bench, log, path
    finally:
        bench.abort()


def last_text(path: Path, log: LiveLog) -> str:
    log.close()
    (text,) = Logged(path).values("/contacts", "TextLog:text")[-1]
    assert isinstance(text, str)
    return text.partition(": ")[2]


def test_a_killed_bench_leaves_nothing_that_looks_current(live_bench: tuple[skinbus.Bench, LiveLog, Path]) -> None:
    bench, log, path = live_bench
    bench.abort()
    for thread in log._threads:
        thread.join(10.0)
        assert not thread.is_alive()
    assert last_text(path, log) == "the bench has ended"
    assert_is_cleared(Logged(path))


def test_a_killed_view_leaves_nothing_that_looks_current(live_bench: tuple[skinbus.Bench, LiveLog, Path]) -> None:
    bench, log, path = live_bench
    log._view.send_signal(signal.SIGKILL)
    log._threads[0].join(10.0)
    bench.press(120, 4.0)
    deadline = time.monotonic() + 10.0
    while bench.events(skinbus.Contact) == [] and time.monotonic() < deadline:
        time.sleep(0.05)
    log.close()
    logged = Logged(path)
    texts = [text.partition(": ")[2] for (text,) in logged.values("/contacts", "TextLog:text")]
    assert texts == ["the view has ended", "vcan0:120 is touched", "the log has ended"]
    assert_is_cleared(logged)


def test_a_killed_script_leaves_no_view(tmp_path: Path) -> None:
    script = f"""
import time, skinbus
with skinbus.Bench({str(SKIN)!r}) as bench, skinbus.to_rerun(bench, save={str(tmp_path / "live.rrd")!r}) as log:
    print(log._view.pid, flush=True)
    time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as started:
        assert started.stdout is not None
        view = int(started.stdout.readline())
        assert is_running(view)
        started.kill()
    deadline = time.monotonic() + 20.0
    while is_running(view) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not is_running(view)


def is_running(pid: int) -> bool:
    """Tells if a process runs: an ended one may still wait for its parent to take notice."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0] != "Z"
    except FileNotFoundError:
        return False


def test_a_silent_cell_looks_silent_while_a_bench_runs(tmp_path: Path) -> None:
    path = tmp_path / "live.rrd"
    with skinbus.Bench(SKIN) as bench, skinbus.to_rerun(bench, save=path):
        cell_dies_and_is_back(bench)
    logged = Logged(path)
    assert_cell_is_silent_and_back(logged)
    assert np.isnan(logged.scalars("/torques/difference")[:, 0][:-1]).any()


def test_a_second_bench_does_not_restart_the_timeline(tmp_path: Path) -> None:
    path = tmp_path / "live.rrd"
    stream = rr.RecordingStream("two benches")
    stream.save(path)
    for _ in range(2):
        with skinbus.Bench(SKIN) as bench, skinbus.to_rerun(bench, recording=stream):
            bench.wait_epochs(30)
    stream.disconnect()
    logged = Logged(path)
    times = logged.runs("/joints")
    np.testing.assert_array_equal(np.diff(times), np.diff(logged.times("/joints")))
    assert np.count_nonzero(np.isnan(logged.scalars("/joints")[:, 0])) == 2


def torques(distributed: list[float], central: list[float]) -> bytes:
    """Returns a message `skinbus_msgs/Torques`."""
    sequences = b"".join(struct.pack(f"<II{len(each)}d", len(each), 0, *each) for each in (distributed, central))
    header = struct.pack("<iiI", 1, 500_000_000, 1) + bytes(4)
    return b"\x00\x01\x00\x00" + header + sequences


def test_torques_are_logged_while_central_ones_are_unknown(tmp_path: Path) -> None:
    stream = rr.RecordingStream("torques")
    stream.save(tmp_path / "torques.rrd")
    log = Log(stream, 1_000_000_000)
    topics = Topics(log, ["a", "b"], {("a", "b")})
    topics.add("/arm/torques", torques([1.0, 2.0], []), [])
    topics.add("/arm/torques", torques([1.0, 2.0], [0.5, 0.5]), [])
    log.set_time(2_000_000_000)
    topics.end(2_000_000_000)
    stream.disconnect()
    logged, unknown = Logged(tmp_path / "torques.rrd"), float("nan")
    for series, expected in (("distributed", [2.0, 2.0]), ("central", [unknown, 0.5]), ("difference", [unknown, 1.5])):
        entity = f"/torques/{series}"
        np.testing.assert_array_equal(logged.scalars(entity)[:, 1], [*expected, unknown])
        assert logged.runs(entity).tolist() == [500_000_000, 500_000_000, 1_000_000_000]
        # Sent together.
        assert logged.chunks[entity] <= 2


def test_series_of_other_joints_in_a_stream_keep_their_names(tmp_path: Path) -> None:
    stream = rr.RecordingStream("two robots")
    stream.save(tmp_path / "two.rrd")
    for joints, torque in ((["a", "b"], [1.0, 2.0]), (["x", "y", "z"], [3.0, 4.0, 5.0]), (["a", "b"], [6.0, 7.0])):
        log = Log(stream, 1_000_000_000)
        topics = Topics(log, joints, {tuple(joints)})
        topics.add("/arm/torques", torques(torque, torque), [])
        log.set_time(2_000_000_000)
        topics.end(2_000_000_000)
    stream.disconnect()
    logged, unknown = Logged(tmp_path / "two.rrd"), [float("nan")]
    for torque_entity, names, expected in (
        ("/torques", ["a", "b"], [[1.0, 2.0], unknown * 2, [6.0, 7.0], unknown * 2]),
        ("/torques_2", ["x", "y", "z"], [[3.0, 4.0, 5.0], unknown * 3]),
    ):
        entity = f"{torque_entity}/distributed"
        assert logged.static_values(entity, "SeriesLines:names")[-1] == names
        np.testing.assert_array_equal(logged.scalars(entity), expected)
        assert logged.cleared_at(torque_entity) == 2_000_000_000


def test_values_are_sent_after_the_clock_was_set_back(tmp_path: Path) -> None:
    stream = rr.RecordingStream("clock")
    stream.save(tmp_path / "clock.rrd")
    topics = Topics(Log(stream, 0), ["a"], {("a",)})
    for _ in range(2):
        topics.add("/arm/torques", torques([1.0], [1.0]), [])
        topics._batch._oldest_ns = 10**18
    topics.add("/arm/torques", torques([2.0], [2.0]), [])
    stream.disconnect()
    assert Logged(tmp_path / "clock.rrd").scalars("/torques/distributed").tolist() == [1.0, 1.0, 2.0]


def test_a_closed_viewer_is_a_warning() -> None:
    class Closed:
        is_connected = True

        def flush(self) -> None:
            raise RuntimeError("the sink is gone")

        def disconnect(self) -> None:
            self.is_connected = False

    own = Closed()
    with pytest.warns(UserWarning, match="the viewer did not receive everything: the sink is gone"):
        finish(cast(Any, Closed()), is_own=False)
    with pytest.raises(RuntimeError, match="the sink is gone"):
        finish(cast(Any, own), is_own=True)
    assert not own.is_connected


@pytest.mark.parametrize("scale", [0.3, 1.0, 3.0])
def test_the_eye_sees_the_whole_robot(scale: float) -> None:
    points = np.random.default_rng(1).uniform(-1, 1, (200, 3)) * scale + [0, 0, scale]
    found = eye([], [Link(points, 0.03)])
    assert found is not None
    assert found.position is not None
    assert found.look_target is not None
    position, target = (np.array(one.as_arrow_array().to_pylist()[0]) for one in (found.position, found.look_target))
    ahead = (target - position) / np.linalg.norm(target - position)
    # Half of the height that the viewer sees is 27.5 degrees.
    cosines = (points - position) @ ahead / np.linalg.norm(points - position, axis=1)
    assert cosines.min() > np.cos(np.radians(27.5 * 2**0.5))
    assert np.linalg.norm(position - target) < 6 * scale
    assert eye([], []) is None
    # A running bench moves.
    live = eye([], [Link(points, 0.03)], is_live=True)
    assert live is not None
    assert live.position is not None
    assert live.position.as_arrow_array() != found.position.as_arrow_array()


def test_units_follow_the_joints() -> None:
    assert unit_names([("rad", "Nm"), ("rad", "Nm")]) == ("rad", "Nm")
    assert unit_names([("rad", "Nm"), ("m", "N")]) == ("rad or m", "Nm or N")
    assert unit_names([]) == ("rad or m", "Nm or N")


def test_a_message_of_another_encoding_is_refused() -> None:
    with pytest.raises(ValueError, match="a message begins with 00000000"):
        Reader(bytes(8))
