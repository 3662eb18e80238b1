"""The source of serial ports, with a device on a pseudo-terminal."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import termios
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from amberbox.blackbox.sources import serial as source
from amberbox.blackbox.sources.serial import Config, Source
from amberbox.core.config import build
from amberbox.core.errors import Problem
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.testing.clock import wait_until
from amberbox.testing.contract import MemorySink, ObservedSink, observe, observe_in_process
from tests.support.can_bus import SerialAdapter, plugged_in


@pytest.fixture
def port(tmp_path: Path) -> Path:
    return tmp_path / "ttyUSB0"


@contextmanager
def reading(port: Path, **options: Any) -> Iterator[tuple[ObservedSink, SerialAdapter]]:
    """Read a device that is plugged in."""
    config = Config(str(port), **options)
    with plugged_in(port) as device, observe(Source(config, "serial")) as sink:
        opened(sink)
        yield sink, device


def opened(sink: MemorySink, times: int = 1) -> None:
    wait_until(lambda: kinds(sink).count("serial_open") >= times, "the port is open")


def kinds(sink: MemorySink) -> list[str]:
    return [kind for kind, *_ in sink.events]


def rows(sink: MemorySink, count: int) -> list[dict[str, Any]]:
    return [json.loads(data) for data in sink.wait_for("lines", count)]


def lost(sink: MemorySink) -> dict[str, int]:
    """Return how many lines were left out, by reason."""
    found: dict[str, int] = {}
    for *_, count, reason in sink.losses:
        found[reason] = found.get(reason, 0) + count
    return found


def wait_lost(sink: MemorySink, wanted: dict[str, int]) -> None:
    wait_until(lambda: lost(sink) == wanted, f"{wanted} are counted")


def test_lines_are_text(port: Path) -> None:
    with reading(port) as (sink, device):
        device.send(b"first\r\n\r\nsec")
        assert rows(sink, 1) == [{"text": "first"}]
        device.send("ond °\nthird \xff\n".encode("latin-1"))
        assert rows(sink, 3)[1:] == [{"text": "second \\xb0"}, {"text": "third \\xff"}]
        assert device.told == b"", "nothing is ever written"
    assert sink.losses == []
    assert [link[:2] for link in sink.links] == [("up", "lines"), ("down", "lines")]


def test_other_encodings_and_delimiters(port: Path) -> None:
    with reading(port, encoding="latin-1", delimiter=";;") as (sink, device):
        device.send("12 °C;".encode("latin-1"))
        device.send(b";next;;")
        assert rows(sink, 2) == [{"text": "12 °C"}, {"text": "next"}]


def test_values_become_columns(port: Path) -> None:
    with reading(port, csv=["a", "b", "c", "d"]) as (sink, device):
        device.send(b'1, 2.5e3,,"x,y"\n-7,nan,1e999,123456789012345678901\n1,2\n1,2,3,4,5\n')
        assert rows(sink, 2) == [
            {"a": 1, "b": 2500.0, "c": None, "d": "x,y"},
            {"a": -7, "b": "nan", "c": "1e999", "d": 123456789012345678901.0},
        ]
        wait_lost(sink, {"a line that does not fit": 2})
    assert kinds(sink) == ["serial_open", "malformed_input"]
    assert sink.events[1][1] == f"{port}: a line that does not fit: 1,2"


def test_values_between_spaces(port: Path) -> None:
    with reading(port, csv=["a", "b"], separator=" ") as (sink, device):
        device.send(b" 1    2 \n")
        assert rows(sink, 1) == [{"a": 1, "b": 2}]


def test_lines_of_json(port: Path) -> None:
    with reading(port, json=True) as (sink, device):
        deep = b"[" * 3000
        device.send(b'{"v": 1}\n[1]\n{"v": NaN}\n{"v": ' + deep + b'\n{"v": {"w": "\xc3\xa9"}}\n')
        assert rows(sink, 2) == [{"v": 1}, {"v": {"w": "é"}}]
        wait_lost(sink, {"a line that does not fit": 3})


def test_groups_of_a_regular_expression_become_columns(port: Path) -> None:
    regex = r"^W=(?P<kg>[-0-9.]+)( T=(?P<celsius>[-0-9.]+))?$"
    with reading(port, regex=regex) as (sink, device):
        device.send(b"W=1.5 T=20\nW=2\nboot v1.2\n")
        assert rows(sink, 2) == [{"kg": 1.5, "celsius": 20}, {"kg": 2, "celsius": None}]
        wait_lost(sink, {"a line that does not fit": 1})


def test_an_expression_runs_in_a_process_of_its_own(port: Path) -> None:
    block = f"- serial: {{port: {port}, regex: '^(?P<a>(b+)+)$'}}"
    with plugged_in(port) as device, observe_in_process(source, block) as sink:
        opened(sink)
        device.send(b"bbb\n")
        assert rows(sink, 1) == [{"a": "bbb"}]
    assert source.needs_process(Config("x", regex="(?P<a>b)"))
    assert not source.needs_process(Config("x"))


def test_garbage_and_endless_lines_are_bounded_and_counted(port: Path) -> None:
    garbage = os.urandom(200_000).replace(b"\n", b"\0").replace(b"\r", b"\0")
    with reading(port, longest_bytes=100, json=True) as (sink, device):
        device.send(garbage + b'\n{"v": 1}\n' + b"x" * 101 + b'\n{"v": 2}\n')
        assert rows(sink, 2) == [{"v": 1}, {"v": 2}]
        wait_lost(sink, {"a line of more than 100 bytes": 2})


def test_a_delimiter_after_a_line_that_is_too_long_is_found(port: Path) -> None:
    with reading(port, longest_bytes=10, delimiter="\r\n") as (sink, device):
        for part in (b"x" * 50, b"\r", b"\n", b"after\r", b"\n"):
            device.send(part)
        assert rows(sink, 1) == [{"text": "after"}]
        wait_lost(sink, {"a line of more than 10 bytes": 1})


def test_a_port_is_unplugged_and_back(port: Path) -> None:
    with observe(Source(Config(str(port)), "serial")) as sink:
        wait_until(lambda: kinds(sink) == ["serial_missing"], "it is missing, told once")
        with plugged_in(port) as device:
            opened(sink)
            device.send(b"one\nhalf a li")
            assert rows(sink, 1) == [{"text": "one"}]
        wait_until(lambda: "serial_lost" in kinds(sink), "it is unplugged")
        with plugged_in(port) as device:
            opened(sink, 2)
            device.send(b"two\n")
            assert rows(sink, 2)[1] == {"text": "two"}
        wait_until(lambda: len(sink.links) == 4, "it is unplugged again")
    assert lost(sink) == {"a line that does not end": 1}
    assert [link[0] for link in sink.links] == ["up", "down", "up", "down"]


def test_a_port_in_use_is_told_and_waited_for(port: Path) -> None:
    holder = "import fcntl,os,sys;f=os.open(sys.argv[1],os.O_RDWR|os.O_NOCTTY);"
    holder += "fcntl.flock(f,fcntl.LOCK_EX);print('held',flush=True);sys.stdin.read()"
    with (
        plugged_in(port) as device,
        subprocess.Popen(
            [sys.executable, "-c", holder, port], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as other,
    ):
        assert other.stdout is not None and other.stdout.readline() == b"held\n"
        with observe(Source(Config(str(port)), "serial")) as sink:
            wait_until(lambda: kinds(sink) == ["serial_missing"], "it is told")
            other.communicate()
            opened(sink)
            device.send(b"one\n")
            assert rows(sink, 1) == [{"text": "one"}]
    assert "exclusively lock" in sink.events[0][1]


def test_control_lines_are_left_alone(port: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import fcntl

    requests: list[int] = []
    real = fcntl.ioctl

    def ioctl(fd: int, request: int, *more: Any) -> Any:
        requests.append(request)
        return real(fd, request, *more)

    monkeypatch.setattr(fcntl, "ioctl", ioctl)
    with plugged_in(port) as device:
        slave = os.open(port, os.O_RDWR | os.O_NOCTTY)
        settings = termios.tcgetattr(slave)
        settings[2] |= termios.HUPCL
        termios.tcsetattr(slave, termios.TCSANOW, settings)
        os.close(slave)
        opened_port = source._open(Config(str(port)))
        settings = termios.tcgetattr(opened_port.fd)
        opened_port.close()
        assert device.told == b""
    assert not settings[2] & termios.HUPCL, "closing it leaves DTR as it is"
    assert not settings[3] & termios.ECHO, "nothing is echoed"
    assert not {termios.TIOCMBIS, termios.TIOCMBIC, termios.TIOCMSET} & set(requests)


def test_without_pyserial_it_says_what_to_install(
    port: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "serial", None)
    with observe(Source(Config(str(port)), "serial")) as sink:
        assert sink.ended.wait(60)
    assert "amberbox[serial]" in str(getattr(sink.error, "hint", ""))
    assert "amberbox[serial]" in dict(Config(str(port)).notes())["port"]


@pytest.mark.parametrize(
    ("block", "words"),
    [
        ("{}", "port"),
        ("{port: ''}", "names no port"),
        ("{port: x, baudrate: 0}", "must be above 0"),
        ("{port: x, parity: both}", "parity"),
        ("{port: x, data_bits: 9}", "data_bits"),
        ("{port: x, encoding: utf-16}", "'utf-16' is no encoding that extends ASCII"),
        ("{port: x, encoding: klingon}", "'klingon' is no encoding"),
        ("{port: x, delimiter: ''}", "must have 1 to 16"),
        ("{port: x, longest_bytes: 0}", "must be between 1 and"),
        ("{port: x, regex: '('}", "is no regular expression"),
        ("{port: x, regex: 'a(b)'}", "has no named group"),
        ("{port: x, csv: [a b]}", "write a_b"),
        ("{port: x, csv: [a, a]}", "names a column twice"),
        ("{port: x, csv: [a], json: true}", "only one of regex, csv and json"),
        ("{port: x, separator: ab}", "must be one character"),
        ("{port: x, topics: [{topic: {name: line}}]}", "did you mean 'lines'?"),
    ],
)
def test_wrong_options_are_named(block: str, words: str) -> None:
    problems: list[Problem] = []
    node = parse_yaml(block, "black_box.yaml", problems)
    assert node is not None
    build(Config, node, problems, "serial")
    assert words in "\n".join(str(problem) for problem in problems)
