"""One output: pending, confirmed, healed, flapping, and the reasons for these."""

from __future__ import annotations

import json
from typing import Any

import pytest

from amberbox.core.robot_status import worst
from amberbox.monitoring.component_states import OutputState, expected_text, highest
from amberbox.monitoring.findings import TICK_NS, OutputChange, OutputCondition
from amberbox.monitoring.plan import Expectation, OutputPlan
from tests.monitoring.engine.stand import at_ns, output, seconds


class Run:
    """An output that is looked at whenever something is found or due."""

    def __init__(self, **plan: Any) -> None:
        self.state = OutputState(output(**plan), 0)
        self.levels: list[tuple[float, str]] = []

    def find(self, second: float, what: OutputCondition, value: Any = None, why: str = "") -> None:
        self.wait(second - 0.01)
        self.state.take(OutputChange(at_ns(second), 0, what, value, why))
        self._settle(at_ns(second))

    def wait(self, until: float) -> None:
        while (due := self._due()) is not None and due <= at_ns(until):
            self._settle(due)

    def _due(self) -> int | None:
        times = [t for t in (self.state.due_ns, self.state.calm_ns) if t is not None]
        return min(times, default=None)

    def _settle(self, now_ns: int) -> None:
        self.state.settle(now_ns)
        if not self.levels or self.levels[-1][1] != self.state.level:
            self.levels.append((seconds(now_ns), self.state.level))

    @property
    def text(self) -> str:
        return ": ".join(part for part in self.state.text() if part)


def test_it_counts_at_once_without_a_delay() -> None:
    run = Run()
    assert run.state.level == "unknown"
    run.find(1, "ok", True)
    run.find(2, "bad", False, "gone")
    assert run.text == "working is false, expected true: gone"
    run.find(3, "ok", True)
    assert run.levels == [(1, "ok"), (2, "error"), (3, "ok")]


def test_it_is_pending_for_a_while_before_it_counts() -> None:
    run = Run(for_s=5)
    run.find(0, "ok", True)
    run.find(1, "bad", False)
    run.find(3, "ok", True)  # too short
    run.find(4, "bad", False)
    run.wait(20)
    assert run.levels == [(0, "ok"), (9, "error")]


def test_what_ends_at_the_last_instant_never_counted() -> None:
    run = Run(for_s=5)
    run.find(0, "ok", True)
    run.find(1, "bad", False)
    run.find(6, "ok", True)
    run.wait(20)
    assert run.levels == [(0, "ok")]


def test_delays_end_at_an_instant() -> None:
    run = Run(for_s=0.12)
    run.find(0, "ok", True)
    run.find(1, "bad", False)
    run.wait(2)
    assert run.levels[-1] == (1.15, "error")
    assert at_ns(1.15) % TICK_NS == 0


def test_what_is_bad_from_the_start_is_unknown_until_it_counts() -> None:
    run = Run(for_s=2)
    run.find(1, "bad", False)
    assert run.state.level == "unknown"
    assert run.text == "not confirmed yet: working is false, expected true"
    run.wait(9)
    assert run.levels == [(1, "unknown"), (3, "error")]


def test_it_heals_only_after_a_while() -> None:
    run = Run(heal_s=2)
    run.find(0, "ok", True)
    run.find(1, "bad", False)
    run.find(2, "ok", True)
    assert run.text == "working was not as expected less than 2 s ago"
    run.find(3, "bad", False)  # again, before it healed
    run.find(4, "ok", True)
    run.wait(20)
    assert run.levels == [(0, "ok"), (1, "error"), (6, "ok")]


def test_silence_hides_a_fault_but_does_not_heal_it() -> None:
    run = Run(for_s=1, heal_s=2)
    run.find(0, "bad", False)
    run.wait(2)
    run.find(3, "stale", None, "nothing received of scan for 5 s")
    assert run.text == "nothing received of scan for 5 s"
    run.find(9, "ok", True)
    assert run.state.level == "error"
    run.wait(20)
    assert run.levels == [(0, "unknown"), (1, "error"), (3, "stale"), (9, "error"), (11, "ok")]


def test_silence_ends_what_was_pending() -> None:
    run = Run(for_s=2)
    run.find(0, "ok", True)
    run.find(1, "bad", False)
    run.find(2, "unknown", None, "no value")
    run.find(2.5, "bad", False)
    run.wait(20)
    assert run.levels == [(0, "ok"), (2, "unknown"), (2.5, "ok"), (4.5, "error")]


def test_flapping_stays_bad_until_it_has_been_calm() -> None:
    run = Run(flaps=6, flap_s=60)
    run.find(0, "ok", True)
    for number in range(1, 8):
        run.find(number, "bad" if number % 2 else "ok", not number % 2)
    assert run.text == "working flapping: 7 changes in 60 s"
    run.find(8, "ok", True)
    assert (run.state.shown, run.text) == ("bad", "working flapping: 7 changes in 60 s")
    run.find(30, "bad", False)
    run.find(31, "ok", True)
    run.wait(200)
    assert run.levels[-2:] == [(7, "error"), (91, "ok")]


def test_after_calm_changes_are_counted_anew() -> None:
    run = Run(flaps=2, flap_s=4)
    run.find(0, "ok", True)
    for second in (1, 2, 3):
        run.find(second, "bad" if second % 2 else "ok", second % 2 == 0)
    run.find(3.5, "ok", True)  # calm from here on
    run.find(7.5, "bad", False)
    run.find(7.6, "ok", True)
    run.wait(20)
    assert run.levels[-2:] == [(3, "error"), (7.6, "ok")]


def test_few_or_slow_changes_are_no_flapping() -> None:
    run = Run(flaps=2, flap_s=10)
    run.find(0, "ok", True)
    for second in range(6, 60, 6):
        run.find(second, "bad" if second % 12 else "ok", second % 12 == 0)
        assert run.state.level == ("error" if second % 12 else "ok")


def test_what_flaps_between_stale_and_ok_stays_stale() -> None:
    run = Run(flaps=2, flap_s=60)
    run.find(0, "ok", True)
    for second in (6, 8, 14, 16):
        run.find(second, "stale" if second in (6, 14) else "ok", None, "nothing received")
    assert (run.state.level, run.text) == ("stale", "working flapping: 3 changes in 60 s")
    run.wait(100)
    assert run.levels[-1] == (76, "ok")


def test_delays_keep_it_from_flapping() -> None:
    run = Run(flaps=2, flap_s=60, for_s=2)
    run.find(0, "ok", True)
    for number in range(20):
        run.find(1 + number, "ok" if number % 2 else "bad", number % 2 == 1)
    assert run.levels == [(0, "ok")]


def test_a_warning_is_a_warning() -> None:
    run = Run(severity="warning")
    run.find(1, "bad", False)
    assert (run.state.level, run.state.severity) == ("warn", "warning")
    run.find(2, "stale")
    assert (run.state.level, run.state.severity) == ("stale", "urgent")


def test_bools_and_texts_are_news_and_numbers_are_not() -> None:
    state = OutputState(output(type="string"), 0)
    assert state.take(OutputChange(at_ns(1), 0, "ok", "RUN")) == "value"
    assert state.take(OutputChange(at_ns(2), 0, "ok", "RUN")) == "none"
    assert state.take(OutputChange(at_ns(3), 0, "ok", "STOP")) == "value"
    assert state.take(OutputChange(at_ns(4), 0, "bad", "STOP")) == "other"
    assert state.take(OutputChange(at_ns(5), 0, "bad", "STOP", "why")) == "other"
    number = OutputState(output(type="float", expectation=Expectation(3, "<=")), 0)
    assert number.take(OutputChange(at_ns(1), 0, "bad", 3.25)) == "other"
    assert number.take(OutputChange(at_ns(2), 0, "bad", 9.0)) == "none"
    number.settle(at_ns(2))
    assert number.text() == ("working is 3.25, expected <= 3", "")


@pytest.mark.parametrize(
    ("plan", "expected"),
    [
        (output(), "true"),
        (output(expectation=Expectation(False)), "false"),
        (output(type="float", expectation=Expectation(50, ">=")), ">= 50"),
        (output(type="int", expectation=Expectation(1, "within", 5)), "1 to 5"),
    ],
)
def test_what_is_expected_is_said(plan: OutputPlan, expected: str) -> None:
    assert expected_text(plan) == expected


def test_a_bool_expects_what_its_mode_calls_nominal() -> None:
    assert expected_text(output("frozen", nominal=False)) == "false"


def test_the_worst_and_the_highest() -> None:
    assert worst(["ok", "unknown", "warn"]) == "unknown"
    assert worst(["stale", "error", "unknown"]) == "error"
    assert worst([]) == "unknown"
    assert highest(["warning", "fatal", "urgent"]) == "fatal"


def test_a_number_that_is_ok_takes_no_room_in_a_snapshot() -> None:
    run = Run(type="float")
    run.find(1, "ok", 2.5)
    assert run.state.snapshot(at_ns(2)) == []


def test_it_goes_on_from_a_snapshot() -> None:
    story: list[tuple[float, OutputCondition]] = [
        (0, "bad"), (3, "ok"), (4, "bad"), (5, "ok"), (9, "stale"), (10, "ok"), (20, "bad"),
    ]  # fmt: skip
    whole = Run(for_s=1, heal_s=1, flaps=2, flap_s=8)
    for second, what in story:
        whole.find(second, what, what == "ok")
    for cut in range(len(story)):
        parts = Run(for_s=1, heal_s=1, flaps=2, flap_s=8)
        for number, (second, what) in enumerate(story):
            parts.find(second, what, what == "ok")
            if number == cut:
                held = json.loads(json.dumps(parts.state.snapshot(at_ns(second))))
                parts.state = OutputState(parts.state.plan, 0)
                parts.state.resume(held, at_ns(second))
        assert parts.levels == whole.levels
        assert parts.text == whole.text
