"""The audit log: rows follow on one another, and what was done to them is found out."""

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
from amberbox.fleet.audit.entry import START, Entry, Row, link, row_after
from amberbox.fleet.audit.log import Head, append, head, rows
from amberbox.fleet.audit.tables import AUDIT, AUDIT_HEAD
from amberbox.fleet.audit.verify import Broken, Verified, follow, verify
from amberbox.fleet.database.database import Database
from amberbox.testing.patience import PATIENCE_S

START_NS = 1_700_000_000_000_000_000
ENTRY = Entry("user:anna", "10.0.0.7", "users.write", "bert", details={"role": "operator"})


def _fill(database: Database, count: int) -> Head:
    with database.begin() as connection:
        for number in range(count):
            append(connection, START_NS + number, replace(ENTRY, object=f"user {number + 1}"))
        return head(connection)


def _verified(database: Database, *kept: Head) -> Verified:
    with database.reading() as connection:
        return verify(connection, kept)


def _tamper(database: Database, *statements: str) -> None:
    """Change rows as somebody does who has the file: without the triggers."""
    with database.begin() as connection:
        for change in ("update", "delete"):
            connection.exec_driver_sql(f"DROP TRIGGER IF EXISTS audit_no_{change}")
        for statement in statements:
            connection.exec_driver_sql(statement)


def _rewrite(database: Database, seq: int, hash_: str) -> None:
    """Change a row and make all hashes from there on anew, the head as well."""
    _tamper(database, f"UPDATE audit SET principal = 'user:eve' WHERE seq = {seq}")
    with database.begin() as connection:
        for row in list(rows(connection, after_seq=seq - 1)):
            hash_ = link(hash_, row)
            connection.execute(AUDIT.update().where(AUDIT.c.seq == row.seq).values(hash=hash_))
        connection.execute(AUDIT_HEAD.update().values(hash=hash_))


def test_an_empty_log_holds(database: Database) -> None:
    assert _verified(database) == Verified(0, Head(0, START), None)


def test_rows_follow_on_one_another(database: Database) -> None:
    last = _fill(database, 5)
    assert _verified(database) == Verified(5, last, None)
    with database.reading() as connection:
        found = list(rows(connection))
    assert [row.seq for row in found] == [1, 2, 3, 4, 5]
    assert found[0] == row_after(0, START, START_NS, replace(ENTRY, object="user 1"))
    assert found[0].details == '{"role": "operator"}'
    assert last == Head(5, found[-1].hash)


def test_the_hash_is_as_documented() -> None:
    row = Row(1, 2, "user:anna", "::1", "own.read", "ä", "ok", "{}", "")
    by_hand = f'["{START}",1,2,"user:anna","::1","own.read","\\u00e4","ok","{{}}"]'
    assert link(START, row) == hashlib.sha256(by_hand.encode()).hexdigest()


def test_a_change_and_its_row_stand_or_fall_together(database: Database) -> None:
    with pytest.raises(RuntimeError), database.begin() as connection:
        append(connection, START_NS, ENTRY)
        raise RuntimeError("the change fails")
    assert _verified(database).rows == 0


@pytest.mark.parametrize("change", ["UPDATE audit SET object = 'x'", "DELETE FROM audit"])
def test_the_server_itself_cannot_change_rows(database: Database, change: str) -> None:
    _fill(database, 1)
    with pytest.raises(IntegrityError, match="stay as they are"), database.begin() as connection:
        connection.exec_driver_sql(change)
    assert _verified(database).rows == 1


def _chain(count: int) -> list[Row]:
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
    stated, at = Head(count, chain[-1].hash), at % count
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
    broken = follow(mixed, Head(6, mixed[-1].hash)).broken
    assert broken is not None
    assert broken.seq == first


@pytest.mark.parametrize(
    ("done", "broken"),
    [
        ("DELETE FROM audit WHERE seq = 3", Broken(3, "missing: row 4 comes after row 2")),
        ("DELETE FROM audit WHERE seq = 1", Broken(1, "missing: row 2 comes after row 0")),
        ("DELETE FROM audit WHERE seq > 4", Broken(5, "missing: the log went to row 6")),
        ("DELETE FROM audit", Broken(1, "missing: the log went to row 6")),
        ("DELETE FROM audit_head", Broken(1, "added: the log went to row 0 only")),
    ],
)
def test_rows_that_are_gone_are_named(database: Database, done: str, broken: Broken) -> None:
    _fill(database, 6)
    _tamper(database, done)
    assert _verified(database).broken == broken


def test_a_log_written_anew_is_found_out_by_a_head_kept_elsewhere(database: Database) -> None:
    with database.begin() as connection:
        first = append(connection, START_NS, ENTRY)
    kept = _fill(database, 5)
    _rewrite(database, 2, first.hash)
    assert _verified(database).holds  # as docs/security.md says: the database alone cannot tell
    assert _verified(database, Head(1, first.hash)).holds
    found = _verified(database, kept, Head(1, first.hash))
    assert found.broken is not None
    assert (found.broken.seq, found.broken.what[:9]) == (6, "rewritten")


def test_a_cut_end_is_found_out_by_a_head_kept_elsewhere(database: Database) -> None:
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
    assert _verified(database, kept).broken == Broken(4, "missing: the log went to row 6")


def test_a_head_is_read_as_it_is_printed(database: Database) -> None:
    last = _fill(database, 2)
    assert Head.from_text(f"{last}\n") == last
    for wrong in ("", "2", "two " + "0" * 64, "2 " + "g" * 64, "2 " + "0" * 63):
        with pytest.raises(UsageError, match="not a head"):
            Head.from_text(wrong)


def test_threads_and_processes_write_one_chain(database: Database) -> None:
    program = (
        "import sys; from pathlib import Path\n"
        "from amberbox.fleet.audit.entry import Entry\n"
        "from amberbox.fleet.audit.log import append\n"
        "from amberbox.fleet.database.database import Database\n"
        "database = Database(Path(sys.argv[1]))\n"
        "for number in range(20):\n"
        "    with database.begin() as connection:\n"
        "        append(connection, number, Entry('process', '', 'own.read', str(number)))\n"
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


def _write_alone(database: Database, writer: int) -> None:
    for number in range(20):
        with database.begin() as connection:
            entry = Entry(f"thread {writer}", "", "own.read", str(number))
            append(connection, number, entry)


def test_secrets_do_not_get_into_the_log(database: Database) -> None:
    details = {"password": "hunter2", "inner": [{"csrf_token": "hunter2"}], "tokens": 3}
    with database.begin() as connection:
        row = append(connection, START_NS, replace(ENTRY, details=details))
    assert json.loads(row.details) == {
        "password": "***",
        "inner": [{"csrf_token": "***"}],
        "tokens": 3,
    }


def test_what_is_too_long_is_cut_and_odd_characters_are_kept_out(database: Database) -> None:
    entry = Entry("p" * 500, "a" * 500, "own.read", "\ud800\0" + "o" * 500, "ok", {"x": "y" * 9000})
    with database.begin() as connection:
        row = append(connection, START_NS, entry)
    lengths = [len(part) for part in (row.principal, row.address, row.object, row.details)]
    assert lengths[:3] == [140, 64, 300]
    assert lengths[3] < 8_100
    assert json.loads(row.details)["characters"] > 9_000
    assert row.object.startswith("?\ufffdo")
    assert _verified(database).holds


def test_rows_are_found_by_time_person_and_action(database: Database) -> None:
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


def test_a_long_log_is_read_in_parts(database: Database) -> None:
    with database.begin() as connection:
        connection.execute(AUDIT.insert(), [asdict(row) for row in _chain(2_500)])
    with database.reading() as connection:
        assert [row.seq for row in rows(connection, after_seq=1_200)] == list(range(1_201, 2_501))
        assert len(list(rows(connection))) == 2_500
