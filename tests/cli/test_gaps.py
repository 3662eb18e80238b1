"""``gaps`` and ``events``: missing data and events, readable without a query."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.cli.main import main
from tests.support.manual_recorder import COUNT, ManualBox, number


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """Two runs with a pause of 5 s between them."""
    first = ManualBox(tmp_path / "store")
    first.hear(COUNT, number(1))
    first.write()
    first.close()
    first.clock.advance(5)
    again = ManualBox(
        tmp_path / "store", clock=first.clock, start_gap_ns=first.clock.wall - 5 * 10**9
    )
    again.hear(COUNT, number(2))
    again.pipeline.event("disk", "the disk does not take data: full", "ros")
    again.write()
    again.close()
    return tmp_path / "store"


def test_a_pause_of_the_box_is_a_gap_of_every_item(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["gaps", str(store), "ros_count", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    pauses = [gap for gap in found if gap["reason"] == "the box was not recording"]
    assert len(pauses) == 1
    assert pauses[0]["item"] is None
    assert main(["gaps", str(store)]) == 0
    assert "5.000" in capsys.readouterr().out


def test_gaps_of_an_unknown_item_are_an_error(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["gaps", str(store), "ros_cout"]) == 2
    assert "ros_count" in capsys.readouterr().err


def test_events_are_lines(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["events", str(store)]) == 0
    assert "disk [ros]: the disk does not take data: full" in capsys.readouterr().out
    assert main(["events", str(store), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[-1]["kind"] == "disk"


def test_own_items_are_shown_when_asked_for(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["items", str(store)]) == 0
    brief = capsys.readouterr().out
    assert "amberbox_event" not in brief
    assert "--all" in brief
    assert main(["items", str(store), "--all"]) == 0
    assert "amberbox_event" in capsys.readouterr().out


def test_a_record_is_read_whatever_became_of_the_black_box_file(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "robot.yaml").write_text("id: r\n")
    (tmp_path / "black_box.yaml").write_text("- sim: {topcis: []}\n")
    assert main(["items", str(tmp_path)]) == 0
    assert "ros_count" in capsys.readouterr().out
