"""Answers about the structure of a model, as the command line and the server give them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal, TypeAlias

from amberbox.core.contracts import Budget, OutOfTimeError
from amberbox.core.equations.structure import Causality, Structure, bits, mask_of
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.diagnosis.structure.isolability import detectable, isolability, testable
from amberbox.diagnosis.structure.sensors import sensor_sets
from amberbox.diagnosis.structure.submodels import mso_sets, mtes_sets

SetKind: TypeAlias = Literal["mso", "mtes", "sensor_sets"]


def faults_json(model: Structure, causality: Causality, budget: Budget) -> dict[str, Any]:
    """Return which faults can be detected, and which each may be taken for.

    When time is up, ``incomplete`` says so, and only what can be detected is there.
    """
    seen = [model.faults[fault] for fault in bits(detectable(model, causality))]
    hidden: Sequence[Sequence[bool]] = []
    incomplete = ""
    try:
        hidden = isolability(model, causality, budget)
    except OutOfTimeError:
        incomplete = "time was up before all faults were compared"
    rows = dict(zip(model.faults, hidden, strict=True)) if hidden else {}
    return {
        "causality": causality.value,
        "redundancy": model.redundancy(testable(model, model.all)),
        "detectable": seen,
        "not_told_from": {
            fault: [other for other, may in zip(model.faults, row, strict=True) if may]
            for fault, row in rows.items()
        },
        "isolability": [[int(may) for may in row] for row in hidden],
        "incomplete": incomplete,
    }


def sets_json(
    model: Structure, kind: SetKind, budget: Budget, most: int,
    measurable: Sequence[str] = (), *, fallible: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """Return sets of equations for tests, or of unknowns to measure, the smallest first.

    ``measurable`` are the unknowns for which there are sensors, all if there are none; these may
    fail if they are ``fallible``. ``incomplete`` says which limit ended the search. Raises
    UsageError for unknowns that are not in the model.
    """
    chosen = _unknowns(model, measurable)
    names = model.unknowns if kind == "sensor_sets" else model.equations

    def sets() -> Iterator[int]:
        if kind == "sensor_sets":
            return sensor_sets(model, chosen, may_fail=fallible, budget=budget)
        return mso_sets(model, budget) if kind == "mso" else mtes_sets(model, budget)

    found: list[list[str]] = []
    incomplete = ""
    try:
        for mask in sets():
            if len(found) == most:
                incomplete = f"there are more than {most:,} sets"
                break
            found.append(sorted(names[number] for number in bits(mask)))
    except OutOfTimeError:
        incomplete = f"time was up after {len(found):,} sets"
    found.sort(key=lambda one: (len(one), one))
    return {kind: found, "count": len(found), "incomplete": incomplete}


def _unknowns(model: Structure, names: Sequence[str]) -> int:
    for name in names:
        if name not in model.unknowns:
            near = did_you_mean(name, model.unknowns)
            raise UsageError(f"there is no unknown '{name}'{near}")
    return mask_of(map(list(model.unknowns).index, names or model.unknowns))
