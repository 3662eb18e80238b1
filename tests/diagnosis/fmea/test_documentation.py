"""The page about fmea.yaml: its examples run, its words and numbers are right."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from amberbox.diagnosis.fmea.loader import load_fmea, read_fmea, resolve, vocabularies

ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "docs/robot/fmea.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
FILES = [block for block in BLOCKS if "functions:" in block]


@pytest.mark.parametrize("text", FILES, ids=["one robot", "a team"])
def test_the_examples_are_right(text: str) -> None:
    fmea, problems = read_fmea(text)
    assert fmea is not None and not [problem for problem in problems if problem.is_error]
    assert len(fmea.system_functions()) == 1


def test_every_word_is_in_the_table() -> None:
    lines = dict(re.findall(r"^\| `(\w+)` \| ([^|]+) \| [^|]+ \|$", PAGE, re.MULTILINE))
    for name, vocabulary in vocabularies().items():
        assert set(re.findall(r"\w+", lines[name])) >= set(vocabulary.words)
        assert vocabulary.source and all(vocabulary.words.values())


def test_words_of_one_vocabulary_need_no_more() -> None:
    assert resolve("effector") == "carlson_murphy.effector"
    assert resolve("wienke.hardware") == "wienke.hardware"
    with pytest.raises(ValueError, match="ambiguous: carlson_murphy"):
        resolve("interaction")


def test_the_numbers_quoted_are_those_of_the_example() -> None:
    fmea, _ = load_fmea(ROOT / "src/amberbox/sim/folder/fmea.yaml")
    assert fmea is not None
    written = {(fmea.components[m.component].type, m.name) for m in fmea.modes.values()}
    said = re.search(r"with (\d+) failure modes written once and (\d+) when all", PAGE)
    assert said is not None
    assert (int(said[1]), int(said[2])) == (len(written), len(fmea.modes))
