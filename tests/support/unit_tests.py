"""Unit tests of a robot in tests: a folder with them, and runs to their end."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from amberbox.agent.unit_tests import Found, Progress, Result, RunTask, UnitTestRun
from amberbox.experiments.unit_tests import TestCollection, UnitTestResult


def write_tests(folder: Path, **files: str) -> Path:
    """Write ``tests/test_NAME.py`` files into a robot folder; return the folder."""
    (folder / "tests").mkdir(parents=True, exist_ok=True)
    (folder / "black_box.yaml").write_text("- sim: {}\n")
    for name, text in files.items():
        source = f"import os, signal, subprocess, sys, time\nimport pytest\n{textwrap.dedent(text)}"
        (folder / "tests" / f"test_{name}.py").write_text(source)
    return folder


@dataclass
class FinishedRun:
    """What a run has reported."""

    found: TestCollection = field(default_factory=TestCollection)
    results: dict[str, UnitTestResult] = field(default_factory=dict)
    progress: list[str] = field(default_factory=list)

    @property
    def outcomes(self) -> dict[str, str]:
        """Return the outcome of each test."""
        return {name: result.outcome for name, result in self.results.items()}


def run_tests(
    folder: Path,
    on_progress: Callable[[UnitTestRun, Progress], None] = lambda run, progress: None,
    **task: Any,
) -> FinishedRun:
    """Run the tests of a folder to their end; ``on_progress`` sees each phase as it comes."""
    done = FinishedRun()
    run = UnitTestRun(RunTask(str(folder), **task))
    try:
        while not run.is_over:
            for event in run.wait(1.0):
                if isinstance(event, Found):
                    done.found = event.collection
                elif isinstance(event, Result):
                    done.results[event.result.name] = event.result
                elif isinstance(event, Progress):
                    done.progress.append(f"{event.name}: {event.text}")
                    on_progress(run, event)
    finally:
        run.close()
    return done
