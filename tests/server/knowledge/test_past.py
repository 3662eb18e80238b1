"""Lookups of rules on the server: conditions in the archive, statuses in archive and link."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from amberbox.blackbox.journal import channels
from amberbox.core.clock import NS
from amberbox.core.timestamps import format_time
from amberbox.core.types import Status
from amberbox.monitoring.findings import record_of
from amberbox.server.knowledge import worker
from amberbox.server.knowledge.questions import AskDiagnosis, AskRules, encode_question
from amberbox.server.knowledge.worker import without_paths
from amberbox.testing.records import BATTERY, T0_NS, FakeRun
from tests.server.archive.recordings import Robot
from tests.server.house import House, house
from tests.server.knowledge import robot as sim

NAME = "ropod_001"
FULL = """\
kind: components
types:
  cell:
    ports: {level: [full, low]}
    modes: {works: {nominal: true, constraints: [level == full]}, unknown: {probability: 1e-6}}
components: {cell: cell}
observe:
  cell.level: {value: battery.volts > 22, values: {true: full, false: low}}
"""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    """Ten minutes in the archive: a battery that runs low in the last four, a mission, a status."""
    with house(tmp_path_factory.mktemp("past") / "server") as found:
        robot = Robot(NAME, tmp_path_factory.mktemp("robot"))
        run = FakeRun(robot.store, items=(BATTERY,))
        run.start(T0_NS - 1)
        run.write([
            (T0_NS + s * NS, BATTERY, {"volts": 24.0 if s < 360 else 20.0}) for s in range(600)
        ])  # fmt: skip
        run.close()
        watch = FakeRun(robot.store, writer="watch")
        for second in range(0, 600, 10):
            at_ns = T0_NS + second * NS
            level: Any = "ok" if second < 400 else "error"
            status = Status(NAME, "battery", "", level, "nominal", {}, (), at_ns, at_ns, "", "c")
            watch.own(channels.STATUS, at_ns, record_of(status)[1])
        watch.close()
        robot.hand_in_all(found.services.archive)
        assert found.services.archive.commit(0).rows
        sim.hand_in(found, more={"models/full.yaml": FULL.encode()})
        yield found


def ask(home: House, query: str, **more: Any) -> Any:
    asked = AskRules(robot=NAME, now_ns=T0_NS + 700 * NS, query=query, want="why", **more)
    return json.loads(worker.rules(home.services.folder, encode_question(asked)))


def test_a_condition_held_in_the_archive(home: House) -> None:
    (answer,) = ask(home, "holds('battery.volts < 22', F, T)")["answers"]
    assert answer == {"F": T0_NS + 360 * NS, "T": T0_NS + 599 * NS + 1}


def test_only_the_window_is_looked_at(home: House) -> None:
    window = {"from_": format_time(T0_NS), "to": format_time(T0_NS + 60 * NS)}
    assert ask(home, "holds('battery.volts < 22', F, T)", **window)["answers"] == []


def test_statuses_of_the_archive_are_facts(home: House) -> None:
    found = ask(home, "status(battery, L, _, _)", from_=format_time(T0_NS))
    assert {answer["L"] for answer in found["answers"]} == {"ok"}  # no event told of the change
    assert found["proof"][0][0]["at"].startswith("watcher, ")


def test_a_model_of_components_reads_items_of_the_archive(home: House) -> None:
    def diagnosed(second: int) -> str:
        at = format_time(T0_NS + second * NS)
        asked = AskDiagnosis(robot=NAME, now_ns=T0_NS + 700 * NS, at=at, config_hash=sim.HASH)
        return str(worker.diagnose(home.services.folder, encode_question(asked)))

    assert "full: not all are sound: cell" not in diagnosed(300)
    assert "full: not all are sound: cell" in diagnosed(500)


def test_answers_name_no_folder_of_the_server() -> None:
    text = f"/srv/amberbox/folders/ropod_001/{'a' * 64}/rules/a.pl:3: a mistake"
    assert without_paths(Path("/srv/amberbox"), text) == "rules/a.pl:3: a mistake"
