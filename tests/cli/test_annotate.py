"""The verb annotate, at the robot: with a keeper and without, changes, what is no note."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from amberbox.blackbox.retention.notes import load_notes, submit_note
from amberbox.blackbox.store.store import Store, open_store, pending, submit
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.core.notes import RecordedNote
from amberbox.testing.records import T0_NS, FakeItem, FakeRun
from tests.support.manual_recorder import recording

TASK = FakeItem("task", [{"speed": 0.5}])


@pytest.fixture
def store(tmp_path: Path) -> Path:
    run = FakeRun(tmp_path / "store", items=[TASK])
    run.write([(T0_NS + n * NS, TASK, {"speed": n / 2}) for n in range(10)])
    run.close()
    return tmp_path / "store"


@pytest.fixture
def notes(store: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    def listed(*options: str) -> list[dict[str, Any]]:
        capsys.readouterr()
        assert main(["annotate", "list", str(store), "--json", *options]) == 0
        found: list[dict[str, Any]] = json.loads(capsys.readouterr().out)
        return found

    return listed


def annotate(store: Path, *words: str) -> int:
    return main(["annotate", *(str(store) if word == "WHERE" else word for word in words)])


def test_a_note_is_in_the_record_of_events_and_in_the_list(
    store: Path, notes: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert annotate(store, "WHERE", "the wheel squeaks", "--at", "-4s", "--who", "anna") == 0
    span = ["--from", "2026-09-21T14:13:21Z", "--to", "2026-09-21T14:13:23Z"]
    assert annotate(store, "WHERE", "wet floor", *span, "--about", "task.speed") == 0
    capsys.readouterr()
    later, early = notes()[::-1]
    assert early["text"] == "wet floor" and early["about"] == "task.speed"
    assert (early["at"], early["to"]) == (
        "2026-09-21T14:13:21.000000000Z", "2026-09-21T14:13:23.000000000Z",
    )  # fmt: skip
    assert later["who"] == "anna" and later["to"] is None
    assert later["at"] == "2026-09-21T14:13:25.000000000Z"
    assert [note["text"] for note in notes("--about", "task.speed")] == ["wet floor"]
    assert [note["text"] for note in notes("--from", "2026-09-21T14:13:22Z")] == [
        "wet floor", "the wheel squeaks",
    ]  # fmt: skip
    assert notes("--to", "2026-09-21T14:13:21Z") == []
    assert main(["events", str(store)]) == 0
    assert "anna noted: the wheel squeaks" in capsys.readouterr().out


def test_plots_show_notes_on_the_item(store: Path, tmp_path: Path) -> None:
    assert annotate(store, "WHERE", "squeaks", "--at", "-4s", "--who", "anna") == 0
    span = ["--from", "2026-09-21T14:13:23Z", "--to", "2026-09-21T14:13:24Z"]
    assert annotate(store, "WHERE", "<b>wet", *span, "--about", "task.speed", "--who", "bo") == 0
    assert annotate(store, "WHERE", "elsewhere", "--about", "odom") == 0
    page = tmp_path / "plot.html"
    assert main(["plot", str(store), "task", "speed", "-o", str(page)]) == 0
    assert '"notes": [[3.0, 4.0, "\\u003cb>wet (bo)"], [5.0, 5.0, "squeaks (anna)"]]' in (
        page.read_text()
    )
    assert main(["plot", str(store), "task", "speed", "-o", str(tmp_path / "plot.svg")]) == 0
    assert "squeaks" in (tmp_path / "plot.svg").read_text()


def test_a_note_is_changed_and_withdrawn(store: Path, notes: Any) -> None:
    assert annotate(store, "WHERE", "the wheel sqeaks") == 0
    (first,) = notes()
    assert annotate(store, "change", "WHERE", first["id"], "the wheel squeaks") == 0
    (changed,) = notes()
    assert changed["text"] == "the wheel squeaks" and changed["revision"] == 2
    assert (changed["id"], changed["at"]) == (first["id"], first["at"])
    assert annotate(store, "WHERE", "withdraw", first["id"]) == 0
    assert notes() == []
    assert load_notes(store)[first["id"]].withdrawn
    assert annotate(store, "withdraw", "WHERE", first["id"]) == 2


def test_a_recorder_that_runs_writes_the_note(tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text("id: r1\n")
    (tmp_path / "black_box.yaml").write_text("- sim: {seed: 1, topics: [{name: odom}]}\n")
    with recording(tmp_path):
        assert annotate(tmp_path, "WHERE", "while it records") == 0
        found = load_notes(tmp_path / "store")
    assert [note.text for note in found.values()] == ["while it records"]


def test_one_revision_is_written_once(store: Path) -> None:
    note = RecordedNote("note-1", T0_NS, "server", "hello")
    opened = open_store(store)
    submit_note(opened, note, "command-1")
    assert annotate(store, "WHERE", "another") == 0
    submit_note(opened, note, "command-1")
    submit_note(opened, RecordedNote("note-1", T0_NS, "server", "hell"))
    assert annotate(store, "WHERE", "a third") == 0
    assert events(opened) == ["server noted: hello", "noted: another", "noted: a third"]


def test_a_damaged_request_is_refused_with_an_event(store: Path) -> None:
    opened = open_store(store)
    for values in ({}, {"id": "../x", "at_ns": 1, "who": "", "text": "x"}, {"id": 1}):
        submit(opened, "note", values)
    assert annotate(store, "WHERE", "good") == 0
    assert not pending(opened)
    assert [note.text for note in load_notes(store).values()] == ["good"]


def events(store: Store) -> list[str]:
    import amberbox

    with amberbox.open(store.path) as record:
        rows = list(record.events().rows())
    texts = [str(row["text"]) for row in rows if row["kind"] == "note"]
    return [text if text.startswith("server") else text.partition(" ")[2] for text in texts]


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["WHERE", "a", "b"], "put its text in quotes"),
        (["WHERE", "x", "--to", "now"], "a range has a beginning"),
        (["WHERE", "x", "--at", "now", "--from", "now"], "on a moment or on a range"),
        (["WHERE", "x", "--from", "now", "--to", "-5s"], "ends before it begins"),
        (["WHERE", "x" * 4001], "4000 characters"),
        (["WHERE", ""], "this is no note"),
        (["change", "WHERE", "note-7", "x"], "there is no note 'note-7'"),
        (["list"], "needs WHERE"),
    ],
)
def test_what_is_wrong_is_said(
    store: Path, capsys: pytest.CaptureFixture[str], words: list[str], hint: str
) -> None:
    assert annotate(store, *words) == 2
    assert hint in capsys.readouterr().err
    assert load_notes(store) == {}
