"""What is missing of a robot's record and why, as the API lists it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, Literal

from amberbox.core.timetext import format_time
from amberbox.core.types import Gap
from amberbox.fleet.archive.gaps import TO_COME, WAITING, gaps_of
from amberbox.fleet.data.asked import Asked
from amberbox.fleet.data.look import Look

GapKind = Literal["to_come", "deleted", "filtered", "lost", "uncovered"]
_KINDS: Sequence[tuple[GapKind, re.Pattern[str]]] = (
    ("to_come", re.compile(f"^({re.escape(TO_COME)}|{re.escape(WAITING)})")),
    ("deleted", re.compile("^deleted")),
    ("filtered", re.compile("filter|unchanged|rate.?limit", re.IGNORECASE)),
    ("lost", re.compile("lost|drop|queue|damaged|torn|refused|corrupt|decod|columns", re.I)),
)
"""Records say why rows are missing in words, those of years ago too: the first that fits."""


def kind_of(reason: str) -> GapKind:
    """Sort a reason: to come, deleted, filtered on purpose, lost; else nothing was recorded."""
    return next((kind for kind, words in _KINDS if words.search(reason)), "uncovered")


def gaps_json(look: Look, asked: Asked) -> dict[str, Any]:
    """List gaps of an item (all without a name) that meet ``[from, to)``, in order of time.

    Journals that wait for their columns are none: questions are answered from them, too.
    """
    item = asked.item or None
    every = gaps_of(look.reader, look.catalogue, item, (asked.from_ns, asked.to_ns))
    found = [gap for gap in every if gap.reason != WAITING]
    return {"gaps": [_gap(gap) for gap in found[: asked.limit]], "more": len(found) > asked.limit}


def _gap(gap: Gap) -> dict[str, Any]:
    return {
        "item": gap.item, "writer": gap.writer, "run": gap.run, "from": format_time(gap.from_ns),
        "to": format_time(gap.to_ns), "kind": kind_of(gap.reason), "reason": gap.reason,
        "count": gap.count,
    }  # fmt: skip
