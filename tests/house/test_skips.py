"""In CI a skipped test fails the run, unless it only lacks the recordings."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tools.findings import ROOT

LACKS_DATA = """
import pytest

@pytest.mark.needs_data
def test_with_a_recording(shared_data):
    raise AssertionError
"""
SKIPS = """
import pytest

def test_with_a_peer():
    pytest.skip("no robot here")
"""
SKIPS_ALL = 'import pytest\npytest.importorskip("no_such_package")\n'
UNMARKED = "def test_with_a_recording(shared_data): pass\n"


PROCESSES = pytest.mark.parametrize("processes", ["0", "2"])
"""Tests that run in processes of their own are counted like those that do not."""


def run(folder: Path, text: str, ci: str = "1", processes: str = "0") -> tuple[int, str]:
    """Run pytest with our conftest on a test file far from any recording."""
    tests = folder / "project" / "tests"
    tests.mkdir(parents=True)
    shutil.copy(ROOT / "tests" / "conftest.py", tests)
    shutil.copy(ROOT / "pyproject.toml", tests.parent)
    (tests / "test_planted.py").write_text(text)
    (tests / "test_fine.py").write_text("def test_fine(): pass\n")
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider"]
    command += ["-p", "timeout", "-p", "xdist", "-n", processes]  # no other plugin: that is slow
    environment = {**os.environ, "AMBERBOX_CI": ci, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done = subprocess.run(
        command, cwd=tests.parent, env=environment, capture_output=True, text=True
    )
    return done.returncode, done.stdout


@PROCESSES
def test_lack_of_recordings_is_counted_and_excused(tmp_path: Path, processes: str) -> None:
    status, output = run(tmp_path, LACKS_DATA, processes=processes)
    assert status == 0
    assert "tests skipped for want of ../shared/data: 1" in output
    assert "slowest 10 durations" in output


@PROCESSES
def test_any_other_skip_fails_the_run_with_its_reason(tmp_path: Path, processes: str) -> None:
    status, output = run(tmp_path, SKIPS, processes=processes)
    assert status == 6
    assert "test_with_a_peer: no robot here" in output


@PROCESSES
def test_a_skipped_file_fails_the_run_with_its_reason(tmp_path: Path, processes: str) -> None:
    status, output = run(tmp_path, SKIPS_ALL, processes=processes)
    assert status == 6
    assert "could not import 'no_such_package'" in output


def test_on_a_desk_a_skip_is_a_skip(tmp_path: Path) -> None:
    assert run(tmp_path, SKIPS, ci="")[0] == 0


def test_using_recordings_without_the_mark_fails(tmp_path: Path) -> None:
    status, output = run(tmp_path, UNMARKED)
    assert status == 1
    assert "mark it needs_data" in output
