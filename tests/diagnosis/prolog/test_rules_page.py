"""The examples of the page on rules, and that it names every built-in predicate."""

from __future__ import annotations

import doctest
import re
from pathlib import Path

from amberbox.diagnosis.prolog.builtins import FUNCTIONS
from amberbox.diagnosis.prolog.compiler import FIXED
from amberbox.diagnosis.prolog.program import VOCABULARY, library

PAGE = Path(__file__).parents[3] / "docs" / "robot" / "rules.md"


def test_the_examples() -> None:
    flags = doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL
    failures, count = doctest.testfile(str(PAGE), module_relative=False, optionflags=flags)
    assert (failures, count > 8) == (0, True)


def test_every_name_is_on_the_page() -> None:
    words = set(re.findall(r"[^\s`|,]+", PAGE.read_text(encoding="utf-8").replace("/\\", " /\\ ")))
    names = {name for name, _ in (*FIXED, *library(), *VOCABULARY, *FUNCTIONS)}
    plain = {name for name in names if name[0] != "$" and name.isidentifier()}
    listed = {word.partition("/")[0].rstrip(".:;)") for word in words}
    assert plain - listed <= {"sumlist"}  # an old name of sum_list
