"""The simulated technician uses only the access log and the visible text of pages."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import pytest

from tools.tour.__main__ import FAULTS, Trial
from tools.tour.notes import Notes, Trail, notes_of, trail_of, truth_of

_WHO = "user:technician"
_CARD = """ropod_002
Ropod (simulated)
What is broken \n
As of 22 Nov, 08:31:19
{broken}
How sure \n
{sure}
Why \n
The fieldbus and its master: the self-check "devices: all there" fails. since 22 Nov, 08:31:10
and 12 more, under “Details”
Can the robot be used?\n
critical No, it cannot go on with what it does.
Do this next \n
Plug it in until it clicks.
5 min
Details
"""
_PLUG = "The fieldbus plug of the front left unit is off"


def _line(second: float, path: str, **more: Any) -> str:
    usual = {"principal": _WHO, "method": "GET", "status": 200, "ms": 0.0}
    return json.dumps({"time": f"2026-11-22T08:31:{second:09.6f}Z", "path": path, **usual, **more})


_WAY = (
    _line(1, "/in", principal="", ms=500.0),
    _line(1.1, "/static/js/all.js", principal=""),
    _line(1.5, "/api/v1/session/code", principal="", method="POST"),
    _line(2, "/"),
    _line(2.5, "/pieces/fleet"),
    _line(3, "/api/v1/robots", principal="user:admin"),
    _line(8, "/api/v1/feed", method="SOCKET", status=101, ms=6000.0),
    _line(8, "/robots/ropod_002/diagnosis"),
    _line(9, "/robots/ropod_002/diagnosis/card"),
    _line(10, "/robots/ropod_002", status=404),
    _line(20.5, "/api/v1/feed", method="SOCKET", status=101, ms=12000.0),
    _line(50, "/robots", principal="user:admin"),
)


def test_clicks_are_pages_and_the_time_ends_when_the_last_is_left() -> None:
    trail = trail_of(_WAY, _WHO)
    assert trail.pages == ["/in", "/", "/robots/ropod_002/diagnosis"]
    assert trail.clicks == 2
    assert trail.seconds == pytest.approx(20.0)


@pytest.mark.parametrize(
    "path",
    ["/", "/alarms", "/alarms/3", "/robots/r", "/robots/r/data", "/robots/r/diagnosis", "/help",
     "/recordings/r", "/a/page/of/tomorrow"],
)  # fmt: skip
def test_whatever_is_not_known_to_be_fetched_by_a_page_is_a_click(path: str) -> None:
    assert trail_of([*_WAY, _line(21, path)], _WHO).clicks == 3


def test_who_opened_no_page_has_no_trail() -> None:
    with pytest.raises(ValueError, match="opened no page"):
        trail_of(_WAY, "user:nurse")


def test_one_cause_is_read_off_the_card() -> None:
    notes = notes_of(_CARD.format(broken=_PLUG, sure="Likely\n 99 %"))
    assert notes == Notes(
        [_PLUG], "Likely 99 %",
        ['The fieldbus and its master: the self-check "devices: all there" fails.'],
        "critical No, it cannot go on with what it does.", "Plug it in until it clicks.",
    )  # fmt: skip


def test_causes_that_look_alike_are_all_read() -> None:
    broken = f"One of these two; nothing tells them apart yet:\n{_PLUG}\n49 %\nA fuse\nunder 1 %"
    notes = notes_of(_CARD.format(broken=broken, sure="Cannot tell them apart"))
    assert notes.causes == [_PLUG, "A fuse"]


def test_a_card_that_lacks_something_is_not_read() -> None:
    with pytest.raises(ValueError, match="How sure"):
        notes_of(_CARD.format(broken=_PLUG, sure=""))


_RIGHT: Mapping[str, Any] = {
    "causes": [_PLUG], "sure": "Likely 99 %",
    "why": ['The fieldbus and its master: the self-check "devices: all there" fails.'],
    "use": "No.", "next": "Plug it in until it clicks.",
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({}, []),
        ({"causes": ["The fuse of the front left unit has blown", _PLUG]}, []),
        ({"causes": ["The fuse of the front left unit has blown"]}, ["it is"]),
        ({"why": ["The battery is empty."]}, ["no reason"]),
        ({"why": ['The rear laser: the self-check "devices: all there" fails.']}, ["no reason"]),
        ({"next": "Replace the robot."}, ["what to do next"]),
        ({"next": "Pull gently at the fieldbus plug of the front left unit."}, []),
    ],
)
def test_what_was_written_down_is_compared_with_what_was_broken(
    change: Mapping[str, Any], what: list[str]
) -> None:
    found = list(truth_of("wheel_front_left_bus_disconnected").wrong(Notes(**{**_RIGHT, **change})))
    assert [text[: len(begin)] for text, begin in zip(found, what, strict=True)] == what


def test_what_takes_too_long_or_too_many_clicks_fails() -> None:
    notes = Notes(**_RIGHT)
    assert list(Trial(FAULTS[-1], notes, Trail(["/in", "/", "/a"], 59.0)).wrong()) == []
    long = Trial(FAULTS[-1], notes, Trail(["/in", *"/abcde"], 61.0))
    assert len(list(long.wrong())) == 2


def test_all_faults_of_the_trial_can_be_judged() -> None:
    assert len({truth_of(fault).cause for fault in FAULTS}) == len(FAULTS) == 3
