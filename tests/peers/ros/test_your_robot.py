"""The page on a robot of one's own works as it is written: its files, its commands, its faults."""

from __future__ import annotations

import os
import shlex
import sys
from pathlib import Path

from tests.support.page_shell import run_page, shell
from tests.support.processes import free_port
from tests.support.ros_nodes import ros_environment
from tools.findings import ROOT

PAGE = (ROOT / "docs" / "start" / "your-robot.md").read_text(encoding="utf-8")
QUESTIONS = (
    *("amberbox status", "amberbox diagnose", "amberbox alarm", "amberbox incident"),
    "rostopic list",
)


def test_the_page_works_as_it_stands(requires_ros: None, tmp_path: Path) -> None:
    port = free_port()
    environment = ros_environment(port) | {
        "ROS_LOG_DIR": str(tmp_path / "log"), "HOME": str(tmp_path), "COLUMNS": "120",
    }  # fmt: skip
    python = shlex.join(["env", f"PYTHONPATH={os.pathsep.join(sys.path)}", sys.executable])
    functions = {
        "amberbox": f'{python} -m amberbox "$@"',
        "roscore": f'command roscore -p {port} "$@"',
    }
    with shell(tmp_path, environment, functions) as at:
        ran = run_page(PAGE, at, QUESTIONS)
    assert [command.split()[1] for command in ran if command.startswith("amberbox")] == [
        "new", "check", "run", "status", "diagnose", "alarm", "status", "diagnose", "status",
        "incident", "check", "status", "diagnose", "export",
    ]  # fmt: skip
