"""Benches of real processes: presses, faults, ends, and what remains of them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import skinbus
from skinbus import Bench, CellState, CommandRefused, Contact, RunFailed, Unconfirmed, program_path


@pytest.fixture(scope="module")
def skin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A skin with 12 cells on one bus."""
    path = tmp_path_factory.mktemp("skin") / "few.toml"
    subprocess.run([program_path("skinbus"), "skin", "generate", "--cells", "12", "-o", path], check=True)
    return path


@pytest.fixture
def bench(skin: Path) -> Iterator[Bench]:
    """A bench of its own for each test; its robot may be halted at the end."""
    with Bench(skin) as bench:
        yield bench
        bench.end(check=False)


def test_a_press_is_confirmed_by_the_torque_of_its_force(bench: Bench) -> None:
    press = bench.press(12, 3)
    assert press.cell == "vcan0:12"
    assert len(press.torque) == len(bench.ready.joints) == 6
    assert any(abs(value) > 0.05 for value in press.torque)
    twice = bench.press("vcan0:12", 6)
    # The arm moves under the touch, so only nearly twice.
    assert twice.torque == pytest.approx([2 * value for value in press.torque], rel=0.2, abs=0.01)
    assert bench.torque(12) == pytest.approx(twice.torque, rel=0.2, abs=0.01)
    bench.wait_epochs(2)
    torques = bench.torques()
    assert torques.distributed == pytest.approx(torques.central, abs=0.01)
    assert any(abs(value) > 0.05 for value in torques.distributed)
    assert set(bench.release(12).torque) == {0.0}
    assert [event.touched for event in bench.events(Contact) if event.cell == "vcan0:12"] == [True, False]


def test_the_arm_gives_way(bench: Bench) -> None:
    before = bench.report().positions
    bench.press(12, 20)
    bench.wait_epochs(30)
    after = bench.report().positions
    assert max(abs(a - b) for a, b in zip(after, before, strict=True)) > 0.01


def test_a_force_below_the_threshold_is_not_confirmed(bench: Bench) -> None:
    with pytest.raises(Unconfirmed) as caught:
        bench.press(12, 0.01)
    assert caught.value.reason == "below-threshold"
    bench.release(11)
    with pytest.raises(Unconfirmed):
        bench.press(11, 0)


def test_wrong_commands_are_refused(bench: Bench) -> None:
    for cell in (13, "vcan1:12", "vcan0:0"):
        with pytest.raises(CommandRefused):
            bench.press(cell, 1)
    for force in (-1, 90.1):
        with pytest.raises(CommandRefused):
            bench.press(12, force)
    with pytest.raises(CommandRefused):
        bench.bus_down("vcan7")
    bench.press(12, 1)


def test_a_cell_dies_and_comes_back(bench: Bench) -> None:
    bench.press(3, 2)
    bench.kill(3)
    dead = bench.wait_for(CellState, lambda event: (event.cell, event.state) == ("vcan0:3", "dead"))
    with pytest.raises(Unconfirmed) as caught:
        bench.press(3, 4)
    assert caught.value.reason == "dead"
    assert dead.cell == "vcan0:3"
    bench.restart(3)
    assert any(bench.press(3, 2).torque)


def test_a_cell_that_hangs_continues(bench: Bench) -> None:
    bench.stop(3)
    bench.wait_for(CellState, lambda event: (event.cell, event.state) == ("vcan0:3", "dead"))
    bench.continue_(3)
    bench.wait_for(CellState, lambda event: (event.cell, event.state) == ("vcan0:3", "alive"))
    bench.press(3, 2)


def test_a_halt_ends_with_the_exit_code_of_a_halted_robot(skin: Path) -> None:
    bench = Bench(skin).start()
    bench.halt()
    bench.wait_for(skinbus.Halted)
    with pytest.raises(Unconfirmed, match="halted"):
        bench.press(3, 2)
    bench.resume()
    bench.wait_for(skinbus.Resumed)
    bench.press(3, 4)
    bench.halt()
    with pytest.raises(RunFailed) as caught:
        bench.end()
    assert caught.value.code == 3
    assert bench.summary["outcome"] == "halted"


def test_a_bus_goes_down_and_up(bench: Bench) -> None:
    bench.bus_down()
    lost = bench.wait_for(skinbus.BusState, lambda event: not event.up)
    bench.bus_up()
    bench.wait_for(skinbus.BusState, lambda event: event.up, start=lost.index)
    bench.wait_epochs(2)


def test_all_presses_are_released(bench: Bench) -> None:
    for cell in (3, 4, 5):
        bench.press(cell, 2)
    bench.release_all()
    gone = {"vcan0:3", "vcan0:4", "vcan0:5"}
    for event in bench.follow(Contact, timeout=5):
        gone -= set() if event.touched else {event.cell}
        if not gone:
            break
    assert gone == set()


def test_presses_that_are_not_waited_for(bench: Bench) -> None:
    presses = [bench.press(cell, 2, confirm=False) for cell in range(1, 13)]
    assert {press.wait().cell for press in presses} == {f"vcan0:{cell}" for cell in range(1, 13)}
    presses = [bench.press(3, force, confirm=False) for force in range(3, 40)]
    assert presses[-1].wait().force_n == 39
    reasons = set()
    for press in presses:
        try:
            press.wait()
        except Unconfirmed as error:
            reasons.add(error.reason)
    assert reasons == {"superseded"}


def test_a_recording_and_a_summary(skin: Path, tmp_path: Path) -> None:
    with Bench(skin, record=tmp_path / "run.mcap") as bench:
        bench.press(12, 3)
        folder = bench.directory
    assert (tmp_path / "run.mcap").stat().st_size > 1000
    assert bench.summary["outcome"] == "done"
    assert bench.summary["cells"][11]["node"] == 12
    assert bench.exit_code == 0
    assert folder is not None
    assert not folder.parent.exists()


def test_a_run_ends_after_its_duration(skin: Path) -> None:
    with Bench(skin, duration=0.5) as bench:
        assert isinstance(list(bench.follow())[-1], skinbus.Ended)
        with pytest.raises(RunFailed, match=r"the run has ended \(exit code 0\)"):
            bench.press(3, 2)


def test_a_scenario_presses_too(skin: Path, tmp_path: Path) -> None:
    scenario = tmp_path / "press.toml"
    scenario.write_text("[[touch]]\nat_s = 0.2\ncells = [5]\nforce_n = 3.0\n")
    with Bench(skin, scenario) as bench:
        contact = bench.wait_for(Contact)
        assert (contact.cell, contact.touched) == ("vcan0:5", True)
        assert any(bench.torque(5))


def test_an_error_in_the_skin_is_the_program_s_line(tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("[robot]\njoints = 3\n")
    with pytest.raises(RunFailed, match=r"wrong.toml") as caught, Bench(wrong):
        pass
    assert caught.value.code == 2
    missing = Bench(tmp_path / "missing.toml")
    with pytest.raises(RunFailed, match=r"missing.toml"):
        missing.start()
    assert missing.exit_code == 2


def test_cells_of_another_process(skin: Path, tmp_path: Path) -> None:
    directory = tmp_path / "bus"
    directory.mkdir(mode=0o700)
    environment = {**os.environ, "SKINBUS_DIR": str(directory)}
    server = subprocess.Popen([program_path("vcan-setup"), "serve", "vcan0"], env=environment)
    cells = None
    try:
        wait_until(lambda: (directory / "vcan0.bus").exists())
        command = [str(program_path("cell-node")), "--bus", "vcan0", "--nodes", "1-12", "--skin", str(skin)]
        cells = subprocess.Popen(command, env=environment)
        with Bench(skin, spawn=False, directory=directory) as bench:
            assert any(bench.press(7, 3).torque)
            with pytest.raises(CommandRefused):
                bench.kill(7)
        assert directory.exists()
        assert cells.poll() is None
    finally:
        for process in (cells, server):
            if process is not None:
                process.terminate()
                process.wait(10)


def test_a_process_that_is_killed_leaves_nothing(skin: Path) -> None:
    program = f"""
import skinbus, time
bench = skinbus.Bench({str(skin)!r}).start()
bench.press(3, 2)
print(bench.directory, flush=True)
time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        directory = Path(process.stdout.readline().strip())
        assert directory.name == "bus"
        assert processes_of(directory)
        process.send_signal(signal.SIGKILL)
    wait_until(lambda: not processes_of(directory))
    wait_until(lambda: not directory.parent.exists())


def test_descriptions_have_the_documented_fields(bench: Bench) -> None:
    bench.wait_epochs(3)
    assert bench.ready.buses[0].reply == "torque"
    assert len(bench.report().distributed) == 6
    bench.wait_epochs(100)
    lateness = bench.report().lateness_us
    assert lateness is not None
    assert lateness.max >= lateness.p90 >= lateness.p50 > 0
    (bus,) = bench.report().buses
    assert bus.number >= 100
    assert bus.epoch is not None
    assert bus.dropped_frames >= 0


def test_two_benches_are_apart(skin: Path) -> None:
    with Bench(skin) as one, Bench(skin) as other:
        one.press(3, 2)
        assert any(one.torque(3))
        assert not any(other.torque(3))


def processes_of(directory: Path) -> list[str]:
    """Returns the command lines of processes whose environment has this bus folder."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if f"SKINBUS_DIR={directory}".encode() in (process / "environ").read_bytes().split(b"\0"):
                found.append((process / "cmdline").read_text())
        except OSError:
            continue
    return [command for command in found if command]


def wait_until(is_true: Callable[[], bool], limit: float = 20.0) -> None:
    """Waits for a state."""
    end = time.monotonic() + limit
    while not is_true():
        assert time.monotonic() < end
        time.sleep(0.02)
