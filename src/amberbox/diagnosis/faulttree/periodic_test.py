"""Unavailability of a component that is tested now and then (Open-PSA MEF, ``periodic-test``).

Its failures show only in a test, after which it is repaired. It is available, failed or in repair;
between the tests these are the states of a Markov process, and each test moves it on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_States = NDArray[np.float64]
"""The probabilities of being available, failed without anyone knowing, and in repair."""


def periodic_test(*arguments: float) -> float:
    """Return the probability of being unavailable at a time; all times in the same unit.

    The arguments are those of the format: 4 (failure rate, time between tests, time of the first
    test, time), 5 (with the repair rate second), or 11 (failure rate, failure rate in the test,
    repair rate, time between tests, time of the first test, probability that beginning the test
    causes a failure, duration of the test, whether it is available then, probability that the test
    detects a failure, probability of a bad restart after a test or repair, time). With 4 a repair
    takes no time, with 4 and 5 a test neither. At the very time of a test it has no effect yet.
    Raises ValueError for other numbers of arguments and for values out of range.
    """
    if len(arguments) == 4:
        rate, between, first, time = arguments
        return _repaired_at_once(rate, between, first, time)
    if len(arguments) == 5:
        rate, repair, between, first, time = arguments
        tested = _Tested(rate, 0.0, repair, between, first, 0.0, 0.0, 1.0, 1.0, 0.0)
        return tested.unavailable(time)
    if len(arguments) == 11:
        return _Tested(*arguments[:10]).unavailable(arguments[10])
    raise ValueError(f"'periodic-test' needs 4, 5 or 11 inputs, not {len(arguments)}")


def _repaired_at_once(rate: float, between: float, first: float, time: float) -> float:
    _check_range(rate=rate, time=time, first=first)
    _check_positive(between)
    if time > first:
        time = math.fmod(time - first, between) or between
    return -math.expm1(-rate * time)


def _check_range(**values: float) -> None:
    for name, value in values.items():
        if not 0.0 <= value < math.inf:
            raise ValueError(f"the {name} {value:g} of a periodic test is not 0 or more")


def _check_positive(between: float) -> None:
    if not 0.0 < between < math.inf:
        raise ValueError(f"the time between tests {between:g} is not above 0")


@dataclass(frozen=True, slots=True)
class _Tested:
    """The arguments of the format up to the time, in their order."""

    rate: float
    rate_in_test: float
    repair: float
    between: float
    first: float
    fails_by_test: float
    duration: float
    available_in_test: float
    detects: float
    bad_restart: float

    def __post_init__(self) -> None:
        _check_range(rate=self.rate, repair=self.repair, first=self.first, duration=self.duration)
        _check_range(**{"rate in the test": self.rate_in_test})
        _check_positive(self.between)
        if self.duration > self.between:
            raise ValueError("a periodic test lasts longer than the time between tests")
        for value in (self.fails_by_test, self.detects, self.bad_restart, self.available_in_test):
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{value:g} in a periodic test is not between 0 and 1")

    def unavailable(self, time: float) -> float:
        """Return the probability of being unavailable at a time."""
        _check_range(time=time)
        states = self._waited(np.array([1.0, 0.0, 0.0]), min(time, self.first))
        if time > self.first:
            after = math.fmod(time - self.first, self.between)
            periods = round((time - self.first - after) / self.between)
            period = np.column_stack([self._period(state) for state in np.eye(3)])
            states = np.linalg.matrix_power(period, periods) @ states
            if after <= self.duration:
                tested, others = self._in_test(states, after)
                hidden = 0.0 if self.available_in_test else tested[0]
                return float(tested[1] + others[1] + others[2] + hidden)
            states = self._waited(self._tested(states), after - self.duration)
        return float(states[1] + states[2])

    def _period(self, states: _States) -> _States:
        return self._waited(self._tested(states), self.between - self.duration)

    def _waited(self, states: _States, time: float) -> _States:
        """Let time pass without a test."""
        available, failed, repaired = states
        works, broken = math.exp(-self.rate * time), -math.expm1(-self.rate * time)
        still = math.exp(-self.repair * time)
        again = (1.0 - self.bad_restart) * self._repaired_and_working(time)
        done = -math.expm1(-self.repair * time)
        return np.array([
            available * works + repaired * again,
            failed + available * broken + repaired * max(0.0, done - again),
            repaired * still,
        ])  # fmt: skip

    def _repaired_and_working(self, time: float) -> float:
        """Return the probability that a repair ends within a time and nothing fails after it."""
        slow, fast = sorted((self.rate, self.repair))
        difference = (fast - slow) * time
        if difference < 1e-9:
            return self.repair * time * math.exp(-slow * time)
        return self.repair * math.exp(-slow * time) * -math.expm1(-difference) / (fast - slow)

    def _in_test(self, states: _States, time: float) -> tuple[_States, _States]:
        """Return the states of those that are tested and of those in repair, which are not."""
        available, failed, repaired = states
        works = available * (1.0 - self.fails_by_test) * math.exp(-self.rate_in_test * time)
        broken = -math.expm1(-self.rate_in_test * time)
        fails = self.fails_by_test + (1.0 - self.fails_by_test) * broken
        tested = np.array([works, failed + available * fails, 0.0])
        return tested, self._waited(np.array([0.0, 0.0, repaired]), time)

    def _tested(self, states: _States) -> _States:
        """Let a whole test pass."""
        (works, failed, _), others = self._in_test(states, self.duration)
        ends = np.array([
            works * (1.0 - self.bad_restart),
            works * self.bad_restart + failed * (1.0 - self.detects),
            failed * self.detects,
        ])  # fmt: skip
        return ends + others
