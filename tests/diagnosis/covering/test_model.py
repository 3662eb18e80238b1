from __future__ import annotations

import itertools

import pytest

from amberbox.core.errors import UsageError
from amberbox.core.needs import Needs, all_of, any_of, at_least
from amberbox.diagnosis.covering.hypotheses import diagnose
from amberbox.diagnosis.covering.model import (
    UNKNOWN,
    Function,
    FunctionGates,
    Link,
    Mode,
    Model,
    Sign,
    Unknown,
)
from amberbox.diagnosis.covering.observations import Evidence

A, S = Mode("a#x", 0.1), Sign("s")


@pytest.mark.parametrize(
    ("model", "what"),
    [
        (lambda: Model((Mode("a#x", 1.1),), (), ()), "the prior of a#x is 1.1, no probability"),
        (lambda: Model((A,), (Sign("s", -1),), ()), "the leak of s is -1"),
        (lambda: Model((A,), (S,), (Link("a#x", "s", 2),)), "the detects of a#x for s is 2"),
        (lambda: Model((A, A), (), ()), "'a#x' is there twice"),
        (lambda: Model((Mode(UNKNOWN, 0.1),), (), ()), "'unknown#other' is there twice"),
        (lambda: Model((A,), (S,), (Link("a#y", "s", 1),)), "no cause 'a#y' of s; did you mean"),
        (lambda: Model((A,), (S,), (Link("a#x", "t", 1),)), "there is no symptom 't' of a#x"),
        (lambda: Model((A,), (S,), (), unknown=Unknown(3)), "prior of unknown#other"),
        (
            lambda: Model((A,), (), (), (Function("f", all_of("g")), Function("g", any_of("f")))),
            "needs go in a circle: f -> g -> f",
        ),
    ],
)
def test_wrong_models_are_refused(model: object, what: str) -> None:
    with pytest.raises(UsageError, match=what):
        model()  # type: ignore[operator]  # a list of lambdas has no better common type


def test_a_conflict_over_what_is_not_there_is_refused() -> None:
    model = Model((A,), (S,), ())
    with pytest.raises(UsageError, match=r"there is no failure mode 'a#z'; did you mean"):
        diagnose(model, Evidence(conflicts=(frozenset({"a#z"}),)))


def test_gates_agree_with_the_definition_for_every_set_of_components() -> None:
    needs: list[tuple[str, Needs]] = [
        ("b", all_of("a")),
        ("f", any_of("a", all_of("b", "c"))),
        ("g", at_least(2, "f", "c", "d")),
        ("h", all_of("g", any_of("d", "nobody"))),
    ]
    components = ["a", "b", "c", "d"]
    gates = FunctionGates(needs, components)
    for down in itertools.chain.from_iterable(
        itertools.combinations(components, n) for n in range(5)
    ):

        def is_up(name: str, down: tuple[str, ...] = down) -> bool:
            return name not in down and (name not in dict(needs) or dict(needs)[name].met(is_up))

        lost = gates.lost(sum(1 << components.index(name) for name in down))
        assert {name for n, (name, _) in enumerate(needs) if lost >> n & 1} == {
            name for name, _ in needs if not is_up(name)
        }
