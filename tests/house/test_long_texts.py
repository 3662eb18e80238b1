"""Text that others wrote is read in time that grows with its length: no pattern explodes.

Each case is read at one length and at eight times that: CPU time grows by 8 where all is well, by
64 where it is quadratic. What is over within moments is fine however it grows.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from amberbox.agent import folder_upload as robot_masking
from amberbox.blackbox.columns import ros1_text, ros_definition
from amberbox.blackbox.formats import csv, mongodump, ulog
from amberbox.blackbox.sources import zmq
from amberbox.core.expressions.parser import tokens as expression_tokens
from amberbox.core.expressions.tree import ExpressionFault
from amberbox.core.redaction import redact, secrets_by_name
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.diagnosis.prolog.syntax import sentences
from amberbox.monitoring import mode_bindings
from amberbox.monitoring.probes import ping
from amberbox.server.ingest.worker import masked
from amberbox.server.web import text

SHORT = 5000
TIMES = 8
TOO_MUCH = 25.0
"""Between 8 and 64, with room for a machine that is busy with other things."""
SOON_S = 0.1
TRIES = 3


def _text(data: str) -> None:
    masked({"a.txt": data.encode()})


def _yaml(data: str) -> None:
    masked({"a.yaml": data.encode()})


def _redacted(data: str) -> None:
    node = parse_yaml(data, "a.yaml", [])
    assert node is not None
    redact(data, secrets_by_name(node))


def _robot(data: str) -> None:
    robot_masking.masked({"a.txt": data.encode()})


def _rules(data: str) -> None:
    list(sentences(data))


def _expression(data: str) -> None:
    try:
        list(expression_tokens(data))
    except ExpressionFault:
        return


def _zmq(data: str) -> None:
    zmq._NAME_AND_JSON.match(data.encode())


KEY, BEGIN = "-----BEGIN PRIVATE KEY-----", "-----BEGIN "
CASES: dict[str, tuple[Callable[[str], object], str, str, str]] = {
    "a folder: blank lines": (_text, "", "\n", ""),
    "a folder: hyphens": (_text, "", "-", ""),
    "a folder: one long word": (_text, "", "secret", ""),
    "a folder: keys without values": (_text, "", "password\n", ""),
    "a folder: keys and blank lines": (_text, "", "token\n\n\n\n", ""),
    "a folder: logins": (_text, "a://", "b:", ""),
    "a folder: addresses": (_text, "", "a://b", ""),
    "a folder: keys that do not end": (_text, "", KEY, ""),
    "a folder: keys that do not begin": (_text, "", BEGIN + "A", ""),
    "a folder: broken YAML": (_yaml, "a: [\n", "\n", ""),
    "a folder: YAML of secrets": (_redacted, "", "- token: abc\n", ""),
    "a robot: one long word": (_robot, "", "a", ""),
    "a robot: a long word of secrets": (_robot, "", "secret", ""),
    "a robot: elements": (_robot, "", "<password ", ""),
    "a robot: elements that end together": (_robot, "", "<password ", "> x"),
    "a robot: questions": (_robot, "?", "key", ""),
    "a robot: blanks behind a key": (_robot, "", "password   ", ""),
    "a robot: keys in two words": (_robot, "", "api key ", ""),
    "rules: comments that are not closed": (_rules, "", "a. /* .\n", ""),
    "rules: comments in a row": (_rules, "", "/* ", ""),
    "rules: quotes": (_rules, "", "a('.\n", ""),
    "rules: blanks": (_rules, "", " \n", "("),
    "rules: a long fact": (_rules, "p(", "a,", "X)."),
    "an expression: names": (_expression, "", "a:", ""),
    "an expression: a long name": (_expression, "", "a.", ""),
    "a message: zeros before JSON": (_zmq, "a", "\0", "x"),
    "a message: blanks before JSON": (_zmq, "a", " ", "x"),
    "a definition: blanks": (mongodump._FIELD.findall, "a", " ", "-"),
    "a definition: brackets": (mongodump._FIELD.findall, "", "a[1", ""),
    "a definition: constants": (ros_definition._CONSTANT.findall, "", "a b", ""),
    "a definition: separators": (ros_definition._SEPARATOR.findall, "=" * 80, " ", "x"),
    "a definition: arrays": (ros1_text._ARRAY.search, "", "[1", ""),
    "a log: a field": (ulog._FIELD.fullmatch, "a", " ", "-"),
    "a table: a unit": (csv._unit_of, "", "_", "x"),
    "a table: numbers": (csv._PATTERNS["float"].fullmatch, "", " 1", "x"),
    "a status: its reason": (text._CHECK.findall, "", "a ", ""),
    "an expectation: blanks": (mode_bindings._RANGE.fullmatch, "a", " ", "x"),
    "an address: colons": (ping._BARE_V6.fullmatch, "", ":", "-"),
    "an answer: digits": (ping._SUMMARY.search, "", "1", ""),
}


@pytest.mark.parametrize("name", CASES)
def test_it_takes_time_in_proportion(name: str) -> None:
    read, head, pump, tail = CASES[name]
    growth = []
    for _ in range(TRIES):
        short_s, long_s = (
            _cpu_s(read, head + pump * (size // len(pump)) + tail)
            for size in (SHORT, SHORT * TIMES)
        )
        growth.append(long_s / short_s)
        if long_s < SOON_S or growth[-1] < TOO_MUCH:
            return
    raise AssertionError(f"{TIMES} times the text takes {growth} times as long")


def _cpu_s(read: Callable[[str], object], text: str) -> float:
    start_ns = time.process_time_ns()
    read(text)
    return max(time.process_time_ns() - start_ns, 1000) / 1e9
