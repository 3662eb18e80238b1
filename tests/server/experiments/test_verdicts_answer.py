"""Verdicts of runs as answers: the open diagnosis is ranked anew, once, by what was measured."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from amberbox.core.clock import NS
from amberbox.experiments.report import RunReport
from amberbox.experiments.run import RunEvent
from amberbox.server.experiments import runs
from amberbox.server.experiments.judge import _answers
from amberbox.server.experiments.runs import RunKind, RunOrder, StoredRun
from amberbox.server.services.experiments import answer_diagnosis
from tests.server.house import House, house
from tests.server.knowledge import robot as sim

ROBOT = "ropod_001"
TEST = "sensors.nothing_covers_laser-front"


@pytest.fixture
def home(tmp_path: Path) -> Iterator[House]:
    """A robot with something on the window of its front laser, or dirt."""
    with house(tmp_path / "house", shared=True) as found:
        sim.hand_in(found)
        sim.state(found)
        covered = sim.symptom("laser_front/window/window_clear", sim.AT_NS)
        at_ns = sim.AT_NS
        sim.say(found, [
            (at_ns - 5 * NS, sim.status("laser_front", at_ns - 5 * NS)),
            (at_ns, covered), (at_ns, sim.diagnosis(at_ns, covered)),
            (at_ns + NS, sim.status("laser_front", at_ns + NS)),
        ])  # fmt: skip
        yield found


def run_of(home: House, kind: RunKind, name: str) -> StoredRun:
    with home.services.database.begin() as connection:
        order = RunOrder(ROBOT, kind, name, name, "", {}, "anna")
        return runs.add(connection, home.clock.wall_ns(), order)


def diagnosis(home: House) -> dict[str, Any]:
    path = f"/api/v1/robots/{ROBOT}/diagnoses/{sim.DIAGNOSIS}"
    return cast("dict[str, Any]", home.client("viewer").get(path).json())


def test_a_unit_test_answers_the_diagnosis_that_asks_for_it(home: House) -> None:
    run = run_of(home, "unit_test", TEST)
    for _ in range(2):  # the server was killed before it had stored the verdict
        asyncio.run(answer_diagnosis(home.services, run, "failed"))
    found = diagnosis(home)
    assert [(a["test"], a["answer"], a["who"]) for a in found["answers"]] == [
        ("laser_front.sector", "covered", "anna")
    ]
    [revision] = found["server_revisions"]
    assert revision["diagnosis"]["answers"] == {"laser_front.sector": "covered"}


def test_other_runs_answer_nothing(home: House) -> None:
    for kind, name in (("unit_test", "other"), ("experiment", TEST), ("experiment", "none")):
        run = run_of(home, cast(RunKind, kind), name)
        asyncio.run(answer_diagnosis(home.services, run, "passed"))
    assert diagnosis(home)["answers"] == []


@pytest.mark.parametrize(
    ("kind", "verdict", "result", "answers"),
    [
        ("unit_test", "failed", {"outcome": "failed"}, "failed"),
        ("unit_test", "passed", {"outcome": "passed"}, "passed"),
        ("unit_test", "failed", {"outcome": "timeout"}, ""),
        ("unit_test", "failed", {}, ""),
        ("experiment", "failed", {}, "failed"),
        ("experiment", "undecided", {}, ""),
        ("experiment", "aborted", {}, ""),
    ],
)
def test_what_was_not_measured_is_no_answer(
    home: House, kind: RunKind, verdict: str, result: dict[str, Any], answers: str
) -> None:
    ended = RunEvent(1, 0, "ended", values={"state": "failed", "result": result})
    report = RunReport(
        "n", "t", "", "r", ROBOT, "failed", cast(Any, verdict), [], 0, 0, {}, {}, {}, [], [],
        [ended],
    )  # fmt: skip
    assert _answers(run_of(home, kind, "n"), report) == answers
