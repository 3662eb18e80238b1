"""Run the benchmarks, each in a process of its own, and write what they measured.

``python -m benchmarks.run`` runs all and keeps the results; with names it runs those, and keeps
what they measured with ``--keep``. A benchmark is a module of this folder with a function
``measure() -> list[Row]``.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from benchmarks.common import Row

FOLDER = Path(__file__).parent
RESULTS = FOLDER / "results"
PAGE = FOLDER.parent / "docs" / "reference" / "benchmarks.md"
PACKAGES = ("amberbox", "numpy", "zstandard", "msgspec", "rosbags", "mcap", "foxglove-sdk",
            "pyarrow", "duckdb")  # fmt: skip
INTRODUCTION = """# Benchmarks

Written by `make bench`; do not edit. Every number of the documentation comes from here.
*times peer* says how many times better than the peer; above 1 is better for Amberbox.
"""


@dataclass(frozen=True)
class Result:
    """What one benchmark measured, when and on which machine."""

    name: str
    about: str
    rows: list[Row]
    when: str
    where: dict[str, str | int]


def benchmarks() -> list[str]:
    """Return the names of the benchmarks, by the files that define ``measure``."""
    return [path.stem for path in sorted(FOLDER.glob("*.py")) if _measures(path)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmarks that are asked for; 1 if one of them failed."""
    parser = argparse.ArgumentParser(description="Measure.")
    parser.add_argument("names", nargs="*", help=f"all when absent; of {', '.join(benchmarks())}")
    parser.add_argument("--keep", action="store_true", help="keep the results of those, too")
    parser.add_argument("--json", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    unknown = sorted(set(options.names) - set(benchmarks()))
    if unknown:
        parser.error(f"there is no benchmark {', '.join(unknown)}")
    if options.json:
        print(json.dumps([asdict(row) for row in _measure(options.names[0])]))
        return 0
    wanted = options.names or benchmarks()
    results = [result for name in wanted if (result := _in_a_process(name)) is not None]
    if options.keep or not options.names:
        _keep(results)
    return 0 if len(results) == len(wanted) else 1


def table(rows: Sequence[Row]) -> str:
    """Write rows as a Markdown table."""
    lines = ["| what | value | unit | peer | times peer | note |", "|---|--:|---|---|--:|---|"]
    for row in rows:
        ratio = "" if row.ratio is None else f"{row.ratio:.3g}"
        cells = (row.name, number(row.value), row.unit, row.peer, ratio, row.note)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def number(value: float) -> str:
    """Write a number with three significant digits and separated thousands."""
    if value == 0 or not 1e-4 <= abs(value) < 1e15:
        return f"{value:.3g}"
    digits = len(str(int(abs(value)))) if abs(value) >= 1 else 0
    return f"{round(value, 3 - digits):,.{max(0, 3 - digits)}f}" if digits else f"{value:.3g}"


def machine() -> dict[str, str | int]:
    """Describe the machine without saying whose it is."""
    facts: dict[str, str | int] = {
        "processor": _processor(),
        "cores": os.cpu_count() or 0,
        "memory_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9),
        "system": f"{platform.system()} {platform.release().split('-')[0]} {platform.machine()}",
        "python": platform.python_version(),
    }
    return facts | {name: version(name) for name in PACKAGES}


def page(results: Sequence[Result]) -> str:
    """Write the page of the documentation."""
    return "\n".join([INTRODUCTION, *map(_section, results)])


def _section(result: Result) -> str:
    facts = ", ".join(f"{key} {value}" for key, value in result.where.items())
    when = f"Measured on {result.when}: {facts}."
    return f"## {result.name}\n\n{result.about}\n\n{table(result.rows)}\n{when}\n"


def _measures(path: Path) -> bool:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return any(isinstance(node, ast.FunctionDef) and node.name == "measure" for node in tree.body)


def _measure(name: str) -> list[Row]:
    rows: list[Row] = importlib.import_module(f"benchmarks.{name}").measure()
    return rows


def _in_a_process(name: str) -> Result | None:
    print(f"{name} ...", flush=True)
    command = [sys.executable, "-m", "benchmarks.run", "--json", name]
    done = subprocess.run(command, cwd=FOLDER.parent, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        print(f"{name} failed with exit status {done.returncode}", file=sys.stderr)
        return None
    rows = [Row(**row) for row in json.loads(done.stdout.splitlines()[-1])]
    print(table(rows), flush=True)
    return Result(name, _about(name), rows, f"{datetime.now(UTC):%Y-%m-%d}", machine())


def _about(name: str) -> str:
    text = (FOLDER / f"{name}.py").read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(text)) or "").partition("\n\n")[0].replace("\n", " ")


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith(("model name", "Model")):
            return line.partition(":")[2].strip()
    return platform.processor()


def _keep(results: Sequence[Result]) -> None:
    """Keep results, each in place of what its benchmark measured before, and write the page."""
    RESULTS.mkdir(exist_ok=True)
    for result in results:
        (RESULTS / f"{result.name}.json").write_text(json.dumps(asdict(result), indent=1) + "\n")
    PAGE.write_text(page([_kept(path) for path in sorted(RESULTS.glob("*.json"))]))
    print(f"written: {PAGE.relative_to(FOLDER.parent)}")


def _kept(path: Path) -> Result:
    found = json.loads(path.read_text())
    return Result(**{**found, "rows": [Row(**row) for row in found["rows"]]})


if __name__ == "__main__":
    sys.exit(main())
