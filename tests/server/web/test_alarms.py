"""The pages of alarms: what they list, to whom, in which words, and what is text in them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict, replace
from typing import Any

import pytest

from amberbox.core.api import AlarmLine, Happening, LeadingCause, Words
from amberbox.core.clock import NS
from amberbox.core.timestamps import format_time
from amberbox.diagnosis.diagnose import DiagnosisContext, ObservedSituation, diagnose_context
from amberbox.diagnosis.report.serialiser import context_json, explain_context
from amberbox.server.alarms.alarm import Alarm, encode_words, explanation_of
from amberbox.server.schema import ALARM, ALARM_ROBOT, CONSEQUENCE, HISTORY, OUTBOX
from amberbox.server.services.alarms import alarm_line
from amberbox.server.web.alarms import AlarmListQuery, AlarmTexts, events
from amberbox.server.web.text import checks_fail, plain_cause
from tests.server.house import START_NS, House, house
from tests.server.knowledge import robot as sim

HOSTILE = '"><script>alert(1)</script> {{7*7}}'
HOUR_NS = 3600 * NS
CAUSE = "laser_front#silent or laser_front#no_power (very likely)"


def alarm(number: int, robot: str, origin: str, severity: Any, **more: Any) -> Alarm:
    """Return an alarm that began ``number`` hours ago."""
    at_ns = START_NS - number * HOUR_NS
    usual = Alarm(number, "robot", robot, origin, severity, "error", f"{origin} is broken",
                  at_ns, at_ns)  # fmt: skip
    return replace(usual, **more)


ALARMS = (
    alarm(1, "ropod_001", "wheel", "warning"),
    alarm(2, "ropod_001", "laser_front", "critical", cause=CAUSE, late=True, count=7),
    alarm(3, "ropod_003", "oven", "fatal", reason=HOSTILE, revision=5),
    alarm(4, "ropod_002", "wifi", "urgent", state="acknowledged", acknowledged_by="operator",
          acknowledged_ns=START_NS, owner="technician"),
    alarm(5, "ropod_002", "battery", "urgent", state="shelved", shelved_by="operator",
          shelved_until_ns=START_NS + HOUR_NS),
    alarm(30, "ropod_001", "imu", "critical", state="resolved", active=False, resolved_by="nurse",
          cleared_ns=START_NS - 28 * HOUR_NS, resolved_ns=START_NS - 28 * HOUR_NS,
          resolution="cable"),
    alarm(31, "ropod_001", "log", "urgent", state="resolved", active=False, merged_into=2),
    alarm(6, "", "access point ward-4", "urgent", kind="offline",
          reason="offline: ropod_001, ropod_003"),
)  # fmt: skip
LAMP_OFF = {"laser_front.lamp": "no"}
SEVERAL = 6
"""The alarm of a robot of the ward and one of the kitchen."""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("alarms"), shared=True) as found:
        plant(found)
        yield found


def plant(home: House) -> None:
    about = [{"alarm": one.number, "robot": robot, "from_ns": one.opened_ns, "to_ns": None}
             for one in ALARMS for robot in ([one.robot] if one.robot else
                                             ["ropod_001", "ropod_003"])]  # fmt: skip
    said = [
        {"alarm": one.number, "at_ns": one.opened_ns + n, "who": who, "what": what, "text": text}
        for one in ALARMS
        for n, (who, what, text) in enumerate([
            ("", "opened", one.reason), ("operator", "note", HOSTILE),
            ("", "notified", one.severity),
        ])
    ]  # fmt: skip
    suffers = {"alarm": 2, "component": "task_executor", "level": "error", "reason": HOSTILE,
               "from_ns": START_NS - HOUR_NS, "to_ns": START_NS - HOUR_NS + 90 * NS}  # fmt: skip
    with home.services.database.begin() as connection:
        connection.execute(ALARM.insert(), [asdict(one) for one in ALARMS])
        connection.execute(ALARM_ROBOT.insert(), about)
        connection.execute(HISTORY.insert(), said)
        connection.execute(CONSEQUENCE.insert(), [suffers])


def page(home: House, path: str = "/alarms", name: str = "viewer", **params: Any) -> str:
    answer = home.client(name).get(path, params=params)
    assert answer.status_code == 200, answer.text
    return str(answer.text)


def listed(home: House, name: str = "viewer", **params: Any) -> list[int]:
    """Return the numbers of the alarms of a list, in its order."""
    found = page(home, "/pieces/alarms", name, **params)
    return [int(number) for number in re.findall(r'data-alarm="(\d+)"', found)]


def counts(home: House, name: str = "viewer", **params: Any) -> dict[str, int]:
    found = page(home, "/pieces/alarms", name, **params)
    tabs = re.findall(r'data-tab="(\w+)".*?<b class="chip-count">(\d+)</b>', found)
    return {tab: int(number) for tab, number in tabs}


@pytest.mark.parametrize(
    ("params", "numbers"),
    [
        ({}, [3, 2, SEVERAL, 1]),
        ({"sort": "newest"}, [1, 2, 3, SEVERAL]),
        ({"state": "acknowledged"}, [4]),
        ({"state": "shelved"}, [5]),
        ({"state": "resolved"}, [30]),
        ({"state": "all", "sort": "newest"}, [1, 2, 3, 4, 5, SEVERAL, 30]),
        ({"state": "all"}, [3, 2, 4, 5, SEVERAL, 1, 30]),
        ({"severity": "critical"}, [3, 2]),
        ({"robot": "ropod_001"}, [2, SEVERAL, 1]),
        ({"robot": "nobody"}, []),
        ({"team": "kitchen"}, [3, SEVERAL]),
        ({"q": "LASER"}, [2]),
        ({"q": "laser wheel"}, []),
        ({"q": "ropod_003"}, [3, SEVERAL]),
        ({"q": "3"}, [3, SEVERAL]),
        ({"q": "technician", "state": "all"}, [4]),
        ({"q": "%"}, []),
        ({"state": "all", "from": "now-20h"}, [3, 2, 4, 5, SEVERAL, 1]),
        ({"state": "all", "to": "now-29h"}, [30]),
        ({"state": "all", "from": "now-29h", "to": "now-210m"}, [4, 5, SEVERAL, 30]),
        ({"n": 1}, [3]),
    ],
)
def test_which_alarms_in_which_order(
    home: House, params: dict[str, Any], numbers: list[int]
) -> None:
    assert listed(home, **params) == numbers


def test_tabs_count_what_fits_and_not_only_what_is_listed(home: House) -> None:
    whole = {"open": 4, "acknowledged": 1, "shelved": 1, "resolved": 1, "all": 7}
    assert counts(home, n=1) == whole
    assert counts(home, severity="critical", state="shelved") == {
        "open": 2, "acknowledged": 0, "shelved": 0, "resolved": 1, "all": 3}  # fmt: skip


def test_there_are_more_where_not_all_are_listed(home: House) -> None:
    assert 'data-more="52"' in page(home, n=2)
    assert "data-more" not in page(home, n=4)


def test_robots_of_other_teams_are_not_there(home: House) -> None:
    assert listed(home, "nurse", state="all", sort="newest") == [1, 2, 4, 5, SEVERAL, 30]
    assert counts(home, "nurse")["open"] == 3
    whole = page(home, "/alarms", "nurse") + page(home, f"/alarms/{SEVERAL}", "nurse")
    assert "ropod_003" not in whole and "kitchen" not in whole
    assert home.client("nurse").get("/alarms/3").status_code == 404
    assert home.client("nurse").get("/pieces/alarms/3").status_code == 404


def test_nobody_finds_out_about_other_robots_by_looking_for_words(home: House) -> None:
    assert listed(home, "nurse", q="ropod_003", state="all") == []
    assert listed(home, "nurse", q="ropod_001") == [2, SEVERAL, 1]


@pytest.mark.parametrize(("name", "number"), [("viewer", 4), ("nurse", 3)])
def test_how_many_are_open_stands_on_every_page(home: House, name: str, number: int) -> None:
    for path in ("/", "/alarms", "/alarms/1", "/help", "/pieces/alarm-count"):
        assert f'data-alarm-count="{number}"' in page(home, path, name), path


def test_who_is_not_signed_in_sees_no_number(home: House) -> None:
    assert "data-alarm-count" not in home.client().get("/help").text


def test_an_alarm_in_words(home: House) -> None:
    found = page(home, "/pieces/alarms", robot="ropod_001", q="laser")
    for text in ("Laser front: “laser front” fails", "laser_front is broken",
                 "it cannot go on with what it does",
                 "Laser front: silent or Laser front: no power (cannot tell them apart)", "7 times",
                 "happened while offline", "1 part suffers from it", "Task executor"):  # fmt: skip
        assert text in found, text


def explained_answer(revision: int, **answers: str) -> dict[str, Any]:
    """Return what the server says of a silent laser after answers to tests."""
    knowledge = sim.knowledge()
    silent = ObservedSituation(
        (sim.symptom(sim.NO_SCANS, sim.AT_NS),), watched=True, answers=answers
    )
    case = DiagnosisContext(sim.AT_NS, silent)
    found = diagnose_context(knowledge, case)
    told = context_json(knowledge, case, found, explain_context(knowledge, case, found))
    return {**told, "revision": revision}


def told(answer: dict[str, Any]) -> AlarmLine:
    """Return an alarm that is explained by an answer."""
    found = explanation_of("ropod_001", answer)
    assert found is not None
    return alarm_line(replace(ALARMS[1], diagnosis="d-1", words=encode_words(found.words)), [])


def test_the_cause_is_told_as_on_the_card_of_the_diagnosis(home: House) -> None:
    words, line = AlarmTexts(home.services), alarm_line(replace(ALARMS[1], diagnosis="d-1"), [])
    assert words.cause(line) == (
        "Laser front: silent or Laser front: no power (cannot tell them apart)"
    )
    both = told(explained_answer(1))
    assert re.fullmatch(
        r"The \w+ of the front laser .* or the front laser has no power "
        r"\(cannot tell them apart, \d\d %\)", words.cause(both)
    )  # fmt: skip
    one = told(explained_answer(1, **LAMP_OFF))
    assert re.fullmatch(r"The front laser has no power \(likely, \d\d %\)", words.cause(one))
    assert words.title(one) == "The front laser has no power"


def test_history_names_failures_as_the_card_does(home: House) -> None:
    words, line = AlarmTexts(home.services), told(explained_answer(1, **LAMP_OFF))
    said = words.plain(line, "laser_front#silent (almost certain)")
    assert said == "The front laser has no power (likely)"
    assert words.plain(line, "laser_front#silent (possible)").endswith("(possible)")


@pytest.mark.parametrize(
    ("reason", "title"),
    [
        ("operational is false, expected true", "Laser: “operational” fails"),
        ("operational is false, expected true; power_on is false, expected true: no power",
         "Laser: “operational” and “power on” fail"),
        ("a is 1, expected 2; b was not as expected less than 20 s ago; c flapping: 9 changes",
         "Laser: “a” and 2 more fail"),
        ("does_not_jump was not as expected less than 20 s ago", "Laser: “does not jump” fails"),
        ("no message for 3 s", "Laser: no message for 3 s"),
        ("", "Laser"),
    ],
)  # fmt: skip
def test_without_a_cause_the_title_says_which_checks_fail(reason: str, title: str) -> None:
    assert checks_fail("Laser", reason) == title


@pytest.mark.parametrize(
    ("cause", "said"),
    [
        ("laser_front: working is false, expected true", "Laser front: “working” fails"),
        ("the watcher has said nothing for 5 s", "the watcher has said nothing for 5 s"),
        ("", ""),
    ],
)
def test_the_cause_of_a_card_says_which_checks_fail(cause: str, said: str) -> None:
    assert plain_cause(cause) == said


def test_what_nobody_described_is_no_title(home: House) -> None:
    other = Words([LeadingCause("something", "other")], 0.7)
    line = alarm_line(replace(ALARMS[1], words=encode_words(other)), [])
    assert AlarmTexts(home.services).title(line) == "Laser front: “laser_front” fails".replace(
        "_", " "
    )
    assert AlarmTexts(home.services).cause(line) == (
        "Something that nobody has described yet (likely, 70 %)"
    )


@pytest.mark.parametrize(
    ("origin", "title"),
    [("access point", "Access point: offline: ropod_001"), ("connection", "offline: ropod_001")],
)
def test_robots_that_are_away_in_words(home: House, origin: str, title: str) -> None:
    away = replace(ALARMS[-1], origin=origin, robot="ropod_001", reason="offline: ropod_001")
    line = alarm_line(away, [])
    assert AlarmTexts(home.services).title(line) == title
    assert "while it is away" in page(home, f"/alarms/{SEVERAL}")


@pytest.mark.parametrize("path", ["/alarms", "/alarms/3", "/pieces/alarms/3", "/alarms/2"])
def test_what_robots_and_people_say_is_text(home: House, path: str) -> None:
    found = page(home, path, "admin")
    assert "&lt;script&gt;alert(1)" in found
    assert "<script>alert" not in found and "49" not in re.findall(r">([^<]*49[^<]*)<", found)


def test_one_alarm_with_all_there_is(home: House) -> None:
    found = page(home, "/alarms/2", "operator")
    window = f"from={format_time(ALARMS[1].opened_ns - 60 * NS)}".replace(":", "%3A")
    assert f'href="/robots/ropod_001/data?{window}' in found
    assert 'href="/robots/ropod_001#timeline"' in found
    for text in ("It began", "the server", "Task executor"):
        assert text in found, text


@pytest.mark.parametrize(
    ("name", "number", "there"),
    [
        ("viewer", 1, []),
        ("operator", 1, ["acknowledge", "own", "own", "note", "shelve", "resolve"]),
        ("operator", 4, ["own", "own", "note", "shelve", "resolve"]),
        ("operator", 5, ["acknowledge", "unshelve", "own", "note", "shelve", "resolve"]),
        ("operator", 30, ["note"]),
        ("operator", 31, []),
        ("nurse", SEVERAL, []),
        ("operator", SEVERAL, ["acknowledge", "own", "note", "shelve", "resolve"]),
    ],
)
def test_what_one_can_do(home: House, name: str, number: int, there: list[str]) -> None:
    found = page(home, f"/alarms/{number}", name)
    posts = re.findall(rf'data-post="/api/v1/alarms/{number}/(\w+)"', found)
    assert sorted(set(posts)) == sorted(set(there))


def test_it_is_said_why_one_can_do_nothing(home: House) -> None:
    assert "Somebody who may is an operator" in page(home, "/alarms/1")
    assert "robots of other teams" in page(home, f"/alarms/{SEVERAL}", "nurse")


@pytest.mark.parametrize(
    ("number", "people"),
    [(1, {"operator", "technician", "admin", "nurse"}), (3, {"operator", "technician", "admin"})],
)
def test_an_alarm_is_given_to_who_may_change_it(home: House, number: int, people: set[str]) -> None:
    found = page(home, f"/alarms/{number}", "operator")
    assert set(re.findall(r"<option[^>]*>(\w+)</option>", found)) == people
    assert '<select name="user">' not in page(home, f"/alarms/{number}", "viewer")


def test_forms_carry_the_revision_that_was_seen(home: House) -> None:
    assert "&#34;revision&#34;:5" in page(home, "/alarms/3", "operator")


def test_what_became_part_of_another_leads_on(home: House) -> None:
    assert '<a href="/alarms/2">alarm 2</a>' in page(home, "/alarms/31")


def test_an_alarm_of_several_robots_lists_them(home: House) -> None:
    found = page(home, f"/alarms/{SEVERAL}")
    assert re.findall(r'<td><a href="/robots/(\w+)">', found) == ["ropod_001", "ropod_003"]


def test_who_was_told_is_for_who_may_know(home: House) -> None:
    assert "People were told" not in page(home, "/alarms/4")
    row = {"key": "k", "destination": "night-shift", "kind": "alarm", "alarm": 4,
           "severity": "urgent", "state": "failed", "subject": "s", "body": "b", "data": "{}",
           "created_ns": START_NS, "due_ns": START_NS, "tries": 1, "trouble": HOSTILE}  # fmt: skip
    with home.services.database.begin() as connection:
        connection.execute(OUTBOX.insert(), [row])
    viewers, admins = page(home, "/alarms/4"), page(home, "/alarms/4", "admin")
    assert "People were told" in viewers and "1 message" in viewers
    assert "night-shift" not in viewers
    assert "night-shift" in admins and "did not arrive" in admins
    assert "<script>alert" not in admins


@pytest.mark.parametrize(
    "query",
    ["state=nonsense", "severity=none", "from=yesterday", "n=0", "sort=up", "q=" + "x" * 200],
)
def test_what_the_address_says_wrong_is_a_page_that_says_so(home: House, query: str) -> None:
    answer = home.client("viewer").get(f"/alarms?{query}")
    assert answer.status_code == 400
    assert answer.headers["content-type"].startswith("text/html")


def test_where_nothing_fits_one_is_led_to_all_of_them(home: House) -> None:
    found = page(home, q="no such thing", state="shelved")
    assert "No alarm fits" in found and 'href="/alarms?state=shelved"' in found


def test_without_alarms_it_says_that_this_is_good(tmp_path_factory: pytest.TempPathFactory) -> None:
    with house(tmp_path_factory.mktemp("none"), shared=True) as empty:
        found = page(empty)
    assert "No open alarm" in found
    assert re.search(r'data-alarm-count="0" hidden', found)


def test_addresses_name_only_what_is_unusual() -> None:
    assert AlarmListQuery().address() == "?"
    assert (
        AlarmListQuery(q="a&b", since="now-1h").address(state="all")
        == "?state=all&q=a%26b&from=now-1h"
    )


def happened(home: House, *lines: Happening) -> list[tuple[str, str, str]]:
    words, line = AlarmTexts(home.services), one_line()
    return [(one.what, one.text, one.until) for one in events(list(lines), words, line)]


def one_line() -> AlarmLine:
    return alarm_line(ALARMS[1], [])


def test_history_in_words_the_newest_first(home: House) -> None:
    at = format_time(START_NS)
    assert happened(
        home,
        Happening(at, "", "worse", "warning -> critical"),
        Happening(at, "", "cause", "laser_front#silent (likely)"),
        Happening(at, "anna", "shelved", "until 2027-01-15T08:00:00Z: until 5: spare"),
        Happening(at, "", "unshelved", "its time is over"),
        Happening(at, "", "resolved", "over, it came 3 times"),
        Happening(at, "anna", "resolved", "over"),
        Happening(at, "", "new_word", "of a later version"),
    ) == [
        ("new_word", "of a later version", ""),
        ("Resolved", "over", ""),
        ("Resolved by itself", "it came 3 times", ""),
        ("Unshelved by itself", "its time is over", ""),
        ("Shelved", "until 5: spare", "2027-01-15T08:00:00Z"),
        ("The diagnosis says", "Laser front: silent (likely)", ""),
        ("It got worse", "critical: it cannot go on with what it does", ""),
    ]
