"""Real recordings: replays at any speed, and rows in random pieces, give the same bytes."""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amberbox.blackbox.query.record import open as open_record
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.store import Store, open_store
from amberbox.cli.main import main
from amberbox.core.types import Batch, Ragged, Status
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.findings import Finding, encoded
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.record_evaluation import DiagnosedEngine, ReplayOptions, blocks, replay

REAL = ("recordings/plotjuggler_tilt_laser.bag", "ropod/bb_test_data")
KINDS = {
    "range": "{min: -1, max: 1, hysteresis: 0.1}",
    "garbage": "{min: -100, max: 100}",
    "frozen": "{for: 1 s}",
    "rate_of_change": "{max: 2}",
    "expression": "{condition: 'abs(input_1) < 1 for 300ms'}",
}
MODE = """\
name: {kind}
mappings:
  - mapping:
      inputs: [{address}]
      outputs:
        - output: {{name: fine, type: bool, for: 100 ms}}
arguments: {arguments}
"""


def folder_of(place: Path, recording: Path) -> tuple[MonitoringPlan, Store]:
    """Import a recording, and monitor some of its numbers in every way."""
    folder = place / "robot"
    (folder / "components").mkdir(parents=True)
    (folder / "robot.yaml").write_text("id: robot\n")
    (folder / "black_box.yaml").write_text("- sim: {}\n")
    assert main(["import", str(recording), "--store", str(folder / "store")]) == 0
    for number, address in enumerate(numbers_of(folder)):
        name, kind = f"part_{number}", list(KINDS)[number % len(KINDS)]
        text = MODE.format(kind=kind, address=address, arguments=KINDS[kind])
        (folder / "components" / f"{name}.yaml").write_text(
            f"component_name: {name}\nmodes: [{name}_mode.yaml]\n"
        )
        (folder / "components" / f"{name}_mode.yaml").write_text(text)
    plan, _ = load_plan(load_folder(folder))
    assert sum(not mode.problem for _, mode in plan.modes()) >= len(KINDS)
    return plan, open_store(folder / "store")


def numbers_of(folder: Path) -> list[str]:
    """Return the addresses of some numbers of every item."""
    with open_record(folder) as record:
        found = []
        for info in record.items():
            if not info.name.startswith("amberbox") and "__" not in info.name:
                columns = record.variables(info.name).columns
                floats = [c.name for c in columns if c.type.startswith("float")]
                found += [f"{info.name}.{name}" for name in floats[:5]]
        return found


def in_bytes(findings: Iterator[Finding] | list[Finding]) -> list[bytes]:
    return [encoded(finding)[1] for finding in findings]


def in_pieces(plan: MonitoringPlan, store: Store, seed: int) -> list[bytes]:
    """Evaluate rows in random batches, with random delays between them."""
    engine, rng = Engine(plan), random.Random(seed)
    found: list[Finding] = []
    epoch: Any = None
    for block in blocks(plan, store, DiagnosedEngine(engine), ReplayOptions()):
        if block.epoch != epoch:
            epoch = block.epoch
            engine.begin(block.start_ns)
        pieces = sorted((p for b in block.batches for p in cut(b, rng)), key=begin_of)
        for number, piece in enumerate(pieces):
            engine.feed(piece)
            rest = pieces[number + 1 : number + 2]
            if rest and rng.random() < 0.3:
                found += engine.advance(min(begin_of(rest[0]) - 1, block.until_ns))
        found += engine.advance(block.until_ns)
    return in_bytes(found)


def begin_of(batch: Batch) -> int:
    return int(batch.log_time_ns[0])


def cut(batch: Batch, rng: random.Random) -> Iterator[Batch]:
    """Cut a batch where its child tables allow it: after any row of its own."""
    start = 0
    while start < len(batch):
        end = min(start + rng.choice([1, 3, 20, 400]), len(batch))
        yield part_of(batch, start, end)
        start = end


def part_of(batch: Batch, start: int, end: int) -> Batch:
    """Return some rows of a batch, and of its child tables what belongs to them."""
    children = {}
    for name, child in batch.children.items():
        first, last = np.searchsorted(child.seq, [batch.seq[start], batch.seq[end - 1] + 1])
        children[name] = part_of(child, int(first), int(last)) if last > first else None
    rows = slice(start, end)
    return dataclasses.replace(
        batch,
        seq=batch.seq[rows],
        log_time_ns=batch.log_time_ns[rows],
        received_ns=batch.received_ns[rows],
        timestamp_ns=batch.timestamp_ns[rows],
        columns={name: some(column, start, end) for name, column in batch.columns.items()},
        children={name: child for name, child in children.items() if child is not None},
    )


def some(column: Any, start: int, end: int) -> Any:
    if not isinstance(column, Ragged):
        return column[start:end]
    offsets = column.offsets[start : end + 1]
    return Ragged(offsets - offsets[0], column.values[offsets[0] : offsets[-1]])


@pytest.mark.needs_data
@pytest.mark.parametrize("name", REAL)
def test_speed_and_pieces_do_not_matter(name: str, tmp_path: Path, shared_data: Path) -> None:
    plan, store = folder_of(tmp_path, shared_data / name)
    at_once = list(replay(plan, store))
    levels = {finding.level for finding in at_once if isinstance(finding, Status)}
    assert {"ok", "error"} <= levels
    expected = in_bytes(at_once)
    assert in_bytes(replay(plan, store, ReplayOptions(speed=8.0))) == expected
    for seed in range(3):
        assert in_pieces(plan, store, seed) == expected


def test_pieces_do_not_matter_on_the_simulated_robot(tmp_path: Path) -> None:
    """The same on a record that is made here."""
    folder = tmp_path / "robot"
    assert main(["new", str(folder)]) == 0
    (folder / "black_box.yaml").write_text(
        "- sim: {seed: 3, speed: max, duration_s: 8, times: virtual,\n"
        "        faults: [{id: laser_front_blocked, at_s: 5}]}\n"
    )
    assert main(["record", str(folder), "--quiet"]) == 0
    plan, _ = load_plan(load_folder(folder))
    store = open_store(folder / "store")
    assert in_pieces(plan, store, 1) == in_bytes(replay(plan, store))
