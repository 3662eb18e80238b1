"""What is to be written down reaches the disk, also one that refuses for a while."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import pytest

from amberbox.blackbox import requests
from amberbox.blackbox.doctor.supervised import STATE_FILE
from amberbox.blackbox.follow.read import journals
from amberbox.blackbox.keeper.keeper import Keeper
from amberbox.blackbox.requests import pending
from amberbox.blackbox.store import Store, create_store
from amberbox.robot.supervisor import notes
from amberbox.robot.supervisor.notes import Notes
from amberbox.testing.box import events


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return create_store(tmp_path / "store")


def test_the_keeper_writes_it_into_the_record(store: Store) -> None:
    said: list[str] = []
    told = Notes(store, said.append)
    told.tell("process_died", "watch was killed by SIGKILL", process="watch")
    told.close()
    assert said[0].endswith("process_died: watch was killed by SIGKILL")
    keeper = Keeper(store)
    keeper.step(threading.Event())
    keeper.close()
    assert pending(store) == [] and list(journals(store.path))
    (event,) = events(store.path, "process_died")
    assert (event["source"], event["text"]) == ("run", "watch was killed by SIGKILL")


def test_what_the_disk_refuses_is_tried_again(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries, submit = [], requests.submit

    def refuses_twice(*args: Any) -> Path:
        tries.append(args)
        if len(tries) <= 2:
            raise OSError(28, "No space left on device")
        return submit(*args)

    monkeypatch.setattr(requests, "submit", refuses_twice)
    monkeypatch.setattr(notes, "_AGAIN_S", 0.01)
    told = Notes(store, lambda _: None)
    told.tell("process_died", "one")
    told.tell("process_died", "two")
    told._thread.join(0.2)
    told.close()
    assert [request.values["text"] for request in pending(store)] == ["one", "two"]


def test_the_newest_state_is_written(store: Store) -> None:
    told = Notes(store, lambda _: None)
    for number in range(5):
        told.state({"number": number})
    told.close()
    assert json.loads((store.path / STATE_FILE).read_text()) == {"number": 4}
