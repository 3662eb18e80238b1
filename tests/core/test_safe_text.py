"""Foreign text has no effect beyond showing its characters."""

from __future__ import annotations

import json
import unicodedata

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.safe_text import escape_hidden, one_line
from tests.fuzzing import examples, fuzz


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("laser", "laser"),
        ("für Höhe, 温度, \U0001f916", "für Höhe, 温度, \U0001f916"),
        ("\x1b[31mred\x1b[0m\x07", "\\u001b[31mred\\u001b[0m\\u0007"),
        ("\x9b31m", "\\u009b31m"),
        ("user\u202etxt.exe", "user\\u202etxt.exe"),
        ("ad\u200bmin ad\u200dmin", "ad\\u200bmin ad\\u200dmin"),
        ("\u0645\u06cc\u200c\u062e\u0648\u0627\u0647\u0645",) * 2,
        ("\U0001f468\u200d\U0001f469",) * 2,
        ("a\U000e0041", "a\\udb40\\udc41"),
        ("two\nlines\tand", "two\nlines\tand"),
    ],
)
def test_what_is_hidden_is_written_out(text: str, shown: str) -> None:
    assert escape_hidden(text) == shown


def test_one_line_is_one_line() -> None:
    assert one_line("a\r\nb\x85c\u2028d\x1be") == "a  b c d\\u001be"


@fuzz
@settings(max_examples=examples(50))
@given(st.text())
def test_nothing_hidden_is_left_and_json_means_the_same(text: str) -> None:
    shown = escape_hidden(text)
    left = {char for char in shown if unicodedata.category(char) in ("Cc", "Cs")}
    assert left <= {"\n", "\t"}
    assert escape_hidden(shown) == shown
    written = json.dumps(text, ensure_ascii=False)
    if not any("\ud800" <= char <= "\udfff" for char in text):
        assert json.loads(escape_hidden(written)) == text
