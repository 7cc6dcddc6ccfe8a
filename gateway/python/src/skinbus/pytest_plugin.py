"""Plugin of pytest: the fixture `bench`, one bench for each test.

The marker `@pytest.mark.skin("skin.toml", scenario="scenario.toml", ...)` of a test, class or module names the skin,
and has the arguments of `Bench`. Paths are relative to the file of the test. The option `skinbus_skin` of the
configuration file names a skin for tests without a marker, relative to that file.

The bench of a failed test leaves its recording in the folder of the option `skinbus_recordings`, by default
`.pytest_cache/d/skinbus`; the report of the test has its path.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import shutil
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from skinbus._folder import PrivateFolder

if TYPE_CHECKING:
    from skinbus.bench import Bench

# The number of lines of the run's standard error in a report.
_NOTES = 40
# The last bytes of a test's name that are in the name of its recording.
_NAME_BYTES = 120


@dataclass
class _State:
    """The bench of a test."""

    bench: Bench
    kept: Path | None
    """Path of the recording if the test fails; None: the test records to a file of its own."""
    has_failed: bool = False
    has_sections: bool = False


_KEY = pytest.StashKey[_State]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds the options of the configuration file."""
    parser.addini("skinbus_skin", "skin of the fixture `bench`, for tests without the marker `skin`")
    parser.addini("skinbus_recordings", "folder for the recordings of failed tests [default: in the cache of pytest]")


def pytest_configure(config: pytest.Config) -> None:
    """Registers the marker."""
    config.addinivalue_line(
        "markers",
        "skin(path, scenario=None, **options): the skin of the fixture `bench` and arguments of skinbus.Bench; "
        "paths are relative to the file of the test",
    )


@pytest.fixture
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    """A running bench of the skin that the marker `skin` or the option `skinbus_skin` names."""
    from skinbus.bench import Bench
    from skinbus.errors import RunFailed

    arguments = _arguments(request)
    is_recorded = "record" not in arguments
    with contextlib.closing(PrivateFolder()) as folder:
        recording = folder.path / "run.mcap"
        if is_recorded:
            arguments["record"] = recording
        running = Bench(**arguments)
        running._share_folder(folder)
        state = _State(bench=running, kept=_kept_path(request) if is_recorded else None)
        try:
            _start(running)
            request.node.stash[_KEY] = state
            yield running
            try:
                running.end(check=not state.has_failed)
            except RunFailed:
                state.has_failed = True
                raise
            finally:
                _keep(recording, state)
        finally:
            running.abort()


def _start(bench: Bench) -> None:
    """Starts a bench. A missing program, or an error of the skin, fails the test with one line and no traceback."""
    from skinbus.errors import ProgramMissing, RunFailed

    try:
        bench.start()
        return
    except ProgramMissing as error:
        text = str(error)
    except RunFailed as error:
        text = "\n".join([str(error), *(note for note in error.notes[-_NOTES:] if note not in str(error))])
    pytest.fail(text, pytrace=False)


def _keep(recording: Path, state: _State) -> None:
    """Moves the recording of a failed test out of the folder that is removed, and removes that of an earlier run."""
    if state.kept is not None:
        state.kept.unlink(missing_ok=True)
        if state.has_failed and recording.exists():
            state.kept.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(recording, state.kept)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Adds the path of the recording and the run's messages to the report of a failed test."""
    report = yield
    state = item.stash.get(_KEY, None)
    if state is not None and report.failed and not state.has_sections:
        state.has_failed = state.has_sections = True
        if state.kept is not None:
            report.sections.append(("skinbus recording", str(state.kept)))
        if notes := state.bench.notes[-_NOTES:]:
            report.sections.append(("skinbus messages", "\n".join(notes)))
    if report.when == "teardown" and state is not None:
        # The events of the run need memory.
        del item.stash[_KEY]
    return report


def _arguments(request: pytest.FixtureRequest) -> dict[str, Any]:
    """Returns the arguments of `Bench` from the marker or the configuration file."""
    marker = request.node.get_closest_marker("skin")
    if marker is None:
        named = request.config.getini("skinbus_skin")
        if not named:
            raise pytest.UsageError(
                f'{request.node.nodeid}: the test has no skin: mark it with @pytest.mark.skin("skin.toml"), or set '
                "skinbus_skin in the configuration file of pytest"
            )
        return {"skin": _configuration_folder(request.config) / named}
    if len(marker.args) != 1:
        raise pytest.UsageError(f"{request.node.nodeid}: the marker `skin` needs one argument, the path of a skin file")
    return _relative({"skin": marker.args[0], **marker.kwargs}, request.path.parent)


def _relative(arguments: Mapping[str, Any], base: Path) -> dict[str, Any]:
    """Returns arguments whose paths are relative to `base`."""
    names = ("skin", "scenario", "record", "directory")
    return {name: base / value if name in names and value is not None else value for name, value in arguments.items()}


def _kept_path(request: pytest.FixtureRequest) -> Path:
    """Returns the path of the recording that a failed test leaves."""
    named = request.config.getini("skinbus_recordings")
    cache: pytest.Cache | None = getattr(request.config, "cache", None)
    folder: Path
    if named:
        folder = _configuration_folder(request.config) / named
    elif cache is not None:
        folder = cache.mkdir("skinbus")
    else:
        folder = request.config.rootpath / ".pytest_cache" / "d" / "skinbus"
    return folder / f"{_file_name(request.node.nodeid)}.mcap"


def _file_name(test: str) -> str:
    """Returns a name of at most 255 bytes for the files of a test, which no other test has."""
    digits = hashlib.sha256(test.encode(errors="backslashreplace")).hexdigest()[:8]
    readable = re.sub(r"[^\w.-]+", "-", test).strip("-").encode()[-_NAME_BYTES:].decode(errors="ignore")
    return f"{readable}-{digits}"


def _configuration_folder(config: pytest.Config) -> Path:
    """Returns the folder of the configuration file."""
    return config.inipath.parent if config.inipath else config.rootpath
