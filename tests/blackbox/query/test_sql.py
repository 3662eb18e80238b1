"""SQL: the views give the same as queries, and only the store can be read."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import amberbox
from amberbox.blackbox.store.journal_reader import journals
from amberbox.cli.main import main
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.testing.records import (
    BATTERY,
    T0_NS,
    FakeItem,
    FakeRun,
    build_segments_of,
    fill_store,
)

MS = 1_000_000


@pytest.mark.parametrize("built", [0, 1, 2])
@pytest.mark.parametrize("item", ["odom", "odom__units", "battery"])
def test_views_say_the_same_as_queries(tmp_path: Path, built: int, item: str) -> None:
    fill_store(tmp_path)
    build_segments_of(tmp_path, built)
    record = amberbox.open(tmp_path)
    key = "parent_seq" if "__" in item else "seq"
    names = [column.name for column in record.variables(item).columns]
    asked = record.query(item, [*names, "received", key])
    order = "received, index" if "__" in item else "received"
    answer = record.sql(f'select * from "{item}" order by {order}')
    assert answer.names == asked.names
    assert list(answer.rows()) == list(asked.rows())


@pytest.mark.parametrize("built", [0, 2])
def test_receipt_follows_the_clock_channel(tmp_path: Path, built: int) -> None:
    run = FakeRun(tmp_path)
    for start, offset in ((0, 0), (10, 300 * MS), (20, -50 * MS)):
        run.clock(T0_NS + start * MS, offset)
        run.write([(T0_NS + (start + n) * MS + 1, BATTERY, {"volts": 1.0}) for n in range(10)])
        if start == 10:
            run.rotate()
            run.clock(T0_NS + start * MS, offset)
    run.close()
    build_segments_of(tmp_path, built)
    record = amberbox.open(tmp_path)
    expected = record.query("battery", ["received", "seq"])
    answer = record.sql('select "timestamp", received, seq from battery order by received')
    assert list(answer.rows()) == list(expected.rows())
    spread = record.sql(
        "select max(received) - min(received) > interval '300 milliseconds' as far from battery"
    )
    assert spread.values("far") == [True]


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([{"a": 1}, {"a": 1.5, "b": "x"}], [(1.0, None), (1.5, "x")]),
        ([{"a": 1}, {"a": 1.5}, {"a": "t", "b": "x"}], [("1", None), ("1.5", None), ("t", "x")]),
    ],
)
def test_schema_versions_are_one_view(
    tmp_path: Path, values: list[dict[str, object]], expected: list[tuple[object, object]]
) -> None:
    run = FakeRun(tmp_path)
    for number, value in enumerate(values):
        run.write([(T0_NS + number, FakeItem("state", [value]), value)])
        run.rotate()
    run.close()
    build_segments_of(tmp_path)
    answer = amberbox.open(tmp_path).sql("select a, b from state order by received")
    assert [(row["a"], row["b"]) for row in answer.rows()] == expected


def test_raw_data_are_not_needed(tmp_path: Path) -> None:
    fill_store(tmp_path)
    build_segments_of(tmp_path)
    for journal in journals(tmp_path):
        journal.path.unlink()
    answer = amberbox.open(tmp_path).sql("select count(*) as n, max(ranges[2]) as r from odom")
    assert list(answer.rows()) == [{"n": 200, "r": 1.0}]


@pytest.mark.parametrize(
    "statement",
    [
        "select * from read_csv('{outside}')",
        "select * from '{outside}'",
        "select * from read_parquet('{outside}')",
        "select * from glob('/*')",
        "select * from read_text('{store}/store.json')",
        "select getenv('HOME')",
        "select * from read_csv('http://127.0.0.1:9/x.csv')",
    ],
)
def test_nothing_outside_can_be_read(tmp_path: Path, statement: str) -> None:
    outside = tmp_path / "outside.csv"
    outside.write_text("a\n1\n")
    store = tmp_path / "store"
    fill_store(store)
    build_segments_of(store, 1)
    with pytest.raises(AmberboxError, match="SQL"):
        amberbox.open(store).sql(statement.format(outside=outside, store=store))


@pytest.mark.parametrize(
    "statement",
    [
        "copy (select 1) to '{store}/segments/odom/x.parquet'",
        "create table t as select 1",
        "attach '{store}/x.db'",
        "install httpfs",
        "load httpfs",
        "set enable_external_access = true",
        "pragma version",
        "select 1; select 2",
        "",
    ],
)
def test_only_one_question_is_taken(tmp_path: Path, statement: str) -> None:
    fill_store(tmp_path)
    build_segments_of(tmp_path, 1)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(AmberboxError, match="SQL"):
        amberbox.open(tmp_path).sql(statement.format(store=tmp_path))
    assert sorted(tmp_path.rglob("*")) == before


def test_a_wrong_statement_names_the_views(tmp_path: Path) -> None:
    fill_store(tmp_path)
    with pytest.raises(AmberboxError, match="nope") as caught:
        amberbox.open(tmp_path).sql("select * from nope")
    assert "odom" in caught.value.hint


def test_kinds_of_answers(tmp_path: Path) -> None:
    fill_store(tmp_path)
    answer = amberbox.open(tmp_path).sql(
        "select sum(seq) as whole, 1.5::decimal(4,2) as part, [1, 2] as list, null as none, "
        "date '2026-01-02' as day, 7 as a, 8 as a, max(\"timestamp\") as t from odom"
    )
    (row,) = answer.rows()
    assert isinstance(row["whole"], int)
    assert (row["part"], row["list"], row["none"]) == (1.5, [1, 2], None)
    assert (row["day"], row["a"], row["a_2"]) == ("2026-01-02", 7, 8)
    assert row["t"] == T0_NS + 2987 * MS
    shown = amberbox.open(tmp_path).sql("describe odom")
    assert "pose_x" in shown.values("column_name")


def test_without_duckdb_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill_store(tmp_path)
    monkeypatch.setitem(sys.modules, "duckdb", None)
    with pytest.raises(UsageError, match="needs DuckDB"):
        amberbox.open(tmp_path).sql("select 1")


@pytest.mark.parametrize("built", [0, 1, 2])
def test_tables_are_the_items(tmp_path: Path, built: int) -> None:
    fill_store(tmp_path)
    build_segments_of(tmp_path, built)
    record = amberbox.open(tmp_path)
    names = sorted(item.name for item in record.items())
    for question in ("show tables", "select view_name as name from duckdb_views()"
                     " where not internal and schema_name = current_schema()"):  # fmt: skip
        assert sorted(record.sql(question).values("name")) == names
    described = record.sql("describe odom").values("column_name")
    assert described[0] == "timestamp" and described[-1] == "seq"


def test_items_may_have_the_names_of_our_schema(tmp_path: Path) -> None:
    run = FakeRun(tmp_path)
    for name in ("journals", "main", "temp"):
        run.write([(T0_NS, FakeItem(name, [{"x": 1}]), {"x": 1})])
    run.close()
    record = amberbox.open(tmp_path)
    for name in ("journals", "main", "temp"):
        assert record.sql(f'select x from "{name}"').values("x") == [1]


def test_ctrl_c_ends_a_long_statement(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill_store(tmp_path)
    submit = ThreadPoolExecutor.submit

    def submitted(pool: ThreadPoolExecutor, work: Callable[[], Any]) -> Future[Any]:
        asked = submit(pool, work)
        monkeypatch.setattr(asked, "result", lambda: signal.raise_signal(signal.SIGINT))
        return asked

    endless = (
        "select count(*) from range(10000000) a, range(10000000) b where a.range * b.range = 7"
    )
    monkeypatch.setattr(ThreadPoolExecutor, "submit", submitted)
    with pytest.raises(KeyboardInterrupt):
        amberbox.open(tmp_path).sql(endless)


@pytest.mark.parametrize(
    "statement", ["select nope", "selec", "select * from nope", "select cast('a' as int)", "drop x"]
)
def test_a_wrong_statement_is_wrong_usage(tmp_path: Path, statement: str) -> None:
    fill_store(tmp_path)
    assert main(["sql", str(tmp_path), statement]) == 2
