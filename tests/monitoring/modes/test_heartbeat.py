"""A heartbeat is evaluated by counts taken before any filter, and silence is never ok."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from amberbox.core.mode import FALSE, TRUE, UNKNOWN, Given, Input
from amberbox.monitoring.modes import heartbeat
from amberbox.monitoring.modes.heartbeat import Config
from amberbox.testing.modes import assert_mode_contract, at_s, one_input

TEN = Config(rate=10, tolerance=20, window=2, max_age=1)


def test_contract() -> None:
    assert_mode_contract(heartbeat, "heartbeat", configs=[Config(), TEN])


def beats(rate_hz: float, start_s: float = 0.0, stop_s: float = 10.0) -> list[float]:
    return [float(second) for second in np.arange(start_s, stop_s, 1 / rate_hz)]


def alive(config: Config, entry: Input, second: float) -> int:
    return int(heartbeat.evaluate(config, [entry], at_s(second))["alive"])


def test_steady() -> None:
    results = heartbeat.evaluate(TEN, [one_input(times_s=beats(10))], at_s(5.05))
    assert int(results["alive"]) == TRUE
    assert float(results["rate_hz"]) == pytest.approx(10)
    assert float(results["age_s"]) == pytest.approx(0.05)


@pytest.mark.parametrize(("rate_hz", "expected"), [(9, TRUE), (7.6, TRUE), (7, FALSE), (30, TRUE)])
def test_a_lower_rate(rate_hz: float, expected: int) -> None:
    assert alive(TEN, one_input(times_s=beats(rate_hz)), 8) == expected


def test_the_rate_is_judged_after_a_whole_window() -> None:
    slow = one_input(times_s=beats(5))
    found = heartbeat.evaluate(TEN, [slow], at_s(1.5, 2.5))
    assert found["alive"].tolist() == [TRUE, FALSE]
    assert np.isnan(found["rate_hz"]).tolist() == [True, False]


def test_silence_is_a_fault_soon_and_stays_one() -> None:
    stopped = one_input(times_s=beats(10, stop_s=5))
    config = Config(max_age=1)
    assert [alive(config, stopped, s) for s in (4.9, 5.5, 6.1, 60, 100_000)] == [1, 1, 0, 0, 0]


def test_a_publisher_that_comes_back() -> None:
    entry = one_input(times_s=[*beats(10, stop_s=5), *beats(10, start_s=8, stop_s=20)])
    assert [alive(TEN, entry, s) for s in (4.9, 7.5, 10.5)] == [TRUE, FALSE, TRUE]


def test_inputs_with_rates_of_their_own() -> None:
    config = Config(rates={"/scan": 10.0, "/map": 0.5}, max_age=1)
    slow = one_input("/map", times_s=beats(0.5, stop_s=40))
    found = heartbeat.evaluate(config, [slow], at_s(39, 43, 45))
    assert found["heard"].tolist() == [TRUE, TRUE, FALSE]
    half = one_input("/scan", times_s=beats(5, stop_s=40))
    assert alive(config, half, 30) == FALSE
    why = heartbeat.reason(config, Given([slow, half], at_s(30)))
    assert why == "/scan too slow: 5 messages per second, 10 expected"
    assert heartbeat.history_s(config) == 8
    assert list(config.check()) == [] and list(Config(rates={"/scan": 0.0}).check())
    problems = list(heartbeat.input_problems(config, ["/scan", "/mop"]))
    assert problems == [("rates", "'/map' is no input of this file; did you mean '/mop'?")]


def test_a_lost_publisher_is_known_before_silence() -> None:
    entry = one_input("/scan", times_s=beats(10, stop_s=5))
    entry.flow.gap_from_ns.extend(np.array([at_s(5)]), np.array([at_s(5)]))
    config = Config(max_age=5)
    found = heartbeat.evaluate(config, [entry], at_s(4.9, 6.1))
    assert (found["connected"].tolist(), found["heard"].tolist()) == ([TRUE, FALSE], [TRUE, TRUE])
    bad = {"connected": False, "alive": True, "heard": True, "often_enough": True}
    assert (
        heartbeat.explain(config, {**bad, "age_s": 1.0, "rate_hz": 9.0})
        == "no connection to its publisher"
    )


def test_nothing_heard_is_unknown_at_first_and_then_a_fault() -> None:
    never = one_input()
    assert alive(Config(window=5), never, 3) == UNKNOWN
    never.flow.began_ns = at_s(0)
    assert [alive(Config(window=5), never, s) for s in (3, 5, 50)] == [UNKNOWN, FALSE, FALSE]


def test_one_message_more_or_less_in_the_window_is_no_fault() -> None:
    jittered = one_input(times_s=[0, 1.04, 2, 3.04, 4, 5.04, 6, 7.04, 8])
    config = Config(rate=1, tolerance=5, window=3)
    assert {alive(config, jittered, 3.02 + n / 20) for n in range(90)} == {TRUE}


def test_explanations() -> None:
    stopped = {"alive": False, "age_s": 3.21, "rate_hz": 0.0, "heard": False, "often_enough": None}
    assert heartbeat.explain(TEN, stopped) == (
        "silent: no message for 3.2 s (10 per second expected)"
    )
    assert heartbeat.explain(Config(), {**stopped, "age_s": np.nan}) == "silent: no message at all"
    assert "while it is silent" in heartbeat.explain_unknown(TEN, stopped)
    slow = {"alive": False, "age_s": 0.1, "rate_hz": 4.0, "heard": True, "often_enough": False}
    assert heartbeat.explain(TEN, slow) == "too slow: 4 messages per second, 10 expected"
    back = heartbeat.explain(TEN, {**slow, "often_enough": None})
    assert back.startswith("comes again after a silence")
    assert heartbeat.explain(TEN, {**slow, "alive": True, "often_enough": True}) == ""


def test_silence_and_half_the_rate_are_told_apart() -> None:
    def told(entry: Input, second: float) -> list[int]:
        found = heartbeat.evaluate(TEN, [entry], at_s(second))
        return [int(found[name]) for name in ("alive", "heard", "often_enough")]

    half = one_input(times_s=[*beats(10, stop_s=5), *beats(5, start_s=5, stop_s=10)])
    assert told(half, 4.9) == [TRUE, TRUE, TRUE]
    assert told(half, 7.5) == [FALSE, TRUE, FALSE]
    silent = one_input(times_s=[*beats(10, stop_s=5), *beats(10, start_s=9, stop_s=20)])
    assert told(silent, 7.5) == [FALSE, FALSE, UNKNOWN]
    assert told(silent, 9.5) == [FALSE, TRUE, UNKNOWN]
    assert told(silent, 11.2) == [TRUE, TRUE, TRUE]
    never = one_input()
    never.flow.began_ns = at_s(0)
    assert told(never, 3) == [FALSE, FALSE, UNKNOWN]


@pytest.mark.parametrize(
    ("config", "key"),
    [
        (replace(TEN, window=0), "window"),
        (replace(TEN, window=0.1), "window"),
        (replace(TEN, max_age=-1), "max_age"),
        (replace(TEN, tolerance=100), "tolerance"),
    ],
)
def test_what_cannot_be_measured_is_refused(config: Config, key: str) -> None:
    assert key in [finding[0] for finding in config.check()]


def test_the_measure_of_an_item_goes_by_its_own_rate() -> None:
    config = heartbeat.Config(rates={"ros_imu": 0.5})
    assert heartbeat.measure(config, "alive", ["`ros_imu`"]) == "age(`ros_imu`) - 6"
    assert heartbeat.measure(config, "alive", ["`ros_odom`"]) == "age(`ros_odom`) - 2"
