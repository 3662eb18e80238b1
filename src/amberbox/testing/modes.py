"""What every monitor mode must do, as checks that a mode's own tests can run.

In the tests of a mode::

    from amberbox.testing.modes import assert_mode_contract, at_s, one_input
    from my_folder.modes import tilt

    def test_tilt_is_a_mode() -> None:
        assert_mode_contract(tilt, "tilt")

    def test_tilt_sees_a_robot_on_its_side() -> None:
        entry = one_input("imu.roll", times_s=[0, 1], values=[0.1, 1.5])
        results = tilt.evaluate(tilt.Config(), [entry], at_s(1))
        assert not results["upright"]

The contract is run on made-up samples with NaN, infinities, unknown values and silence, which
needs the package ``hypothesis``.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.mode import HOLD, UNKNOWN, Given, Input, Result
from amberbox.core.samples import Samples
from amberbox.testing._mode_files import ModeFile, mode_file, module_problems
from amberbox.testing._mode_worlds import Feeding, World, sampled_worlds

__all__ = ["assert_mode_contract", "at_s", "mode_file", "module_problems", "one_input"]

T0_NS = 1_700_000_000 * NS
"""When the samples of ``one_input`` begin: second 0."""


def at_s(*seconds: float) -> Any:
    """Return an instant, or an array of several, in the time of ``one_input``."""
    instants = [T0_NS + round(second * NS) for second in seconds]
    return instants[0] if len(instants) == 1 else np.array(instants, np.int64)


def one_input(
    name: str = "x",
    *,
    times_s: Sequence[float] = (),
    values: Sequence[Any] | np.ndarray[Any, Any] = (),
    parts: Mapping[str, Sequence[Any]] | None = None,
    stamps_s: Sequence[float] | None = None,
    received_s: Sequence[float] | None = None,
    labels: Mapping[int, str] | None = None,
) -> Input:
    """Make an input by hand: samples at times, None where unknown, messages at the same times.

    ``received_s`` are the times of its messages where these are others than ``times_s``. With
    ``stamps_s`` and no ``values`` it is a whole item.
    """
    made = Input(name, labels=dict(labels or {}))
    if len(values):
        made.samples.extend(_ns(times_s), _column(values))
    elif stamps_s is not None:
        made.samples = made.flow.rows
    stamps = np.asarray([T0_NS + round(s * NS) for s in stamps_s or ()], np.int64)
    made.stamps.extend(_ns(times_s)[: len(stamps)], stamps)
    made.parts = {part: Samples() for part in parts or {}}
    for part, column in (parts or {}).items():
        made.parts[part].extend(_ns(times_s), _column(column))
    heard = _ns(times_s if received_s is None else received_s)
    made.flow.received.extend(heard, np.arange(1, len(heard) + 1))
    made.flow.last_ns.extend(heard, heard)
    made.flow.rows.extend(heard, np.arange(1, len(heard) + 1))
    return made


def _ns(times_s: Sequence[float]) -> np.ndarray[Any, np.dtype[np.int64]]:
    return np.array([T0_NS + round(second * NS) for second in times_s], np.int64)


def _column(values: Sequence[Any] | np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Make a column as the record gives them: masked numbers, or objects with None."""
    if isinstance(values, np.ndarray):
        return values
    if any(isinstance(value, str) for value in values):
        return np.array([*values, None], object)[:-1]
    null = [value is None for value in values]
    plain = np.array([0 if value is None else value for value in values])
    return np.ma.MaskedArray(plain, null) if any(null) else plain


def assert_mode_contract(
    module: ModuleType,
    name: str,
    *,
    configs: Sequence[Any] = (),
    text: bool = False,
    parts: Mapping[str, str] | None = None,
    examples: int = 40,
) -> None:
    """Check a mode: what it defines, its sample, and its function on made-up samples.

    ``configs`` are further configurations to try beside the one of the sample. With ``text`` its
    inputs may also be texts. ``parts`` are the names and types (``bool int float string``) of
    what its probes measure or its items hold. Raises AssertionError.
    """
    problems = module_problems(module, name)
    assert not problems, "\n".join(problems)
    file = mode_file(module, name)
    returned: set[str] = set()
    for config in (file.config, *configs):
        _check_function(
            module, replace(file, config=config), (text, parts or {}), examples, returned
        )
    missing = {result.name for result in module.RESULTS} - returned
    assert not missing, f"{name}: evaluate never returned {', '.join(sorted(missing))}"


def _check_function(
    module: ModuleType,
    file: ModeFile,
    kinds: tuple[bool, Mapping[str, str]],
    examples: int,
    returned: set[str],
) -> None:
    from hypothesis import HealthCheck, given, settings

    @settings(
        max_examples=examples,
        deadline=None,
        database=None,
        report_multiple_bugs=False,
        suppress_health_check=list(HealthCheck),
    )
    @given(sampled_worlds(module, file, *kinds))
    def check(world: World) -> None:
        with np.errstate(all="ignore"):
            returned.update(_Check(module, file).run(world))

    check()


class _Check:
    """One configuration of a mode on one world of samples."""

    def __init__(self, module: ModuleType, file: ModeFile) -> None:
        self.module: Any = module
        self.config = file.config
        self.declared: dict[str, Result] = {r.name: r for r in file.results(module)}
        history = getattr(module, "history_s", None)
        self.history_ns = round((history(self.config) if history else 0.0) * NS)

    def run(self, world: World) -> Collection[str]:
        """Check everything; return the names of the results."""
        one_by_one = self._whole(world)
        self._check_columns(world, one_by_one)
        self._check_feeding(world, one_by_one)
        self._check_silence(world)
        self._check_explanations(one_by_one)
        self._check_reasons(world)
        return {name for results in one_by_one for name in results}

    def evaluate(self, inputs: Sequence[Input], now: Any) -> Mapping[str, Any]:
        found: Mapping[str, Any] = self.module.evaluate(self.config, inputs, now)
        undeclared = set(found) - set(self.declared)
        assert not undeclared, f"results that RESULTS does not have: {sorted(undeclared)}"
        return found

    def _whole(self, world: World) -> Sequence[Mapping[str, Any]]:
        """Evaluate at each instant with all samples there, twice, and look what it touched."""
        inputs = [given.whole() for given in world.inputs]
        before = [_content(entry) for entry in inputs]
        found = [self._plain(self.evaluate(inputs, int(now))) for now in world.instants]
        again = [self._plain(self.evaluate(inputs, int(now))) for now in world.instants]
        assert _bits(found) == _bits(again), "the same inputs gave other results the second time"
        assert before == [_content(entry) for entry in inputs], "evaluate changed its inputs"
        return found

    def _plain(self, results: Mapping[str, Any]) -> dict[str, Any]:
        return {name: self._value(name, value) for name, value in results.items()}

    def _value(self, name: str, value: Any) -> Any:
        """Return a result at one instant as plain Python; raise if it is of another type."""
        assert np.ndim(value) == 0, f"{name} has a shape at one instant: {value!r}"
        plain = value.item() if isinstance(value, np.ndarray | np.generic) else value
        kind = self.declared[name].type
        if kind == "bool":
            assert plain in (0, 1, UNKNOWN, HOLD), f"{name} is no bool: {plain!r}"
            return int(plain)
        fits = isinstance(plain, str) if kind == "string" else isinstance(plain, int | float)
        assert plain is None or fits, f"{name} is not of type {kind}: {plain!r}"
        return plain

    def _check_columns(self, world: World, expected: Sequence[Mapping[str, Any]]) -> None:
        if not getattr(self.module, "COLUMNS", False):
            return
        inputs = [given.whole() for given in world.inputs]
        found = self.evaluate(inputs, world.instants)
        rows = [self._plain(_row(found, row)) for row in range(len(world.instants))]
        assert _bits(rows) == _bits(expected), f"at once {rows}, one by one {expected}"

    def _check_feeding(self, world: World, expected: Sequence[Mapping[str, Any]]) -> None:
        """Evaluate as live does: samples come in parts, and old ones are forgotten."""
        inputs = [Feeding(given, world.cuts) for given in world.inputs]
        found = []
        for now in world.instants.tolist():
            for entry in inputs:
                entry.feed_until(now)
                entry.forget_before(now - self.history_ns)
            found.append(self._plain(self.evaluate([entry.input for entry in inputs], now)))
        assert _bits(found) == _bits(expected), f"in parts {found}, at once {expected}"

    def _check_silence(self, world: World) -> None:
        """Before any sample nothing may look well, whoever asks."""
        inputs = [given.empty() for given in world.inputs]
        found = self._plain(self.evaluate(inputs, int(world.instants[0])))
        for name, value in found.items():
            result = self.declared[name]
            well = result.type == "bool" and value in (HOLD, int(result.nominal))
            assert not well, f"{name} is {value} before there is any sample"

    def _check_explanations(self, found: Sequence[Mapping[str, Any]]) -> None:
        explanations = [getattr(self.module, n, None) for n in ("explain", "explain_unknown")]
        for explain in filter(None, explanations):
            for results in found:
                known = {name: self._known(name, value) for name, value in results.items()}
                assert isinstance(explain(self.config, known), str)

    def _check_reasons(self, world: World) -> None:
        """Reasons are texts at any instant: of several inputs one alone may be known."""
        reason = getattr(self.module, "reason", None)
        if reason is None:
            return
        inputs = [given.whole() for given in world.inputs]
        for now in world.instants.tolist():
            assert isinstance(reason(self.config, Given(inputs, now)), str)

    def _known(self, name: str, value: Any) -> Any:
        if self.declared[name].type == "bool":
            return None if value in (UNKNOWN, HOLD) else bool(value)
        return value


def _row(results: Mapping[str, Any], row: int) -> dict[str, Any]:
    return {name: v if np.ndim(v) == 0 else np.asarray(v)[row] for name, v in results.items()}


def _bits(found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Make results comparable bit for bit, all NaN alike."""
    return [{name: _exact(value) for name, value in results.items()} for results in found]


def _exact(value: Any) -> Any:
    if not isinstance(value, float):
        return type(value).__name__, value
    return "nan" if np.isnan(value) else struct.pack("<d", value)


def _content(entry: Input) -> list[Any]:
    return [_samples_content(samples) for samples in _all_samples(entry)]


def _all_samples(entry: Input) -> Iterator[Samples]:
    flow = entry.flow
    yield from (entry.samples, entry.stamps, flow.received, flow.last_ns, flow.rows)
    yield from entry.parts.values()


def _samples_content(samples: Samples) -> Any:
    null = None if samples.null is None else samples.null.tolist()
    return samples.times_ns.tolist(), [repr(value) for value in samples.values.tolist()], null
