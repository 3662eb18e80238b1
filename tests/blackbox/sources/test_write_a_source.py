"""The page on writing a source works as it stands: its package is built, installed and records."""

from __future__ import annotations

import os
import shlex
import sys
from pathlib import Path

from tests.support.page_shell import run_page, shell
from tests.support.processes import free_port
from tools.findings import ROOT
from tools.markdown import fences

PAGE = (ROOT / "docs" / "start" / "write-a-source.md").read_text(encoding="utf-8")
MOST_LINES = 60
PORT = "5005"
OFFLINE = "--quiet --no-index --no-build-isolation --no-deps"


def test_the_page_works_as_it_stands(tmp_path: Path) -> None:
    """Only the port is another one, and pip installs without network into a folder."""
    site = tmp_path / "site"
    python = shlex.join(
        ["env", f"PYTHONPATH={os.pathsep.join([str(site), *sys.path])}", sys.executable]
    )
    functions = {
        "amberbox": f'{python} -m amberbox "$@"',
        "python": f'{python} "$@"',
        "pip": f'{python} -m pip "$@" {OFFLINE} --target {site}',
    }
    page = PAGE.replace(PORT, str(free_port()))
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "COLUMNS": "120"}
    with shell(tmp_path, environment, functions) as at:
        ran = run_page(page, at, ("amberbox query",))
    assert [command.split()[:2] for command in ran] == [
        ["pip", "install"], ["python", "-m"], ["amberbox", "check"], ["amberbox", "record"],
        ["while", "sleep"], ["amberbox", "query"],
    ]  # fmt: skip
    assert list(site.glob("amberbox_udp_text-*.dist-info/entry_points.txt"))


def test_the_source_is_one_short_file() -> None:
    (source,) = (
        fence.text
        for fence in fences(PAGE)
        if fence.info.endswith("_udp_text.py") and "test_" not in fence.info
    )
    assert len(source.splitlines()) < MOST_LINES
