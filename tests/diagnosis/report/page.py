"""The outputs on the page: ``python -m tests.diagnosis.report.page`` writes them again."""

from __future__ import annotations

import re
from pathlib import Path

from amberbox.diagnosis.report.text import as_text
from tests.diagnosis.report.robot import STOPPED, WINDOW, explained

ROOT = Path(__file__).resolve().parents[3]
PAGE = ROOT / "docs" / "robot" / "explanations.md"
FOLDER = ROOT / "src" / "amberbox" / "sim" / "folder"
BLOCK = re.compile(r"```text\n.*?```", re.DOTALL)


def outputs() -> tuple[str, str]:
    """Return the two outputs that the page shows."""
    return as_text(explained(*WINDOW)), as_text(explained(*STOPPED), details=False)


def written(page: str) -> str:
    """Return the page with its present outputs."""
    made = iter(outputs())
    return BLOCK.sub(lambda _: f"```text\n{next(made).rstrip()}\n```", page)


if __name__ == "__main__":
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
