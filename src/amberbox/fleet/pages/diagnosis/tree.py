"""The tab of fault trees: what takes a function away, and how close that is now."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice
from typing import Any

import msgspec

from amberbox.core.errors import UsageError
from amberbox.core.sureness import percent
from amberbox.fleet.drawing.branches import Tree
from amberbox.fleet.drawing.faulttree import fault_tree
from amberbox.fleet.knowledge.asked import AskTrees
from amberbox.fleet.pages.diagnosis.parts import Asked, Values
from amberbox.fleet.pages.drawingwords import drawing_words
from amberbox.fleet.pages.strings import catalogue

CUT_SETS = 300
"""So many sets are looked at, those of fewest failures first."""
PATTERNS = 20
"""So many kinds of sets are listed."""
IMPORTANT = 10
DEPTH, PLACES = 3, 60
"""How much of a tree is drawn: gates above each other, and places in all."""


async def tree(asked: Asked, effect: str) -> Values:
    """Return the tree of a function: of what the diagnosis says is lost, without a name.

    It alone is solved; the others are listed.
    """
    chosen = effect or await _lost(asked)
    every = await asked.ask(_question(asked, chosen), "one_tree")
    if every["tree"] is None:
        return {"effects": [], "chosen": "", "tree": None}
    found, shown = every["tree"], msgspec.convert(every["shape"], Tree)
    near = _near(found)
    texts = {name: event.label or name for name, event in shown.events.items()}
    chosen = found["effect"]
    label = catalogue().text("diagnosis.details.tree.label", text=found["description"] or chosen)
    return {
        "effects": every["functions"], "chosen": chosen, "tree": found, "notes": found["notes"],
        "chance": _small(found["top_probability"]), "closest": _named(near, texts),
        "important": _important(found, texts), "patterns": _patterns(found["cut_sets"], texts),
        "drawing": fault_tree(
            shown, label=label, depth=DEPTH, most=PLACES, cut_set=_happened(near),
            words=drawing_words(),
        ),
    }  # fmt: skip


async def _lost(asked: Asked) -> str:
    """Return the gravest of what the diagnosis says is lost; empty where it says nothing."""
    try:
        answer = await asked.answer()
    except UsageError:
        return ""
    lost = answer["explanation"]["use"]["lost"] if answer else ()
    return next((str(one["id"]) for one in lost), "")


def _patterns(sets: Sequence[Sequence[str]], texts: Mapping[str, str]) -> list[Values]:
    """Group sets that differ only in which of several like parts fails."""
    found: dict[tuple[tuple[str, str], ...], list[list[str]]] = {}
    for one in sets:
        key = tuple(sorted(_pattern(name) for name in one))
        found.setdefault(key, []).append([texts.get(name, name) for name in one])
    return [{"first": alike[0], "others": alike[1:]} for alike in islice(found.values(), PATTERNS)]


def _pattern(name: str) -> tuple[str, str]:
    """Return what a failure has in common with that of like parts: the kind of part, and how."""
    part, _, mode = name.partition("#")
    return part.partition("_")[0], mode


def _question(asked: Asked, effect: str) -> AskTrees:
    return AskTrees(robot=asked.robot, now_ns=asked.now_ns, at=asked.at, effect=effect,
                    cut_sets=CUT_SETS)  # fmt: skip


def _near(found: Mapping[str, Any]) -> Sequence[Mapping[str, Any]]:
    near = next((one for one in found["closest"] if one["effect"] == found["effect"]), None)
    return near["closest"] if near else ()


def _happened(near: Sequence[Mapping[str, Any]]) -> list[str]:
    return list(near[0]["happened"]) if near else []


def _named(near: Sequence[Mapping[str, Any]], texts: Mapping[str, str]) -> list[Values]:
    return [
        {
            "happened": [texts.get(name, name) for name in one["happened"]],
            "missing": [texts.get(name, name) for name in one["missing"]],
            "share": percent(one["probability"]),
        }
        for one in near
        if one["happened"]
    ]  # fmt: skip


def _important(found: Mapping[str, Any], texts: Mapping[str, str]) -> list[Values]:
    ranked = sorted((found["importance"] or {}).items(), key=lambda item: -(item[1]["cif"] or 0))
    return [{"text": texts.get(name, name), "share": percent(of["cif"] or 0)}
            for name, of in ranked[:IMPORTANT]]  # fmt: skip


def _small(value: float | None) -> str:
    return "" if value is None else f"{value:.2g}"
