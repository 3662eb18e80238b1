"""What ``amberbox check`` says about a folder: asked in a process of its own, beside the rest."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from amberbox.robot.supervisor.child import amberbox

LIMIT_S = 120.0
_NICE = 10


@dataclass(frozen=True, slots=True)
class Judgement:
    """Whether a folder is right; ``trouble`` says what is wrong first and how much there is."""

    is_right: bool
    trouble: str = ""
    config_hash: str = ""
    store: str = ""


class Judging:
    """One question under way; ``answer`` is None until it is there."""

    def __init__(self, folder: Path, now_s: float, command: Sequence[str] = ()) -> None:
        self._output = os.memfd_create("check")
        self._until_s = now_s + LIMIT_S
        asked = ["nice", "-n", str(_NICE), *(command or amberbox("check", "--json", str(folder)))]
        self._process = subprocess.Popen(
            asked, stdin=subprocess.DEVNULL, stdout=self._output, stderr=subprocess.DEVNULL,
            process_group=0,
        )  # fmt: skip

    def answer(self, now_s: float) -> Judgement | None:
        """Return the answer once it is there; a question that takes too long is given up."""
        if self._process.poll() is None:
            if now_s < self._until_s:
                return None
            self.close()
            return Judgement(False, f"amberbox check gave no answer within {LIMIT_S:.0f} s")
        size = os.fstat(self._output).st_size
        text = os.pread(self._output, size, 0)
        self.close()
        return read(text)

    def close(self) -> None:
        """Give the question up, if it is still under way."""
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        if self._output >= 0:
            os.close(self._output)
            self._output = -1


def read(text: bytes) -> Judgement:
    """Read what ``amberbox check --json`` has printed."""
    try:
        report: Mapping[str, Any] = json.loads(text)
    except ValueError:
        return Judgement(False, "amberbox check gave no answer")
    errors = [problem for problem in report.get("problems", ()) if problem["is_error"]]
    if not report["ok"]:
        return Judgement(False, _first_of(errors))
    return Judgement(True, "", str(report["config_hash"]), str(report["store"]))


def _first_of(errors: Sequence[Mapping[str, Any]]) -> str:
    if not errors:
        return "amberbox check names no error"
    first = "{file}:{line}: {where}: {what}".format_map(errors[0])
    return first if len(errors) == 1 else f"{first}; {len(errors) - 1} more"
