"""The decomposition of Dulmage and Mendelsohn: which equations determine which unknowns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from amberbox.core.cycles import cyclic_groups
from amberbox.core.equations.matching import Matching
from amberbox.core.equations.structure import Structure, bits

Part: TypeAlias = Literal["under", "just", "over"]


@dataclass(frozen=True, slots=True)
class Block:
    """Equations and unknowns, by their numbers: unknown n is computed by equation n.

    The under-determined part has more unknowns than equations, the over-determined part more
    equations than unknowns; what is left over stands at the end. A block of the just-determined
    part with several equations is solved as a whole.
    """

    part: Part
    equations: Sequence[int]
    unknowns: Sequence[int]


def blocks(model: Structure) -> list[Block]:
    """Return the blocks in an order in which each equation has unknowns of its own and later ones.

    Source: Dulmage, Mendelsohn, Coverings of bipartite graphs, Canadian Journal of Mathematics 10
    (1958); Blanke et al., Diagnosis and Fault-Tolerant Control, ch. 5.
    """
    matching = Matching.of(model.variables, model.all, len(model.unknowns))
    over = matching.overdetermined_part().equations
    unknowns = (1 << len(model.unknowns)) - 1
    lower = unknowns & ~matching.determined()
    upper = model.unknowns_of(over)
    middle = unknowns & ~lower & ~upper
    found = [
        Block("under", _computing(matching, lower), _computed_first(matching, lower)),
        *_just_determined(model, matching, middle),
        Block("over", [*_computing(matching, upper), *bits(matching.free)], list(bits(upper))),
    ]
    return [block for block in found if block.equations or block.unknowns]


def _computing(matching: Matching, unknowns: int) -> list[int]:
    return [matching.owner[u] for u in bits(unknowns) if matching.owner[u] >= 0]


def _computed_first(matching: Matching, unknowns: int) -> list[int]:
    return sorted(bits(unknowns), key=lambda unknown: matching.owner[unknown] < 0)


def _just_determined(model: Structure, matching: Matching, unknowns: int) -> Iterator[Block]:
    computed = {matching.owner[unknown]: unknown for unknown in bits(unknowns)}
    needs = {
        equation: [matching.owner[u] for u in bits(model.variables[equation] & unknowns)]
        for equation in computed
    }
    for group in reversed(cyclic_groups(needs)):
        yield Block("just", group, [computed[equation] for equation in group])


def matrix_json(model: Structure) -> Mapping[str, Any]:
    """Return the equations and unknowns of a model in the order of its blocks."""
    faults: dict[int, list[str]] = {}
    for fault, shown in zip(model.faults, model.shown_in, strict=True):
        for equation in bits(shown):
            faults.setdefault(equation, []).append(fault)
    equations, unknowns = [], []
    for number, block in enumerate(blocks(model)):
        place = {"part": block.part, "block": number}
        unknowns += [{"name": model.unknowns[unknown], **place} for unknown in block.unknowns]
        equations += [
            {
                "name": model.equations[equation], **place,
                "unknowns": [model.unknowns[u] for u in bits(model.variables[equation])],
                "known": list(model.known[equation]) if model.known else [],
                "faults": faults.get(equation, []),
                "derivative": _derivative(model, equation),
            }
            for equation in block.equations
        ]  # fmt: skip
    return {"equations": equations, "unknowns": unknowns, "faults": list(model.faults)}


def _derivative(model: Structure, equation: int) -> str:
    """Return the derivative that an equation says is one; empty for another equation."""
    if equation not in model.differentials:
        return ""
    return model.unknowns[model.differentials[equation][1]]
