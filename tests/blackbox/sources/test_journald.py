"""The source of systemd's journal, with files of systemd-journal-remote and a real journalctl."""

from __future__ import annotations

import json
import os
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import psutil
import pytest

import amberbox
from amberbox.blackbox.sources import journald
from amberbox.blackbox.sources.journald import Config, Source
from amberbox.core.config import build
from amberbox.core.errors import Problem
from amberbox.core.pacing import Backoff
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.testing.clock import PATIENCE_S, wait_until
from amberbox.testing.contract import MemorySink, observe, observe_in_process
from tests.support.journal import BOOT, append, entry, missing_journal
from tests.support.manual_recorder import event_texts, raw_messages, recording
from tests.support.processes import command

pytestmark = pytest.mark.skipif(bool(missing_journal()), reason=missing_journal())


@pytest.fixture
def journal(tmp_path: Path) -> Path:
    """Return the file that a journal is written to; its folder is the journal."""
    folder = tmp_path / "journal"
    folder.mkdir()
    return folder / "system.journal"


def source(journal: Path, **changes: Any) -> Source:
    return Source(Config(directory=str(journal.parent), **changes), "journald")


def entries(sink: MemorySink, count: int) -> list[dict[str, Any]]:
    return [json.loads(data) for data in sink.wait_for("entries", count)]


def messages(sink: MemorySink, count: int) -> list[str]:
    return [row["message"] for row in entries(sink, count)]


def kinds(sink: MemorySink) -> list[str]:
    return [kind for kind, *_ in sink.events]


def readers() -> list[psutil.Process]:
    """Return the processes of journalctl that this process has started."""
    return [p for p in psutil.Process().children() if p.name() == "journalctl"]


def test_entries_are_read_and_followed(journal: Path) -> None:
    append(journal, [entry("before", PRIORITY="3", _UID="0", CODE_FILE="a.cpp")])
    with observe(source(journal, fields=["CODE_FILE"])) as sink:
        first = entries(sink, 1)[0]
        now_us = time.time_ns() // 1000
        append(journal, [entry("after", now_us, _TRANSPORT="stdout", _HOSTNAME="robot")])
        second = entries(sink, 2)[1]
    assert (first["message"], first["priority"], first["uid"]) == ("before", 3, 0)
    assert (first["unit"], first["identifier"]) == ("rosbridge.service", "test")
    assert (first["pid"], first["code_file"], first["cut"]) == (4711, "a.cpp", 0)
    assert (second["stamp"], second["boot"]) == (now_us * 1000, BOOT)
    assert (second["transport"], second["hostname"]) == ("stdout", "robot")
    assert second["uid"] is None
    assert sink.links[0][:2] == ("up", "entries") and kinds(sink) == []


def test_it_also_reads_in_a_process_of_its_own(journal: Path) -> None:
    append(journal, [entry("one")])
    with observe_in_process(journald, f"- journald: {{directory: {journal.parent}}}") as sink:
        assert messages(sink, 1) == ["one"]


def test_entries_are_chosen(journal: Path) -> None:
    append(
        journal,
        [
            entry("1", PRIORITY="3"),
            entry("2", PRIORITY="6"),
            entry("3", PRIORITY="4", _SYSTEMD_UNIT="other.service"),
            entry("4", PRIORITY="4", SYSLOG_IDENTIFIER="other"),
            entry("5", PRIORITY="0", _TRANSPORT="kernel"),
            entry("6", PRIORITY="4"),
        ],
    )
    chosen: dict[str, tuple[dict[str, Any], str]] = {
        "priority": ({"priority": "warning"}, "13456"),
        "units": ({"units": ["ros*.service"]}, "12456"),
        "identifiers": ({"identifiers": ["other", "third"]}, "4"),
        "matches": ({"matches": ["_TRANSPORT=kernel"]}, "5"),
        "all": ({"units": ["rosbridge.service"], "priority": "err"}, "15"),
    }
    for options, wanted in chosen.values():
        with observe(source(journal, **options)) as sink:
            assert messages(sink, len(wanted)) == list(wanted)


def test_hostile_entries_are_kept_bounded_and_the_rest_goes_on(journal: Path) -> None:
    many_lines = "a\nb\n" * 3
    append(
        journal,
        [
            entry(b"bytes \xff\x00 \x1b[31m"),
            entry(many_lines),
            entry("é" * 5000),
            entry("x" * (5 << 20)),
            entry("numbers", PRIORITY="many", _PID="9" * 30),
            entry("the rest"),
        ],
    )
    with observe(source(journal, longest_bytes=1001)) as sink:
        found = entries(sink, 5)
        wait_until(lambda: sink.losses, "what is too long is counted")
    assert found[0]["message"] == "bytes \\xff\x00 \x1b[31m"
    assert found[1]["message"] == many_lines
    assert (found[2]["message"], found[2]["cut"]) == ("é" * 500, 10_000 - 1001)
    assert (found[3]["priority"], found[3]["pid"]) == (None, None)
    assert found[4]["message"] == "the rest"
    ((topic, peer, _, _, count, reason),) = sink.losses
    assert (topic, peer, count) == ("entries", str(journal.parent), 1)
    assert reason == "an entry of more than 4194304 bytes"
    assert kinds(sink) == ["malformed_input"]


def test_output_that_is_not_of_journalctl_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "journalctl"
    good = '{"__CURSOR":"s=1;i=1;b=1;m=1;t=5;x=1","MESSAGE":"good"}'
    place.write_text(f"#!/bin/sh\nprintf '%s\\n' '{{' '[1]' '{{}}' '{good}'\nexec sleep 600\n")
    place.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    with observe(Source(Config(), "journald")) as sink:
        assert messages(sink, 1) == ["good"]
        wait_until(lambda: sum(loss[4] for loss in sink.losses) == 3, "three are counted")
    assert {loss[5] for loss in sink.losses} == {
        "an entry that is no JSON",
        "an entry without a cursor",
    }


def test_a_burst_is_complete(journal: Path) -> None:
    with observe(source(journal)) as sink:
        append(journal, [entry(f"{number}") for number in range(10_000)])
        assert messages(sink, 10_000) == [f"{number}" for number in range(10_000)]
    assert sink.losses == []


def test_journalctl_is_started_again_and_nothing_is_missing(journal: Path) -> None:
    append(journal, [entry("1"), entry("2")])
    with observe(source(journal)) as sink:
        assert messages(sink, 2) == ["1", "2"]
        (reader,) = readers()
        reader.kill()
        wait_until(lambda: ("down", "entries") in [link[:2] for link in sink.links], "a gap")
        append(journal, [entry("3")])
        assert messages(sink, 3) == ["1", "2", "3"]
        append(journal, [entry("4")])
        assert messages(sink, 4)[3] == "4"
    assert [link[0] for link in sink.links] == ["up", "down", "up", "down"]
    (event,) = sink.events
    assert event[:2] == (
        "journald_ended",
        "journalctl has ended by signal 9; it is started again",
    )


def test_after_a_reader_that_worked_the_next_one_starts_soon(
    journal: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    class Noted(Backoff):
        def failed(self) -> float:
            calls.append("failed")
            return super().failed()

        def succeeded(self) -> None:
            calls.append("succeeded")
            super().succeeded()

    monkeypatch.setattr(journald, "Backoff", Noted)
    append(journal, [entry("1")])
    with observe(source(journal)) as sink:
        entries(sink, 1)
        readers()[0].kill()
        wait_until(lambda: calls, "it has ended")
        wait_until(readers, "another one is started")
        readers()[0].kill()
        wait_until(lambda: len(calls) >= 3, "it has ended, too")
    assert calls[:3] == ["succeeded", "failed", "failed"]


def test_where_the_record_has_no_entry_any_more_a_saved_position_counts(
    journal: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(journald, "_SAVE_S", 0.0)
    append(journal, [entry("1")])
    with observe(source(journal)) as sink:
        first = entries(sink, 1)[0]
        append(journal, [entry("2")])
        entries(sink, 2)
        wait_until(lambda: sink.saved.get("cursor") == first["cursor"], "the one before is saved")
    again = MemorySink(saved=sink.saved)
    stop = threading.Event()
    thread = threading.Thread(target=source(journal).run, args=(again, stop))
    thread.start()
    try:
        assert messages(again, 1) == ["2"]
    finally:
        stop.set()
        thread.join(PATIENCE_S)


def test_a_new_boot_and_a_new_file_are_followed(journal: Path) -> None:
    append(journal, [entry("1")])
    with observe(source(journal)) as sink:
        entries(sink, 1)
        journal.rename(journal.with_name("system@1.journal"))
        later = entry("2", boot="f" * 32, __MONOTONIC_TIMESTAMP="5000000")
        append(journal, [later])
        found = entries(sink, 2)
    assert [row["message"] for row in found] == ["1", "2"]
    assert [row["boot"] for row in found] == [BOOT, "f" * 32]


def test_a_journal_that_is_not_there_yet_is_waited_for(tmp_path: Path) -> None:
    folder = tmp_path / "later"
    with observe(Source(Config(directory=str(folder)), "journald")) as sink:
        wait_until(lambda: kinds(sink) == ["journald_ended"], "it is told once")
        folder.mkdir()
        append(folder / "system.journal", [entry("there")])
        assert messages(sink, 1) == ["there"]
    assert "No such file or directory" in sink.events[0][1]


def test_without_journalctl_it_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    with observe(Source(Config(), "journald")) as sink:
        wait_until(lambda: sink.events, "it is told")
    assert "journalctl cannot be started: it is not installed" in sink.events[0][1]
    assert sink.links == []


@pytest.fixture
def folder(tmp_path: Path, journal: Path) -> Iterator[Path]:
    """Yield a robot folder that records the journal."""
    folder = tmp_path / "robot"
    folder.mkdir()
    (folder / "robot.yaml").write_text("id: r1\nstore: {path: store}\n")
    (folder / "black_box.yaml").write_text(f"- journald:\n    directory: {journal.parent}\n")
    yield folder


def recorded(folder: Path) -> list[str]:
    return [json.loads(data)["message"] for data in raw_messages(folder / "store", "entries")]


def recorded_all(folder: Path, wanted: Sequence[str]) -> Callable[[], bool]:
    return lambda: (folder / "store").exists() and len(recorded(folder)) >= len(wanted)


def test_over_restarts_of_the_recorder_nothing_is_missing_or_doubled(
    folder: Path, journal: Path
) -> None:
    wanted: list[str] = []

    def write(count: int) -> None:
        new = [f"{number}" for number in range(len(wanted), len(wanted) + count)]
        append(journal, [entry(text) for text in new])
        wanted.extend(new)

    for _ in range(2):  # ended in order: the entry that was recorded last is found in the record
        write(3)
        with recording(folder):
            write(3)
            wait_until(recorded_all(folder, wanted), "all are recorded")
        assert recorded(folder) == wanted
    write(500)
    process = subprocess.Popen(
        command("record", folder), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        wait_until(recorded_all(folder, wanted[:13]), "it has begun")
        write(500)
        started = psutil.Process(process.pid).children(recursive=True)
        assert "journalctl" in [child.name() for child in started]
    finally:
        process.kill()
        process.wait()
    wait_until(lambda: not any(map(psutil.Process.is_running, started)), "all of it has ended")
    write(3)
    with recording(folder):
        wait_until(recorded_all(folder, wanted), "all are recorded")
    assert recorded(folder) == wanted


def test_the_record_has_columns_at_the_times_of_the_entries(folder: Path, journal: Path) -> None:
    at_us = time.time_ns() // 1000 - 60_000_000
    append(journal, [entry("\x1b[1mlost", at_us, PRIORITY="3")])
    with recording(folder):
        wait_until(recorded_all(folder, ["lost"]), "it is recorded")
    table = amberbox.open(folder).query("journald_entries", ["message", "priority", "pid"])
    assert list(table.values("message")) == ["\x1b[1mlost"]
    assert (list(table.values("priority")), list(table.values("pid"))) == ([3], [4711])
    assert list(table.values("timestamp")) == [at_us * 1000]
    (priority,) = [column for column in table.fields if column.name == "priority"]
    assert priority.labels[3] == "err"


def test_an_entry_that_is_gone_is_told(folder: Path, journal: Path) -> None:
    append(journal, [entry("1"), entry("2")])
    with recording(folder):
        wait_until(recorded_all(folder, ["1", "2"]), "both are recorded")
    journal.unlink()
    append(journal, [entry("5")])
    with recording(folder):
        wait_until(recorded_all(folder, ["1", "2", "5"]), "the rest is recorded")
    assert recorded(folder) == ["1", "2", "5"]
    (text,) = event_texts(folder / "store", "journald_gone")
    assert "not in the journal any more" in text


def test_what_is_too_long_ago_is_left_out(folder: Path, journal: Path) -> None:
    old_us = time.time_ns() // 1000 - 7200 * 1_000_000
    append(journal, [entry("old", old_us), entry("new")])
    with recording(folder):
        wait_until(recorded_all(folder, ["new"]), "the new one is recorded")
    assert recorded(folder) == ["new"]


def test_after_a_long_pause_the_bound_is_told(journal: Path) -> None:
    old_us = time.time_ns() // 1000 - 7200 * 1_000_000
    cursor = f"s=1;i=1;b={BOOT};m=1;t={old_us:x};x=1"
    append(journal, [entry("missed", old_us + 1), entry("new")])
    sink = MemorySink(latched={"entries": json.dumps({"cursor": cursor}).encode()})
    follower = journald._Follower(Config(directory=str(journal.parent)), sink)
    assert (sink.events[0][0], follower._cursor) == ("journald_skipped", "")
    assert "it was read until 3600 s before that" in sink.events[0][1]


@pytest.mark.parametrize("saved", [{"cursor": 5}, {"cursor": "s=1;--root=/"}])
def test_a_saved_position_that_is_none_is_ignored(saved: dict[str, Any], journal: Path) -> None:
    sink = MemorySink(saved=saved, latched={"entries": b"garbage"})
    follower = journald._Follower(Config(directory=str(journal.parent)), sink)
    assert follower._cursor == ""


@pytest.mark.parametrize(
    ("block", "words"),
    [
        ("{priority: errors}", "priority"),
        ("{matches: [--root=/]}", "'--root=/' is no condition"),
        ("{fields: [code_file]}", "'code_file' is no field"),
        ("{fields: [MESSAGE]}", "there is a column 'message' already"),
        ("{units: ['']}", "holds an empty name"),
        ("{directory: a, files: [b]}", "does not go together with 'directory'"),
        ("{back_s: -1}", "must be 0 or more"),
        ("{longest_bytes: 3}", "must be between 16 and"),
        ("{topics: [{topic: {name: entry}}]}", "did you mean 'entries'?"),
    ],
)
def test_wrong_options_are_named(block: str, words: str) -> None:
    problems: list[Problem] = []
    node = parse_yaml(block, "black_box.yaml", problems)
    assert node is not None
    build(Config, node, problems, "journald")
    assert words in "\n".join(str(problem) for problem in problems)
