"""The page on explanations: its outputs, thresholds and words are those of the program."""

from __future__ import annotations

import re

from amberbox.core.units import CONFIDENCE_WORDS
from amberbox.diagnosis.report.causal_graph import CAUSES, SYMPTOMS
from amberbox.diagnosis.report.explain import ANSWERS, COVERED, UNKNOWN_USE
from amberbox.diagnosis.report.text import SURE_ENOUGH
from tests.diagnosis.report.page import BLOCK, PAGE, outputs, written


def test_the_outputs_are_real() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert len(BLOCK.findall(page)) == len(outputs())
    assert written(page) == page


def test_the_words_and_their_thresholds_are_on_the_page() -> None:
    page = PAGE.read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\w[\w ]+) \| (?:from (\d+) %|less) \|$", page, re.MULTILINE)
    assert [(word, float(least or 0) / 100) for word, least in rows] == [
        (word, least) for least, word in CONFIDENCE_WORDS
    ]


def test_severities_and_limits_are_on_the_page() -> None:
    page = " ".join(PAGE.read_text(encoding="utf-8").split())
    for severity, words in ANSWERS.items():
        assert f"| {severity or 'nothing is lost'} | {words} |" in page
    assert f"| nobody knows | {UNKNOWN_USE} |" in page
    assert f"at most {CAUSES} causes and {SYMPTOMS} symptoms" in page
    assert f"{COVERED:.0%}".replace("%", " %") in page
    assert f"at least {SURE_ENOUGH:.0%}".replace("%", " %") in page
