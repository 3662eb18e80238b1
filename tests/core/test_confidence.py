from __future__ import annotations

import pytest

from amberbox.core.units import CONFIDENCE_WORDS, confidence_word, percent


@pytest.mark.parametrize(
    ("probability", "text"),
    [
        (1.0, "over 99 %"),
        (0.9951, "over 99 %"),
        (0.97, "97 %"),
        (0.004, "under 1 %"),
        (0.01, "1 %"),
    ],
)
def test_percent_is_never_all_or_nothing(probability: float, text: str) -> None:
    assert percent(probability) == text


def test_each_word_begins_at_its_threshold() -> None:
    for least, word in CONFIDENCE_WORDS:
        assert confidence_word(least) == word
    assert [confidence_word(least - 1e-9) for least, _ in CONFIDENCE_WORDS[:-1]] == [
        w for _, w in CONFIDENCE_WORDS[1:]
    ]
