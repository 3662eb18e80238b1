"""The page on writing a monitor works unchanged: its files are written, its commands run."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from amberbox.core.errors import Problem
from amberbox.core.yaml_nodes import load_yaml
from tools.findings import ROOT
from tools.markdown import fences

PAGE = (ROOT / "docs" / "start" / "write-a-monitor.md").read_text(encoding="utf-8")
MOST_LINES = 30


def _run(command: str, folder: Path) -> str:
    """Run a command of the page and return what it prints."""
    words = command.split()
    assert words[0] == "amberbox"
    environment = os.environ | {"COLUMNS": "200"}
    done = subprocess.run(
        [sys.executable, "-m", *words], cwd=folder, env=environment, capture_output=True, text=True,
        timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout + done.stderr


def _commands(text: str) -> Iterator[tuple[str, list[str]]]:
    """Yield each command of a console block with the lines that the page shows of its output."""
    shown: list[str] = []
    for line in text.splitlines():
        if line.startswith("$ "):
            shown = []
            yield line[2:], shown
        elif line != "...":
            shown.append(line)


def test_the_page_works_as_it_stands(tmp_path: Path) -> None:
    ran: list[str] = []
    for fence in fences(PAGE):
        kind, _, name = fence.info.partition(" ")
        if kind == "console":
            for command, shown in list(_commands(fence.text)):
                printed = " ".join(_run(command, tmp_path).split())
                ran.append(command.split()[1])
                assert [line for line in shown if " ".join(line.split()) not in printed] == []
        else:
            assert name, f"line {fence.line}: the block names no file"
            path = tmp_path / "robot" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(fence.text, encoding="utf-8")
    assert ran == ["new", "check", "record", "watch"]


def test_the_monitor_is_one_short_file() -> None:
    (monitor,) = (fence.text for fence in fences(PAGE) if fence.info.startswith("python modes/"))
    assert len(monitor.splitlines()) < MOST_LINES


def test_the_rule_test_of_the_page_can_fail(tmp_path: Path) -> None:
    """The page's rule test against a monitor that finds nothing."""
    from amberbox.monitoring.plan import MonitoringPlan
    from amberbox.monitoring.rule_tests import read_rule_tests, run_rule_tests

    blocks = {fence.info.partition(" ")[2]: fence.text for fence in fences(PAGE)}
    (tmp_path / "modes").mkdir()
    lazy = blocks["modes/charger.py"].replace("abs(volts - config.volts) < 1.0", "True")
    (tmp_path / "modes" / "charger.py").write_text(lazy)
    mode = "".join(f"  {line}\n" for line in blocks["components/charger/contact.yaml"].splitlines())
    rules = blocks["components/charger/contact.test.yaml"].replace("of: charger/contact\n", "")
    path = tmp_path / "lazy.test.yaml"
    path.write_text(f"mode:\n{mode}{rules}")
    problems: list[Problem] = []
    assert load_yaml(path, problems) is not None
    read = read_rule_tests(path, path.name, tmp_path, problems)
    assert read is not None, problems
    told = [problem.where for problem in run_rule_tests(read, MonitoringPlan("", ""))]
    assert told == ["test 'the contacts fail while the robot charges' at 6 s"]
