"""The check of a robot folder: its command, and how its result is used."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import pytest

from amberbox.agent.folder_changes import (
    LIMIT_S,
    FolderCheck,
    FolderVerdict,
    folder_snapshot,
    read_verdict,
    recorder_config_hash,
)
from amberbox.testing.clock import PATIENCE_S


def problem(line: int, *, is_error: bool = True) -> dict[str, object]:
    return {"file": "f.yaml", "line": line, "where": "a.b", "what": "wrong", "is_error": is_error}


@pytest.mark.parametrize(
    ("report", "judgement"),
    [
        ({"ok": True, "problems": [problem(1, is_error=False)], "config_hash": "h", "store": "s"},
         FolderVerdict(True, "", "h", "s")),
        ({"ok": False, "problems": [problem(1, is_error=False), problem(2)]},
         FolderVerdict(False, "f.yaml:2: a.b: wrong")),
        ({"ok": False, "problems": [problem(2), problem(3), problem(4)]},
         FolderVerdict(False, "f.yaml:2: a.b: wrong; 2 more")),
        ({"ok": False, "problems": []}, FolderVerdict(False, "amberbox check names no error")),
    ],
)  # fmt: skip
def test_a_report_is_read(report: dict[str, object], judgement: FolderVerdict) -> None:
    assert read_verdict(json.dumps(report).encode()) == judgement


def test_no_answer_is_no_approval() -> None:
    assert read_verdict(b"") == FolderVerdict(False, "amberbox check gave no answer")


def answer_of(question: FolderCheck) -> FolderVerdict:
    end_s = time.monotonic() + PATIENCE_S
    while (answer := question.answer(0.0)) is None:
        assert time.monotonic() < end_s
        time.sleep(0.02)
    return answer


def test_a_real_folder_is_judged(tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text("id: r\n")
    (tmp_path / "black_box.yaml").write_text("- sim: {sed: 1}\n")
    found = answer_of(FolderCheck(tmp_path, 0.0))
    assert not found.is_right and "black_box.yaml:1:" in found.trouble and "sed" in found.trouble
    (tmp_path / "black_box.yaml").write_text("- sim: {seed: 1}\n")
    found = answer_of(FolderCheck(tmp_path, 0.0))
    assert found.is_right and len(found.config_hash) == 64
    assert found.store == str(tmp_path / "store")


def test_a_question_that_takes_too_long_is_given_up(tmp_path: Path) -> None:
    question = FolderCheck(
        tmp_path, 0.0, [sys.executable, "-S", "-c", "import time; time.sleep(60)"]
    )
    assert question.answer(LIMIT_S - 1) is None
    found = question.answer(LIMIT_S)
    assert found is not None and "no answer within 120 s" in found.trouble
    question.close()


def test_more_than_a_pipe_holds_is_read(tmp_path: Path) -> None:
    text = "import json; print(json.dumps({'ok': True, 'problems': [], 'config_hash': 'h', "
    text += "'store': 's', 'x': 'y' * 1_000_000}))"
    assert answer_of(FolderCheck(tmp_path, 0.0, [sys.executable, "-S", "-c", text])).is_right


def test_a_footprint_changes_with_what_is_configured(tmp_path: Path) -> None:
    store = tmp_path / "store"
    store.mkdir()
    (tmp_path / "black_box.yaml").write_text("- sim: {seed: 1}\n")
    first, hashed = folder_snapshot(tmp_path, store), recorder_config_hash(tmp_path)
    (store / "journal").write_text("x")
    (tmp_path / ".hidden").write_text("x")
    (tmp_path / "__pycache__").mkdir()
    (tmp_path / "__pycache__" / "a.pyc").write_text("x")
    assert folder_snapshot(tmp_path, store) == first
    (tmp_path / "components").mkdir()
    (tmp_path / "components" / "motor.yaml").write_text("x")
    assert folder_snapshot(tmp_path, store) != first
    assert recorder_config_hash(tmp_path) == hashed
    (tmp_path / "black_box.yaml").write_text("- sim: {seed: 2}\n")
    assert recorder_config_hash(tmp_path) != hashed
    assert folder_snapshot(tmp_path / "nowhere", store) == frozenset()
