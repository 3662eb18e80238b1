"""The first page: its numbers agree with each other and with the pages they link to."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from html import unescape
from typing import Any

import pytest

from amberbox.core.clock import NS
from amberbox.server.schema import ALARM, ALARM_ROBOT
from tests.server.house import START_NS, House, house
from tests.server.state.lives import put_alarm

SHELVED = {"state": "shelved", "shelved_by": "operator"}
SEEN_TO = {"state": "acknowledged", "acknowledged_by": "operator"}
OVER = {"active": False, "cleared_ns": START_NS}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    """Active and past alarms, acknowledged or not."""
    with house(tmp_path_factory.mktemp("house"), shared=True) as made:
        happened: Sequence[Mapping[str, Any]] = ({}, OVER, SEEN_TO, SHELVED)
        for number, changes in enumerate(happened, 1):
            put_alarm(made, number, "ropod_001")
            change(made, number, **changes)
        put_alarm(made, 5, "ropod_002", severity="fatal")
        change(made, 5, **OVER)
        put_alarm(made, 6, "ropod_003", severity="critical")
        change(made, 6, **SEEN_TO)
        yield made


def change(home: House, number: int, **changes: Any) -> None:
    if changes:
        with home.services.database.begin() as connection:
            connection.execute(ALARM.update().where(ALARM.c.number == number), [changes])


def read(home: House, path: str = "/") -> str:
    return unescape(home.client("viewer").get(path).text)


def card(home: House, robot: str) -> str:
    return read(home, f"/pieces/robots/{robot}")


def test_the_numbers_of_alarms_agree(home: House) -> None:
    shown = read(home)
    on_top = re.findall(r'data-alarm-count="(\d+)"', shown)
    on_cards = re.findall(r'data-alarms="(\d+)"', shown)
    assert on_top == ["3"] and sorted(on_cards) == ["0", "1", "2"]
    for robot, number in (("ropod_001", 2), ("ropod_002", 1), ("ropod_003", 0)):
        assert f'data-alarms="{number}"' in card(home, robot)
        listed = re.findall(r'data-alarm="(\d+)"', read(home, f"/pieces/alarms?robot={robot}"))
        assert len(listed) == number, robot


def test_the_choices_count_the_robots_that_they_show(home: House) -> None:
    for name, robots in (("alarms", 2), ("trouble", 3), ("all", 3)):
        shown = read(home, f"/pieces/robots?show={name}")
        counts = re.search(r"data-counts='([^']+)'", shown)
        assert counts and json.loads(counts[1])[name] == robots == shown.count("<article"), name


def test_a_card_says_what_is_over_and_how_bad_what_lasts_is(home: House) -> None:
    assert "2 open alarms, 1 of them over" in card(home, "ropod_001")
    over = card(home, "ropod_002")
    assert "1 open alarm, over" in over and "severity-" not in over
    seen_to = card(home, "ropod_003")
    assert "No open alarm" in seen_to and "it cannot go on" in seen_to


def test_an_offline_alarm_of_several_counts_for_who_is_back_as_over(home: House) -> None:
    put_alarm(home, 7, "ropod_001", "ropod_002")
    try:
        back = ALARM_ROBOT.update().where(
            ALARM_ROBOT.c.alarm == 7, ALARM_ROBOT.c.robot == "ropod_002"
        )
        with home.services.database.begin() as connection:
            connection.execute(back.values(to_ns=START_NS + NS))
        cards = {one["robot"]: one for one in home.client("viewer").get("/api/v1/robots").json()}
        assert (cards["ropod_001"]["alarms"], cards["ropod_001"]["alarms_over"]) == (3, 1)
        assert (cards["ropod_002"]["alarms"], cards["ropod_002"]["alarms_over"]) == (2, 2)
        assert 'data-alarm-count="4"' in read(home)
    finally:
        change(home, 7, state="resolved", **OVER)


def test_who_is_away_is_said_so_once_and_how_it_was(home: House) -> None:
    away = card(home, "ropod_001")
    assert away.count("never connected") == 1 and "Nothing is known of it." in away
    assert "rows" not in away
