"""The few words that mean the same on every machine: make targets, scripts, the CI run."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tools.findings import ROOT

SCRIPTS = [ROOT / ".ci" / "run", *sorted((ROOT / "tools").glob("*.sh"))]


@pytest.mark.parametrize("target", ["demo", "test", "check", "bench", "venv"])
def test_a_target_is_there(target: str) -> None:
    """A target that exists is explained by ``make help`` and can be planned without running."""
    assert f"\n{target} " in "\n" + _run("make", "help")
    assert _run("make", "--dry-run", target)


def test_check_runs_every_check() -> None:
    planned = _run("make", "--dry-run", "check")
    for command in ("ruff check", "ruff format --check", "mypy"):
        assert command in planned
    for tool in (ROOT / "tools").glob("check_*.py"):
        assert f"tools.{tool.stem}" in planned


def test_ci_checks_and_tests_and_forbids_skips() -> None:
    text = (ROOT / ".ci" / "run").read_text()
    for words in ("set -e", "make check", "make test", "AMBERBOX_CI=1", "</dev/null"):
        assert words in text


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_scripts_can_be_run(script: Path) -> None:
    assert os.access(script, os.X_OK)
    _run("bash", "-n", str(script))


UNSTEADY = """
from pathlib import Path

def test_unsteady():
    before = Path("before").exists()
    Path("before").touch()
    assert before
"""
FAILS = "import pytest\n\n@pytest.mark.parametrize('n', range({}))\ndef test_fails(n): assert {}\n"


@pytest.mark.parametrize(
    ("text", "status", "says"),
    [
        (UNSTEADY, 0, "unsteady, to be mended: test_planted.py::test_unsteady\n"),
        (UNSTEADY + FAILS.format(1, False), 1, "1 failed, 1 passed"),
        (FAILS.format(6, False), 1, ""),
        (FAILS.format(1, True), 2, ""),
    ],
    ids=["unsteady", "one of two fails again", "too many", "the run itself broke"],
)
def test_what_failed_runs_once_more(tmp_path: Path, text: str, status: int, says: str) -> None:
    (tmp_path / "tools").mkdir()
    again = shutil.copy(ROOT / "tools" / "again.sh", tmp_path / "tools")
    (tmp_path / "test_planted.py").write_text(text)
    environment = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "VENV": sys.prefix}
    options: dict[str, Any] = {"cwd": tmp_path, "env": environment, "text": True}
    first = subprocess.run([sys.executable, "-m", "pytest"], capture_output=True, **options)
    ended = str(first.returncode or 2)  # as if it had been interrupted
    done = subprocess.run([again, ended], capture_output=True, **options)
    assert done.returncode == status, done.stderr
    assert says in done.stdout
    assert ("again, with nothing beside" in done.stdout) is bool(says)


def test_a_python_that_is_too_old_is_refused_with_a_hint(tmp_path: Path) -> None:
    old = tmp_path / "python3"
    old.write_text('#!/bin/sh\n[ "$1" = --version ] && echo Python 3.9.2\nexit 1\n')
    old.chmod(0o755)
    for name in ("python3.11", "python3.12", "python3.13"):
        (tmp_path / name).symlink_to(old)
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    environment.pop("PYTHON", None)
    done = subprocess.run(
        [ROOT / "tools" / "python.sh"], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "needs Python 3.11 or newer, found: Python 3.9.2" in done.stderr
    assert "hint:" in done.stderr


def test_missing_debian_packages_are_named_to_those_who_may_not_install(tmp_path: Path) -> None:
    """Stand-ins for ``id`` and ``dpkg-query``: not root, and only ros-core is installed."""
    for name, text in {
        "id": "echo 1000",
        "dpkg-query": 'for last; do :; done; [ "$last" = ros-core ] && printf installed',
    }.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    command = [str(ROOT / "tools" / "apt.sh"), "ros-core", "python3-rospy"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 3
    assert "apt-get install --no-install-recommends python3-rospy\n" in done.stderr


def _run(*command: str) -> str:
    # A make above this one would pass its own flags down.
    environment = {name: value for name, value in os.environ.items() if "MAKE" not in name}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, check=True, capture_output=True, text=True
    )
    return done.stdout
