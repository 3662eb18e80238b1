"""One order of words, ``VERB ACTION WHERE``; each form of before means the same request."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import pytest

from amberbox.cli import alarm, fmea, incident, mission
from amberbox.cli.main import main

VERBS = {"alarm": alarm, "incident": incident, "mission": mission, "fmea": fmea}
URL = "https://fleet.example:8443/robots/r1"
FORMS: Sequence[tuple[str, str, list[str]]] = [
    # verb, as it is documented, other forms
    ("alarm", "list WHERE", ["WHERE", "WHERE list"]),
    ("alarm", "list WHERE --all --json", ["WHERE --all --json", "--json WHERE list --all",
                                          "WHERE --all --json list"]),
    ("alarm", "ack WHERE a1 --note n", ["WHERE ack a1 --note n", "WHERE --note n ack a1",
                                        "--note n ack WHERE a1"]),
    ("alarm", "shelve WHERE a1 --for 2h", ["WHERE shelve a1 --for 2h", "WHERE shelve --for 2h a1"]),
    ("alarm", "unshelve WHERE a1 --who bo", ["WHERE unshelve a1 --who bo"]),
    ("incident", "mark WHERE", ["WHERE", "WHERE mark"]),
    ("incident", "mark WHERE --before 5s --reason r", ["WHERE --before 5s --reason r",
                                                       "--before 5s WHERE --reason r"]),
    ("incident", "list WHERE --json", ["WHERE list --json", "--json list WHERE"]),
    ("incident", "show WHERE last", ["WHERE show last"]),
    ("incident", "release WHERE i1", ["WHERE release i1"]),
    ("mission", "list WHERE", ["WHERE", "WHERE list"]),
    ("mission", "list WHERE --failed --last 3", ["WHERE --failed --last 3",
                                                 "WHERE list --failed --last 3",
                                                 "list --failed WHERE --last 3"]),
    ("mission", "start WHERE transport --id m1", ["WHERE start transport --id m1",
                                                  "start --id m1 WHERE transport"]),
    ("mission", "end WHERE", ["WHERE end"]),
    ("mission", "end WHERE m1 --outcome failed", ["WHERE end m1 --outcome failed"]),
    ("mission", "detect WHERE --dry-run", ["WHERE detect --dry-run"]),
    ("fmea", "table WHERE --json", ["WHERE table --json", "--json table WHERE"]),
]  # fmt: skip


def request(verb: str, line: str, where: str) -> dict[str, Any]:
    """Return the parsed arguments of a command line."""
    parser = argparse.ArgumentParser(prog=f"amberbox {verb}")
    VERBS[verb].configure(parser)
    parsed = vars(parser.parse_args([where if w == "WHERE" else w for w in line.split()]))
    return {name: value for name, value in parsed.items() if name != "words"}


@pytest.mark.parametrize("where", ["r1", "./list", URL])
@pytest.mark.parametrize(("verb", "line", "others"), FORMS)
def test_every_form_is_the_same_request(
    verb: str, line: str, others: list[str], where: str
) -> None:
    asked = request(verb, line, where)
    assert asked["action"] == line.split()[0] and asked["where"] == where
    for other in others:
        assert request(verb, other, where) == asked, other


@pytest.mark.parametrize(
    ("verb", "line", "action", "where"),
    [
        ("alarm", "list", "list", "list"),  # a folder called list, as before
        ("alarm", "ack list", "list", "ack"),
        ("alarm", "shelve ack a1", "ack", "shelve"),
        ("incident", "mark", "mark", "mark"),
        ("incident", "list show", "list", "show"),
        ("mission", "list start", "list", "start"),
    ],
)
def test_a_folder_that_is_called_like_an_action_is_meant_as_before(
    verb: str, line: str, action: str, where: str
) -> None:
    asked = request(verb, line, "")
    assert (asked["action"], asked["where"]) == (action, where)


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ("alarm acc r1 a1", "did you mean 'ack'"),
        ("alarm r1 acc a1", "did you mean 'ack'"),
        ("incident shw r1 last", "did you mean 'show'"),
        (f"incident {URL} shw last", "did you mean 'show'"),
        ("incident list", "needs WHERE"),
    ],
)
def test_a_wrong_action_is_named(line: str, what: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(line.split()) == 2
    assert what in capsys.readouterr().err


def test_a_robot_is_named_beside_every_action() -> None:
    for line in ("list WHERE --robot r1", "WHERE --robot r1", "--robot r1 WHERE list"):
        asked = request("alarm", line, "https://fleet.example")
        assert (asked["where"], asked["robot"]) == ("https://fleet.example", "r1")
