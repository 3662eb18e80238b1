"""A clock jump ages nothing: it is held, reported, confirmed by people or by evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sqlalchemy import select

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.archive.retention import AGREED_NS, ALONE_NS, DAY_NS, SLACK_NS, RetentionClock
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.journals import Retention
from amberbox.server.schema import EVENT
from amberbox.testing.clock import ManualClock
from tests.fuzzing import examples, fuzz
from tests.server.archive.recordings import Robot

_DAY_S = 24 * 3600.0
_RULE = [Retention(journals_s=30 * _DAY_S, columns_s=30 * _DAY_S)]


@pytest.fixture
def robot(archive: FolderArchive, tmp_path: Path) -> Robot:
    """A robot with three journals that arrived just now."""
    made = Robot("r1", tmp_path)
    made.record(0, files=3)
    made.hand_in_all(archive)
    archive.commit()
    return made


def left(archive: FolderArchive) -> int:
    """Count the journal files that are left."""
    return len(list(archive.layout.journals.rglob("*.mcap")))


def events(database: ServerDatabase) -> list[str]:
    """Return the kinds of the server's events, in order."""
    chosen = select(EVENT.c.kind).where(EVENT.c.robot == "").order_by(EVENT.c.number)
    with database.reading() as connection:
        return list(connection.scalars(chosen))


def off(clock: ManualClock, days: float, name: str = "next boot") -> None:
    """Switch the machine off for some days."""
    clock.wall += round(days * DAY_NS)
    clock.boot, clock.boot_name = 60 * NS, name


def looks(ages: RetentionClock, clock: ManualClock, hours: float) -> None:
    """Let time pass with a step every ten minutes."""
    for _ in range(round(hours * 6)):
        clock.advance(600.0)
        ages.look()


def confirm(archive: FolderArchive) -> None:
    """Confirm the clock as an admin does."""
    with archive.catalogue.database.begin() as connection:
        archive.ages.confirm(connection, "somebody")


def test_a_server_that_wakes_ahead_deletes_nothing(
    archive: FolderArchive, robot: Robot, clock: ManualClock
) -> None:
    clock.is_synchronised = False
    off(clock, 32)
    assert archive.retain(_RULE) == 0
    looks(archive.ages, clock, 48)
    assert archive.retain(_RULE) == 0
    assert left(archive) == 3
    text = archive.ages.read().text
    assert "32 days ahead" in text
    assert "no recording is deleted" in text
    assert events(archive.catalogue.database) == ["clock_jumped"]


def test_confirmed_time_off_counts(
    archive: FolderArchive, robot: Robot, clock: ManualClock
) -> None:
    off(clock, 32)
    archive.ages.look()
    confirm(archive)
    assert archive.ages.read().text == ""
    assert archive.retain(_RULE) == 3
    assert left(archive) == 0
    assert events(archive.catalogue.database) == ["clock_confirmed"]


@pytest.mark.parametrize("by_s", [32 * _DAY_S, -32 * _DAY_S])
def test_a_clock_that_is_set_makes_nothing_older_even_when_confirmed(
    archive: FolderArchive, robot: Robot, clock: ManualClock, by_s: float
) -> None:
    clock.advance(10 * _DAY_S)
    clock.step(by_s)
    assert archive.retain(_RULE) == 0
    confirm(archive)
    assert archive.retain(_RULE) == 0
    clock.advance(19 * _DAY_S)
    assert archive.retain(_RULE) == 0
    clock.advance(2 * _DAY_S)
    assert archive.retain(_RULE) == 3


def test_ages_go_on_while_a_jump_is_held(
    archive: FolderArchive, robot: Robot, clock: ManualClock
) -> None:
    clock.step(32 * _DAY_S)
    clock.advance(29 * _DAY_S)
    assert archive.retain(_RULE) == 0
    clock.advance(2 * _DAY_S)
    assert archive.retain(_RULE) == 3


def test_journals_that_came_in_1970_are_not_56_years_old(
    archive: FolderArchive, tmp_path: Path, clock: ManualClock
) -> None:
    now_ns, clock.wall = clock.wall, 1000 * NS
    robot = Robot("r1", tmp_path)
    robot.record(0, files=3)
    robot.hand_in_all(archive)
    archive.commit()
    clock.advance(_DAY_S)
    off(clock, 0)
    clock.wall = now_ns
    assert archive.ages.look().text == "", "the first time that it is set needs no confirmation"
    clock.advance(29 * _DAY_S)
    assert archive.retain(_RULE) == 0
    clock.advance(2 * _DAY_S)
    assert archive.retain(_RULE) == 3


def test_a_server_without_a_battery_goes_on(
    archive: FolderArchive, robot: Robot, clock: ManualClock
) -> None:
    now_ns = clock.wall
    off(clock, 0)
    clock.wall = 1000 * NS
    assert "behind" in archive.ages.look().text
    with pytest.raises(UsageError, match="never set"):
        confirm(archive)
    assert archive.retain(_RULE) == 0
    robot.record(200 * NS, files=1)
    robot.hand_in_all(archive)
    archive.commit()
    clock.wall = now_ns + round(0.6 * DAY_NS)
    assert archive.ages.look().text == ""
    assert events(archive.catalogue.database) == []
    clock.advance(29 * _DAY_S)
    assert archive.retain(_RULE) == 0
    clock.advance(2 * _DAY_S)
    assert archive.retain(_RULE) == 4


@pytest.mark.parametrize("robots", [["right"], ["right", "right", "1970", "wrong"]])
def test_a_synchronised_clock_that_robots_share_confirms_itself(
    archive: FolderArchive, robot: Robot, clock: ManualClock, robots: Sequence[str]
) -> None:
    off(clock, 14)
    says = {"right": clock.wall, "wrong": clock.wall - 14 * DAY_NS, "1970": 5 * NS}
    for number, one in enumerate(robots):
        archive.ages.compare_wall(f"r{number}", says[one])
    archive.ages.look()
    looks(archive.ages, clock, AGREED_NS / NS / 3600 - 0.5)
    assert archive.ages.read().jump == "ahead"
    looks(archive.ages, clock, 1)
    assert archive.ages.read().jump == ""
    assert events(archive.catalogue.database) == ["clock_jumped", "clock_confirmed"]


def test_a_synchronised_clock_alone_takes_a_day(
    archive: FolderArchive, robot: Robot, clock: ManualClock
) -> None:
    off(clock, 14)
    looks(archive.ages, clock, ALONE_NS / NS / 3600 - 1)
    assert archive.ages.read().jump == "ahead"
    looks(archive.ages, clock, 2)
    assert archive.ages.read().jump == ""


@pytest.mark.parametrize("is_synchronised", [True, False, None])
def test_no_evidence_confirms_nothing(
    archive: FolderArchive, robot: Robot, clock: ManualClock, is_synchronised: bool | None
) -> None:
    right_ns = clock.wall
    off(clock, 32)
    clock.is_synchronised = is_synchronised
    if is_synchronised:
        archive.ages.compare_wall("r1", right_ns)
    looks(archive.ages, clock, 50)
    assert archive.ages.read().jump == "ahead"
    assert archive.retain(_RULE) == 0


def test_a_jump_that_is_over_is_said_and_forgotten(
    archive: FolderArchive, robot: Robot, clock: ManualClock
) -> None:
    clock.is_synchronised = False
    clock.step(-32 * _DAY_S)
    looks(archive.ages, clock, 1)
    restarted = RetentionClock(archive.catalogue.database, clock)
    looks(restarted, clock, 1)
    assert "32 days behind" in restarted.read().text
    clock.step(32 * _DAY_S)
    restarted.look()
    assert restarted.read().text == ""
    assert events(archive.catalogue.database) == ["clock_jumped", "clock_agrees"]


def test_a_database_of_before_is_as_late_as_what_it_holds(
    tmp_path: Path, archive: FolderArchive, robot: Robot, clock: ManualClock
) -> None:
    database = archive.catalogue.database
    with database.begin() as connection:
        connection.exec_driver_sql("DELETE FROM option")
    assert RetentionClock(database, replace(clock, boot_name="other")).read().text == ""
    assert (
        "ahead"
        in RetentionClock(database, replace(clock, wall=clock.wall + 3 * DAY_NS)).read().text
    )


ACTS = st.lists(
    st.tuples(st.sampled_from(["pass", "step", "off", "1970"]), st.floats(-40, 40)), max_size=12
)


@fuzz
@settings(max_examples=examples(30))
@given(acts=ACTS)
def test_whatever_the_clock_does_no_age_is_more_than_the_time_that_passed(
    tmp_path_factory: pytest.TempPathFactory, acts: list[tuple[str, float]]
) -> None:
    """Without any confirmation; each restart may add a day, because a machine may have been off."""
    clock = ManualClock(is_synchronised=False)
    database = ServerDatabase(tmp_path_factory.mktemp("ages") / FILE, clock)
    ages = RetentionClock(database, clock)
    came_ns, passed_ns, boots = ages.came_ns(), 0, 0
    for act, days in acts:
        if act == "pass":
            clock.advance(abs(days) * _DAY_S)
            passed_ns += round(abs(days) * DAY_NS)
        elif act == "step":
            clock.step(days * _DAY_S)
        elif act == "1970":
            clock.wall = 1000 * NS
        elif act == "off":
            boots += 1
            off(clock, abs(days), f"boot {boots}")
            passed_ns += round(abs(days) * DAY_NS)
        found = ages.look()
        allowed_ns = boots * (DAY_NS + 60 * NS) + len(acts) * SLACK_NS
        assert found.age_ns - came_ns <= passed_ns + allowed_ns
    database.close()
