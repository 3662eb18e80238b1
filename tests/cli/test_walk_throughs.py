"""The pages on one's first failure modes and on one's own recording work as they are written."""

from __future__ import annotations

import os
import shlex
import sys
from pathlib import Path

import pytest

from tests.support.page_shell import run_page, shell
from tools.findings import ROOT


@pytest.mark.parametrize(
    ("page", "verbs"),
    [
        (
            "start/six-modes.md",
            ["record", "diagnose", "check", "diagnose", "diagnose", "check", "diagnose", "fmea"],
        ),
        (
            "robot/own-recording.md",
            ["items", "import", "check", "watch", "diagnose", "annotate", "fmea"],
        ),
    ],
)
def test_the_page_works_as_it_stands(page: str, verbs: list[str], tmp_path: Path) -> None:
    python = shlex.join(["env", f"PYTHONPATH={os.pathsep.join(sys.path)}", sys.executable])
    functions = {"amberbox": f'{python} -m amberbox "$@"', "python": f'{python} "$@"'}
    environment = {
        "PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "COLUMNS": "120", "USER": "anna",
        "LOGNAME": "anna",
    }  # fmt: skip
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    with shell(tmp_path, environment, functions) as at:
        ran = run_page(text, at, ("amberbox diagnose",))
    assert [line.split()[1] for line in ran if line.startswith("amberbox")] == verbs
