"""The page on explanations: its outputs, thresholds and words are those of the program."""

from __future__ import annotations

import re

from amberbox.core.sureness import SURE_WORDS
from amberbox.diagnosis.explanation.graph import CAUSES, SYMPTOMS
from amberbox.diagnosis.explanation.sureness import COVERED
from amberbox.diagnosis.explanation.text import SURE_ENOUGH
from amberbox.diagnosis.explanation.use import ANSWERS, NOBODY_KNOWS
from tests.diagnosis.explanation.page import BLOCK, PAGE, outputs, written


def test_the_outputs_are_real() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert len(BLOCK.findall(page)) == len(outputs())
    assert written(page) == page


def test_the_words_and_their_thresholds_are_on_the_page() -> None:
    page = PAGE.read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\w[\w ]+) \| (?:from (\d+) %|less) \|$", page, re.MULTILINE)
    assert [(word, float(least or 0) / 100) for word, least in rows] == [
        (word, least) for least, word in SURE_WORDS
    ]


def test_severities_and_limits_are_on_the_page() -> None:
    page = " ".join(PAGE.read_text(encoding="utf-8").split())
    for severity, words in ANSWERS.items():
        assert f"| {severity or 'nothing is lost'} | {words} |" in page
    assert f"| nobody knows | {NOBODY_KNOWS} |" in page
    assert f"at most {CAUSES} causes and {SYMPTOMS} symptoms" in page
    assert f"{COVERED:.0%}".replace("%", " %") in page
    assert f"at least {SURE_ENOUGH:.0%}".replace("%", " %") in page
