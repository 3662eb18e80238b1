"""The tab of fault trees: what takes a function away, and how close that is now."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from amberbox.core.sureness import percent
from amberbox.fleet.drawing.branches import Tree
from amberbox.fleet.drawing.faulttree import fault_tree
from amberbox.fleet.knowledge.asked import AskTrees
from amberbox.fleet.pages.diagnosis.parts import Asked, Values
from amberbox.fleet.pages.drawingwords import drawing_words
from amberbox.fleet.pages.strings import catalogue

CUT_SETS = 20
"""So many sets are listed, those of fewest failures first."""
IMPORTANT = 10
DEPTH, PLACES = 3, 60
"""How much of a tree is drawn: gates above each other, and places in all."""


async def tree(asked: Asked, effect: str) -> Values:
    """Return the tree of a function: that which is closest to being lost without a name."""
    every = await asked.ask(_question(asked, ""), "fault_trees")
    effects = [{"id": one["effect"], "text": one["description"]} for one in every["effects"]]
    chosen = effect or _closest(every) or (effects[0]["id"] if effects else "")
    if not chosen:
        return {"effects": [], "chosen": "", "tree": None}
    question = _question(asked, chosen)
    found, shape = await asyncio.gather(
        asked.ask(question, "fault_trees"), asked.ask(question, "drawn_tree")
    )
    shown, near = msgspec.convert(shape, Tree), _near(found)
    texts = {name: event.label or name for name, event in shown.events.items()}
    label = catalogue().text("diagnosis.details.tree.label", text=found["description"] or chosen)
    return {
        "effects": effects, "chosen": chosen, "tree": found, "notes": found["notes"],
        "chance": _small(found["top_probability"]), "closest": _named(near, texts),
        "important": _important(found, texts),
        "sets": [[texts.get(name, name) for name in one] for one in found["cut_sets"][:CUT_SETS]],
        "drawing": fault_tree(
            shown, label=label, depth=DEPTH, most=PLACES, cut_set=_happened(near),
            words=drawing_words(),
        ),
    }  # fmt: skip


def _question(asked: Asked, effect: str) -> AskTrees:
    return AskTrees(robot=asked.robot, now_ns=asked.now_ns, at=asked.at, effect=effect,
                    cut_sets=CUT_SETS)  # fmt: skip


def _closest(every: Mapping[str, Any]) -> str:
    """Return the function that what is broken brings closest to being lost."""
    return next((str(one["effect"]) for one in every["closest"] if one["closest"]), "")


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
