"""Rows on their way: what a server writes is what the client reads, in either form."""

from __future__ import annotations

import math
import subprocess
import sys
from typing import Literal

import numpy as np
import pytest

from amberbox.blackbox.columns import arrays as col
from amberbox.blackbox.query.table import Table
from amberbox.client import table_reader
from amberbox.client.transport import ApiReply
from amberbox.core.types import Column, ColumnData, Ragged
from amberbox.server.data.query import AnswerInfo, RowAnswer, encoded

_TIMES = np.array([1_800_000_000_000_000_001, 1_800_000_001_000_000_002])
_FIELDS = (
    Column("timestamp", "timestamp", "time"),
    Column("x", "a/x", "float64", "m"),
    Column("count", "count", "uint64", labels={1: "one"}),
    Column("flag", "flag", "bool"),
    Column("text", "text", "string"),
    Column("data", "data", "binary"),
    Column("ranges", "ranges", "list<float32>"),
)
_KINDS = {"json": "application/json", "arrow": "application/vnd.apache.arrow.stream"}


def table() -> Table:
    columns: dict[str, ColumnData] = {
        "timestamp": _TIMES,
        "x": np.array([math.inf, math.nan]),
        "count": np.ma.masked_array(np.array([1, 0], np.uint64), mask=[False, True]),
        "flag": np.array([True, False]),
        "text": col.objects(["=a", None]),
        "data": col.objects([b"\x00\xff", None]),
        "ranges": Ragged(np.array([0, 2, 2]), np.array([1.5, -math.inf], np.float32)),
    }
    return Table("odom", _FIELDS, columns)


@pytest.mark.parametrize("form", ["json", "arrow"])
@pytest.mark.parametrize("rows", [2, 0])
def test_all_kinds_of_columns_come_as_they_were(form: Literal["json", "arrow"], rows: int) -> None:
    sent = table().take(slice(rows))
    body = b"".join(encoded(RowAnswer(sent, _TIMES[:rows], AnswerInfo(rows)), form))
    headers = {"content-type": _KINDS[form], "x-amberbox-notes": '["a note"]'}
    came = table_reader.page_of(ApiReply(200, headers, body))
    assert came.table.fields == sent.fields and came.table.notes == ("a note",)
    assert repr([*came.table.rows()]) == repr([*sent.rows()])
    assert table_reader.concatenate([came.table, came.table]).item == "odom"


def test_what_was_summed_up_is_shown_by_its_extremes() -> None:
    fields = (_FIELDS[0], *(Column(f"x:{end}", "", "float64") for end in ("min", "max")))
    low, high = np.array([1.0, 2.0]), np.array([5.0, 6.0])
    envelope = Table("odom", fields, {"timestamp": _TIMES, "x:min": low, "x:max": high})
    rows = table_reader.as_rows(envelope, {"x": _FIELDS[1]})
    assert rows.values("x") == [1.0, 5.0, 2.0, 6.0]
    assert rows.values("received") == np.repeat(_TIMES, 2).tolist()
    assert rows.fields[-1].unit == "m" and "least and the greatest" in rows.notes[-1]


def test_the_client_is_imported_when_it_is_needed() -> None:
    code = "import sys, amberbox.cli.query; sys.exit('http.client' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
