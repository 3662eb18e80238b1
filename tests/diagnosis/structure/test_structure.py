"""Structural analysis against its definitions, tried on all subsets of small models."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.equations.structure import Causality, Structure, bits, mask_of
from amberbox.diagnosis.structure.isolability import detectable, isolability
from amberbox.diagnosis.structure.sensors import minimal_sets, sensor_sets, with_sensors
from amberbox.diagnosis.structure.submodels import mso_sets, mtes_sets

MIXED, INTEGRAL, DERIVATIVE = Causality


def structure(
    equations: Sequence[str], faulty: Iterable[int], differentials: Any = None
) -> Structure:
    """Return a model whose equations are words of one-letter unknowns."""
    unknowns = sorted(set("".join(equations)))
    variables = [mask_of(map(unknowns.index, word)) for word in equations]
    faults = list(faulty)
    pairs = {
        number: (unknowns.index(x), unknowns.index(dx))
        for number, (x, dx) in (differentials or {}).items()
    }
    names = [f"f{number}" for number in faults]
    return Structure(list(equations), unknowns, names, variables, [1 << f for f in faults], pairs)


words = st.text("abcd", min_size=0, max_size=3).map(lambda word: "".join(sorted(set(word))))


@st.composite
def models(draw: st.DrawFn) -> Structure:
    """Return a model of up to eight equations with four unknowns."""
    equations = draw(st.lists(words, min_size=1, max_size=8))
    faulty = st.sets(st.integers(0, len(equations) - 1), min_size=1, max_size=5)
    return structure(equations, sorted(draw(faulty)))


def all_redundant(model: Structure) -> list[int]:
    """Return all sets with more equations than unknowns."""
    return [mask for mask in range(model.all + 1) if model.redundancy(mask) > 0]


def minimal(masks: Iterable[int]) -> list[int]:
    found = list(masks)
    return sorted(m for m in found if not any(n != m and n & m == n for n in found))


def minimal_test_supports(model: Structure) -> list[int]:
    """Return them by their definition."""

    @cache
    def surplus(mask: int) -> int:
        own = model.redundancy(mask)
        return max([own, *(surplus(mask & ~(1 << number)) for number in bits(mask))])

    def faults(mask: int) -> int:
        return mask_of(f for f, shown in enumerate(model.shown_in) if shown & mask)

    proper = [
        mask for mask in range(1, model.all + 1)
        if all(surplus(mask & ~(1 << number)) < surplus(mask) for number in bits(mask))
    ]  # fmt: skip
    supports = [
        mask for mask in proper
        if faults(mask) and not any(
            wider != mask and wider & mask == mask and faults(wider) == faults(mask)
            for wider in proper
        )
    ]  # fmt: skip
    return minimal(supports)


@settings(max_examples=100)
@given(models())
def test_sets_and_isolability_are_those_of_their_definitions(model: Structure) -> None:
    sets = list(mso_sets(model))
    assert sorted(sets) == minimal(all_redundant(model))
    assert sorted(mtes_sets(model)) == minimal_test_supports(model)
    seen = [any(mask & shown for mask in sets) for shown in model.shown_in]
    assert detectable(model) == mask_of(f for f, is_seen in enumerate(seen) if is_seen)
    assert isolability(model) == [
        [not any(mask & f and not mask & g for mask in sets) for g in model.shown_in]
        for f in model.shown_in
    ]


@settings(max_examples=20)
@given(models(), st.booleans())
def test_sensor_sets_are_minimal_and_all_there_are(model: Structure, may_fail: bool) -> None:
    unknowns = len(model.unknowns)

    def shown(measured: int) -> tuple[set[tuple[int, str]], set[str]]:
        extended = with_sensors(model, measured, may_fail=may_fail)
        sets = list(mso_sets(extended))
        pairs = set()
        for fault, own in enumerate(model.shown_in):
            if any(own & mask for mask in sets):
                pairs.add((fault, ""))
            for name, other in zip(extended.faults, extended.shown_in, strict=True):
                if any(own & mask and not other & mask for mask in sets):
                    pairs.add((fault, name))
        return pairs, {"", *extended.faults}

    best, _ = shown((1 << unknowns) - 1)
    enough = []
    for size in range(unknowns + 1):
        for chosen in map(mask_of, combinations(range(unknowns), size)):
            pairs, possible = shown(chosen)
            if {pair for pair in best if pair[1] in possible} <= pairs:
                enough.append(chosen)
    assert sorted(sensor_sets(model, (1 << unknowns) - 1, may_fail=may_fail)) == minimal(enough)


def test_nothing_is_found_where_not_even_everything_suffices() -> None:
    assert list(minimal_sets(0b111, lambda chosen: False)) == []
    assert list(minimal_sets(0b111, lambda chosen: True)) == [0]


# x' = x + u with a fault; x' is the derivative of x; a sensor of x
LAG = structure(["Dx", "Dx", "x"], [0, 2], {1: ("x", "D")})
# the same without a sensor of x, but one of z = x + w and one of w
SEEN_LATER = structure(["Dx", "Dx", "xzw", "z", "w"], [0], {1: ("x", "D")})
# two lags one behind the other, with one sensor that sees the sum of both
TWO_LAGS = structure(["Ax", "Ax", "Bxy", "By", "xy"], [0], {1: ("x", "A"), 3: ("y", "B")})


@pytest.mark.parametrize(
    ("model", "causality", "seen"),
    [
        (LAG, MIXED, [0, 1]), (LAG, INTEGRAL, [0, 1]), (LAG, DERIVATIVE, [0, 1]),
        (SEEN_LATER, INTEGRAL, [0]), (SEEN_LATER, DERIVATIVE, [0]),
        (TWO_LAGS, MIXED, [0]), (TWO_LAGS, INTEGRAL, [0]), (TWO_LAGS, DERIVATIVE, []),
    ],
)  # fmt: skip
def test_what_can_be_detected_depends_on_the_causality(
    model: Structure, causality: Causality, seen: list[int]
) -> None:
    assert list(bits(detectable(model, causality))) == seen


def test_a_sensor_of_the_derivative_alone_needs_no_integration_to_check_itself() -> None:
    """A second sensor of the derivative checks the first; the state is computed by integration."""
    model = structure(["D", "D", "Dx", "x"], [0, 3], {2: ("x", "D")})
    assert [list(bits(detectable(model, causality))) for causality in Causality] == [[0, 1]] * 3
    for causality in Causality:
        assert isolability(model, causality) == [[True, False], [False, True]]


@pytest.mark.needs_data
@pytest.mark.parametrize("name", ["three_tank", "induction_motor", "electric_motor"])
def test_published_models(shared_data: Path, name: str) -> None:
    known = json.loads((shared_data / "diagnosis/structural/models.json").read_text())[name]
    model = Structure(
        known["eqs"], known["x"], known["f"],
        [mask_of(x for x, entry in enumerate(row) if entry) for row in known["X"]],
        [mask_of(e for e, row in enumerate(known["F"]) if row[f]) for f in range(known["nf"])],
        {e: (row.index(2), row.index(3)) for e, row in enumerate(known["X"]) if 3 in row},
    )  # fmt: skip
    assert sorted(list(bits(mask)) for mask in mso_sets(model)) == sorted(known["msos"])
    assert sorted(list(bits(mask)) for mask in mtes_sets(model)) == sorted(known["mtes"])
    for causality, key in zip(Causality, ("", "_int", "_der"), strict=True):
        assert isolability(model, causality) == known[f"isolability{key}"]
