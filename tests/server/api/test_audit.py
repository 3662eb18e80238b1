"""The audit log over the API: looked through, taken away, verified."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import text

from amberbox.server.audit import AuditEntry, append
from tests.server.house import House, house

AUDITS = "/api/v1/audit"


@pytest.fixture
def home(tmp_path: Path) -> Iterator[House]:
    with house(tmp_path / "server", shared=True) as found:
        with found.services.database.begin() as connection:
            for number in range(5):
                entry = AuditEntry("user:anna", "192.0.2.7", "alarms.own", f"=alarm_{number}")
                append(connection, found.clock.wall_ns(), entry)
                found.clock.advance(60)
            refused = AuditEntry("user:?", "192.0.2.8", "login", "%_", "refused")
            append(connection, found.clock.wall_ns(), refused)
        yield found


def _numbers(home: House, **query: Any) -> list[int]:
    answer = home.client("admin").get(AUDITS, params=query)
    assert answer.status_code == 200, answer.text
    return [row["seq"] for row in answer.json()]


def test_it_goes_on_behind_the_last_row_in_both_orders(home: House) -> None:
    assert _numbers(home, limit=2) == [6, 5]
    assert _numbers(home, limit=3, after=5) == [4, 3, 2]
    assert _numbers(home, order="oldest", limit=2) == [1, 2]
    assert _numbers(home, order="oldest", after=4) == [5, 6]


@pytest.mark.parametrize(
    ("query", "found"),
    [
        ({"principal": "user:?"}, [6]),
        ({"action": "login"}, [6]),
        ({"result": "refused"}, [6]),
        ({"object": "=alarm_3"}, [4]),
        ({"object": "%"}, [6]),
        ({"object": "_"}, []),
        ({"from": "2027-01-15T08:04:00Z"}, [6, 5]),
        ({"to": "2027-01-15T08:01:00Z"}, [1]),
        ({"from": "now-2m", "action": "alarms.own"}, [5, 4]),
    ],
)
def test_filters(home: House, query: dict[str, str], found: list[int]) -> None:
    assert _numbers(home, **query) == found


def test_a_page_is_never_longer_than_it_may_be(home: House) -> None:
    assert home.client("admin").get(AUDITS, params={"limit": 1001}).status_code == 422
    assert home.client("admin").get(AUDITS, params={"from": "x"}).status_code == 400


def test_taking_it_away_is_in_it(home: House) -> None:
    answer = home.client("admin").get(f"{AUDITS}/export", params={"form": "jsonl"})
    rows = [json.loads(line) for line in answer.text.splitlines()]
    assert [row["seq"] for row in rows] == [1, 2, 3, 4, 5, 6]
    assert answer.headers["content-disposition"] == 'attachment; filename="amberbox-audit.jsonl"'
    newest = home.client("admin").get(AUDITS, params={"limit": 1}).json()[0]
    assert (newest["action"], newest["principal"]) == ("audit.export", "user:admin")


def test_a_spreadsheet_runs_nothing_of_it(home: House) -> None:
    answer = home.client("admin").get(f"{AUDITS}/export", params={"action": "alarms.own"})
    assert answer.headers["content-type"] == "text/csv; charset=utf-8"
    rows = list(csv.DictReader(io.StringIO(answer.text)))
    assert [row["object"] for row in rows] == [f"'=alarm_{number}" for number in range(5)]


def test_a_long_log_is_exported_whole(home: House) -> None:
    with home.services.database.begin() as connection:
        for _ in range(2_100):
            append(connection, home.clock.wall_ns(), AuditEntry("user:a", "", "many"))
    answer = home.client("admin").get(f"{AUDITS}/export", params={"form": "jsonl"})
    numbers = [json.loads(line)["seq"] for line in answer.text.splitlines()]
    assert numbers == list(range(1, 2_107))
    lines = home.client("admin").get(f"{AUDITS}/export").text.splitlines()
    assert len(lines) == 2_108  # a header, and the export before
    assert sum(line.startswith('"seq"') for line in lines) == 1


def test_it_is_verified_against_heads_that_were_noted(home: House) -> None:
    admin = home.client("admin")
    head = admin.get(f"{AUDITS}/head").json()
    found = admin.get(f"{AUDITS}/verify", params={"head": head["text"]}).json()
    assert (found["holds"], found["rows"], found["head"]) == (True, 6, head)
    other = f"{head['seq']} {'0' * 64}"
    found = admin.get(f"{AUDITS}/verify", params={"head": [head["text"], other]}).json()
    assert (found["holds"], found["broken"]) == (False, 6)
    assert admin.get(f"{AUDITS}/verify", params={"head": "6"}).status_code == 400


def test_a_row_that_was_changed_is_named(home: House) -> None:
    with home.services.database.begin() as connection:
        connection.execute(text("DROP TRIGGER audit_no_update"))
        connection.execute(text("UPDATE audit SET object = 'other' WHERE seq = 3"))
    found = home.client("admin").get(f"{AUDITS}/verify").json()
    assert (found["holds"], found["broken"]) == (False, 3)
    assert "changed" in found["what"]


def test_a_token_for_the_log_reads_it_and_nothing_else(home: House) -> None:
    client = home.token_client("admin", "read:audit")
    assert client.get(AUDITS).status_code == 200
    assert client.get("/api/v1/users").status_code == 403
