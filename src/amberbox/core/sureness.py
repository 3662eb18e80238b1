"""How sure an answer is, in words: the same wherever a diagnosis is spoken of."""

from __future__ import annotations

SURE_WORDS: tuple[tuple[float, str], ...] = (
    (0.95, "almost certain"),
    (0.80, "very likely"),
    (0.50, "likely"),
    (0.20, "possible"),
    (0.0, "only a guess"),
)
"""From which probability on each word is used."""
LIKELY = 0.5
"""From which probability on a cause is called likely: it is so rather than not."""


def sure_word(probability: float) -> str:
    """Say a probability in words."""
    return next(word for least, word in SURE_WORDS if probability >= least)


def percent(probability: float) -> str:
    """Write a probability in whole percent; what is not quite sure is never 0 or 100 %."""
    if probability >= 0.995:
        return "over 99 %"
    return "under 1 %" if probability < 0.005 else f"{probability:.0%}".replace("%", " %")
