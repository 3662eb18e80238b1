"""The contract of detectors, as checks that a detector's own tests can run.

In the tests of a detector::

    from amberbox.testing.detectors import assert_detector_contract, given_rows
    from my_package import spikes

    def test_spikes_is_a_detector() -> None:
        assert_detector_contract(spikes, "spikes")

    def test_spikes_sees_a_spike() -> None:
        detector = spikes.Detector(spikes.Config())
        detector.fit([given_rows("imu", times_s, {"roll": values})])

The contract is run on made-up missions of several items with NaN, infinities, late stamps, steps of
the clock, silence, and columns that come and go; this needs the package ``hypothesis``.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.contracts import Detector, LearntState, Row, Score, ScoreReason, Span
from amberbox.core.errors import AmberboxError
from amberbox.core.options import describe
from amberbox.testing.modes import kit_settings

if TYPE_CHECKING:
    from hypothesis.strategies import DrawFn

T0_NS = 1_700_000_000 * NS
TICK_NS = NS // 2
_WILD = (0.0, -0.0, 1.0, -3.0, 1e9, -1e300, 1.7e308, 5e-324, math.nan, math.inf, -math.inf)


@dataclass(frozen=True)
class GivenMission:
    """A mission whose rows are given, in the order of their arrival."""

    name: str
    rows: Sequence[Row]
    span: Span

    def __iter__(self) -> Iterator[Row]:
        return iter(self.rows)


def mission(rows: Iterable[Row], name: str = "mission") -> GivenMission:
    """Make a mission of rows of any items, sorted by arrival; it ends with the last of them."""
    ordered = sorted(rows, key=lambda row: row.at_ns)
    span = (ordered[0].at_ns, ordered[-1].at_ns + 1) if ordered else (T0_NS, T0_NS)
    return GivenMission(name, ordered, span)


def rows_of(
    item: str,
    times_s: Sequence[float] | np.ndarray[Any, Any],
    values: Mapping[str, Any] | None = None,
    *,
    lag_s: float | Sequence[float] | np.ndarray[Any, Any] = 0.0,
) -> list[Row]:
    """Make rows of an item, with columns of the length of ``times_s``.

    ``times_s`` are seconds of arrival after ``T0_NS``; ``lag_s`` is how long before its arrival
    each was stamped.
    """
    lags = np.broadcast_to(np.asarray(lag_s, float), len(times_s))
    columns = {name: np.asarray(column, float).tolist() for name, column in (values or {}).items()}
    return [
        Row(
            item,
            T0_NS + round(float(time_s) * NS),
            T0_NS + round((float(time_s) - float(lags[i])) * NS),
            {name: column[i] for name, column in columns.items()},
        )
        for i, time_s in enumerate(times_s)
    ]


def given_rows(
    item: str,
    times_s: Sequence[float] | np.ndarray[Any, Any],
    values: Mapping[str, Any] | None = None,
    name: str = "mission",
) -> GivenMission:
    """Make a mission of one item; see ``rows_of``."""
    return mission(rows_of(item, times_s, values), name)


def nominal_missions(count: int = 3, seconds: float = 20.0, seed: int = 1) -> list[GivenMission]:
    """Return missions of three items at 20, 7 and 1 Hz, with noise and jitter."""
    made = []
    for number in range(count):
        random = np.random.default_rng((seed, number))
        rows: list[Row] = []
        for item, rate_hz in (("imu", 20.0), ("wheel", 7.0), ("battery", 1.0)):
            times = np.arange(0.0, seconds, 1 / rate_hz)
            times = np.sort(times + random.normal(0.02, 0.05 / rate_hz, len(times)).clip(0))
            swing = np.sin(times)
            values = {
                "a": swing + random.normal(0, 0.1, len(times)),
                "b": 2 * swing + random.normal(0, 0.1, len(times)),
                "c": random.normal(5, 1, len(times)),
            }
            lags = random.uniform(0.001, 0.01, len(times))
            rows += rows_of(item, times, values, lag_s=lags)
        made.append(mission(rows, f"mission_{number}"))
    return made


def run_detector(
    detector: Detector, rows: Iterable[Row], end_ns: int | None = None
) -> list[tuple[Score, ...]]:
    """Feed a mission; return the scores after each row and tick, as the wing feeds a detector."""
    rows = list(rows)
    found: list[tuple[Score, ...]] = []
    start_ns = rows[0].at_ns if rows else T0_NS
    detector.begin(start_ns)
    next_ns = start_ns + TICK_NS
    for row in rows:
        while next_ns <= row.at_ns:
            found.append(tuple(detector.tick(next_ns)))
            next_ns += TICK_NS
        found.append(tuple(detector.observe(row)))
    while end_ns is not None and next_ns <= end_ns:
        found.append(tuple(detector.tick(next_ns)))
        next_ns += TICK_NS
    return found


def assert_detector_contract(
    module: ModuleType,
    name: str,
    *,
    missions: Sequence[GivenMission] = (),
    configs: Sequence[Any] = (),
    examples: int = 25,
) -> None:
    """Check a detector: its definitions, what it keeps, and its scores of hostile missions.

    It is fitted on ``missions``, by default ``nominal_missions()``; ``configs`` are further
    configurations to try beside the default. Raises AssertionError.
    """
    problems = module_problems(module, name)
    assert not problems, "\n".join(problems)
    for config in (module.Config(), *configs):
        _check(module, config, list(missions) or nominal_missions(), examples)


def module_problems(module: ModuleType, name: str) -> list[str]:
    """Return the problems of the names that the module of a detector defines."""
    missing = [n for n in ("Config", "Detector") if not hasattr(module, n)]
    if missing:
        return [f"{name}: the module does not define {n}" for n in missing]
    found = []
    if not (module.__doc__ or "").strip():
        found.append(f"{name}: the module has no docstring; its first line is shown to users")
    if not _is_frozen_dataclass(module.Config):
        return [*found, f"{name}: Config is not a frozen dataclass"]
    without = [row.key for row in describe(module.Config) if not row.doc]
    found += [f"{name}: the option '{key}' has no doc" for key in without]
    version = getattr(module.Detector, "version", None)
    if not isinstance(version, int) or version < 1:
        found.append(f"{name}: Detector.version must be a number from 1")
    return found


def _is_frozen_dataclass(cls: Any) -> bool:
    return dataclasses.is_dataclass(cls) and bool(vars(cls)["__dataclass_params__"].frozen)


def _check(
    module: ModuleType, config: Any, missions: Sequence[GivenMission], examples: int
) -> None:
    fitted = module.Detector(config)
    fitted.fit(missions)
    _check_poor_missions(module, config, missions)
    state = copied(fitted.learnt())
    _check_one(module, config, state, missions[0].rows, cut=len(missions[0].rows) // 2)
    _check_hostile(module, config, state, missions, examples)


def copied(state: LearntState) -> LearntState:
    """Return a state as a file gives it back: values through JSON, arrays as copies."""
    for name, array in state.arrays.items():
        assert array.dtype.kind in "fiub", f"the array '{name}' has no numbers but {array.dtype}"
    values = json.loads(json.dumps(dict(state.values), allow_nan=False))
    return LearntState(values, {name: np.array(array) for name, array in state.arrays.items()})


def _check_poor_missions(module: ModuleType, config: Any, missions: Sequence[GivenMission]) -> None:
    """Fit with nothing, with one row, with nonsense: an AmberboxError, or a detector that works."""
    one_row = mission(missions[0].rows[:1])
    without_values = mission([row._replace(values={}) for row in missions[0].rows[:200]])
    not_finite = mission(
        row._replace(values=dict.fromkeys(row.values, math.nan)) for row in missions[0].rows[:200]
    )
    empty = mission([])
    for poor in ([], [empty], [one_row], [empty, one_row], [without_values], [not_finite]):
        detector = module.Detector(config)
        try:
            detector.fit(poor)
        except AmberboxError:
            continue
        for given in (missions[0].rows[:50], one_row.rows, ()):
            _assert_scores(detector, run_detector(detector, given, T0_NS + 5 * NS))
    rich = module.Detector(config)
    rich.fit([*missions, empty, one_row, not_finite])


def _check_hostile(
    module: ModuleType,
    config: Any,
    state: LearntState,
    missions: Sequence[GivenMission],
    examples: int,
) -> None:
    from hypothesis import given
    from hypothesis import strategies as st

    pool = missions[-1].rows[:400]

    @st.composite
    def streams(draw: DrawFn) -> tuple[list[Row], int]:
        rows = _hostile(draw, pool)
        return rows, draw(st.integers(0, len(rows)))

    @kit_settings(examples)
    @given(streams())
    def check(stream: tuple[list[Row], int]) -> None:
        rows, cut = stream
        _check_one(module, config, state, rows, cut)

    check()


def _hostile(draw: DrawFn, pool: Sequence[Row]) -> list[Row]:
    """Draw a part of a mission with damage: values, stamps, gaps, columns, items."""
    from hypothesis import strategies as st

    first = draw(st.integers(0, max(len(pool) - 2, 0)))
    rows = list(pool[first : first + draw(st.integers(0, 120))])
    shift_ns = 0
    made = []
    damaged = draw(st.dictionaries(st.integers(0, 119), st.integers(0, 7), max_size=12))
    for place, row in enumerate(rows):
        kind = damaged.get(place)
        row = row._replace(at_ns=row.at_ns + shift_ns, stamp_ns=row.stamp_ns + shift_ns)
        match kind:
            case 0:
                wild = draw(st.sampled_from(_WILD))
                row = row._replace(values=dict.fromkeys(row.values, wild))
            case 1:
                row = row._replace(values={})
            case 2:
                row = row._replace(values={**row.values, "new": 1.0, "": math.nan})
            case 3:
                step_s = draw(st.sampled_from((-1e9, -5.0, 0.5, 1e9)))
                row = row._replace(stamp_ns=row.stamp_ns + round(step_s * NS))
            case 4:
                row = row._replace(item="never_seen")
            case 5:
                shift_ns += draw(st.sampled_from((NS // 10, 2 * NS, 30 * NS)))
            case 6:
                row = row._replace(texts={"state": "ä" * 50}, stamp_ns=0)
            case 7:
                continue
        made.append(row)
    return made


def _check_one(
    module: ModuleType, config: Any, state: LearntState, rows: Sequence[Row], cut: int
) -> None:
    """Check that scores are finite, causal, forget other missions, and survive a checkpoint."""
    whole = _restored(module, config, state)
    end_ns = (rows[-1].at_ns if rows else T0_NS) + 3 * NS
    expected = run_detector(whole, rows, end_ns)
    _assert_scores(whole, expected)
    after = copied(whole.learnt())
    assert after.values == copied(state).values, "observing rows changed what was learnt"
    again = run_detector(whole, rows, end_ns)
    assert bits(again) == bits(expected), "begin() does not forget the mission before"
    head = run_detector(_restored(module, config, state), rows[:cut])
    assert bits(head) == bits(expected[: len(head)]), "later rows change earlier scores"
    first = _restored(module, config, state)
    run_detector(first, rows[:cut])
    snapshot = json.loads(json.dumps(first.snapshot(), allow_nan=False))
    second = _restored(module, config, state)
    second.begin(T0_NS)
    second.resume(snapshot)
    assert bits([second.observe(r) for r in rows[cut:]]) == bits(
        [first.observe(r) for r in rows[cut:]]
    ), "a checkpoint changes the scores after it"
    assert bits([second.tick(end_ns)]) == bits([first.tick(end_ns)]), "a checkpoint changes ticks"


def _restored(module: ModuleType, config: Any, state: LearntState) -> Detector:
    detector: Detector = module.Detector(config)
    detector.restore(copied(state))
    return detector


def _assert_scores(detector: Detector, found: Sequence[Sequence[Score]]) -> None:
    for score in (score for scores in found for score in scores):
        assert isinstance(score.at_ns, int), f"{score}: at_ns is no int"
        assert isinstance(score.value, float), f"{score}: the value is no float"
        assert math.isfinite(score.value) and score.value >= 0, f"{score}: the value"
    for series in {score.series for scores in found for score in scores}:
        reason = detector.explain(series)
        assert isinstance(reason, ScoreReason) and reason.finding and reason.item, reason
    assert all(isinstance(n, int) and n >= 0 for n in detector.counts.values()), detector.counts


def bits(found: Iterable[Sequence[Score]]) -> list[list[tuple[int, str, str]]]:
    """Make scores comparable bit for bit."""
    return [[(s.at_ns, s.series, float(s.value).hex()) for s in scores] for scores in found]
