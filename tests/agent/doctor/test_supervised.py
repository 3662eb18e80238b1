"""Findings of the doctor about ``amberbox run``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from amberbox.agent.doctor.processes import (
    SUPERVISOR_LOCK,
    SUPERVISOR_STATE_FILE,
    judged_supervisor,
    supervisor,
)
from amberbox.agent.doctor.subject import HostSystem, subject
from amberbox.blackbox.store.store import WriterLock, create_store


def child(state: str, restarts: int = 0, trouble: str = "") -> dict[str, Any]:
    return {"state": state, "pid": 7, "restarts": restarts, "trouble": trouble}


@pytest.mark.parametrize(
    ("watch", "level", "words"),
    [
        (child("running"), "ok", "watch (running)"),
        (child("off"), "ok", "looks after record (running)"),
        (child("running", 2, "was killed by SIGSEGV"), "warn",
         "watch (running, started again 2 times: was killed by SIGSEGV)"),
        (child("refused", 0, "no such item"), "warn", "watch (refused: no such item)"),
        (child("waiting", 1, "hangs"), "warn", "waiting"),
    ],
)  # fmt: skip
def test_trouble_is_a_warning(watch: dict[str, Any], level: str, words: str) -> None:
    state = {"pid": 5, "children": {"record": child("running"), "watch": watch}}
    found = judged_supervisor(state, "amberbox events r")
    assert found.level == level and words in found.found and "process 5" in found.found


def test_only_one_that_is_at_work_is_spoken_of(tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text("id: r\n")
    (tmp_path / "black_box.yaml").write_text("- sim: {seed: 1}\n")
    store = create_store(tmp_path / "store")
    state = {"pid": 5, "children": {"record": child("running")}}
    (store.path / SUPERVISOR_STATE_FILE).write_text(json.dumps(state))
    assert list(supervisor(subject(tmp_path), HostSystem())) == []
    lock = WriterLock(store, SUPERVISOR_LOCK)
    (found,) = supervisor(subject(tmp_path), HostSystem())
    assert found.found == "amberbox run (process 5) looks after record (running)"
    lock.release()
