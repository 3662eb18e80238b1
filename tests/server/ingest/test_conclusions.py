"""Conclusions: records from columns as they were written, joined with the link's, once each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest

from amberbox.blackbox.journal import channels
from amberbox.core.clock import NS
from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis, Output, Status, Symptom
from amberbox.core.types import Test as Step
from amberbox.monitoring.findings import finding_of, record_of
from amberbox.server.derived import derived_records
from amberbox.server.schema import ASIDE, BOOT, ROW, RUN
from amberbox.testing.records import T0_NS, FakeRun
from tests.server.archive.recordings import Robot
from tests.server.house import House, house

ROBOT = "ropod_001"
STEPS = (
    Step("battery", "read", "measure it", "technician", 60.0, 0.0, 0.5, {"high": 0.5, "low": 1}),
    Step("look", "check", "look", "operator", 5.0, 0.0, 0.1, {"yes": 0.25, "no": 0.75}),
)
FAULTS = (
    Hypothesis("h1", frozenset({"a", "b"}), 0.5, ("s1",), (), (), (), "p", 1.0),
    Hypothesis("h2", frozenset({"c"}), 0.25, ("s1", "s2"), ("s3",), (), ("h1",), "", 2.0),
)


def status(number: int) -> Status:
    outputs: dict[str, Output] = {"volts": 23.5 + number, "text": "x", "none": None, "on": True}
    outputs["count"] = number
    at_ns = T0_NS + number
    return Status(ROBOT, "battery", "", "ok", "nominal", outputs, ("bus",), at_ns, 1, "why", "c")


def diagnosis(number: int) -> Diagnosis:
    groups = (AmbiguityGroup(("h1", "h2"), 0.75, (), "battery"),) if number else ()
    hypotheses, tests = (FAULTS, STEPS) if number else ((), ())
    return Diagnosis("d1", number, ROBOT, T0_NS, "c", hypotheses, 0.9, "", ("f",), tests, groups)


def symptom(number: int) -> Symptom:
    evidence = (("a/b", 1, 2), ("c/d", 3, 4))[:number]
    return Symptom(f"s{number}", "present", "a/b", None, T0_NS, 1.0, "monitor", evidence, ())


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("conclusions") / "server") as found:
        yield found


@pytest.fixture(scope="module")
def recorded(home: House, tmp_path_factory: pytest.TempPathFactory) -> Robot:
    """A robot whose first ten seconds are in the archive; the journal's rows begin at 0."""
    robot = Robot(ROBOT, tmp_path_factory.mktemp("robot"))
    run = FakeRun(robot.store, writer="watch")
    for number in range(10):
        for finding in (status(number), diagnosis(number % 2), symptom(number % 3)):
            channel, values = record_of(finding)
            run.own(channel, T0_NS + number * NS, values)
        if number == 4:
            run.rotate()
    run.close()
    robot.hand_in_all(home.services.archive)
    assert home.services.archive.commit(0).rows
    return robot


def come_early(home: House, store_id: str, seqs: Sequence[int], run: int = 1) -> None:
    """Store rows from the link."""
    about = {"robot": ROBOT, "store_id": store_id, "writer": "watch", "run": run,
             "channel": channels.STATUS, "received_ns": 0}  # fmt: skip
    rows = [
        {**about, "seq": n, "log_ns": T0_NS + n * NS,
         "data": msgspec.json.encode(record_of(status(n))[1])}
        for n in seqs
    ]  # fmt: skip
    with home.services.database.begin() as connection:
        connection.execute(ROW.insert(), rows)


def test_records_come_back_as_they_were_written(home: House, recorded: Robot) -> None:
    for made, channel in ((status, channels.STATUS), (symptom, channels.SYMPTOM)):
        found = derived_records(home.services, ROBOT, channel)
        assert len(found) == 10
        assert finding_of(channel, found[0].values) == made(0)
        assert finding_of(channel, found[2].values) == made(2)
    found = derived_records(home.services, ROBOT, channels.DIAGNOSIS)
    assert [finding_of(channels.DIAGNOSIS, e.values) for e in found] == [
        diagnosis(number % 2) for number in range(10)
    ]
    assert list(found[1].values) == list(record_of(diagnosis(1))[1])


def test_a_range_and_a_limit_are_kept(home: House, recorded: Robot) -> None:
    def times(**asked: Any) -> list[int]:
        found = derived_records(home.services, ROBOT, channels.STATUS, **asked)
        return [(entry.at_ns - T0_NS) // NS for entry in found]

    assert times(span=(T0_NS + 3 * NS, T0_NS + 6 * NS)) == [3, 4, 5]
    assert times(limit=2) == [0, 1]
    assert times(limit=2, newest=True) == [8, 9]
    assert times(limit=7, newest=True, span=(None, T0_NS + 8 * NS)) == [1, 2, 3, 4, 5, 6, 7]
    assert times(span=(T0_NS + NS * 4 + 1, None), limit=1) == [5]


def test_rows_of_the_link_follow_once(home: House, recorded: Robot) -> None:
    come_early(home, recorded.store_id, [3, 6, 30, 31])  # the journal holds 0 to 29
    come_early(home, recorded.store_id, [40], run=2)
    with home.services.database.begin() as connection:
        about = {"robot": ROBOT, "store_id": recorded.store_id, "writer": "watch", "run": 2}
        connection.execute(RUN.insert(), [{**about, "boot": "00c0ffee", "end_seq": 41}])
        boot = {"robot": ROBOT, "boot_id": "00c0ffee-1111-2222", "round_ns": 1, "at_ns": 1}
        connection.execute(BOOT.insert(), [{**boot, "offset_ns": 5 * NS}])
        lost = {**about, "seq": 41, "sha256": "0" * 64, "why": "lost_at_power_cut",
                "channel": channels.STATUS, "log_ns": T0_NS + 41 * NS, "at_ns": 0,
                "data": b'{"component":"gone"}'}  # fmt: skip
        connection.execute(ASIDE.insert(), [lost])
    found = derived_records(home.services, ROBOT, channels.STATUS)
    assert [entry.seq for entry in found][-3:] == [30, 31, 40]
    places = [(entry.store_id, entry.writer, entry.run, entry.seq) for entry in found]
    assert len(found) == 13 == len(set(places))
    assert found[-1].server_ns == T0_NS + 45 * NS and found[-2].server_ns is None
    shown = derived_records(home.services, ROBOT, channels.STATUS, aside=True)
    assert [entry.aside for entry in shown][-2:] == ["", "lost_at_power_cut"]
    newest = derived_records(home.services, ROBOT, channels.STATUS, limit=2, newest=True)
    assert [entry.seq for entry in newest] == [31, 40]


def test_commands_are_conclusions_like_the_others(home: House, tmp_path: Path) -> None:
    def command(number: int, state: str) -> dict[str, str]:
        about = {"id": f"{number:032x}", "text": "why", "person": "anna", "action": "drive",
                 "parameters": "{}", "risk": "moves", "issuer": "anna", "run": "run-1", "step": "",
                 "result": ""}  # fmt: skip
        return {"robot": "ropod_003", "state": state, **about}

    robot = Robot("ropod_003", tmp_path)
    run = FakeRun(robot.store, writer="act")
    states = ("ask", "accepted", "report", "done")
    for number, state in enumerate(states):
        run.own(channels.COMMAND, T0_NS + number * NS, command(1, state))
    run.close()
    robot.hand_in_all(home.services.archive)
    home.services.archive.commit(0)
    about = {"robot": "ropod_003", "store_id": robot.store_id, "writer": "act", "run": 1,
             "channel": channels.COMMAND, "received_ns": 0}  # fmt: skip
    rows = [
        {**about, "seq": n, "log_ns": T0_NS + n * NS,
         "data": msgspec.json.encode(command(2, "refused"))}
        for n in (1, 50)
    ]  # fmt: skip
    with home.services.database.begin() as connection:
        connection.execute(ROW.insert(), rows)
    found = derived_records(home.services, "ropod_003", channels.COMMAND)
    assert [one.values["state"] for one in found] == [*states, "refused"]
    assert found[0].values == command(1, "ask") and found[0].writer == "act"


def test_another_robot_has_concluded_nothing(home: House, recorded: Robot) -> None:
    assert derived_records(home.services, "ropod_002", channels.STATUS, aside=True) == []
