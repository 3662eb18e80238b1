"""What should move and does not is seen, also between garbage, and standing still is no fault."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amberbox.core.clock import NS
from amberbox.core.config import build
from amberbox.core.errors import Problem
from amberbox.core.expression import parse
from amberbox.core.mode import FALSE, HOLD, TRUE, UNKNOWN, Input
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.monitoring.modes import frozen
from amberbox.monitoring.modes.frozen import Config
from amberbox.testing.modes import assert_mode_contract, at_s, one_input

TWO_S = Config(window=2, min=-100, max=100)
DRIVEN = Config(window=2, should_move=parse("cmd.v != 0"))
GATED = Config(window=2, valid=parse("cmd.v != 0 or input_1 > 1"))
STEADY = [n / 10 for n in range(100)]


def test_contract() -> None:
    assert_mode_contract(frozen, "frozen", configs=[Config(), TWO_S, DRIVEN, GATED])


def moving(config: Config, inputs: Sequence[Input], *seconds: float) -> list[int]:
    found = frozen.evaluate(config, inputs, at_s(*seconds))["moving"]
    return [int(value) for value in np.atleast_1d(found)]


def stops_at_5(values: Sequence[float]) -> list[float]:
    return [
        value if second < 5 else values[50] for second, value in zip(STEADY, values, strict=True)
    ]


def test_a_value_that_stops() -> None:
    wheel = one_input(times_s=STEADY, values=stops_at_5(STEADY))
    assert moving(TWO_S, [wheel], 1, 4, 6.5, 7.5, 9) == [TRUE, TRUE, TRUE, FALSE, FALSE]


@pytest.mark.parametrize("garbage", [nan, inf, -1e30, None])
def test_garbage_between_frozen_values_is_no_movement(garbage: float | None) -> None:
    values: list[float | None] = list(stops_at_5(STEADY))
    values[52::7] = [garbage] * len(values[52::7])
    wheel = one_input(times_s=STEADY, values=values)
    assert moving(TWO_S, [wheel], 4, 7.5, 9) == [TRUE, FALSE, FALSE]


def test_only_garbage_says_nothing_for_or_against() -> None:
    wheel = one_input(times_s=STEADY, values=[nan, inf] * 50)
    assert moving(TWO_S, [wheel], 1, 5) == [UNKNOWN, UNKNOWN]


def test_a_gap_of_rows_is_no_standing_still() -> None:
    times = [second for second in STEADY if not 3 < second < 6]
    wheel = one_input(times_s=times, values=times)
    assert moving(TWO_S, [wheel], 2.9, 4, 5.2, 5.9, 6, 6.1) == [1, 1, UNKNOWN, UNKNOWN, 1, 1]
    still = one_input(times_s=times, values=[7.0] * len(times))
    assert moving(TWO_S, [still], 2.9, 5.2, 5.9, 6.1, 7.5, 7.9, 8.0) == [0, 2, 2, 2, 2, 2, 0]
    found = frozen.evaluate(TWO_S, [still], at_s(5.9))
    told = {"moving": None, "gap_s": float(found["gap_s"])}
    assert frozen.explain_unknown(TWO_S, told) == (
        "not judged: no valid row for 2.9 s of the last 2 s"
    )


def test_garbage_within_the_limits_is_no_movement_where_it_is_known_to_be_none() -> None:
    values = stops_at_5(STEADY)
    values[52::7] = [3.0] * len(values[52::7])
    counter = [12.0] * 100
    counter[52::7] = [9.0] * len(counter[52::7])
    wheel = one_input(times_s=STEADY, values=values)
    bus = one_input("bus.counter", times_s=STEADY, values=counter)
    gated = Config(window=2, valid=parse("bus.counter == 12"))
    assert frozen.reads(gated) == ("bus.counter",)
    assert moving(TWO_S, [wheel], 4, 7.5, 9) == [TRUE, TRUE, TRUE]
    assert moving(gated, [wheel, bus], 4, 7.5, 9) == [TRUE, FALSE, FALSE]
    assert [moving(gated, [wheel, bus], at) for at in (4, 7.5, 9)] == [[TRUE], [FALSE], [FALSE]]


def test_nothing_is_said_before_a_whole_window_was_seen() -> None:
    assert moving(TWO_S, [one_input(times_s=STEADY, values=[1.0] * 100)], 1, 3) == [UNKNOWN, FALSE]


def test_standing_still_on_purpose_is_no_fault_and_heals_none() -> None:
    wheel = one_input(times_s=STEADY, values=stops_at_5(STEADY))
    stopped = one_input("cmd.v", times_s=[0, 5], values=[1.0, 0.0])
    driven = one_input("cmd.v", times_s=[0, 5, 6], values=[1.0, 0.0, 0.5])
    assert moving(DRIVEN, [wheel, stopped], 4, 8) == [TRUE, HOLD]
    assert moving(DRIVEN, [wheel, driven], 7.5, 8.5) == [HOLD, FALSE]
    assert moving(DRIVEN, [wheel, driven], 8.5) == [FALSE]


def test_a_change_filter_leaves_values_out_and_the_one_before_counts() -> None:
    filtered = one_input(times_s=[0, 9.9], values=[5.0, 6.0])
    assert moving(TWO_S, [filtered], 5, 9.95, 11, 12) == [UNKNOWN, TRUE, TRUE, UNKNOWN]
    seconds = np.array([at_s(second) for second in range(13)])
    filtered.flow.received.clear()
    filtered.flow.last_ns.clear()
    filtered.flow.received.extend(seconds, 10 * np.arange(1, 14))
    filtered.flow.last_ns.extend(seconds, seconds - NS // 10)
    assert moving(TWO_S, [filtered], 5, 9.95, 11, 12) == [FALSE, TRUE, TRUE, FALSE]


def test_noise_within_the_tolerance_is_no_movement() -> None:
    noise = one_input(times_s=STEADY, values=[1.0, 1.001] * 50)
    assert moving(Config(window=2, tolerance=0.01), [noise], 5) == [FALSE]
    assert moving(Config(window=2), [noise], 5) == [TRUE]


def test_stamps_that_stop_while_messages_come() -> None:
    stamps = [min(second, 5.0) for second in STEADY]
    item = one_input("scan", times_s=STEADY, stamps_s=stamps)
    assert moving(TWO_S, [item], 4, 6.5, 7.5) == [TRUE, TRUE, FALSE]


def test_explanation() -> None:
    assert frozen.explain(TWO_S, {"moving": False}) == "has not moved for 2 s"
    assert frozen.explain(TWO_S, {"moving": None}) == ""


@pytest.mark.needs_data
def test_real_wheels_move_and_one_cut_off_does_not(shared_data: Path, tmp_path: Path) -> None:
    times, wheels = real_voltages(shared_data, tmp_path)
    half = len(times) // 2
    for values in wheels:
        healthy, dead = Input("wheel"), Input("wheel")
        healthy.samples.extend(times, values)
        assert FALSE not in frozen.evaluate(TWO_S, [healthy], times)["moving"]
        cut_off = np.where(np.arange(len(times)) < half, values, values[half])
        cut_off[half + 3 :: 9] = 1e30
        dead.samples.extend(times, cut_off)
        moving = frozen.evaluate(TWO_S, [dead], times)["moving"]
        late_s = (times[np.flatnonzero(moving == FALSE)[0]] - times[half]) / NS
        assert late_s == pytest.approx(2, abs=0.5)
        assert np.all(moving[times > times[half] + 2.5 * NS] == FALSE)


def real_voltages(shared_data: Path, store: Path) -> tuple[Any, list[Any]]:
    """Return bus voltages of the four wheels of a real robot, and their times."""
    import amberbox
    from amberbox.blackbox.formats._recording import ReadOptions
    from amberbox.blackbox.query.importing import import_recordings

    options = ReadOptions(messages=shared_data / "ropod/message_definitions")
    import_recordings([shared_data / "ropod/bb_test_data"], store, options=options, segments=False)
    with amberbox.open(store) as record:
        table = record.query("ros_sw_ethercat_parser_data__sensors", ["voltage_bus"])
        times = np.asarray(table["timestamp"]).astype(np.int64).reshape(-1, 4)[:, 0]
        return times, list(np.asarray(table["voltage_bus"], np.float64).reshape(-1, 4).T)


def test_words_of_the_mode_file() -> None:
    problems: list[Problem] = []
    node = parse_yaml("{for: 500 ms, while: max(cmd.v over 3s) > 1}", "f", problems)
    assert node is not None
    config = build(Config, node, problems)
    assert config is not None
    assert not problems
    assert frozen.reads(config) == ("cmd.v",)
    assert frozen.history_s(config) == 3.5


@pytest.mark.parametrize(
    "config",
    [
        *(Config(window=0), Config(tolerance=-1), Config(min=2, max=2)),
        Config(should_move=parse("cmd.v + 1")),
    ],
)
def test_what_cannot_be_judged_is_refused(config: Config) -> None:
    assert list(config.check())


def test_text_is_no_evidence() -> None:
    wheel = one_input(times_s=STEADY, values=[1.0, "off"] * 50)
    assert moving(TWO_S, [wheel], 1, 5) == [UNKNOWN, FALSE]
