"""The channel to a run, with a stand-in that also fails as no program should."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import skinbus
from skinbus import Bench, Contact, Epoch, Event, RunFailed, Unconfirmed
from skinbus.events import Unknown, parse_event

FAKE = Path(__file__).parent / "fake"


@pytest.fixture(autouse=True)
def _stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SKINBUS_PROGRAMS", str(FAKE))
    monkeypatch.delenv("SKINBUS_DIR", raising=False)


@pytest.fixture
def fake() -> Iterator[Bench]:
    with Bench("skin.toml", timeout=5.0) as bench:
        yield bench


def commands(bench: Bench) -> list[dict[str, object]]:
    """Returns the commands that the stand-in only repeats."""
    texts = [event.text for event in bench.events(skinbus.Accepted) if event.text]
    return [{key: value for key, value in json.loads(text).items() if key != "id"} for text in texts]


def test_a_press_is_confirmed_and_its_torque_is_read(fake: Bench) -> None:
    press = fake.press(3, 2)
    assert (press.cell, press.force_n, press.epoch) == ("vcan0:3", 2.0, 18)
    assert press.torque == (0.2, 0, 0, 0, 0, 0)
    assert fake.torque("vcan0:3") == fake.torque(3) == press.torque
    assert fake.torque(4) == (0,) * 6
    assert fake.torques() == skinbus.Torques(press.torque, press.torque)
    assert fake.release(3).wait().torque == (0,) * 6


def test_a_press_that_no_torque_shows_raises_the_reason(fake: Bench) -> None:
    with pytest.raises(Unconfirmed, match=r"vcan0:3, 0.05 N: below-threshold: computes") as caught:
        fake.press(3, 0.05)
    assert caught.value.reason == "below-threshold"
    later = fake.press(3, 0.05, confirm=False)
    for _ in range(2):
        with pytest.raises(Unconfirmed):
            later.wait()


def test_a_cell_that_was_not_touched_may_be_released(fake: Bench) -> None:
    press = fake.release(5)
    with pytest.raises(Unconfirmed, match="not-touched"):
        press.wait()
    with pytest.raises(Unconfirmed, match="not-touched"):
        fake.press(5, 0)


def test_a_press_that_is_not_answered_is_repeated_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE", "late")
    with Bench("skin.toml") as bench:
        assert bench.press(3, 2).torque[0] == 0.2
        assert len(bench.events(skinbus.NotConfirmed)) == 2
        with pytest.raises(Unconfirmed, match="no-answer"):
            bench.press(3, 3)
        assert len(bench.events(skinbus.NotConfirmed)) == 5


def test_a_press_without_a_verdict_ends_after_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE", "no-verdict")
    with Bench("skin.toml") as bench:
        press = bench.press(3, 2, confirm=False)
        with pytest.raises(
            TimeoutError, match=r"Press of vcan0:3, 2 N, from epoch 18>: the bench did not answer for 0.1 s"
        ):
            press.wait(0.1)


def test_refused_commands_are_exceptions(fake: Bench) -> None:
    with pytest.raises(skinbus.CommandRefused, match="the skin has no cell 13"):
        fake.press(13, 1)
    with pytest.raises(skinbus.CommandRefused, match="0 to 90"):
        fake.press(1, 91)
    with pytest.raises(ValueError, match="JSON"):
        fake.press(1, float("nan"))
    for wrong in (13, "vcan1:3", "vcan0:13"):
        with pytest.raises(ValueError, match="the skin has no such cell"):
            fake.torque(wrong)
    fake.press(1, 1)


def test_each_method_sends_its_command(fake: Bench) -> None:
    fake.halt()
    fake.resume()
    for method in (fake.kill, fake.stop, fake.continue_, fake.restart):
        method(3)
    fake.bus_down()
    fake.bus_up("vcan0")
    fake.link_down(3, "vcan0:4")
    fake.link_up(3, 4)
    assert commands(fake) == [
        {"do": "halt"},
        {"do": "resume"},
        {"do": "kill", "cell": 3},
        {"do": "stop", "cell": 3},
        {"do": "continue", "cell": 3},
        {"do": "restart", "cell": 3},
        {"do": "bus", "bus": "vcan0", "down": True},
        {"do": "bus", "bus": "vcan0", "down": False},
        {"do": "link", "cells": [3, "vcan0:4"], "down": True},
        {"do": "link", "cells": [3, 4], "down": False},
    ]


def test_epochs_are_counted_only_while_waited_for(fake: Bench) -> None:
    fake.wait_epochs(0)
    fake.wait_epochs(3)
    assert [event.number for event in fake.events(Epoch)][:3]
    assert [command["every"] for command in commands(fake)] == [1, 0]
    threads = [threading.Thread(target=fake.wait_epochs, args=(5,)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert commands(fake)[-1]["every"] == 0
    with pytest.raises(TimeoutError, match="100 epochs"):
        fake.wait_epochs(100, timeout=0.1)


@pytest.mark.parametrize("mode", ["no-begin", "no-end", "refuse-end"])
def test_epochs_whose_command_fails_are_counted_later(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE", mode)
    with Bench("skin.toml", timeout=0.5) as bench:
        if mode == "no-begin":
            with pytest.raises(TimeoutError, match="epochs: the bench did not answer"):
                bench.wait_epochs(1)
        else:
            bench.wait_epochs(1)
        bench.wait_epochs(2)
        # The stand-in never accepts the end of epochs in the last mode.
        expected = {"no-begin": [1, 0], "no-end": [1, 1, 0], "refuse-end": [1, 1]}
        assert [command["every"] for command in commands(bench)] == expected[mode]


def test_a_report_has_the_documented_fields(fake: Bench) -> None:
    report = fake.report()
    assert (report.buses[0].epoch, report.buses[0].number, report.buses[0].dropped_frames) == (21, 277, 3)
    assert report.lateness_us == skinbus.events.Lateness(p50=20, p90=25, p99=30, max=99)


def test_commands_of_many_threads_have_their_own_answers(fake: Bench) -> None:
    wrong = []

    def press(cell: int) -> None:
        for force in range(1, 40):
            confirmed = fake.press(cell, force).wait()
            if (confirmed.cell, confirmed.force_n) != (f"vcan0:{cell}", force):
                wrong.append(confirmed)

    threads = [threading.Thread(target=press, args=(cell,)) for cell in range(1, 9)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


def test_events_are_followed_until_the_end(fake: Bench) -> None:
    seen: list[Event] = []
    thread = threading.Thread(target=lambda: seen.extend(fake.follow()))
    thread.start()
    fake.press(1, 1)
    fake.end()
    thread.join(5)
    assert seen == fake.events()
    assert [event.index for event in seen] == list(range(len(seen)))
    assert [type(event).__name__ for event in seen] == ["Ready", "Accepted", "Confirmed", "Ended"]
    assert list(fake.follow(skinbus.Confirmed, start=2)) == fake.events(skinbus.Confirmed)


def test_to_follow_without_an_event_ends_after_its_time(fake: Bench) -> None:
    with pytest.raises(TimeoutError, match=r"the bench sent no event for 0.1 s"):
        next(fake.follow(start=1, timeout=0.1))
    with pytest.raises(TimeoutError, match=r"Halted: the bench did not answer for 0.1 s"):
        fake.wait_for(skinbus.Halted, timeout=0.1)


def test_a_flood_of_events_keeps_the_newest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE", "flood")
    with Bench("skin.toml") as bench:
        bench.halt()
        last = bench.wait_for(Contact, lambda event: event.at_ns == 119_999)
        assert bench.press(3, 2).torque == (0.2, 0, 0, 0, 0, 0)
        assert len(bench.events()) == 100_000
        assert next(bench.follow()).index > 20_000
        assert last.index == 120_001


def test_strange_lines_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE", "strange")
    with Bench("skin.toml") as bench:
        bench.press(3, 2)
        lines = [event.line for event in bench.events(Unknown)]
    assert lines[:2] == ["no event", '{"event":"novel","a":1}']
    assert len(lines) == 5


def test_an_event_of_a_later_version_is_read() -> None:
    line = b'{"event":"halted","reason":null,"later":{"a":[1]}}\n'
    assert parse_event(line, 7) == skinbus.Halted(index=7, reason=None)


def test_a_run_that_cannot_start_raises_its_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE", "refuse")
    bench = Bench("skin.toml")
    with pytest.raises(RunFailed, match=r"skinbus: skin.toml: 1 error \(exit code 2\)") as caught:
        bench.start()
    assert caught.value.code == 2
    assert caught.value.notes[0] == "skin.toml:3: joint 9 is not a joint"
    assert bench.directory is not None
    assert not bench.directory.exists()
    assert bench.exit_code == 2


def test_a_run_that_is_killed_raises_what_it_wrote_last(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE", "crash")
    with pytest.raises(RunFailed, match=r"thread 'main' panicked \(exit code -9\)"), Bench("skin.toml") as bench:
        bench.press(3, 2)
    assert bench.summary == {}
    assert bench.exit_code == -9


def test_the_summary_is_there_after_the_end(fake: Bench) -> None:
    with pytest.raises(RuntimeError, match="the run has not ended"):
        _ = fake.summary
    summary = fake.end()
    assert summary["outcome"] == "done"
    assert fake.end() == fake.summary == summary
    assert fake.exit_code == 0
    with pytest.raises(RunFailed, match=r"the run has ended \(exit code 0\)"):
        fake.press(3, 2)


def test_an_exit_code_is_an_exception_unless_another_one_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE_CODE", "3")
    with pytest.raises(RunFailed, match=r"the robot was halted \(exit code 3\)"), Bench("skin.toml"):
        pass
    with pytest.raises(ZeroDivisionError), Bench("skin.toml"):
        raise ZeroDivisionError
    with Bench("skin.toml") as bench:
        assert bench.end(check=False)["outcome"] == "halted"


def test_a_run_that_hangs_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE", "hang")
    monkeypatch.setattr("skinbus.bench._END_TIMEOUT", 0.1)
    monkeypatch.setattr("skinbus._run._SIGNAL_TIMEOUT", 0.1)
    bench = Bench("skin.toml").start()
    bench.end(check=False)
    assert bench.exit_code == -9


@pytest.mark.parametrize("is_writing", [False, True])
def test_a_run_that_is_stopped_with_a_full_pipe_is_killed(is_writing: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skinbus.bench._END_TIMEOUT", 0.5)
    monkeypatch.setattr("skinbus._run._SIGNAL_TIMEOUT", 0.5)
    bench = Bench("skin.toml").start()
    assert bench._run is not None
    run, pipe = bench._run, bench._run._input.fileno()
    os.kill(run._process.pid, signal.SIGSTOP)
    failures = []

    def write_for_ever() -> None:
        try:
            while True:
                run.send("halt")
        except RunFailed as failure:
            failures.append(failure.code)

    os.set_blocking(pipe, False)
    try:
        while True:
            os.write(pipe, b"\n" * 4096)
    except BlockingIOError:
        os.set_blocking(pipe, True)
    writer = threading.Thread(target=write_for_ever, daemon=True)
    if is_writing:
        writer.start()
        time.sleep(0.1)
    began = time.monotonic()
    bench.end(check=False)
    assert time.monotonic() - began < 5
    assert bench.exit_code == -9
    if is_writing:
        writer.join(5)
        assert failures == [-9]
    assert run._input.closed


def test_a_run_ends_although_a_fork_of_this_process_has_its_input(fake: Bench) -> None:
    assert fake._run is not None
    copy = os.dup(fake._run._input.fileno())
    try:
        assert fake.end()["outcome"] == "done"
    finally:
        os.close(copy)


def test_a_silent_run_ends_after_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE", "silent")
    with (
        pytest.raises(TimeoutError, match=r"press: the bench did not answer for 0.1 s"),
        Bench("skin.toml", timeout=0.1) as bench,
    ):
        bench.press(3, 2)


def test_arguments_are_handed_on() -> None:
    with Bench("a.toml", Path("b.toml"), duration=1.5, options=["--view"]) as bench:
        pass
    expected = ["run", "a.toml", "--control", "--quiet", "--scenario", "b.toml", "--duration", "1.5"]
    assert bench.summary["arguments"] == [*expected, "--bus-kind", "embedded", "--view"]
    with Bench("a.toml", spawn=False) as bench:
        assert bench.directory is None
    assert bench.summary["arguments"][4:] == ["--no-spawn"]
    with Bench("a.toml", options=["--bus-kind=socketcan"]) as bench:
        pass
    assert bench.summary["arguments"][4:] == ["--bus-kind=socketcan"]


def test_a_folder_that_is_given_is_kept(tmp_path: Path) -> None:
    with Bench("skin.toml", directory=tmp_path) as bench:
        assert bench.ready.buses[0].directory == str(tmp_path)
    assert tmp_path.exists()


def test_a_bench_runs_once(fake: Bench) -> None:
    with pytest.raises(RuntimeError, match="was already started"):
        fake.start()
    with pytest.raises(RuntimeError, match="was not started"):
        Bench("skin.toml").report()


def test_a_process_that_is_killed_leaves_nothing() -> None:
    program = (
        "import skinbus, time; b = skinbus.Bench('s.toml').start(); print(b.directory, flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        folder = Path(process.stdout.readline().strip()).parent
        assert folder.name.startswith("skinbus-")
        assert folder.exists()
        process.kill()
    limit = time.monotonic() + 10
    while folder.exists() and time.monotonic() < limit:
        time.sleep(0.02)
    assert not folder.exists()
