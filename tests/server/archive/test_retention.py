"""Data older than their rule are deleted, journals and columns apart; incidents and events stay."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.core.clock import NS
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.journals import OWN, Retention
from amberbox.testing.clock import ManualClock
from amberbox.testing.records import POSE, T0_NS, FakeRun
from tests.server.archive.recordings import Robot

_DAY_S = 24 * 3600.0


@pytest.fixture
def robot(archive: FolderArchive, tmp_path: Path, clock: ManualClock) -> Robot:
    """A robot with three journals that arrived three days ago, joined to one file per table."""
    made = Robot("r1", tmp_path)
    made.record(0, files=3)
    _incident(made, 1, "complete")
    made.hand_in_all(archive)
    archive.commit()
    clock.advance(3 * _DAY_S)
    return made


def _incident(robot: Robot, number: int, state: str) -> None:
    """Pin what the journal of this number holds."""
    run = FakeRun(robot.store, "keep")
    start_ns = T0_NS + number * 40 * NS // 100
    window = {"id": "i1", "state": state, "from_ns": start_ns + 1, "to_ns": start_ns + NS // 10}
    run.own("amberbox/incident", start_ns, window)
    run.close()


def journals(archive: FolderArchive) -> list[str]:
    """Return the journal files that are left."""
    return sorted(f"{p.parent.name}/{p.name}" for p in archive.layout.journals.rglob("*.mcap"))


def test_columns_go_and_what_an_incident_pins_stays(archive: FolderArchive, robot: Robot) -> None:
    assert archive.retain([Retention(columns_s=2 * _DAY_S)]) == 2
    x = archive.robot("r1").query("odom", ["pose_x"]).values("pose_x")
    assert x == [float(number) for number in range(40, 80)]
    assert sum(archive.robot("r1").envelope("odom", ["pose_x"]).values("pose_x:count")) == 40
    assert len(archive.robot("r1").query("amberbox_run")) == 3
    assert len(journals(archive)) == 4
    reasons = [gap.reason for gap in archive.robot("r1").gaps()]
    assert reasons == ["deleted: older than its lifetime, the journal is kept"] * 2
    assert archive.retain([Retention(columns_s=2 * _DAY_S)]) == 0


def test_journals_go_by_class_and_columns_stay(archive: FolderArchive, robot: Robot) -> None:
    assert archive.retain([Retention(journals_s=2 * _DAY_S)]) == 2
    assert journals(archive) == ["journal/000001-00000001-0001.mcap",
                                 "keep/000002-00000002-0000.mcap"]  # fmt: skip
    assert len(archive.robot("r1").query("odom")) == 120
    assert archive.robot("r1").gaps() == []


def test_a_released_incident_pins_nothing(
    archive: FolderArchive, robot: Robot, clock: ManualClock
) -> None:
    _incident(robot, 1, "released")
    robot.hand_in_all(archive)
    archive.commit()
    rule = Retention("r1", "main", journals_s=2 * _DAY_S, columns_s=2 * _DAY_S)
    assert archive.retain([rule]) == 3
    assert len(archive.robot("r1").query("odom")) == 0
    gaps = archive.robot("r1").gaps()
    assert [gap.reason for gap in gaps] == ["deleted: older than its lifetime"]
    assert gaps[0].count == 243


@pytest.mark.parametrize(
    "rules",
    [
        [],
        [Retention(journals_s=4 * _DAY_S, columns_s=4 * _DAY_S)],
        [Retention("r2", journals_s=0.0, columns_s=0.0)],
        [Retention(keeping="bulk", journals_s=0.0)],
        [Retention(columns_s=0.0), Retention("r1")],
    ],
)
def test_what_no_rule_is_about_stays(
    archive: FolderArchive, robot: Robot, rules: list[Retention]
) -> None:
    assert archive.retain(rules) == 0
    assert len(archive.robot("r1").query("odom")) == 120


def test_what_the_box_says_goes_only_when_told(archive: FolderArchive, robot: Robot) -> None:
    assert archive.retain([Retention(keeping=OWN, columns_s=2 * _DAY_S)]) == 3
    runs = archive.robot("r1").query("amberbox_run", ["run"])
    assert runs.values("run") == [1]  # that of the pinned journal
    assert len(archive.robot("r1").query("odom")) == 120


def test_journals_of_commands_go_only_by_a_rule_that_names_them(
    archive: FolderArchive, tmp_path: Path, clock: ManualClock
) -> None:
    robot = Robot("r2", tmp_path)
    run = FakeRun(robot.store, "act")
    run.own("amberbox/command", T0_NS, {"state": "done", "id": "7"})
    run.close()
    robot.hand_in_all(archive)
    archive.commit()
    clock.advance(3 * _DAY_S)
    assert archive.retain([Retention(journals_s=0.0, columns_s=0.0)]) == 0
    assert archive.retain([Retention(keeping="act", journals_s=0.0)]) == 1
    assert journals(archive) == []
    assert archive.robot("r2").query("amberbox_command", ["state"]).values("state") == ["done"]


def test_a_ring_journal_that_a_rule_names_goes(
    archive: FolderArchive, tmp_path: Path, clock: ManualClock
) -> None:
    robot = Robot("r2", tmp_path)
    run = FakeRun(robot.store, "ring", items=[POSE])
    run.write([(T0_NS, POSE, POSE.examples[0])])
    run.close()
    robot.hand_in_all(archive)
    archive.commit()
    clock.advance(2 * _DAY_S)
    archive.retain([Retention(keeping="ring", journals_s=_DAY_S / 2)])
    assert journals(archive) == []
