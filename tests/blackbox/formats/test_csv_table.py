"""CSV files: times and types found over the whole file, bad rows named, our own ones exact."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import amberbox
from amberbox.blackbox.formats import csv as formats_csv
from amberbox.blackbox.formats._open import open_recording
from amberbox.blackbox.formats._recording import FileBytes, ReadOptions
from amberbox.blackbox.formats.csv import ColumnKind, convert
from amberbox.blackbox.query.importing import import_recordings
from amberbox.blackbox.query.table import Table
from amberbox.core.errors import AmberboxError, UsageError

NS = 10**9
NOON = 1_544_443_200
"""2018-12-10T12:00:00Z"""


def imported(content: str | bytes, folder: Path, name: str = "table.csv", **options: Any) -> Any:
    """Import a table; returns report and rows."""
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    (report,) = import_recordings([path], folder / "store", options=ReadOptions(**options))
    return report, amberbox.open(folder / "store").query(path.stem)


def test_types_are_those_of_the_whole_column(tmp_path: Path) -> None:
    lines = ["time,whole,number,yes,word,nothing,mixed,late,list"]
    for n in range(5000):
        late = "2.5" if n == 4999 else str(n)
        gap = "" if n % 2 else str(n)
        lines.append(f'{NOON + n}.25,{gap},{n / 8},{n % 2 == 0},w{n},,{n or "x"},{late},"[{n}, 1]"')
    report, table = imported("\n".join(lines), tmp_path)
    assert {field.name: field.type for field in table.fields} == {
        "timestamp": "time", "whole": "int64", "number": "float64", "yes": "bool",
        "word": "string", "mixed": "string", "late": "float64", "list": "list<int64>",
    }  # fmt: skip
    assert table.values("timestamp")[1] == (NOON + 1) * NS + NS // 4
    assert table.values("whole")[:3] == [0, None, 2]
    assert table.values("mixed")[:2] == ["x", "1"]
    assert table.values("list")[7] == [7, 1]
    assert report.accounts == ["table.csv: 5000 rows = 5000 messages + 0 refused"]
    assert "the time is the column 'time', in s since 1970 or the start" in report.notes
    assert "empty in every row: nothing" in report.notes


@pytest.mark.parametrize(
    ("header", "cells", "unit"),
    [
        ("timestamp", ["1544443200.000000001", "1544443201"], "s"),
        ("time", ["1544443200000.000001", "1544443201000"], "ms"),
        ("t", ["1544443200000000.001", "1544443201000000"], "us"),
        ("stamp", ["1544443200000000001", "1544443201000000000"], "ns"),
        ("Time [ms]", ["1544443200000.000001", "1544443201000"], "ms"),
        ("%time", ["1544443200000000001", "1544443201000000000"], "ns"),
        ("timestamp", ["2018-12-10T12:00:00.000000001Z", "2018-12-10T12:00:01Z"], "ISO 8601"),
        ("date", ["2018-12-10 13:00:00.000000001+01:00", "2018-12-10 12:00:01"], "ISO 8601"),
    ],
)
def test_the_time_is_found_with_its_unit(
    tmp_path: Path, header: str, cells: list[str], unit: str
) -> None:
    rows = "\n".join(f"{n},{cell}" for n, cell in enumerate(cells))
    report, table = imported(f"n,{header}\n{rows}\n", tmp_path)
    assert table.values("timestamp") == [NOON * NS + 1, (NOON + 1) * NS]
    assert table.names == ["timestamp", "n"]
    assert f", in {unit}" in report.notes[0]


def test_times_that_no_journal_holds_are_refused(tmp_path: Path) -> None:
    cells = ["2018-12-10T12:00:00Z", "2300-01-01T00:00:00Z", "2018-12-10T12:00:00+5Z", ""]
    report, table = imported("time,n\n" + "".join(f"{c},1\n" for c in cells), tmp_path)
    assert table.values("timestamp") == [NOON * NS]
    (account,) = report.accounts
    assert "1 messages + 3 refused (2 no time, 1 a time before 1970 or after 2262)" in account


def test_relative_times_begin_when_one_says(tmp_path: Path) -> None:
    content = "t_ms,x\n-500,1\n0,2\n250.5,3\n"
    report, table = imported(content, tmp_path, start_ns=NOON * NS)
    assert table.values("timestamp") == [NOON * NS + n for n in (0, 500_000_000, 750_500_000)]
    (tmp_path / "second").mkdir()
    report, table = imported(content, tmp_path / "second")
    assert table.values("timestamp") == [0, 250_500_000]
    assert any("--start TIME" in note for note in report.notes)
    assert report.accounts == [
        "table.csv: 3 rows = 2 messages + 1 refused (1 a time before 1970 or after 2262)"
    ]


def test_the_time_column_can_be_named(tmp_path: Path) -> None:
    _, table = imported("a,b,timestamp\n1544443200,2,7\n", tmp_path, time="a")
    assert table.values("timestamp") == [NOON * NS]
    assert table.values(table.names[2]) == [7]
    path = tmp_path / "other.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(UsageError, match="no column looks like a time") as caught:
        open_recording(path)
    assert "--time COLUMN" in caught.value.hint and "a, b" in caught.value.hint
    with pytest.raises(UsageError, match="there is no column 'c'"):
        open_recording(path, ReadOptions(time="c"))
    path.write_text("a,time\n1,soon\n")
    with pytest.raises(AmberboxError, match="holds no times"):
        open_recording(path)


@pytest.mark.parametrize(
    "content",
    [
        "time;x;y\n1544443200;1,5;a\n",
        "time\tx\ty\n1544443200\t1.5\ta\n",
        "time|x|y\r\n1544443200|1.5|a\r\n",
        "\ufefftime,x,y\n1544443200,1.5,a",
        "time, x, y\n1544443200, 1.5, a\n",
        '"time","x","y"\n"1544443200","1.5","a"\n',
        "\n# time,x,y\n\n1544443200,1.5,a\n\n",
    ],
)
def test_dialects(tmp_path: Path, content: str) -> None:
    report, table = imported(content, tmp_path)
    assert list(table.rows()) == [{"timestamp": NOON * NS, "x": 1.5, "y": "a"}]
    assert report.messages == 1


def test_latin_letters_and_names_that_are_twice_or_missing(tmp_path: Path) -> None:
    content = "time,Größe,Größe,\n1544443200,1,2,3\n".encode("cp1252")
    _, table = imported(content, tmp_path)
    assert len(table.names) == 4
    assert sorted(value for row in table.rows() for value in row.values())[:3] == [1, 2, 3]


def test_bad_rows_are_named_by_their_line(tmp_path: Path) -> None:
    lines = ["time,x,y"] + [f"{NOON + n},{n},a" for n in range(20)]
    lines[4] = "1544443203,3"
    lines[7] = "soon,6,a"
    lines[10] = '1544443209,"9,a'
    lines[13] = "1544443212,12,a,b"
    report, table = imported("\n".join(lines) + "\n", tmp_path)
    assert table.values("x") == [n for n in range(20) if n not in (3, 6, 9, 12)]
    assert report.accounts[0].startswith("table.csv: 20 rows = 16 messages + 4 refused (")
    (note,) = (note for note in report.notes if note.startswith("refused: "))
    for line in (5, 8, 11, 14):
        assert f"line {line} (" in note


def test_a_cell_may_have_several_lines(tmp_path: Path) -> None:
    content = 'time,text\n1544443200,"a\nb\n\nc"\n1544443201,"d ""e"""\n'
    _, table = imported(content, tmp_path)
    assert table.values("text") == ["a\nb\n\nc", 'd "e"']


def test_what_is_no_table_is_refused_in_words(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_bytes("time,x\n1,2\n".encode("utf-16"))
    with pytest.raises(AmberboxError, match="no text in UTF-8"):
        open_recording(path)
    path.write_text("time,x\n")
    with pytest.raises(AmberboxError, match="holds no times"):
        open_recording(path)
    path.write_text("\n\n")
    with pytest.raises(AmberboxError, match="no header line"):
        open_recording(path)


def test_the_name_of_a_table_names_its_item(tmp_path: Path) -> None:
    content = "time,x\n1544443200,1\n"
    for name in ("left.csv", "right.csv"):
        report, _ = imported(content, tmp_path, name)
        assert report.items == {name[:-4]: 1}
    report, _ = imported(content, tmp_path, "left.csv")
    assert report.known


def test_large_tables_are_read_in_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(formats_csv, "_BLOCK", 1000)
    monkeypatch.setattr(formats_csv, "_BATCH_ROWS", 7)
    lines = [f'{NOON + n},{n},"{"x" * (n % 300)}"' for n in range(500)]
    report, table = imported("time,n,pad\n" + "\n".join(lines), tmp_path)
    assert table.values("n") == list(range(500))
    assert report.messages == 500
    with open_recording(tmp_path / "table.csv") as recording:
        assert len(recording._parts) > 70


def test_rows_in_any_order_come_out_in_order_of_time(tmp_path: Path) -> None:
    numbers = [7, 3, 9, 1, 5] * 3
    lines = [f"{NOON + n},{n}" for n in numbers]
    _, table = imported("time,n\n" + "\n".join(lines), tmp_path)
    assert table.values("n") == sorted(numbers)


# -- tables of our own


def as_csv(table: Table) -> str:
    text = io.StringIO()
    table.to_csv(text)
    return text.getvalue()


def make_table(folder: Path) -> tuple[Table, str]:
    """Import JSON-like rows, and write them as 'amberbox query --format csv' does."""
    content = "time,whole,number,word,yes,list\n" + "".join(
        f'{NOON + n}.{n:09d},{n},{n / 7},"=w {n},\n{n}",{n % 2 > 0},"[{n / 3}, NaN]"\n'
        if n % 5 else f"{NOON + n}.{n:09d},,,,,\n"
        for n in range(50)
    ).replace("NaN", '""NaN""')  # fmt: skip
    _, table = imported(content, folder, "robot.csv")
    return table, as_csv(table)


def test_our_own_tables_come_back_exactly(tmp_path: Path) -> None:
    (tmp_path / "first").mkdir()
    original, text = make_table(tmp_path / "first")
    assert "'=w" in text  # a spreadsheet would calculate it
    _, again = imported(text, tmp_path, "robot.csv")
    assert as_csv(again) == text
    assert [(f.name, f.type) for f in again.fields] == [(f.name, f.type) for f in original.fields]
    assert str(list(again.rows())) == str(list(original.rows()))


def with_stamps(second: str, header: str = "x") -> str:
    lines = [f"timestamp,{header},received"]
    for n in range(10):
        stamp = f"2018-12-10T12:00:{n:02d}.123456789Z"
        other = stamp if header == "header_stamp" else str(n)
        lines.append(f"{stamp},{other},2018-12-10T12:{second}:{n:02d}.000000001Z")
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("header", ["x", "header_stamp", "stamp"])
def test_own_stamps_and_times_of_receipt_come_back_exactly(tmp_path: Path, header: str) -> None:
    text = with_stamps("01", header)
    _, _ = imported(text, tmp_path)
    record = amberbox.open(tmp_path / "store")
    names = text.splitlines()[0].split(",")
    assert as_csv(record.query("table", names)) == text
    extra = {"x": {"stamp"}, "header_stamp": set(), "stamp": {"stamp_2"}}[header]
    assert set(record.query("table").names) - set(names) == extra
    (info,) = (info for info in record.items() if info.name == "table")
    assert info.stamp_offset_s == pytest.approx(59.876543212)


def test_stamps_that_are_the_times_of_receipt_add_nothing(tmp_path: Path) -> None:
    stamp = "2018-12-10T12:00:00.000000007Z"
    _, table = imported(f"timestamp,x,received\n{stamp},1,{stamp}\n", tmp_path)
    assert table.names == ["timestamp", "x"]


# -- kinds of columns


def kind_of(*cells: str, comma: bool = False) -> str:
    kind = ColumnKind("x", comma)
    kind.observe(cells)
    return kind.kind


@pytest.mark.parametrize(
    ("cells", "kind"),
    [
        (["0", "-1", "+7", " 12 "], "int"),
        (["9223372036854775807", "-9223372036854775808"], "int"),
        (["9223372036854775808"], "text"),
        (["1", "2.5", "", "nan", "-inf", "1e-3", ".5", "5."], "float"),
        (["9007199254740993", "0.5"], "text"),
        (["007"], "text"),
        (["1_000"], "text"),
        (["-0"], "float"),
        (["true", "False", "TRUE"], "bool"),
        (["true", "1"], "text"),
        (["5\n6"], "text"),
        (["1,5"], "text"),
        (["[]", "[1, 2]"], "list<int>"),
        (["[1]", '["NaN", 0.5]'], "list<float>"),
        (['["a"]', '["NaN"]'], "list<text>"),
        (["[true]"], "list<bool>"),
        (["[[1]]"], "text"),
        (['[1, "a"]'], "text"),
        (["[1"], "text"),
        (["", ""], ""),
    ],
)
def test_kinds(cells: list[str], kind: str) -> None:
    assert kind_of(*cells) == kind
    assert [value for value in convert(kind, cells) if value is None] == [None] * cells.count("")


def test_commas_are_decimal_points_where_they_separate_nothing_else() -> None:
    assert kind_of("1,5", "2", comma=True) == "comma"
    assert convert("comma", ["1,5", "2"]) == [1.5, 2.0]
    assert kind_of("1.234,5", comma=True) == "text"


@settings(max_examples=200)
@given(st.lists(st.one_of(st.floats(), st.integers(-(2**60), 2**60), st.none()), max_size=20))
def test_numbers_come_back_as_they_were_written(values: list[float | int | None]) -> None:
    cells = ["" if value is None else repr(value) for value in values]
    column = ColumnKind("x")
    column.observe(cells)
    if column.kind == "text":  # floats beside whole numbers that no float holds
        assert any(isinstance(v, int) and abs(v) >= 10**15 for v in values)
        return
    for value, found in zip(values, convert(column.kind, cells), strict=True):
        same = value == found or (value is not None and math.isnan(value) and math.isnan(found))
        assert same


@settings(max_examples=60)
@given(
    st.lists(
        st.lists(st.text(st.characters(codec="utf-8", exclude_characters="\0\r")), min_size=2,
                 max_size=2),
        min_size=1, max_size=30,
    )
)  # fmt: skip
def test_rows_are_those_of_the_csv_module(rows: list[list[str]]) -> None:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(
        [["time", "a", "b"]] + [["1", *r] for r in rows]
    )
    with NamedTemporaryFile() as temporary:
        temporary.write(text.getvalue().encode())
        temporary.flush()
        file = FileBytes(Path(temporary.name))
        dialect = formats_csv.find_dialect(file)
        found = list(formats_csv.read_rows(file, dialect, dialect.start, file.size, 2))
        file.close()
    assert [row.cells for row in found] == [["1", *row] for row in rows]
    assert all(not row.problem for row in found)


def test_a_lost_quotation_mark_costs_one_row(tmp_path: Path) -> None:
    lines = [f'{NOON + n},"text {n}"' for n in range(3000)]
    lines[1000] = f'{NOON + 1000},"never closed'
    report, table = imported("time,text\n" + "\n".join(lines) + "\n", tmp_path)
    assert table.values("text") == [f"text {n}" for n in range(3000) if n != 1000]
    assert report.accounts[0].startswith("table.csv: 3000 rows = 2999 messages + 1 refused")
    assert any("refused: line 1002 (" in note for note in report.notes)
