"""The plugin of pytest, with a stand-in for the run."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from skinbus.pytest_plugin import _file_name

FAKE = Path(__file__).parent / "fake"


@pytest.fixture(autouse=True)
def temporary(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder in which private folders are made; they must be gone after each test."""
    monkeypatch.setenv("SKINBUS_PROGRAMS", str(FAKE))
    pytester.makeini("[pytest]")
    # That of the fixture `tmp_path` is too long for sockets.
    with tempfile.TemporaryDirectory(prefix="plugin-") as folder:
        monkeypatch.setenv("TMPDIR", folder)
        monkeypatch.setattr("tempfile.tempdir", folder)
        yield Path(folder)
        assert list(Path(folder).glob("skinbus-*")) == []


def test_a_test_has_the_bench_of_its_marker(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        **{
            "sub/test_press": """
            import pytest

            @pytest.mark.skin("few.toml", scenario="../still.toml", duration=3)
            def test_press(bench):
                assert bench.press(3, 2).torque[0] == 0.2
                arguments = bench.end()["arguments"]
                folder = __file__.rpartition("/")[0]
                assert arguments[1] == f"{folder}/few.toml"
                assert arguments[arguments.index("--scenario") + 1] == f"{folder}/../still.toml"
                assert arguments[arguments.index("--duration") + 1] == "3"
            """
        }
    )
    pytester.runpytest("--strict-markers").assert_outcomes(passed=1)
    assert not list(pytester.path.rglob("*.mcap"))


def test_a_failed_test_leaves_its_recording_and_names_it(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import pytest

        pytestmark = pytest.mark.skin("few.toml")

        @pytest.mark.parametrize("cell", [3, 4])
        def test_press(bench, cell):
            while not bench.notes:
                pass
            assert bench.press(cell, 2).torque[0] == (0.2 if cell == 3 else 0.3)
        """
    )
    result = pytester.runpytest()
    result.assert_outcomes(passed=1, failed=1)
    kept = list(pytester.path.rglob("*.mcap"))
    assert len(kept) == 1
    assert re.fullmatch(
        r"test_a_failed_test_leaves_its_recording_and_names_it\.py-test_press-4-[0-9a-f]{8}\.mcap", kept[0].name
    )
    assert kept[0].read_text() == "recording"
    result.stdout.fnmatch_lines(["*- skinbus recording -*", str(kept[0]), "*- skinbus messages -*", "a note"])
    # The same test passes: its old recording goes.
    pytester.makepyfile(
        """
        import pytest

        @pytest.mark.parametrize("cell", [3, 4])
        @pytest.mark.skin("few.toml")
        def test_press(bench, cell):
            pass
        """
    )
    pytester.runpytest().assert_outcomes(passed=2)
    assert not list(pytester.path.rglob("*.mcap"))


def test_recordings_of_tests_with_similar_names_are_apart(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import pytest

        # The test "a-b" passes, and must not remove the recording of "a b".
        @pytest.mark.parametrize("name", ["a b", "a-b", "c"], ids=["a b", "a-b", "c" * 300])
        @pytest.mark.skin("few.toml")
        def test_press(bench, name):
            assert name == "a-b"
        """
    )
    pytester.runpytest().assert_outcomes(passed=1, failed=2)
    kept = sorted(path.name for path in pytester.path.rglob("*.mcap"))
    assert len(kept) == 2
    assert all(len(name) < 150 for name in kept)


@pytest.mark.parametrize("test", ["test_x.py::test_" + "ö" * 300, "test_x.py::test_" + "触" * 300, "\udc80" * 300, ""])
def test_names_of_recordings_are_short_in_bytes(test: str) -> None:
    name = _file_name(test)
    assert len(f"{name}.mcap".encode()) < 150
    assert re.search(r"-[0-9a-f]{8}$", name)
    assert _file_name(test + "-") != name


def test_options_name_a_skin_and_a_folder(pytester: pytest.Pytester) -> None:
    pytester.makeini("[pytest]\nskinbus_skin = skins/few.toml\nskinbus_recordings = failed")
    pytester.makepyfile(
        f"""
        def test_default(bench):
            assert bench.end()["arguments"][1] == "{pytester.path}/skins/few.toml"
            raise ValueError
        """
    )
    result = pytester.runpytest("-p", "no:cacheprovider")
    result.assert_outcomes(failed=1)
    result.stdout.re_match_lines(
        [rf"{re.escape(str(pytester.path))}/failed/test_options.*-test_default-[0-9a-f]{{8}}\.mcap"]
    )
    assert len(list((pytester.path / "failed").glob("*.mcap"))) == 1


def test_a_recording_of_the_test_itself_is_left_alone(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import pytest

        @pytest.mark.skin("few.toml", record="own.mcap")
        def test_fails(bench):
            raise ValueError
        """
    )
    result = pytester.runpytest()
    result.assert_outcomes(failed=1)
    result.stdout.no_fnmatch_line("*skinbus recording*")
    assert [path.name for path in pytester.path.rglob("*.mcap")] == ["own.mcap"]


def test_a_run_that_fails_at_its_end_is_an_error_of_the_test(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAKE_CODE", "3")
    pytester.makepyfile(
        """
        import pytest

        pytestmark = pytest.mark.skin("few.toml")

        def test_error(bench):
            pass

        def test_expected(bench):
            bench.end(check=False)

        def test_fails(bench):
            raise ValueError
        """
    )
    result = pytester.runpytest()
    result.assert_outcomes(passed=2, failed=1, errors=1)
    result.stdout.fnmatch_lines(
        ["*RunFailed: the robot was halted (exit code 3)", "*- skinbus recording -*", "*-test_error-????????.mcap"]
    )
    assert len(list(pytester.path.rglob("*.mcap"))) == 2


def test_a_run_that_cannot_start_is_an_error_with_its_line(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAKE", "refuse")
    pytester.makepyfile("import pytest\n@pytest.mark.skin('few.toml')\ndef test_it(bench): pass")
    result = pytester.runpytest()
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["skinbus: skin.toml: 1 error (exit code 2)", "skin.toml:3: joint 9 is not a joint"])


@pytest.mark.parametrize(
    ("marker", "line"),
    [
        ("", "*the test has no skin: mark it with*"),
        ("@pytest.mark.skin", "*the marker `skin` needs one argument, the path of a skin file"),
        ("@pytest.mark.skin('few.toml', colour=3)", "*unexpected keyword argument 'colour'"),
    ],
)
def test_a_wrong_marker_is_an_error_in_one_line(pytester: pytest.Pytester, marker: str, line: str) -> None:
    pytester.makepyfile(f"import pytest\n{marker}\ndef test_it(bench): pass")
    result = pytester.runpytest()
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines([line])


def test_benches_run_beside_each_other(pytester: pytest.Pytester) -> None:
    pytest.importorskip("xdist")
    pytester.makepyfile(
        """
        import pytest

        @pytest.mark.parametrize("cell", range(1, 9))
        @pytest.mark.skin("few.toml")
        def test_press(bench, cell):
            assert bench.press(cell, 2).torque[0] == (0 if cell == 8 else 0.2)
        """
    )
    result = pytester.runpytest_subprocess("-n", "4")
    result.assert_outcomes(passed=7, failed=1)
    result.stdout.fnmatch_lines(["*- skinbus recording -*", "*test_press-8-????????.mcap"])
    assert len(list(pytester.path.rglob("*.mcap"))) == 1
