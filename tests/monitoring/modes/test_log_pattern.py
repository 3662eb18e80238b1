"""Matching lines: faults are counted, required lines must appear; levels, and the last line."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from amberbox.core.flow import Flow
from amberbox.core.mode import FALSE, TRUE, UNKNOWN, Input
from amberbox.monitoring.modes import log_pattern as mode
from amberbox.monitoring.modes.log_pattern import Config
from amberbox.testing.modes import assert_mode_contract, at_s, one_input

LINES = ["laser: started", "laser: Timeout", "odom: fine", "laser: timeout again", None, "bye"]


def log(lines: Sequence[str | None] = LINES) -> Input:
    return one_input("ros_rosout.msg", times_s=range(len(lines)), values=lines)


def test_contract() -> None:
    configs = [Config("error", window=1.0), Config("ok", good=True, count=2, window=2.0)]
    assert_mode_contract(mode, "log_pattern", configs=configs, text=True, examples=40)


def test_bad_lines_count_within_the_window() -> None:
    config = Config("(?i)timeout", count=2, window=3.0)
    found = mode.evaluate(config, [log()], at_s(0, 1, 3, 3.95, 4, 6))
    assert found["ok"].tolist() == [TRUE, TRUE, FALSE, FALSE, TRUE, TRUE]
    assert found["lines"].tolist() == [0, 1, 2, 2, 1, 0]
    assert found["last_line"].tolist() == [
        "", "laser: Timeout", *["laser: timeout again"] * 3, ""
    ]  # fmt: skip


def test_good_lines_must_come() -> None:
    config = Config("heartbeat", good=True, window=2.0)
    lines = ["other", "heartbeat 1", "other", "other", "other", "heartbeat 2"]
    found = mode.evaluate(config, [log(lines)], at_s(0, 1, 2.9, 3, 5))["ok"].tolist()
    assert found == [UNKNOWN, TRUE, TRUE, FALSE, TRUE]


def test_only_lines_of_the_level_count() -> None:
    levels = one_input("ros_rosout.level", times_s=range(6), values=[2, 4, 2, 8, 8, 2])
    found = mode.evaluate(Config("(?i)timeout", level=8), [log(), levels], at_s(5))
    assert found["lines"] == 1
    assert found["last_line"] == "laser: timeout again"


def test_lines_at_one_time_keep_their_own_levels() -> None:
    text = one_input(times_s=[1, 1, 1], values=["bad a", "bad b", "fine"])
    levels = one_input(times_s=[1, 1, 1], values=[8, 2, 8])
    found = mode.evaluate(Config("bad", level=8), [text, levels], at_s(1))
    assert (found["lines"], found["last_line"]) == (1, "bad a")


def test_a_level_that_is_no_number_does_not_count() -> None:
    levels = one_input(times_s=[0], values=["high"])
    assert mode.evaluate(Config("laser", level=2), [log(["laser"]), levels], at_s(0))["lines"] == 0


def test_before_any_line_nothing_is_known() -> None:
    found = mode.evaluate(Config("x"), [log([])], at_s(0, 1))
    assert found["ok"].tolist() == [UNKNOWN, UNKNOWN]


def test_only_lines_of_one_writer_count() -> None:
    levels = one_input("ros_rosout.level", times_s=range(6), values=[8] * 6)
    names = one_input(times_s=range(6), values=["/laser", "/laser", "/odom", "/odom", "/odom", ""])
    config = Config("", level=8, of="/laser")
    found = mode.evaluate(config, [log(), levels, names], at_s(5))
    assert (found["lines"], found["last_line"]) == (2, "laser: Timeout")


def test_a_log_without_lines_may_be_well() -> None:
    quiet = Input("log", flow=Flow(began_ns=at_s(0)))
    assert mode.in_silence(Config("x", silence_ok=True)) and not mode.in_silence(Config("x"))
    found = mode.evaluate(Config("x", silence_ok=True), [quiet], at_s(0.5, 2))
    assert found["ok"].tolist() == [UNKNOWN, TRUE]


def test_explanations() -> None:
    bad = {"ok": False, "lines": 3, "last_line": "laser: timeout"}
    assert mode.explain(Config("x"), bad) == "3 lines in 60 s, the last: laser: timeout"
    assert mode.explain(Config("x", good=True), bad) == "no line with 'x' for 60 s"
    assert mode.explain(Config("x"), {"ok": True, "lines": 0, "last_line": ""}) == ""


@pytest.mark.parametrize("config", [Config("("), Config("x", count=0), Config("x", window=0)])
def test_what_matches_nothing_is_refused(config: Config) -> None:
    assert list(config.check())


def test_many_lines_are_counted_exactly() -> None:
    lines = [f"{'bad' if k % 7 == 0 else 'good'} {k}" for k in range(500)]
    found = mode.evaluate(Config("^bad", window=50.0), [log(lines)], at_s(*range(500)))
    expected = [sum(k % 7 == 0 for k in range(max(0, t - 49), t + 1)) for t in range(500)]
    assert np.array_equal(found["lines"], expected)
