"""`skinbus.to_rerun`: the file that it writes is read back by Rerun, and compared with `skinbus.read`."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import skinbus
from skinbus._ros2 import Reader

rr = pytest.importorskip("rerun", reason='rerun-sdk is not installed: pip install "skinbus[rerun]"')
RECORDINGS = Path(__file__).parents[3] / "tests" / "recordings"
SKIN = Path(__file__).parents[3] / "gateway" / "examples" / "ur5-253.toml"


class Logged:
    """The columns of a file of Rerun, by entity."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        self._columns: dict[str, dict[str, list[Any]]] = {}
        self.static: set[str] = set()
        for chunk in RrdReader(path).stream():
            batch = chunk.to_record_batch()
            if chunk.is_static:
                self.static.add(chunk.entity_path)
                continue
            columns = self._columns.setdefault(chunk.entity_path, {})
            for name in batch.schema.names:
                column = batch.column(name)
                # Times in ns have no equal in Python.
                values = column.cast("int64") if name in ("time", "run", "log_time") else column
                columns.setdefault(name, []).extend(values.to_pylist())

    @property
    def entities(self) -> set[str]:
        """The entities with values that change."""
        return set(self._columns)

    def times(self, entity: str) -> NDArray[np.int64]:
        """Returns the times of an entity in ns since 1970."""
        return np.array(self._columns[entity]["time"], np.int64)

    def values(self, entity: str, component: str) -> list[Any]:
        """Returns the values of a component, one list of instances for each time."""
        return self._columns[entity][component]

    def scalars(self, entity: str) -> NDArray[np.float64]:
        """Returns the only scalar at each time."""
        return np.array([one for (one,) in self.values(entity, "Scalars:scalars")], np.float64)


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
        for at, name in enumerate(recording.joint_names):
            for entity, expected in (
                (f"/joints/{name}", epochs.positions),
                (f"/torques/{name}/distributed", epochs.distributed),
                (f"/torques/{name}/central", epochs.central),
                (f"/torques/{name}/difference", epochs.error),
            ):
                np.testing.assert_array_equal(logged.times(entity), epochs.at_ns)
                np.testing.assert_array_equal(logged.scalars(entity), expected[:, at])


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
        every = zip(
            logged.values(entity, "Points3D:positions"),
            logged.values(entity, "Points3D:colors"),
            logged.values(forces, "Arrows3D:origins"),
            logged.values(forces, "Arrows3D:vectors"),
            strict=True,
        )
        for positions, colors, origins, vectors in every:
            assert len(colors) == len(positions)
            assert len(vectors) == len(origins) == sum(color != 0x00224EFF for color in colors if color != 0x808080FF)
            for origin, vector in zip(origins, vectors, strict=True):
                # An arrow ends at its cell.
                tip = np.array(origin) + np.array(vector)
                distances = np.linalg.norm(np.array(positions) - tip, axis=1)
                assert distances.min() < 1e-5
                touched += 1
        assert {entity, forces} <= logged.static
    assert touched > 0


def test_links_move_with_the_joints(logged: Logged) -> None:
    every = logged.values("/robot/links", "LineStrips3D:strips")
    assert len(every) > 20
    assert all(len(strips) == 6 for strips in every)
    lengths = [[np.linalg.norm(np.subtract(end, begin)) for begin, end in strips] for strips in every]
    np.testing.assert_allclose(lengths, np.broadcast_to(lengths[0], (len(lengths), 6)), atol=1e-6)


def test_a_log_has_series_and_parts_are_one_recording(tmp_path: Path) -> None:
    parts = [RECORDINGS / name for name in ("split-2.mcap", "split.mcap", "split-1.mcap")]
    skinbus.to_rerun(*parts, save=tmp_path / "split.rrd")
    with skinbus.read(*parts, index=False) as recording:
        split = Logged(tmp_path / "split.rrd")
        name = recording.joint_names[0]
        np.testing.assert_array_equal(split.scalars(f"/joints/{name}"), recording.epochs().positions[:, 0])
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
    assert texts[:2] == [f"{cell} is touched", f"{cell} is no longer touched"]
    joints = {entity for entity in logged.entities if entity.startswith("/joints/")}
    assert len(joints) == 6
    assert all(len(logged.scalars(entity)) > 30 for entity in joints)
    forces = [entity for entity in logged.entities if entity.startswith("/robot/forces/")]
    arrows = [vectors for entity in forces for vectors in logged.values(entity, "Arrows3D:vectors") if vectors]
    # 4 N, at 0.02 m for each N.
    assert arrows
    np.testing.assert_allclose([np.linalg.norm(vectors[0]) for vectors in arrows], 0.08, rtol=1e-2)
    distributed = [logged.scalars(entity) for entity in logged.entities if entity.endswith("/distributed")]
    assert max(float(np.max(np.abs(values))) for values in distributed) > 0.1


def test_a_message_of_another_encoding_is_refused() -> None:
    with pytest.raises(ValueError, match="a message begins with 00000000"):
        Reader(bytes(8))
