"""Incidents that robots pin, journals that are copied again, new files: what people ask a robot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest

from amberbox.core.command import AnswerState, CommandAnswer
from amberbox.core.record_commands import RECORD_COMMANDS
from amberbox.link import limits
from amberbox.link.frames import Hello
from amberbox.server import commands
from amberbox.server.ingest import ledger
from amberbox.server.schema import BOOT
from tests.server.house import House, house

STORE = "12345678-1234-1234-1234-123456789012"
BOOT_ID = "9c2e4f10-1111-4000-8000-000000000001"
ROBOT = "/api/v1/robots/ropod_001"
JOURNAL = "journal/000001-9c2e4f10-000001.mcap"
WINDOW = {"from": "2027-01-15T07:00:00Z", "to": "2027-01-15T07:01:00Z", "reason": "it jerked"}


def connect(home: House, *names: str) -> int:
    """Let the robot connect and say which commands it takes; return the epoch."""
    hello = Hello(
        "ropod_001", STORE, BOOT_ID, {}, "hash", 0, 0, "1", capabilities=[limits.COMMANDS]
    )
    now_ns = home.clock.wall_ns()
    with home.services.database.begin() as connection:
        epoch = ledger.admit(connection, hello, now_ns).epoch
        commands.begin_contact(connection, "ropod_001", epoch, STORE)
        said = msgspec.json.encode({"actions": [], "record": list(names)}).decode()
        commands.announce(connection, "ropod_001", epoch, said, now_ns)
        row = {"robot": "ropod_001", "boot_id": BOOT_ID, "offset_ns": 3_600_000_000_000,
               "round_ns": 1, "at_ns": now_ns}  # fmt: skip
        connection.execute(BOOT.insert(), [row])
    return epoch


def sent(home: House) -> list[commands.StoredCommand]:
    with home.services.database.reading() as connection:
        return commands.listed(connection, home.clock.wall_ns(), "ropod_001")[::-1]


def answer(home: House, epoch: int, state: AnswerState, reason: str = "") -> None:
    one = CommandAnswer(sent(home)[-1].id, state, reason, number=len(sent(home)))
    with home.services.database.begin() as connection:
        now_ns = home.clock.wall_ns()
        commands.store_answers(connection, "ropod_001", epoch, STORE, [one], now_ns)


@pytest.mark.parametrize(
    ("state", "shown"),
    [("done", "pinned"), ("refused", "refused: nothing of it is in the record")],
)
def test_an_incident_is_pinned_on_the_robot(tmp_path: Path, state: Any, shown: str) -> None:
    with house(tmp_path, shared=True) as home:
        epoch, asking = connect(home, *RECORD_COMMANDS), home.client("operator")
        made = asking.post(f"{ROBOT}/incidents", json=WINDOW).json()
        assert made["on_robot"] == "asked"
        answer(home, epoch, state, "" if state == "done" else "nothing of it is in the record")
        (listed,) = asking.get(f"{ROBOT}/incidents").json()
        assert listed["on_robot"] == shown
        released = asking.post(f"{ROBOT}/incidents/{made['id']}/release")
        assert released.status_code == 200
        actions = [one.action for one in sent(home)]
        assert actions == ["incident.mark", "incident.release"][: 1 + (state == "done")]


def test_a_window_until_now_is_in_the_time_of_the_robot(tmp_path: Path) -> None:
    with house(tmp_path, shared=True) as home:
        connect(home, *RECORD_COMMANDS)
        body = {"from": "now-60s", "to": "now", "reason": "it jerked"}
        assert home.client("operator").post(f"{ROBOT}/incidents", json=body).status_code == 201
        (one,) = sent(home)
        behind_ns = home.clock.wall_ns() - msgspec.json.decode(one.parameters)["to_ns"]
        assert abs(behind_ns - 3_600_000_000_000) < 1_000_000_000


def test_a_robot_without_such_commands_is_not_asked(tmp_path: Path) -> None:
    with house(tmp_path, shared=True) as home:
        asking = home.client("technician")
        assert asking.post(f"{ROBOT}/incidents", json=WINDOW).json()["on_robot"] == ""
        refused = asking.post(f"{ROBOT}/recordings/rotate")
        assert refused.status_code == 400 and "takes no such commands" in refused.text
        connect(home)  # one that says that it takes none
        assert asking.post(f"{ROBOT}/recordings/rotate").status_code == 400
        assert sent(home) == []


def test_new_files_and_another_copy(tmp_path: Path) -> None:
    with house(tmp_path, shared=True) as home:
        connect(home, *RECORD_COMMANDS)
        asking = home.client("technician")
        made = asking.post(f"{ROBOT}/recordings/rotate")
        assert made.status_code == 202 and made.json()["action"] == "journal.rotate"
        unknown = asking.post(f"{ROBOT}/recordings/copy", json={"journal": JOURNAL})
        assert unknown.status_code == 400 and "never had" in unknown.text
        other = {"journal": JOURNAL, "store_id": "another"}
        assert asking.post(f"{ROBOT}/recordings/copy", json=other).status_code == 400
        for name in ("../../x", "journal/x.mcap", "", "journal/1-a-1.mcap\n"):
            said = asking.post(f"{ROBOT}/recordings/copy", json={"journal": name})
            assert said.status_code == 422, name
        assert [one.action for one in sent(home)] == ["journal.rotate"]
        assert home.client("operator").post(f"{ROBOT}/recordings/rotate").status_code == 403
