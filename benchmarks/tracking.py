"""Tracking: what it costs to turn symptoms into diagnoses on the simulated robot.

Conditions of its FMEA are evaluated over what its wheel units say for a minute without faults,
in steps as live, and at once as in a replay. Answers are those to random faults.
"""

from __future__ import annotations

import contextlib
import io
import random
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.cli.main import main
from amberbox.consult.folder_knowledge import fmea_references
from amberbox.core.clock import NS
from amberbox.core.types import Batch, Column, ItemSchema, Symptom
from amberbox.diagnosis.diagnose import DiagnosisId, ObservedSituation, answer
from amberbox.diagnosis.fmea.loader import load_fmea
from amberbox.diagnosis.fmea.model import links_by_mode
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.tracker import EFFORT, FaultTracker
from amberbox.sim.robot import START_NS, Robot
from benchmarks.common import Row, percentile

SECONDS = 60
STEP_NS = NS // 10
CASES = 100
READABLE = 0.9


def measure() -> list[Row]:
    """Measure conditions live and in a replay, and answers to one, two and three faults."""
    knowledge = _simulated()
    return [*_conditions(knowledge), *(_answers(knowledge, faults) for faults in (1, 2, 3))]


def _simulated() -> Knowledge:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "robot"
        with contextlib.redirect_stdout(io.StringIO()):
            assert main(["new", str(folder), "--from", "sim"]) == 0
        fmea, problems = load_fmea(folder / "fmea.yaml", fmea_references(load_folder(folder)))
    assert fmea is not None, problems
    return Knowledge("bench", fmea)


def _conditions(knowledge: Knowledge) -> Iterator[Row]:
    count = sum(symptom.condition is not None for symptom in knowledge.fmea.symptoms.values())
    whole = _wheels()
    live_s = _tracked_s(knowledge, [*_parts(whole, STEP_NS)])
    replay_s = _tracked_s(knowledge, [*_parts(whole, SECONDS * NS)])
    what, note = f"{count} conditions of the simulated robot", f"{len(whole)} messages, no fault"
    yield Row(f"{what}, live", 100 * live_s / SECONDS, "% of a core", note=f"{note}; to be < 2")
    yield Row(f"{what}, replay", SECONDS / replay_s, "x", note=f"{note}; to be > 100")


def _wheels() -> Batch:
    """Return what the wheel units say for a while."""
    said = [
        (at, message) for topic, at, message in Robot(3).step_until(SECONDS) if topic == "wheels"
    ]
    times_ns = np.array([at for at, _ in said], np.int64)
    rows = [dict(_flat("", message)) for _, message in said]
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    schema = ItemSchema("sim", tuple(Column(name, name, "float64") for name in columns))
    seq = np.arange(len(said))
    return Batch("sim_wheels", schema, "main", 1, seq, times_ns, times_ns, times_ns, columns)


def _flat(prefix: str, message: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in message.items():
        if isinstance(value, dict):
            yield from _flat(f"{prefix}{key}_", value)
        elif isinstance(value, int | float):
            yield f"{prefix}{key}", value


def _parts(whole: Batch, step_ns: int) -> Iterator[tuple[int, Batch]]:
    """Cut a batch into what comes in each step."""
    for until_ns in range(START_NS + step_ns, START_NS + SECONDS * NS + 1, step_ns):
        first, end = whole.log_time_ns.searchsorted([until_ns - step_ns, until_ns], "right")
        times_ns, seq = whole.log_time_ns[first:end], whole.seq[first:end]
        columns = {name: np.asarray(values)[first:end] for name, values in whole.columns.items()}
        yield until_ns, Batch(whole.item, whole.schema, "main", 1, seq, times_ns, times_ns,
                              times_ns, columns)  # fmt: skip


def _tracked_s(knowledge: Knowledge, parts: list[tuple[int, Batch]]) -> float:
    """Return the CPU seconds that tracking takes."""
    tracker = FaultTracker(knowledge)
    tracker.begin(START_NS)
    start_s = time.process_time()
    for until_ns, batch in parts:
        tracker.feed(batch)
        tracker.advance([], until_ns)
    return time.process_time() - start_s


def _answers(knowledge: Knowledge, faults: int) -> Row:
    rng = random.Random(faults)
    times_ms = [_answer_ms(knowledge, _situation(knowledge, faults, rng)) for _ in range(CASES)]
    note = f"95 %: {percentile(times_ms, 95):.1f}, largest {max(times_ms):.1f}, with its tests"
    what = f"answer to {faults} random {'fault' if faults == 1 else 'faults'}, median"
    return Row(what, percentile(times_ms, 50), "ms", note=note)


def _situation(knowledge: Knowledge, faults: int, rng: random.Random) -> ObservedSituation:
    """Return what monitors say of random faults; some outputs cannot be read."""
    links = links_by_mode(knowledge.fmea)
    chosen = rng.sample(list(knowledge.fmea.modes), faults)
    shown = {link.symptom for m in chosen for link in links[m] if rng.random() < link.detects}
    read = [name for name in knowledge.fmea.symptoms if name in shown or rng.random() < READABLE]
    symptoms = (Symptom(name, "present" if name in shown else "absent", name) for name in read)
    return ObservedSituation(tuple(symptoms), watched=True)


def _answer_ms(knowledge: Knowledge, situation: ObservedSituation) -> float:
    start_s = time.process_time()
    answer(knowledge, situation, DiagnosisId("bench", 1, 0), EFFORT)
    return 1e3 * (time.process_time() - start_s)
