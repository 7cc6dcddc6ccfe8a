"""Hook of hatchling that adds the programs of the bench to the wheel.

`cargo build --release` compiles them, or they are in the directory that `SKINBUS_PROGRAMS` names. The wheel's tag is
computed from the symbols that they need.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PROGRAMS = ("skinbus", "cell-node", "vcan-setup")
VARIABLE = "SKINBUS_PROGRAMS"

# Libraries that every Linux has which the tags manylinux_2_17 and later cover, as PEP 600 and PEP 599 require.
_LIBRARIES = re.compile(r"(lib(c|m|dl|rt|util|pthread)\.so\.[0-9]+|libgcc_s\.so\.1|ld-linux-[a-z0-9-]+\.so\.[0-9]+)$")
# The oldest glibc for which a tag is given, and the newest version of libgcc that comes with it.
_OLDEST_GLIBC = (2, 17)
_NEWEST_GCC = (4, 8)
_MACHINES = {62: "x86_64", 183: "aarch64"}


class ProgramsHook(BuildHookInterface[Any]):
    """Adds the programs to a wheel. An editable installation has none, and a source distribution cannot be made."""

    PLUGIN_NAME = "custom"
    _folder: tempfile.TemporaryDirectory[str] | None = None

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compiles the programs and names them and the tag to hatchling."""
        if self.target_name == "sdist":
            self.app.abort("skinbus is built from its tree: a source distribution would lack the programs in Rust")
        if version == "editable":
            return
        named = os.environ.get(VARIABLE)
        try:
            found = find_programs(Path(named)) if named else compile_programs(Path(self.root).parents[1])
            self._folder = tempfile.TemporaryDirectory(prefix="skinbus-wheel-")
            programs = [strip_program(path, Path(self._folder.name)) for path in found]
            tag = platform_tag([read_needs(path) for path in programs])
        except BuildError as error:
            self.app.abort(str(error))
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{tag}"
        build_data["shared_scripts"] |= {str(path): path.name for path in programs}

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Removes the copies of the programs."""
        if self._folder is not None:
            self._folder.cleanup()


class BuildError(Exception):
    """The programs cannot be compiled or packed."""


def find_programs(directory: Path) -> list[Path]:
    """Returns the paths of the programs in a directory."""
    paths = [directory / name for name in PROGRAMS]
    missing = [str(path) for path in paths if not path.is_file()]
    if missing:
        raise BuildError(f"{VARIABLE}: {', '.join(missing)} missing: build them, or unset the variable")
    return paths


def compile_programs(tree: Path) -> list[Path]:
    """Compiles the programs and returns their paths."""
    if not (tree / "Cargo.lock").is_file():
        raise BuildError(f"{tree} is not the tree of skinbus: build the package in its place in the tree")
    if shutil.which("cargo") is None:
        raise BuildError(f"cargo is missing: install Rust, or set {VARIABLE} to the directory of compiled programs")
    # The default members of the workspace are the packages of the programs.
    command = ["cargo", "build", "--release", "--locked", "--message-format=json-render-diagnostics"]
    done = subprocess.run(command, cwd=tree, stdout=subprocess.PIPE, check=False)
    if done.returncode != 0:
        raise BuildError(f"{' '.join(command[:4])} failed with exit code {done.returncode}")
    messages = [json.loads(line) for line in done.stdout.splitlines() if line.startswith(b"{")]
    found = {Path(one["executable"]).name: Path(one["executable"]) for one in messages if one.get("executable")}
    missing = [name for name in PROGRAMS if name not in found]
    if missing:
        raise BuildError(f"cargo built no {', '.join(missing)}")
    return [found[name] for name in PROGRAMS]


def strip_program(path: Path, folder: Path) -> Path:
    """Copies a program, without debug information if the tool `strip` is there. Returns the copy's path."""
    copy = folder / path.name
    shutil.copy2(path, copy)
    copy.chmod(0o755)
    if shutil.which("strip"):
        subprocess.run(["strip", "--strip-debug", str(copy)], check=False, stderr=subprocess.DEVNULL)
    return copy


class Needs(NamedTuple):
    """The machine and the libraries that a program needs."""

    machine: str
    libraries: set[str]
    versions: set[str]
    """Versions of symbols, such as "GLIBC_2.34"; without those that the linker only warns about."""


def platform_tag(programs: list[Needs]) -> str:
    """Returns the platform of a wheel's tag: manylinux with the glibc that all programs need, or else linux."""
    machines = {program.machine for program in programs}
    if len(machines) != 1:
        raise BuildError(f"the programs are for different machines: {', '.join(sorted(machines))}")
    machine = machines.pop()
    libraries = set().union(*(program.libraries for program in programs))
    versions = set().union(*(program.versions for program in programs))
    glibc = [_OLDEST_GLIBC]
    is_portable = any(name.startswith("libc.so.") for name in libraries)
    is_portable &= all(_LIBRARIES.match(name) for name in libraries)
    for version in versions:
        family, _, digits = version.rpartition("_")
        if not re.fullmatch(r"[0-9]+(\.[0-9]+)+", digits):
            # Such as GLIBC_PRIVATE and GLIBC_ABI_DT_RELR: no number tells which glibc has it.
            is_portable = False
            continue
        number = tuple(map(int, digits.split(".")))
        if family == "GLIBC":
            glibc.append((number[0], number[1]))
        else:
            is_portable &= family == "GCC" and number[:2] <= _NEWEST_GCC
    if not is_portable:
        return f"linux_{machine}"
    major, minor = max(glibc)
    return f"manylinux_{major}_{minor}_{machine}"


def read_needs(path: Path) -> Needs:
    """Reads from an ELF file of 64 bits, little-endian, what it needs."""
    data = path.read_bytes()
    if data[:6] != b"\x7fELF\x02\x01":
        raise BuildError(f"{path.name} is not a program for Linux on a machine of 64 bits, little-endian")
    machine = struct.unpack_from("<H", data, 18)[0]
    if machine not in _MACHINES:
        raise BuildError(f"{path.name} is for the machine {machine} of ELF; a wheel can be built for: {_MACHINES}")
    sections = list(_sections(data))
    needs = Needs(_MACHINES[machine], set(), set())
    for kind, offset, size, link, count in sections:
        if kind == 6:
            names = sections[link][1]
            entries = struct.iter_unpack("<QQ", data[offset : offset + size])
            needs.libraries.update(_text(data, names + value) for tag, value in entries if tag == 1)
        elif kind == 0x6FFFFFFE:
            needs.versions.update(_versions(data, offset, count, sections[link][1]))
    return needs


def _sections(data: bytes) -> Iterator[tuple[int, int, int, int, int]]:
    """Returns type, offset, size, link and info of each section."""
    start = struct.unpack_from("<Q", data, 40)[0]
    size, count = struct.unpack_from("<HH", data, 58)
    for at in range(start, start + size * count, size):
        yield (
            struct.unpack_from("<I", data, at + 4)[0],
            *struct.unpack_from("<QQ", data, at + 24),
            *struct.unpack_from("<II", data, at + 40),
        )


def _versions(data: bytes, at: int, count: int, names: int) -> Iterator[str]:
    """Returns the versions of symbols in a section `.gnu.version_r`, except weak ones."""
    for _ in range(count):
        _, entries, _, first, following = struct.unpack_from("<HHIII", data, at)
        entry = at + first
        for _ in range(entries):
            _, flags, _, name, next_entry = struct.unpack_from("<IHHII", data, entry)
            if not flags & 2:
                yield _text(data, names + name)
            entry += next_entry
        at += following


def _text(data: bytes, at: int) -> str:
    """Returns the text at an offset, which ends with a zero."""
    return data[at : data.index(0, at)].decode()
