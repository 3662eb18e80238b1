"""The audit log: rows are chained, and changes of them are detected."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import threading
from dataclasses import asdict, replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy.exc import IntegrityError

from amberbox.core.errors import UsageError
from amberbox.server.audit import (
    START,
    AuditChainHead,
    AuditEntry,
    AuditLogRow,
    AuditVerification,
    BrokenAuditRow,
    append,
    chain_hash,
    follow,
    head,
    row_after,
    rows,
    verify,
)
from amberbox.server.database import ServerDatabase
from amberbox.server.schema import AUDIT, AUDIT_HEAD
from amberbox.testing.clock import PATIENCE_S

START_NS = 1_700_000_000_000_000_000
ENTRY = AuditEntry("user:anna", "10.0.0.7", "users.write", "bert", details={"role": "operator"})


def _fill(database: ServerDatabase, count: int) -> AuditChainHead:
    with database.begin() as connection:
        for number in range(count):
            append(connection, START_NS + number, replace(ENTRY, object=f"user {number + 1}"))
        return head(connection)


def _verified(database: ServerDatabase, *kept: AuditChainHead) -> AuditVerification:
    with database.reading() as connection:
        return verify(connection, kept)


def _tamper(database: ServerDatabase, *statements: str) -> None:
    """Change rows as a person with the file does: without the triggers."""
    with database.begin() as connection:
        for change in ("update", "delete"):
            connection.exec_driver_sql(f"DROP TRIGGER IF EXISTS audit_no_{change}")
        for statement in statements:
            connection.exec_driver_sql(statement)


def _rewrite(database: ServerDatabase, seq: int, hash_: str) -> None:
    """Change a row and recompute all later hashes, including the head."""
    _tamper(database, f"UPDATE audit SET principal = 'user:eve' WHERE seq = {seq}")
    with database.begin() as connection:
        for row in list(rows(connection, after_seq=seq - 1)):
            hash_ = chain_hash(hash_, row)
            connection.execute(AUDIT.update().where(AUDIT.c.seq == row.seq).values(hash=hash_))
        connection.execute(AUDIT_HEAD.update().values(hash=hash_))


def test_an_empty_log_holds(database: ServerDatabase) -> None:
    assert _verified(database) == AuditVerification(0, AuditChainHead(0, START), None)


def test_rows_follow_on_one_another(database: ServerDatabase) -> None:
    last = _fill(database, 5)
    assert _verified(database) == AuditVerification(5, last, None)
    with database.reading() as connection:
        found = list(rows(connection))
    assert [row.seq for row in found] == [1, 2, 3, 4, 5]
    assert found[0] == row_after(0, START, START_NS, replace(ENTRY, object="user 1"))
    assert found[0].details == '{"role": "operator"}'
    assert last == AuditChainHead(5, found[-1].hash)


def test_the_hash_is_as_documented() -> None:
    row = AuditLogRow(1, 2, "user:anna", "::1", "own.read", "ä", "ok", "{}", "")
    by_hand = f'["{START}",1,2,"user:anna","::1","own.read","\\u00e4","ok","{{}}"]'
    assert chain_hash(START, row) == hashlib.sha256(by_hand.encode()).hexdigest()


def test_a_change_and_its_row_stand_or_fall_together(database: ServerDatabase) -> None:
    with pytest.raises(RuntimeError), database.begin() as connection:
        append(connection, START_NS, ENTRY)
        raise RuntimeError("the change fails")
    assert _verified(database).rows == 0


@pytest.mark.parametrize("change", ["UPDATE audit SET object = 'x'", "DELETE FROM audit"])
def test_the_server_itself_cannot_change_rows(database: ServerDatabase, change: str) -> None:
    _fill(database, 1)
    with pytest.raises(IntegrityError, match="stay as they are"), database.begin() as connection:
        connection.exec_driver_sql(change)
    assert _verified(database).rows == 1


def _chain(count: int) -> list[AuditLogRow]:
    chain = [row_after(0, START, START_NS, ENTRY)]
    while len(chain) < count:
        before = chain[-1]
        chain.append(row_after(before.seq, before.hash, START_NS + before.seq, ENTRY))
    return chain


CHANGES = st.sampled_from(
    [
        {"seq": 99},
        {"time_ns": 1},
        {"principal": "user:eve"},
        {"address": ""},
        {"action": "own.read"},
        {"object": "b\0ert"},
        {"result": "refused"},
        {"details": "{}"},
        {"hash": "f" * 64},
        {"principal": "user:anna10.0.0.7", "address": ""},
    ]
)


@given(count=st.integers(1, 12), at=st.integers(0, 11), change=CHANGES)
def test_a_changed_row_is_named_whatever_was_changed(
    count: int, at: int, change: dict[str, Any]
) -> None:
    chain = _chain(count)
    stated, at = AuditChainHead(count, chain[-1].hash), at % count
    assert follow(chain, stated).holds
    chain[at] = replace(chain[at], **change)
    found = follow(chain, stated)
    assert found.broken is not None
    assert (found.rows, found.broken.seq) == (at, at + 1)


@given(st.permutations(range(1, 7)).filter(lambda order: order != list(range(1, 7))))
def test_another_order_is_found(order: list[int]) -> None:
    chain = _chain(6)
    mixed = [replace(chain[seq - 1], seq=place) for place, seq in enumerate(order, 1)]
    first = next(place for place, seq in enumerate(order, 1) if place != seq)
    broken = follow(mixed, AuditChainHead(6, mixed[-1].hash)).broken
    assert broken is not None
    assert broken.seq == first


@pytest.mark.parametrize(
    ("done", "broken"),
    [
        ("DELETE FROM audit WHERE seq = 3", BrokenAuditRow(3, "missing: row 4 comes after row 2")),
        ("DELETE FROM audit WHERE seq = 1", BrokenAuditRow(1, "missing: row 2 comes after row 0")),
        ("DELETE FROM audit WHERE seq > 4", BrokenAuditRow(5, "missing: the log went to row 6")),
        ("DELETE FROM audit", BrokenAuditRow(1, "missing: the log went to row 6")),
        ("DELETE FROM audit_head", BrokenAuditRow(1, "added: the log went to row 0 only")),
    ],
)
def test_rows_that_are_gone_are_named(
    database: ServerDatabase, done: str, broken: BrokenAuditRow
) -> None:
    _fill(database, 6)
    _tamper(database, done)
    assert _verified(database).broken == broken


def test_a_log_written_anew_is_found_out_by_a_head_kept_elsewhere(database: ServerDatabase) -> None:
    with database.begin() as connection:
        first = append(connection, START_NS, ENTRY)
    kept = _fill(database, 5)
    _rewrite(database, 2, first.hash)
    assert _verified(database).holds  # docs/server/security.md: the database cannot tell
    assert _verified(database, AuditChainHead(1, first.hash)).holds
    found = _verified(database, kept, AuditChainHead(1, first.hash))
    assert found.broken is not None
    assert (found.broken.seq, found.broken.what[:9]) == (6, "rewritten")


def test_a_cut_end_is_found_out_by_a_head_kept_elsewhere(database: ServerDatabase) -> None:
    _fill(database, 3)
    with database.reading() as connection:
        third = head(connection)
    kept = _fill(database, 3)
    _tamper(
        database,
        "DELETE FROM audit WHERE seq > 3",
        f"UPDATE audit_head SET seq = 3, hash = '{third.hash}'",
    )
    assert _verified(database).holds
    assert _verified(database, kept).broken == BrokenAuditRow(4, "missing: the log went to row 6")


def test_a_head_is_read_as_it_is_printed(database: ServerDatabase) -> None:
    last = _fill(database, 2)
    assert AuditChainHead.from_text(f"{last}\n") == last
    for wrong in ("", "2", "two " + "0" * 64, "2 " + "g" * 64, "2 " + "0" * 63):
        with pytest.raises(UsageError, match="not a head"):
            AuditChainHead.from_text(wrong)


def test_threads_and_processes_write_one_chain(database: ServerDatabase) -> None:
    program = (
        "import sys; from pathlib import Path\n"
        "from amberbox.server.audit import AuditEntry\n"
        "from amberbox.server.audit import append\n"
        "from amberbox.server.database import ServerDatabase\n"
        "database = ServerDatabase(Path(sys.argv[1]))\n"
        "for number in range(20):\n"
        "    with database.begin() as connection:\n"
        "        append(connection, number, AuditEntry('process', '', 'own.read', str(number)))\n"
    )
    command = [sys.executable, "-c", program, str(database.path)]
    with subprocess.Popen(command) as process:
        threads = [threading.Thread(target=_write_alone, args=(database, n)) for n in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert process.wait(PATIENCE_S) == 0
    found = _verified(database)
    assert (found.rows, found.broken) == (80, None)


def _write_alone(database: ServerDatabase, writer: int) -> None:
    for number in range(20):
        with database.begin() as connection:
            entry = AuditEntry(f"thread {writer}", "", "own.read", str(number))
            append(connection, number, entry)


def test_secrets_do_not_get_into_the_log(database: ServerDatabase) -> None:
    details = {"password": "hunter2", "inner": [{"csrf_token": "hunter2"}], "tokens": 3}
    with database.begin() as connection:
        row = append(connection, START_NS, replace(ENTRY, details=details))
    assert json.loads(row.details) == {
        "password": "***",
        "inner": [{"csrf_token": "***"}],
        "tokens": 3,
    }


def test_what_is_too_long_is_cut_and_odd_characters_are_kept_out(database: ServerDatabase) -> None:
    entry = AuditEntry(
        "p" * 500, "a" * 500, "own.read", "\ud800\0" + "o" * 500, "ok", {"x": "y" * 9000}
    )
    with database.begin() as connection:
        row = append(connection, START_NS, entry)
    lengths = [len(part) for part in (row.principal, row.address, row.object, row.details)]
    assert lengths[:3] == [140, 64, 300]
    assert lengths[3] < 8_100
    assert json.loads(row.details)["characters"] > 9_000
    assert row.object.startswith("?\ufffdo")
    assert _verified(database).holds


def test_rows_are_found_by_time_person_and_action(database: ServerDatabase) -> None:
    with database.begin() as connection:
        append(connection, 100, ENTRY)
        append(connection, 200, replace(ENTRY, principal="robot:r1"))
        append(connection, 300, replace(ENTRY, action="own.read"))

    def found(**filters: int | str) -> list[int]:
        with database.reading() as connection:
            return [row.seq for row in rows(connection, **filters)]  # type: ignore[arg-type] # the keywords of each case

    assert found(from_ns=200) == [2, 3]
    assert found(to_ns=200) == [1]
    assert found(principal="robot:r1") == [2]
    assert found(action="own.read") == [3]
    assert found(principal="robot:r1", action="own.read") == []


def test_a_long_log_is_read_in_parts(database: ServerDatabase) -> None:
    with database.begin() as connection:
        connection.execute(AUDIT.insert(), [asdict(row) for row in _chain(2_500)])
    with database.reading() as connection:
        assert [row.seq for row in rows(connection, after_seq=1_200)] == list(range(1_201, 2_501))
        assert len(list(rows(connection))) == 2_500
