"""The next best test: expected information against cost and risk."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from amberbox.core.types import Hypothesis, Test
from amberbox.diagnosis.covering.model import Model
from amberbox.diagnosis.covering.observations import (
    AnsweredCheck,
    Check,
    Evidence,
    Prediction,
    causes_seen,
    outcomes_seen,
    predict,
    reading_check,
)

# The answer to a test that cannot be done: it changes nothing, and is not proposed again
CANNOT = "cannot check"

LEAST_GAIN_BITS = 1e-3  # tests with less information are not proposed


@dataclass(frozen=True, slots=True)
class TestCosts:
    """Weights of a test's price: ``fixed_s + cost_s + risk * risk_s``, in seconds.

    ``fixed_s`` is the effort of any test, ``risk_s`` how many seconds a risk of 1 is worth.
    """

    fixed_s: float = 10.0
    risk_s: float = 600.0

    def price_s(self, check: Check) -> float:
        """Return the price of a test, seconds."""
        return self.fixed_s + check.cost_s + check.risk * self.risk_s


@dataclass(frozen=True, slots=True)
class TestProposal:
    """A test with its gain and outcomes; ``value`` is bits per second of its price."""

    test: Test
    check: Check
    value: float


def reading_checks(model: Model, evidence: Evidence) -> Iterator[Check]:
    """Yield the readings of symptoms whose state is not known and that can be read on demand."""
    for sign in model.signs:
        observation = evidence.observations.get(sign.id)
        is_known = observation is not None and observation.state != "unknown"
        if not is_known and sign.read_cost_s is not None:
            yield reading_check(sign.id, sign.read_cost_s)


def next_tests(
    model: Model,
    evidence: Evidence,
    hypotheses: Sequence[Hypothesis],
    checks: Iterable[Check] = (),
    weights: TestCosts | None = None,
    most: int = 5,
) -> tuple[TestProposal, ...]:
    """Return the tests that are worth most: expected bits of information per price.

    The expectation is exact over the hypotheses given; failure modes that are in none of them are
    taken to be absent, and the unknown mode to show nothing more than it denies. Tests that were
    done are left out, as are those without information.
    """
    prices = weights or TestCosts()
    total = math.fsum(h.probability for h in hypotheses)
    if total <= 0:
        return ()
    shares = [hypothesis.probability / total for hypothesis in hypotheses]
    predictions = [predict(model, hypothesis.faults) for hypothesis in hypotheses]
    candidates = [
        c for c in (*checks, *reading_checks(model, evidence)) if c.id not in evidence.asked
    ]
    proposals = [
        _proposal(check, shares, expected, prices)
        for check, expected in _informative(model, candidates, predictions)
    ]
    worthy = [proposal for proposal in proposals if proposal.test.gain_bits >= LEAST_GAIN_BITS]
    return tuple(sorted(worthy, key=lambda p: (-p.value, p.test.id))[:most])


def splitting_test(
    model: Model,
    evidence: Evidence,
    hypotheses: Sequence[Hypothesis],
    members: Collection[str],
    checks: Iterable[Check] = (),
    weights: TestCosts | None = None,
) -> TestProposal | None:
    """Return the best test that distinguishes the members of an ambiguity group, else None."""
    chosen = [hypothesis for hypothesis in hypotheses if hypothesis.id in members]
    return next(iter(next_tests(model, evidence, chosen, checks, weights, 1)), None)


def with_answer(evidence: Evidence, check: Check, answer: str) -> Evidence:
    """Return the evidence after a test: an outcome of it, or ``CANNOT``.

    Raises UsageError for an answer that the test does not give.
    """
    asked = replace(evidence, asked=evidence.asked | {check.id})
    if answer == CANNOT:
        return asked
    level = check.level(answer)
    if check.reads:
        return asked.with_observation(check.reads, "present" if level else "absent")
    return replace(asked, answers=(*asked.answers, AnsweredCheck(check, answer)))


Outcomes = list[tuple[float, ...]]  # per hypothesis how probable each outcome is


def _informative(
    model: Model, checks: Iterable[Check], predictions: Sequence[Prediction]
) -> Iterator[tuple[Check, Outcomes]]:
    """Yield each check with its outcomes, unless no hypothesis touches it."""
    modes = frozenset().union(*(p.modes for p in predictions))
    lost = frozenset().union(*(p.lost for p in predictions))
    shown = {sign for p in predictions for sign in p.misses}
    for check in checks:
        if check.reads:
            sign = model.sign_places[check.reads]
            if sign in shown:
                present = [prediction.expected(model, sign) for prediction in predictions]
                yield check, [(1.0 - chance, chance) for chance in present]
            continue
        of_modes, of_functions = causes_seen(model, check)
        if any(p in modes for p, _ in of_modes) or any(p in lost for p, _ in of_functions):
            yield check, [outcomes_seen(check, of_modes, of_functions, p) for p in predictions]


def _proposal(
    check: Check, shares: Sequence[float], expected: Outcomes, by: TestCosts
) -> TestProposal:
    chances = [
        sum(share * row[level] for share, row in zip(shares, expected, strict=True))
        for level in range(len(check.outcomes))
    ]
    left = sum(share * entropy_bits(row) for share, row in zip(shares, expected, strict=True))
    gain = max(0.0, entropy_bits(chances) - left)
    test = Test(
        check.id,
        check.kind,
        check.text,
        check.role,
        check.cost_s,
        check.risk,
        gain,
        dict(zip(check.outcomes, chances, strict=True)),
        check.run,
        check.moves,
    )
    price_s = by.price_s(check)
    return TestProposal(test, check, gain / price_s if price_s > 0 else math.inf)


def entropy_bits(chances: Iterable[float]) -> float:
    """Return the entropy of a distribution in bits."""
    return -sum([chance * math.log2(chance) for chance in chances if chance > 0])
