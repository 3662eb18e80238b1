"""Tables for terminals: nothing is wider than they are, and nothing is half a number."""

from __future__ import annotations

import io

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from amberbox.blackbox.columns.table_text import (
    LineWidth,
    fit_columns,
    format_grid,
    line_length,
    shorten,
    write_grid,
)
from amberbox.core.types import Column

HEADER = ["item", *(f"v{number}" for number in range(12))]
ROWS = [["odometry of the robot", *(1000.5 + number for number in range(12))]]


@given(
    st.lists(st.tuples(st.integers(1, 40), st.booleans()), min_size=1, max_size=30),
    st.integers(10, 200),
)
def test_what_is_shown_has_room(columns: list[tuple[int, bool]], width: int) -> None:
    widths, may_cut = [w for w, _ in columns], [text for _, text in columns]
    fitted = fit_columns(widths, may_cut, width)
    shown = fitted.pick(fitted.widths, 3)
    assert line_length(shown) <= max(width, line_length([widths[0], 3]))
    assert list(fitted.columns) == sorted(set(fitted.columns)) and fitted.columns[0] == 0
    assert fitted.widths[0] == widths[0]
    for before, after, text in zip(widths, fitted.widths, may_cut, strict=True):
        assert after == before or (text and 12 <= after < before)
    if line_length(widths) <= width:
        assert list(fitted.widths) == widths and not fitted.hides


def test_the_middle_is_left_out() -> None:
    lines = format_grid(HEADER, ROWS, room=LineWidth(60, "name some")).splitlines()
    assert lines[0].split() == ["item", "v0", "v1", "...", "v10", "v11"]
    assert lines[2].startswith("odometry of the robot  1000.5  1001.5  ...  ")
    assert lines[3] == "5 of 13 columns; name some"
    assert max(map(len, lines)) <= 60


def test_what_has_room_beside_a_wide_column_is_shown() -> None:
    header, row = ["item", "rate", "first", "last", "size"], ["odom", 10.5, 10**25, 10**25, 7]
    lines = format_grid(header, [row], room=LineWidth(40)).splitlines()
    assert lines[0].split() == ["item", "rate", "...", "size"]
    assert lines[-1] == "3 of 5 columns"


def test_texts_are_cut_no_more_than_needed_when_columns_go() -> None:
    rows = [["a", *(10**20 for _ in range(4)), "the words of a warning"]]
    lines = format_grid(["x", "b", "c", "d", "e", "text"], rows, room=LineWidth(60)).splitlines()
    assert lines[2].endswith("the words of a warning") and "..." in lines[2]


def test_long_texts_are_cut_before_columns_go() -> None:
    rows = [["a long name that is needed", "x" * 40, 1.25, "y" * 15]]
    lines = format_grid(["item", "text", "number", "short"], rows, room=LineWidth(70)).splitlines()
    assert len(lines) == 3 and len(lines[2]) == 70
    assert lines[2].split()[-3:] == ["x" * 14 + "...", "1.25", "y" * 15]
    assert lines[2].startswith("a long name that is needed  xxx")


def test_there_is_always_room_without_a_terminal() -> None:
    wide = format_grid(HEADER, ROWS)
    assert wide == format_grid(HEADER, ROWS, room=LineWidth(1000)) and len(wide.splitlines()) == 3
    assert len(wide.splitlines()[1]) > 100


def test_no_rows_and_one_column() -> None:
    assert format_grid(["a", "b"], [], room=LineWidth(80)).splitlines() == ["a  b", "-  -"]
    assert format_grid(["a"], [["x" * 30]], room=LineWidth(10)).splitlines()[2] == "x" * 30


def test_rows_that_come_later_have_the_same_columns() -> None:
    fields = [Column(f"v{number}", f"v{number}", "float64") for number in range(9)]
    file = io.StringIO()
    for header, value in ((True, 1.0), (False, -1.2345678e-300), (False, 5.0)):
        columns = {field.name: np.array([value]) for field in fields}
        write_grid(file, fields, columns, header=header, steady=True, room=LineWidth(60))
    lines = file.getvalue().splitlines()
    assert lines[0].split() == ["v0", "v1", "...", "v8"]
    assert lines[3] == "3 of 9 columns"
    assert lines[4].split() == ["-1.2345678e-300"] * 2 + ["..."] + ["-1.2345678e-300"]
    assert lines[5].split() == ["5", "5", "...", "5"]


def test_cutting() -> None:
    assert (
        shorten("abcdef", 6) == "abcdef"
        and shorten("abcdefg", 6) == "abc..."
        and shorten("abc", 2) == "..."
    )
