"""One alarm per root: folded, joined, reopened; duplicates and old news change nothing."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.core.clock import NS
from amberbox.server.alarms import lifecycle
from amberbox.server.alarms.recipients import NAME, Notifications
from amberbox.server.alarms.store import AlarmRegister
from amberbox.server.bus import ServerChange
from tests.server.alarms.stand import (
    EARLIER,
    EVERYTHING,
    STORE,
    Stand,
    alarm,
    blocked,
    diagnosis,
    explained,
    stand,
)


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Stand]:
    with stand(tmp_path) as one:
        yield one


def test_it_opens_is_told_once_and_is_over_when_it_was_quiet(home: Stand) -> None:
    home.say("r1", alarm(home))
    one = home.only()
    assert (one.robot, one.origin, one.severity, one.state, one.active) == (
        "r1", "laser", "urgent", "open", True,
    )  # fmt: skip
    assert home.published == [one.number]
    home.wait(9)
    assert home.told == []
    home.wait(3)
    assert [name for name, _ in home.told] == ["hook"]
    home.say("r1", alarm(home, state="healed"))
    home.wait(59)
    assert (home.only().state, home.only().active) == ("open", False)
    home.wait(2)
    assert (home.only().state, home.only().resolution) == ("resolved", "over")
    assert len(home.told) == 1
    assert home.history(one.number) == ["opened", "notified", "resolved"]


def test_nobody_was_told_where_there_is_nobody_to_tell(home: Stand) -> None:
    home.set(NAME, Notifications())
    home.say("r1", alarm(home))
    home.wait(12)
    one = home.only()
    assert (home.history(one.number), one.told, one.notify_ns) == (["opened"], "", None)
    home.set(NAME, EVERYTHING)
    home.say("r1", alarm(home, state="healed"))
    home.wait(62)
    home.say("r1", alarm(home))  # it comes back when there is somebody: that is news
    home.wait(12)
    assert home.history(one.number) == ["opened", "resolved", "reopened", "notified"]
    assert len(home.told) == 1


def test_what_failed_first_folds_into_its_root_and_keeps_its_id(home: Stand) -> None:
    home.say("r1", alarm(home, "loc"))
    first = home.only()
    home.wait(5)
    follows = "follows from laser"
    home.say("r1", alarm(home, "laser"), alarm(home, "loc", "healed", reason=follows))
    one = home.only()
    assert (one.number, one.origin, one.active, one.state) == (first.number, "laser", True, "open")
    home.wait(20)
    assert len(home.told) == 1


def test_a_root_further_away_is_found_through_what_is_blocked(home: Stand) -> None:
    home.say("r1", alarm(home, "nav"))
    home.say("r1", blocked(home, "loc", "laser"), alarm(home, "laser"))
    home.say("r1", alarm(home, "nav", "healed", reason="follows from loc"))
    assert home.only().origin == "laser"


def test_what_suffers_is_listed_under_the_root(home: Stand) -> None:
    home.say("r1", blocked(home, "loc", "laser"), blocked(home, "nav", "loc"), alarm(home))
    number = home.only().number
    assert home.suffering(number) == {"loc": True, "nav": True}
    home.say("r1", blocked(home, "nav", level="ok"))
    assert home.suffering(number) == {"loc": True, "nav": False}


def test_a_diagnosis_joins_what_comes_from_one_component(home: Stand) -> None:
    home.say("r1", alarm(home, "laser"))
    number = home.only().number
    home.say("r1", alarm(home, "log"))
    assert len(home.found()) == 2
    home.say(
        "r1", diagnosis(home, "laser#silent"), explained(home, "laser"),
        explained(home, "log"),
    )  # fmt: skip
    one = home.only()
    assert (one.number, one.origin, one.cause) == (number, "laser", "laser#x")
    assert home.suffering(number) == {"log": True}
    home.wait(20)
    assert len(home.told) == 1


@pytest.mark.parametrize(
    ("faults", "share"), [(("laser#silent", "log#dead"), 0.9), (("laser#silent",), 0.4)]
)
def test_two_faults_or_a_guess_join_nothing(
    home: Stand, faults: tuple[str, ...], share: float
) -> None:
    home.say(
        "r1", diagnosis(home, *faults, share=share), explained(home, "laser"),
        explained(home, "log"),
    )  # fmt: skip
    assert len(home.found()) == 2


def test_the_cause_comes_later_and_the_acknowledgement_stays(home: Stand) -> None:
    home.say("r1", alarm(home))
    number = home.only().number
    acknowledge(home)
    home.say("r1", diagnosis(home, "laser#x"), alarm(home, cause="laser#x", diagnosis="d1"))
    one = home.only()
    assert (one.number, one.cause, one.state) == (number, "laser#x", "acknowledged")


def acknowledge(home: Stand) -> None:
    one = home.only()
    with home.database.begin() as connection:
        step = lifecycle.acknowledged(one, "anna", home.clock.wall_ns())
        AlarmRegister(connection).keep(one, step)


def test_what_gets_worse_is_open_and_told_again(home: Stand) -> None:
    home.say("r1", alarm(home))
    home.wait(12)
    acknowledge(home)
    home.say("r1", alarm(home, severity="fatal"))
    assert home.only().state == "open"
    home.wait(12)
    assert [m.subject for _, m in home.told] == ["urgent: r1 laser", "fatal: r1 laser"]
    home.say("r1", alarm(home, severity="warning", count=2))
    home.wait(12)
    assert len(home.told) == 2


def test_it_comes_back_as_the_same_alarm(home: Stand) -> None:
    home.say("r1", alarm(home))
    home.wait(12)
    home.say("r1", alarm(home, state="healed"))
    home.wait(100)
    assert home.only().state == "resolved"
    home.say("r1", alarm(home, source="laser-2"))
    one = home.only()
    assert (one.state, one.active, one.count) == ("open", True, 2)
    assert "reopened" in home.history(one.number)
    home.wait(12)
    assert len(home.told) == 1
    home.say("r1", alarm(home, state="healed", source="laser-2"))
    home.wait(500)
    home.say("r1", alarm(home, source="laser-3"))
    assert [one.count for one in home.found()] == [2, 1]


def test_what_is_said_again_changes_nothing(home: Stand) -> None:
    opened = home.rows("r1", [alarm(home)])
    healed = home.rows("r1", [alarm(home, state="healed")])
    home.send("r1", opened)
    home.send("r1", healed)
    home.alarms.step()
    before = home.only(), home.history(1)
    home.send("r1", opened)  # the ledger knows it
    home.bus.publish(ServerChange("rows", "r1", {"store_id": STORE, "rows": opened}))
    home.alarms.step()
    assert (home.only(), home.history(1)) == before


def test_old_news_that_come_after_new_ones_change_nothing(home: Stand) -> None:
    opened = home.rows("r1", [alarm(home)])
    healed = home.rows("r1", [alarm(home, state="healed")])
    home.send("r1", healed)
    home.alarms.step()
    home.send("r1", opened)
    home.alarms.step()
    assert (home.only().active, home.only().count) == (False, 1)
    home.wait(12)
    assert home.told == []


def test_flapping_at_1_hz_for_10_minutes_is_one_alarm_with_a_counter(home: Stand) -> None:
    home.alarms.step()
    for number in range(300):
        home.hear("r1", alarm(home, count=number + 1))
        home.clock.advance(1)
        home.hear("r1", alarm(home, state="healed", count=number + 1))
        home.wait(1)
    one = home.only()
    assert (one.count, one.state) == (300, "open")
    assert len(home.told) == 1
    assert len(home.history(one.number)) < 5
    home.wait(61)
    assert home.only().state == "resolved"


def test_flapping_that_the_robot_takes_for_new_alarms_is_one_too(home: Stand) -> None:
    for number in range(10):
        home.say("r1", alarm(home, source=f"laser-{number}"))
        home.wait(30)
        home.say("r1", alarm(home, state="healed", source=f"laser-{number}"))
        home.wait(90)
    assert home.only().count == 10
    assert len(home.told) == 1


def test_a_robot_that_forgot_to_end_an_alarm_has_one_all_the_same(home: Stand) -> None:
    home.say("r1", alarm(home))
    home.say("r1", alarm(home, source="laser-2"))
    home.say("r1", alarm(home, state="healed", source="laser-2"))
    assert home.only().active is False


def test_a_crash_after_rows_were_stored_loses_no_alarm(home: Stand) -> None:
    home.alarms.step()
    home.send("r1", home.rows("r1", [alarm(home)]), heard=False)
    home.restart()
    home.alarms.step()
    assert home.only().origin == "laser"
    home.restart()
    home.wait(12)
    assert len(home.told) == 1
    home.restart()
    home.wait(12)
    assert (len(home.told), home.only().count) == (1, 1)


def test_nonsense_of_a_robot_disturbs_nobody(home: Stand) -> None:
    good = alarm(home)
    (row,) = home.rows("r1", [good])
    bad = [
        b"", b"[]", b"{}", row.data.replace(b'"urgent"', b'"dreadful"'),
        row.data.replace(b'"component":"laser"', b'"component":["laser"]'),
        row.data.replace(b'"count":1', b'"count":1e999'),
    ]  # fmt: skip
    rows = [type(row)("watch", 1, 10 + k, row.channel, row.log_ns, data)
            for k, data in enumerate(bad)]  # fmt: skip
    huge = row.data.replace(b'"count":1,', b'"count":99999999999999999999999,')
    named = row.data.replace(b'"laser-1"', b'"' + b"x" * 5000 + b'"')
    rows += [type(row)("watch", 1, 30 + k, row.channel, row.log_ns, data)
             for k, data in enumerate([huge, named])]  # fmt: skip
    home.send("r1", rows)
    home.alarms.step()
    home.send("r1", [row])
    home.alarms.step()
    assert {one.origin for one in home.found()} == {"laser"}


def test_a_robot_speaks_for_itself_alone(home: Stand) -> None:
    home.add(["r2"])
    home.connect("r2")
    (row,) = home.rows("r2", [alarm(home)])  # it says that it is r1
    home.send("r2", [row])
    home.alarms.step()
    assert home.only().robot == "r2"


def test_times_are_those_of_the_server(home: Stand) -> None:
    home.connect("r1", behind_s=3600, boot=EARLIER)
    behind_ns = home.clock.wall_ns() - 3600 * NS
    rows = home.rows("r1", [alarm(home, opened_ns=behind_ns, changed_ns=behind_ns)], behind_ns)
    home.send("r1", rows)
    home.alarms.step()
    assert (home.only().opened_ns, home.only().late) == (home.clock.wall_ns(), False)


def test_the_part_that_is_named_is_the_one_whose_reason_is_given(home: Stand) -> None:
    home.say("r1", alarm(home, "laser", reason="new_scans is false"))
    home.say("r1", alarm(home, "log", reason="errors is 3"))
    home.say(
        "r1", diagnosis(home, "laser#silent"), explained(home, "laser"), explained(home, "log")
    )
    assert home.only().origin == "laser"
    home.say("r1", alarm(home, "log", reason="errors is 3"))
    home.say("r1", alarm(home, "laser", "healed", reason="new_scans is false"))
    one = home.only()
    assert (one.origin, one.reason, one.active) == ("log", "errors is 3", True)


def test_alarms_of_which_the_robot_names_different_causes_stay_two(home: Stand) -> None:
    home.say(
        "r1", diagnosis(home, "laser#silent"), explained(home, "laser", "laser#silent"),
        explained(home, "log", "log#full"),
    )  # fmt: skip
    assert [(one.origin, one.cause) for one in home.found()] == [
        ("laser", "laser#silent"), ("log", "log#full"),
    ]  # fmt: skip


def test_the_second_of_two_faults_is_not_the_alarm_of_the_first(home: Stand) -> None:
    follows = alarm(home, "log", "healed", reason="follows from laser")
    home.say("r1", alarm(home, "laser"), alarm(home, "log"), follows)
    home.say("r1", alarm(home, "laser", "healed"))
    home.wait(20)  # repaired, and not over yet
    home.say("r1", alarm(home, "log", source="log-2"))
    home.say("r1", alarm(home, "motor", cause="motor#weak", diagnosis="d1"))
    home.say("r1", alarm(home, "log", "healed", source="log-2", reason="follows from motor"))
    told = [(one.origin, one.active) for one in home.found() if one.merged_into is None]
    assert sorted(told) == [("laser", False), ("motor", True)]


def test_what_belongs_to_an_alarm_is_listed_while_it_fails(home: Stand) -> None:
    home.say("r1", alarm(home, "laser"), alarm(home, "log"), blocked(home, "log"))
    home.say("r1", alarm(home, "log", "healed", reason="follows from laser"))
    number = home.only().number
    assert home.suffering(number) == {"log": True}
    home.say("r1", blocked(home, "log", level="ok"))
    assert home.suffering(number) == {"log": False}
