"""Events of the supervisor reach the disk, even one that refuses writes for a while."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import pytest

from amberbox.agent import supervisor
from amberbox.agent.doctor.processes import SUPERVISOR_STATE_FILE
from amberbox.agent.supervisor import SupervisorLog
from amberbox.blackbox.retention.maintenance import RetentionService
from amberbox.blackbox.store import store as store_store
from amberbox.blackbox.store.journal_reader import journals
from amberbox.blackbox.store.store import Store, create_store, pending
from tests.support.manual_recorder import events


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return create_store(tmp_path / "store")


def test_the_keeper_writes_it_into_the_record(store: Store) -> None:
    said: list[str] = []
    told = SupervisorLog(store, said.append)
    told.log_event("process_died", "watch was killed by SIGKILL", process="watch")
    told.close()
    assert said[0].endswith("process_died: watch was killed by SIGKILL")
    keeper = RetentionService(store)
    keeper.step(threading.Event())
    keeper.close()
    assert pending(store) == [] and list(journals(store.path))
    (event,) = events(store.path, "process_died")
    assert (event["source"], event["text"]) == ("run", "watch was killed by SIGKILL")


def test_what_the_disk_refuses_is_tried_again(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries, submit = [], store_store.submit

    def refuses_twice(*args: Any) -> Path:
        tries.append(args)
        if len(tries) <= 2:
            raise OSError(28, "No space left on device")
        return submit(*args)

    monkeypatch.setattr(store_store, "submit", refuses_twice)
    monkeypatch.setattr(supervisor, "_AGAIN_S", 0.01)
    told = SupervisorLog(store, lambda _: None)
    told.log_event("process_died", "one")
    told.log_event("process_died", "two")
    told._thread.join(0.2)
    told.close()
    assert [request.values["text"] for request in pending(store)] == ["one", "two"]


def test_the_newest_state_is_written(store: Store) -> None:
    told = SupervisorLog(store, lambda _: None)
    for number in range(5):
        told.state({"number": number})
    told.close()
    assert json.loads((store.path / SUPERVISOR_STATE_FILE).read_text()) == {"number": 4}
