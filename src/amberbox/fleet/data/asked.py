"""What can be asked of a robot's rows, and what an answer says beside them."""

from __future__ import annotations

from typing import Any, Literal

import msgspec

Form = Literal["json", "csv", "arrow", "plot"]
By = Literal["received", "timestamp"]

ROWS = 100_000
"""Rows of an answer where nothing else is said."""
MOST_ROWS = 5_000_000
MOST_POINTS = 100_000
MOST_BINS = 500


class Asked(msgspec.Struct, frozen=True):
    """Rows of an item: of ``[from_ns, to_ns)``, at most ``limit``, or thinned to ``points``.

    ``bins`` is in how many bars sums count values, none if it is None.
    """

    robot: str
    item: str
    variables: list[str] | None = None
    from_ns: int | None = None
    to_ns: int | None = None
    by: By = "received"
    limit: int = ROWS
    points: int | None = None
    form: Form = "json"
    bins: int | None = None


class About(msgspec.Struct, frozen=True):
    """What an answer says beside its rows.

    ``next_ns`` is from where on there are more, None at the end. ``kind`` is ``rows``, or
    ``envelope`` where rows were summed up: least, greatest and mean value of each step.
    ``complete_ns`` is up to when all that the server holds was looked at; ``of`` is how many rows
    a thinned answer or an envelope was made of.
    """

    rows: int
    kind: Literal["rows", "envelope"] = "rows"
    next_ns: int | None = None
    complete_ns: int | None = None
    notes: list[str] = []
    of: int | None = None


def arguments(asked: Asked) -> dict[str, Any]:
    """Return a question as a worker takes it."""
    found: dict[str, Any] = msgspec.to_builtins(asked)
    return found
