"""The code of docs/tutorial/from-python.md works as written."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from skinbus import program_path

TREE = Path(__file__).parents[3]


def blocks(language: str) -> list[str]:
    """Returns the blocks of the tutorial in a language."""
    text = (TREE / "docs/tutorial/from-python.md").read_text()
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


def test_the_tutorial(pytester: pytest.Pytester) -> None:
    first, second = blocks("python")
    (table,) = blocks("toml")
    pytester.makeini("[pytest]")
    pytester.makepyfile(test_arm=first, test_own=second)
    skin = pytester.path / "skin.toml"
    subprocess.run([program_path("skinbus"), "skin", "generate", "--cells", "12", "-o", skin], check=True)
    text, count = re.subn(r"^\[controller\].*?(?=^\[)", lambda _: table + "\n", skin.read_text(), flags=re.M | re.S)
    assert count == 1
    (pytester.path / "own.toml").write_text(text)
    shutil.copy(TREE / "gateway/examples/external_controller.py", pytester.path)
    result = pytester.runpytest()
    result.assert_outcomes(passed=2)
    assert len([line for line in first.splitlines() if line.strip()]) <= 10
    assert os.listdir(pytester.path).count("loop.sock") == 0
