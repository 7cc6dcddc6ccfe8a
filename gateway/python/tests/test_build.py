"""The hook that packs the programs: tags of wheels, and errors in one line."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

PACKAGE = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def hook() -> ModuleType:
    """The module `build_hook`, which is not a part of the package."""
    pytest.importorskip("hatchling")
    spec = importlib.util.spec_from_file_location("build_hook", PACKAGE / "build_hook.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("libraries", "versions", "tag"),
    [
        ("libc.so.6", "GLIBC_2.2.5 GLIBC_2.9", "manylinux_2_17"),
        ("libc.so.6 libm.so.6 libgcc_s.so.1", "GLIBC_2.9 GLIBC_2.34 GCC_4.2.0", "manylinux_2_34"),
        ("libc.so.6 ld-linux-x86-64.so.2", "GLIBC_2.100 GLIBC_2.99", "manylinux_2_100"),
        ("libc.so.6 libssl.so.3", "GLIBC_2.9", "linux"),
        ("libc.so.6 libgcc_s.so.1", "GCC_7.0.0", "linux"),
        ("libc.so.6", "GLIBC_2.36 GLIBC_ABI_DT_RELR", "linux"),
        ("libc.so.6", "GLIBC_PRIVATE", "linux"),
        ("libc.musl-x86_64.so.1", "", "linux"),
        ("", "", "linux"),
    ],
)
def test_the_tag_is_computed_from_symbols(hook: ModuleType, libraries: str, versions: str, tag: str) -> None:
    needs = hook.Needs("x86_64", set(libraries.split()), set(versions.split()))
    assert hook.platform_tag([needs, needs]) == f"{tag}_x86_64"


def test_programs_for_two_machines_are_refused(hook: ModuleType) -> None:
    with pytest.raises(hook.BuildError, match="different machines: aarch64, x86_64"):
        hook.platform_tag([hook.Needs("x86_64", set(), set()), hook.Needs("aarch64", set(), set())])


def test_symbols_are_those_that_binutils_reads(hook: ModuleType) -> None:
    program = Path(sys.executable).resolve()
    needs = hook.read_needs(program)
    assert "libc.so.6" in needs.libraries
    try:
        done = subprocess.run(["readelf", "-VW", str(program)], capture_output=True, text=True, check=True)
    except FileNotFoundError:
        pytest.skip("readelf is not installed")
    lines = done.stdout.partition("Version needs section")[2].splitlines()
    names = [line.split("Name: ")[1].split() for line in lines if "Name: " in line]
    assert needs.versions == {words[0] for words in names if "WEAK" not in words}


def test_what_is_not_a_program_is_refused(hook: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "skinbus"
    path.write_bytes(b"#!/bin/sh\n")
    with pytest.raises(hook.BuildError, match="skinbus is not a program for Linux"):
        hook.read_needs(path)
    with pytest.raises(hook.BuildError, match=r"cell-node, .*vcan-setup missing: build them, or unset"):
        hook.find_programs(tmp_path)


def test_only_the_tree_is_compiled(hook: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(hook.BuildError, match="is not the tree of skinbus"):
        hook.compile_programs(tmp_path)
    (tmp_path / "Cargo.lock").touch()
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(hook.BuildError, match="cargo is missing: install Rust, or set SKINBUS_PROGRAMS"):
        hook.compile_programs(tmp_path)
