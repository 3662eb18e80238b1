"""Residuals against computations by hand: order of steps, windows, gaps, and what is concluded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.clock import NS
from amberbox.core.equations.generator import (
    NoResidualError,
    ResidualGenerator,
    derived,
    generator_of,
)
from amberbox.core.equations.model_file import EquationModel, ResidualOptions, load_model
from amberbox.core.equations.residual import (
    IDLE,
    UNKNOWN,
    VIOLATED,
    WITHIN,
    Conclusion,
    concluded,
    integrals,
    slopes,
)
from amberbox.core.errors import ConfigurationError
from amberbox.core.expression import parse
from amberbox.core.samples import Samples

MODEL = """\
kind: equations
unknowns: [v, a, x]
known: {encoder: wheel.rate, odometer: odom.speed, accelerometer: imu.ax, place: gps.x}
equations:
  wheel: {solve: {v: 0.1 * encoder}, component: wheel, faults: [slips]}
  motion: {state: v, derivative: a, window_s: 0.4}
  way: {state: x, derivative: v, over_s: 4, initial: place}
  odometer: {residual: odometer - v, component: odometry, faults: [scale]}
  accelerometer: {residual: accelerometer - a, component: imu}
  place: {residual: place - x, component: gps}
residuals:
  speed: {equations: [wheel, odometer], threshold: 0.05, over_s: 2, persistence_s: 0.5, least: 10}
  scale: {equations: [wheel, odometer], per: v, beside: [a], when: abs(v) > 0.2, threshold: 0.1}
  late: {equations: [wheel, odometer], per: -a, beside: [v], when: abs(a) > 0.1, threshold: 0.1}
  push: {equations: [wheel, motion, accelerometer], threshold: 0.1, least: 10}
  place: {equations: [wheel, way, place], threshold: 0.2, least: 10}
"""


def model(tmp_path: Path, text: str = MODEL) -> EquationModel:
    path = tmp_path / "model.yaml"
    path.write_text(text)
    return load_model(path)


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> EquationModel:
    return model(tmp_path_factory.mktemp("model"))


def samples(times_s: Any, values: Any) -> Samples:
    found = Samples()
    found.extend(np.round(np.asarray(times_s) * NS).astype(np.int64), np.ma.asarray(values))
    return found


FAST_S, SLOW_S = np.arange(0, 60, 0.02), np.arange(0.003, 60, 0.05)


def speed(times_s: Any) -> Any:
    return np.sin(0.5 * times_s)


def drive(scale: float = 1.0, late_s: float = 0.0) -> dict[str, Samples]:
    """Return a drive of a minute; odometry is wrong by a scale, and late."""
    return {
        "wheel.rate": samples(FAST_S, 10 * speed(FAST_S)),
        "odom.speed": samples(FAST_S + 0.001, scale * speed(FAST_S - late_s)),
        "imu.ax": samples(SLOW_S, 0.5 * np.cos(0.5 * SLOW_S)),
        "gps.x": samples(SLOW_S, -2 * np.cos(0.5 * SLOW_S)),
    }


def at(*times_s: float) -> Any:
    return np.round(np.array(times_s) * NS).astype(np.int64)


def conclude(
    generator: ResidualGenerator, of: Mapping[str, Samples], *times_s: float
) -> Conclusion:
    return concluded(generator, of, at(*times_s))


def test_a_mean_is_that_of_a_computation_by_hand(base: EquationModel) -> None:
    generator = generator_of(base, "speed")
    assert (generator.lead_ns, generator.back_ns, generator.checks) == (0, 0, "odometer")
    assert generator.faults == ("slips", "scale") and generator.components == ("wheel", "odometry")
    found = conclude(generator, drive(1.3), 20.0)
    times_s = FAST_S + 0.001  # of odometry: both come as rarely, and it is read first
    rows = (times_s > 18) & (times_s <= 20.0)
    held = np.searchsorted(FAST_S, times_s[rows], "right") - 1
    by_hand = np.mean(1.3 * speed(FAST_S[rows]) - speed(FAST_S[held]))
    assert found.sizes[0] == pytest.approx(by_hand, abs=1e-12)


@pytest.mark.parametrize(("scale", "late_s"), [(1.0, 0.0), (1.3, 0.0), (0.8, 0.0), (1.0, 0.4)])
def test_a_scale_and_a_delay_are_told_from_each_other(
    base: EquationModel, scale: float, late_s: float
) -> None:
    instants = [20.0, 25.0, 30.0, 35.0]
    for name, wanted in (("scale", scale - 1), ("late", late_s)):
        found = conclude(generator_of(base, name), drive(scale, late_s), *instants)
        assert found.sizes == pytest.approx([wanted] * 4, abs=0.05), name
        expected = VIOLATED if abs(wanted) > 0.1 else WITHIN
        assert found.states.tolist() == [expected] * 4, name


def test_derivatives_are_late_by_half_their_window(base: EquationModel) -> None:
    generator = generator_of(base, "push")
    assert generator.lead_ns == 0.2 * NS and generator.checks == "accelerometer"
    found = conclude(generator, drive(), 20.0, 40.0)
    assert found.sizes == pytest.approx([0, 0], abs=2e-3)
    assert found.states.tolist() == [WITHIN, WITHIN]
    shifted = drive() | {"imu.ax": samples(SLOW_S, 0.5 * np.cos(0.5 * (SLOW_S + 0.2)))}
    assert abs(conclude(generator, shifted, 20.0).sizes[0]) > 0.01  # it would not do to ignore it


def test_an_integral_begins_where_it_is_measured(base: EquationModel) -> None:
    generator = generator_of(base, "place")
    assert generator.back_ns == 4 * NS
    found = conclude(generator, drive(), 20.0, 40.0)
    assert found.sizes == pytest.approx([0, 0], abs=5e-3)
    slipping = drive() | {"wheel.rate": samples(FAST_S, 20 * speed(FAST_S))}
    assert conclude(generator, slipping, 20.0).states.tolist() == [VIOLATED]


def test_parabolas_are_differentiated_exactly_also_where_samples_are_uneven() -> None:
    chance = np.random.default_rng(1)
    times_ns = np.cumsum(chance.integers(5_000_000, 40_000_000, 400))
    times_s = times_ns / NS
    found = slopes(times_ns, 3 * times_s**2 - times_s + 2, NS // 2, NS // 4)
    inside = slice(40, -40)
    assert found[inside] == pytest.approx(6 * times_s[inside] - 1, rel=1e-9)
    assert np.isnan(found[[0, -1]]).all()


def test_a_derivative_is_unknown_around_a_gap_and_where_a_value_is() -> None:
    every_ns = np.arange(0, 10 * NS, NS // 50, dtype=np.int64)
    times_ns = np.delete(every_ns, slice(250, 300))
    values = times_ns / NS
    values[100] = np.nan
    found = slopes(times_ns, values, NS // 2, NS // 10)
    known = ~np.isnan(found)
    assert found[known] == pytest.approx(1.0)
    wrong = np.abs(times_ns - times_ns[100]) <= NS // 4
    edge = (times_ns > 4.85 * NS) & (times_ns < 6.1 * NS)
    assert not known[wrong].any() and not known[edge].any()
    assert known[(times_ns > 2.4 * NS) & (times_ns < 4.6 * NS)].all()


def test_an_integral_with_a_leak_is_that_of_its_equation() -> None:
    times_ns = np.arange(0, 20 * NS, NS // 200)
    times_s = times_ns / NS
    ones, zero = np.ones(len(times_ns)), np.zeros(len(times_ns))
    found = integrals(times_ns, ones, zero, 5 * NS, 0.7, NS // 10)
    assert np.isnan(found[times_s < 5]).all()
    by_hand = (1 - np.exp(-0.7 * 5)) / 0.7  # of x' = 1 - 0.7 x from 0, after five seconds
    assert found[times_s >= 5] == pytest.approx(by_hand, rel=1e-5)
    plain = integrals(times_ns, np.cos(times_s), np.sin(times_s), 5 * NS, 0.0, NS // 10)
    assert plain[-1] == pytest.approx(np.sin(times_s[-1]), abs=1e-4)
    pulled = integrals(times_ns, zero, ones * 4, 5 * NS, 3.0, NS // 10)
    assert pulled[-1] == pytest.approx(4.0, rel=1e-4)


def test_a_gap_begins_anew_and_old_samples_are_unknown(base: EquationModel) -> None:
    generator = generator_of(base, "speed")
    drive_ = drive()
    for address in ("wheel.rate", "odom.speed"):
        kept = np.r_[0:1000, 1100:3000]  # nothing from 20 s to 22 s
        whole = drive_[address]
        gap = drive_ | {address: samples(whole.times_ns[kept] / NS, whole.values[kept])}
        found = conclude(generator, gap, 19.9, 20.4, 21.0, 23.0, 24.5, 25.0)
        assert found.states.tolist() == [WITHIN, WITHIN, UNKNOWN, UNKNOWN, WITHIN, WITHIN], address
    late = drive_ | {"odom.speed": samples([0.0, 1.0], [0.0, 0.5])}
    assert conclude(generator, late, 20.0).states.tolist() == [UNKNOWN]
    assert conclude(generator, drive_, 1.0, 1.9).states.tolist() == [UNKNOWN, UNKNOWN]


@pytest.mark.parametrize("wrong", [np.nan, np.inf, np.ma.masked])
def test_what_is_no_number_is_unknown(base: EquationModel, wrong: Any) -> None:
    values = np.ma.MaskedArray(speed(FAST_S))
    values[1000] = wrong
    of = drive() | {"odom.speed": samples(FAST_S, values)}
    found = conclude(generator_of(base, "speed"), of, 19.9, 20.5, 21.9, 22.6)
    assert found.states.tolist() == [WITHIN, UNKNOWN, UNKNOWN, WITHIN]


def test_nothing_is_concluded_where_it_is_not_excited(base: EquationModel) -> None:
    still = drive(1.3) | {"wheel.rate": samples(FAST_S, 0 * FAST_S)}
    found = conclude(generator_of(base, "scale"), still, 20.0)
    assert found.states.tolist() == [IDLE] and np.isnan(found.sizes[0])


def test_a_violation_lasts_for_the_persistence(base: EquationModel) -> None:
    values = speed(FAST_S) + np.where(FAST_S > 20, 1.0, 0.0)
    of = drive() | {"odom.speed": samples(FAST_S, values)}
    found = conclude(generator_of(base, "speed"), of, 20.0, 20.25, 20.5, 20.75, 30.0)
    assert found.states.tolist() == [WITHIN, IDLE, IDLE, VIOLATED, VIOLATED]


def test_terms_that_are_alike_give_no_size(base: EquationModel) -> None:
    speed_ = parse("v")
    options = ResidualOptions(["wheel", "odometer"], per=speed_, beside=[speed_, speed_])
    found = conclude(derived(base, "alike", options), drive(), 20.0)
    assert found.states.tolist() == [IDLE]


TIMES_S = st.lists(st.floats(0, 40), min_size=1, max_size=12).map(lambda some: sorted({*some}))


@settings(max_examples=30)
@given(TIMES_S, st.integers(0, 10**6), st.sampled_from(["scale", "late", "push", "place"]))
def test_pieces_of_a_record_give_the_same_bits(
    base: EquationModel, times_s: Sequence[float], seed: int, name: str
) -> None:
    chance = np.random.default_rng(seed)
    of = {}
    for address, whole in drive(1.1, 0.1).items():
        kept = np.sort(chance.choice(len(whole), int(0.9 * len(whole)), replace=False))
        kept = kept[(kept < 700) | (kept > 740)]
        values = whole.values[kept] + 0.01 * chance.standard_normal(len(kept))
        of[address] = (whole.times_ns[kept], np.where(chance.random(len(kept)) < 0.001, np.nan,
                                                      values))  # fmt: skip
    generator = generator_of(base, name)
    together = concluded(generator, {a: samples(t / NS, v) for a, (t, v) in of.items()},
                         at(*times_s))  # fmt: skip
    for place, now in enumerate(at(*times_s)):
        known = {}
        for address, (times_ns, values) in of.items():  # as a watcher has them at that instant
            first = max(times_ns.searchsorted(now - generator.history_ns, "right") - 1, 0)
            rows = slice(first, int(times_ns.searchsorted(now, "right")))
            known[address] = samples(times_ns[rows] / NS, values[rows])
        alone = concluded(generator, known, np.array([now]))
        assert alone.sizes.tobytes() == together.sizes[place : place + 1].tobytes()
        assert alone.states[0] == together.states[place]


def test_the_slowest_input_or_the_clock_sets_the_times(base: EquationModel) -> None:
    slow = drive() | {"odom.speed": samples(SLOW_S, speed(SLOW_S))}
    options = base.residuals["speed"]
    by_rate = derived(base, "speed", ResidualOptions(options.equations, least=60, over_s=2))
    assert conclude(by_rate, slow, 20.0).states.tolist() == [IDLE]  # 40 samples in 2 s
    timed = ResidualOptions(options.equations, least=60, over_s=2, clock="encoder")
    assert conclude(derived(base, "speed", timed), slow, 20.0).states.tolist() == [WITHIN]


def refusal(model_: EquationModel, **options: Any) -> str:
    with pytest.raises(NoResidualError) as error:
        derived(model_, "r", ResidualOptions(**options))
    return str(error.value)


def test_a_loop_is_named_and_not_solved(tmp_path: Path) -> None:
    text = """\
kind: equations
unknowns: [x, y, z]
known: {m: a.m, n: a.n}
equations:
  one: {variables: [x, y, m], solve: {x: y + m}}
  two: {variables: [x, y, n], solve: {y: x * n}}
  three: {variables: [y, z], solve: {z: y}}
  check: {variables: [z, m], residual: z - m}
"""
    found = refusal(model(tmp_path, text), equations=["one", "two", "three", "check"],
                    checks="check")  # fmt: skip
    assert found == "an algebraic loop is not solved: one, two"
    solvable = text.replace("two: {variables: [x, y, n], solve: {y: x * n}}",
                            "two: {variables: [y, n], solve: {y: n}}")  # fmt: skip
    options = ResidualOptions(["three", "check", "two"])
    generator = derived(model(tmp_path, solvable), "r", options)
    assert [step.name for step in generator.steps] == ["y", "z"] and generator.checks == "check"


def test_why_a_set_has_no_residual(base: EquationModel, tmp_path: Path) -> None:
    assert "a residual has one more" in refusal(base, equations=["wheel"])
    assert "is none of its" in refusal(base, equations=["wheel", "odometer"], checks="place")
    with pytest.raises(NoResidualError, match="did you mean 'scale'"):
        generator_of(base, "scal")
    bare = model(tmp_path, MODEL.replace("window_s: 0.4", "window_s: 0"))
    assert "nothing computes 'a': give solve: {a: ...} to motion" in refusal(
        bare, equations=["wheel", "motion", "accelerometer"], checks="accelerometer")  # fmt: skip
    unrecorded = model(tmp_path, """\
kind: equations
unknowns: [v]
known: [odometer]
equations:
  odometer: {residual: odometer - v}
  still: {variables: [v], solve: {v: 0}}
""")  # fmt: skip
    assert "what is recorded of 'odometer' is not stated" in refusal(
        unrecorded, equations=["still", "odometer"], checks="odometer")  # fmt: skip


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        (("0.1 * encoder", "0.1 * encodr"), "no variable 'encodr'; did you mean 'encoder'"),
        (("0.1 * encoder", "0.1 * v"), "'v' is computed from itself"),
        (("0.1 * encoder", "mean(encoder over 2s)"), "looks back in time"),
        (("window_s: 0.4", "window_s: 4000"), "must lie from 0 to 600 s"),
        (("initial: place", "leak: 1"), "integration needs over_s and initial"),
        (("initial: place", "initial: v"), "'v' is none of its variables"),
        (("equations: [wheel, way, place]", "equations: [wheel, wey, place]"), "no equation 'wey'"),
        (("when: abs(v) > 0.2", "when: abs(vv) > 0.2"), "no variable 'vv'"),
        (("threshold: 0.05", "threshold: -1"), "must be 0 or more"),
        (("residual: odometer - v", "residual: odometer - v, window_s: 2"), "belongs to an equ"),
        (("per: -a, beside: [v],", "beside: [v],"), "needs per"),
        (("encoder: wheel.rate", "encoder: mean(wheel.rate over 2s)"), "looks back in time"),
    ],
)
def test_mistakes_in_a_file_are_named(tmp_path: Path, change: tuple[str, str], wanted: str) -> None:
    assert change[0] in MODEL
    with pytest.raises(ConfigurationError) as error:
        model(tmp_path, MODEL.replace(*change))
    assert wanted in str(error.value) and "model.yaml:" in str(error.value)
