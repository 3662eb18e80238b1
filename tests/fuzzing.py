"""How many random examples a fuzz test tries: few in ``make test``, many in ``make soak``."""

from __future__ import annotations

import os

import pytest

SOAKING = os.environ.get("HYPOTHESIS_PROFILE") == "soak"

fuzz = pytest.mark.fuzz
"""Marks a test of random hostile input; ``make soak`` runs all of them at length."""


def examples(usual: int) -> int:
    """Return how many examples to try: `usual` in ``make test``, forty times as many in a soak."""
    return usual * 40 if SOAKING else usual
