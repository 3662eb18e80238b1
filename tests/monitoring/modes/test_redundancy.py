"""Members against their siblings and against a formula: who is off, by how much, and who is not."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amberbox.core.clock import NS
from amberbox.core.expression import parse
from amberbox.core.mode import FALSE, TRUE, UNKNOWN, Input
from amberbox.core.samples import Samples
from amberbox.monitoring.modes import redundancy as mode
from amberbox.monitoring.modes.redundancy import Config
from amberbox.testing.modes import assert_mode_contract, at_s, one_input

WHEEL = parse("-0.073 * (input_1 + input_2) / 0.0893")
"""Speed of the pivot of a wheel with two motors: diameter and distance in metres."""


def together(*columns: Sequence[float | None]) -> list[Input]:
    """Make members with a sample per second."""
    return [one_input(f"x{k}", times_s=range(len(c)), values=c) for k, c in enumerate(columns)]


def members(config: Config, inputs: Sequence[Input], at: Any) -> list[Any]:
    found = mode.evaluate(config, inputs, at)
    return [np.asarray(v).tolist() for name, v in found.items() if name.startswith("member_")]


def test_contract() -> None:
    configs = [Config(threshold=1.0), Config(threshold=1.0, window=2.0, formula=WHEEL)]
    assert_mode_contract(mode, "redundancy", configs=configs, examples=40)


@pytest.mark.parametrize("count", [3, 4, 5, 6])
@pytest.mark.parametrize("odd", [0, 1, 2])
@pytest.mark.parametrize("value", [100.0, -1e300, nan, inf])
def test_the_odd_one_out_is_named_and_no_other(count: int, odd: int, value: float) -> None:
    values = [1000.0 + k for k in range(count)]
    values[odd] = value
    found = members(Config(threshold=10.0), together(*[[v] for v in values]), at_s(0))
    assert [bool(v) for v in found] == [k != odd for k in range(count)]


def test_two_of_five_may_be_off() -> None:
    found = members(Config(threshold=1.0), together([5.0], [9.0], [5.1], [1.0], [5.2]), at_s(0))
    assert found == [TRUE, FALSE, TRUE, FALSE, TRUE]


def test_of_two_nobody_can_say_which_one_it_is() -> None:
    inputs = together([1.0, 1.0], [1.5, 9.0])
    found = mode.evaluate(Config(threshold=1.0), inputs, at_s(0, 1))
    assert found["member_1"].tolist() == found["member_2"].tolist() == [TRUE, FALSE]
    assert found["residual"].tolist() == [0.5, 8.0]


def test_where_no_sibling_shows_a_number_it_is_not_known() -> None:
    found = mode.evaluate(Config(threshold=1.0), together([1.0], [nan]), at_s(0))
    assert int(found["member_1"]) == UNKNOWN
    assert int(found["member_2"]) == int(found["agree"]) == FALSE
    assert np.isnan(found["residual_2"])


def test_the_median_of_a_window_forgives_single_frames_of_garbage() -> None:
    good = [7.0] * 10
    bad = [7.0, 7.0, nan, 7.0, 7.0, 1e30, 7.0, 7.0, 90.0, 90.0]
    inputs = together(good, good, good, bad)
    found = mode.evaluate(Config(threshold=1.0, window=3.0), inputs, at_s(*range(10)))
    assert found["member_4"].tolist() == [UNKNOWN] * 3 + [TRUE] * 6 + [FALSE]
    assert found["member_1"].tolist() == [UNKNOWN] * 3 + [TRUE] * 7
    bare = mode.evaluate(Config(threshold=1.0), inputs, at_s(*range(10)))["member_4"]
    assert np.flatnonzero(bare == FALSE).tolist() == [2, 5, 8, 9]


def test_members_that_come_at_their_own_pace_are_compared_by_what_they_said_last() -> None:
    slow = one_input("slow", times_s=[0, 10], values=[1.0, 5.0])
    fast = one_input("fast", times_s=range(11), values=[1.0] * 11)
    found = mode.evaluate(Config(threshold=1.0), [slow, fast], at_s(9, 10))
    assert found["agree"].tolist() == [TRUE, FALSE]


def test_a_formula_says_what_a_member_should_be() -> None:
    v1, v2, pivot = together([1.0, 1.0, 1.0], [2.0, 2.0, 2.0], [-2.4524, -2.4524, 1.0])
    config = Config(threshold=1.0, formula=WHEEL)
    found = mode.evaluate(config, [v1, v2, pivot], at_s(0, 1, 2))
    assert found["agree"].tolist() == [TRUE, TRUE, FALSE]
    assert found["residual"][2] == pytest.approx(3.4524, abs=1e-4)
    assert set(found) == {"agree", "residual", "member_1", "residual_1"}


def test_a_formula_may_read_what_is_no_input() -> None:
    config = Config(threshold=0.1, formula=parse("ros_cmd_vel.linear_x"))
    assert mode.reads(config) == ("ros_cmd_vel.linear_x",)
    left, right, command = together([0.5], [0.9], [0.5])
    found = mode.evaluate(config, [left, right, command], at_s(0))
    assert (int(found["member_1"]), int(found["member_2"])) == (TRUE, FALSE)


def test_what_the_formula_reads_and_is_unknown_makes_it_unknown() -> None:
    inputs = together([1.0], [None], [2.0])
    found = mode.evaluate(Config(threshold=1.0, formula=WHEEL), inputs, at_s(0))
    assert int(found["agree"]) == UNKNOWN


def test_one_bool_output_is_about_all_members_and_several_about_one_each() -> None:
    config = Config(threshold=1.0)
    assert mode.results_of(config, 4, 1)[0].name == "agree"
    several = [r.name for r in mode.results_of(config, 4, 4) if r.type == "bool"]
    assert several[:4] == ["member_1", "member_2", "member_3", "member_4"]
    formula = Config(threshold=1.0, formula=WHEEL)
    assert [r.name for r in mode.results_of(formula, 3, 1)][:2] == ["agree", "residual"]
    assert "member_2" not in {r.name for r in mode.results_of(formula, 3, 1)}


def test_the_explanation_names_the_member() -> None:
    found = mode.evaluate(Config(threshold=1.0), together([7.0], [7.0], [9.5], [nan]), at_s(0))
    text = mode.explain(Config(threshold=1.0), {n: v.item() for n, v in found.items()})
    assert text == "member 3 is off by 2.5, member 4 shows no number (at most 1)"
    single = {"agree": False, "residual": 3.0, "member_1": False, "residual_1": 3.0}
    assert mode.explain(Config(threshold=0.5), single) == "it is off by 3 (at most 0.5)"
    nothing = {"member_1": False, "residual_1": None, "member_2": None, "residual_2": None}
    assert mode.explain(Config(threshold=0.5), nothing) == "member 1 shows no number"


@pytest.mark.parametrize("config", [Config(threshold=-1.0), Config(threshold=1.0, window=-1.0)])
def test_what_means_nothing_is_refused(config: Config) -> None:
    assert list(config.check())


def wheels(shared_data: Path, tmp_path: Path) -> dict[str, list[Input]]:
    """Read the four wheels of the real recording, a list of four inputs per variable."""
    import amberbox
    from amberbox.blackbox.formats._recording import ReadOptions
    from amberbox.blackbox.query.importing import import_recordings

    options = ReadOptions(messages=shared_data / "ropod/message_definitions")
    import_recordings(
        [shared_data / "ropod/bb_test_data"], tmp_path, options=options, segments=False
    )
    with amberbox.open(tmp_path) as record:
        table = record.query("ros_sw_ethercat_parser_data__sensors", None)
        times = np.asarray(table["timestamp"]).astype(np.int64).reshape(-1, 4)
        names = ("velocity_1", "velocity_2", "velocity_pivot", "pressure")
        columns = {n: np.asarray(table[n], np.float64).reshape(-1, 4) for n in names}
    return {n: [_made(f"{n}_{k}", times[:, k], c[:, k]) for k in range(4)]
            for n, c in columns.items()}  # fmt: skip


def _made(name: str, times_ns: Any, values: Any) -> Input:
    samples = Samples()
    samples.extend(times_ns, values)
    return Input(name, samples)


@pytest.mark.needs_data
def test_the_real_barometers_agree_until_one_drifts(shared_data: Path, tmp_path: Path) -> None:
    inputs = wheels(shared_data, tmp_path)["pressure"]
    instants = inputs[0].samples.times_ns
    config = Config(threshold=10.0, window=1.0)
    full = instants >= max(one.samples.times_ns[0] for one in inputs) + NS
    agree = mode.evaluate(config, inputs, instants)["agree"]
    assert np.all(agree[full] == TRUE) and np.all(agree[~full] == UNKNOWN)
    drift = inputs[2].samples.derived(inputs[2].samples.values + np.linspace(0, 50, len(instants)))
    drifting = [*inputs[:2], Input("drift", drift), inputs[3]]
    found = members(config, drifting, instants)
    assert [FALSE in verdicts for verdicts in found] == [False, False, True, False]


@pytest.mark.needs_data
def test_the_real_wheels_fit_their_kinematics_as_the_predecessor_found(
    shared_data: Path, tmp_path: Path
) -> None:
    columns = wheels(shared_data, tmp_path)
    config = Config(threshold=1.0, window=1.0, formula=WHEEL)
    share = []
    for k in range(4):
        inputs = [columns[name][k] for name in ("velocity_1", "velocity_2", "velocity_pivot")]
        agree = mode.evaluate(config, inputs, inputs[0].samples.times_ns)["agree"]
        share.append(float(np.mean(agree[agree != UNKNOWN] == TRUE)))
    assert share[0] == pytest.approx(0.65, abs=0.05)  # its check flags 35 % of this nominal wheel
    assert min(share[1:]) > 0.9


def test_generated_barometers_agree_until_one_drifts() -> None:
    rng = np.random.default_rng(3)
    columns = [1015 + 0.3 * k + rng.normal(0, 0.05, 200) for k in range(4)]
    columns[1][100:] += np.linspace(0, 40, 100)
    for column in columns:
        column[50] = 0.0  # a frame of zeros, as the bus gives where a slave is late
    inputs = [one_input(times_s=[k / 7 for k in range(200)], values=c) for c in columns]
    instants = inputs[0].samples.times_ns
    found = members(Config(threshold=10.0, window=1.0), inputs, instants)
    assert [FALSE in verdicts for verdicts in found] == [False, True, False, False]
    assert found[1].index(FALSE) > 100


@pytest.mark.parametrize(
    ("config", "is_timed"),
    [(Config(1.0), False), (Config(1.0, window=0.5), True),
     (Config(1.0, formula=parse("input_2 + 1")), False),
     (Config(1.0, formula=parse("age(input_2)")), True)],
)  # fmt: skip
def test_only_what_looks_back_changes_as_time_passes(config: Config, is_timed: bool) -> None:
    assert mode.timed(config) is is_timed
