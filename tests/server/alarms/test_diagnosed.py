"""The diagnosis of an alarm: stored in the state of its last revision while the alarm was
active.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from amberbox.core.clock import NS
from amberbox.server.alarms import lifecycle
from amberbox.server.alarms.alarm import Alarm, AlarmSettings, decode_words
from amberbox.server.alarms.store import AlarmRegister
from amberbox.server.bus import ServerChange
from amberbox.server.schema import CONSEQUENCE
from tests.server.alarms.stand import Stand, alarm, blocked, diagnosis, explained, stand

SETTINGS = AlarmSettings()


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Stand]:
    with stand(tmp_path) as one:
        yield one


def answer(revision: int, severity: str, *texts: str) -> dict[str, Any]:
    """Return what of an answer counts for alarms."""
    members = [{"text": text, "faults": [{"id": f"laser#{n}", "text": text}]}
               for n, text in enumerate(texts)]  # fmt: skip
    told: dict[str, Any] = {"broken": {"members": members} if members else None, "others": [],
            "sure": {"probability": 0.93}, "use": {"severity": severity}}  # fmt: skip
    return {"id": "d1", "revision": revision, "explanation": told}


def explain(
    home: Stand, revision: int, severity: str, *texts: str, probability: float = 0.93
) -> None:
    told: dict[str, Any] = {"answer": answer(revision, severity, *texts)}
    told["answer"]["explanation"]["sure"]["probability"] = probability
    home.bus.publish(ServerChange("explained", "r1", told))
    home.alarms.step()


def causes(one: Alarm) -> list[str]:
    words = decode_words(one.words)
    return [cause.text for cause in words.causes] if words else []


def test_what_is_found_after_its_end_does_not_change_an_alarm(home: Stand) -> None:
    home.say("r1", alarm(home), diagnosis(home, "laser#x", revision=3), explained(home))
    explain(home, 3, "critical", "the mirror is slow")
    one = home.only()
    assert (one.revised, one.severity, causes(one)) == (3, "critical", ["the mirror is slow"])
    home.say("r1", alarm(home, state="healed", cause="laser#x", diagnosis="d1"))
    home.say("r1", diagnosis(home, "loc#shift", revision=4))
    explain(home, 4, "warning", "it is at a wrong place")
    home.wait(120)
    one = home.only()
    assert (one.state, one.revised, one.severity) == ("resolved", 3, "critical")
    assert causes(one) == ["the mirror is slow"]


def test_it_follows_its_diagnosis_while_it_lasts_and_when_it_comes_back(home: Stand) -> None:
    home.say("r1", diagnosis(home, "laser#x", revision=1))
    explain(home, 1, "urgent", "one")
    home.say("r1", explained(home))  # the alarm comes after what explains it
    assert (home.only().revised, causes(home.only())) == (1, ["one"])
    home.say("r1", diagnosis(home, "laser#y", revision=2))
    explain(home, 2, "urgent", "two")
    assert (home.only().revised, causes(home.only())) == (2, ["two"])
    home.say("r1", alarm(home, state="healed", cause="laser#x", diagnosis="d1"))
    home.say("r1", diagnosis(home, "laser#z", revision=3))
    explain(home, 3, "urgent", "three")
    assert home.only().revised == 2
    home.wait(5)
    home.say("r1", alarm(home, count=2, cause="laser#z", diagnosis="d1"))
    assert (home.only().revised, causes(home.only())) == (3, ["three"])


def test_words_that_come_after_the_end_count_if_they_are_of_its_last_revision(home: Stand) -> None:
    home.say("r1", diagnosis(home, "laser#x", revision=2), explained(home))
    home.say("r1", alarm(home, state="healed", cause="laser#x", diagnosis="d1"))
    explain(home, 2, "critical", "one")
    one = home.only()
    assert (one.severity, causes(one), one.active) == ("critical", ["one"], False)


def test_the_severity_is_that_of_the_effect(home: Stand) -> None:
    home.say("r1", diagnosis(home, "laser#x"), explained(home))
    explain(home, 1, "warning", "one")
    assert home.only().severity == "warning"  # be it less than the monitor's
    home.say("r1", alarm(home, count=1, cause="laser#x", diagnosis="d1", reason="still"))
    assert home.only().severity == "warning"
    explain(home, 1, "", "one")
    assert home.only().severity == "warning"  # nobody knows: as it was
    home.wait(12)
    assert home.only().told == "warning"


def test_a_guess_makes_an_alarm_worse_but_not_less_bad(home: Stand) -> None:
    home.say("r1", diagnosis(home, "laser#x"), explained(home))
    explain(home, 1, "warning", "one", probability=0.4)
    assert home.only().severity == "urgent"
    explain(home, 1, "warning")  # probably a false alarm
    assert home.only().severity == "urgent"
    explain(home, 1, "critical", "one", probability=0.4)
    assert home.only().severity == "critical"


def test_what_was_as_bad_before_is_not_open_again(home: Stand) -> None:
    home.say("r1", diagnosis(home, "laser#x"), explained(home))
    explain(home, 1, "critical", "one")
    one = home.only()
    with home.database.begin() as connection:
        step = lifecycle.acknowledged(one, "anna", home.clock.wall_ns(), person="anna")
        AlarmRegister(connection).keep(one, step)
    for severity, state in (("urgent", "acknowledged"), ("critical", "acknowledged"),
                            ("fatal", "open")):  # fmt: skip
        explain(home, 1, severity, "one")
        assert (home.only().severity, home.only().state) == (severity, state)
    assert home.only().owner == "anna"


def test_who_acknowledges_owns_what_nobody_owns() -> None:
    of = Alarm(1, "robot", "r1", "laser", "urgent", "error", "", 0, 0)
    assert lifecycle.acknowledged(of, "anna", 1, person="anna")[0].owner == "anna"
    owned = lifecycle.owned(of, "anna", 1, "berta")[0]
    assert lifecycle.acknowledged(owned, "anna", 2, person="anna")[0].owner == "berta"


def suffering(home: Stand) -> dict[str, tuple[int, int | None]]:
    with home.database.reading() as connection:
        return {r.component: (r.from_ns, r.to_ns) for r in connection.execute(select(CONSEQUENCE))}


def test_nothing_stops_to_suffer_before_it_began(home: Stand) -> None:
    home.say("r1", alarm(home))
    home.wait(60)
    begun_ns = home.clock.wall_ns()  # long after the last word of the alarm itself
    home.say("r1", blocked(home, "loc", "laser"))
    home.wait(10)
    home.say("r1", blocked(home, "loc", level="ok"))
    assert suffering(home)["loc"] == (begun_ns, begun_ns + 10 * NS)


def test_what_goes_on_to_suffer_began_when_it_began(home: Stand) -> None:
    home.say("r1", alarm(home), blocked(home, "loc", "laser"))
    begun_ns = home.clock.wall_ns()
    home.wait(10)
    home.say("r1", blocked(home, "loc", "laser", level="warn"))
    assert suffering(home)["loc"] == (begun_ns, None)
    home.say("r1", blocked(home, "loc", level="ok"))
    home.wait(10)
    home.say("r1", blocked(home, "loc", "laser"))
    assert suffering(home)["loc"] == (begun_ns + 20 * NS, None)
