"""The contract of monitor modes, as checks that a mode's own tests can run.

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

import dataclasses
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.config import build
from amberbox.core.contracts import ModeContract
from amberbox.core.errors import Problem
from amberbox.core.flow import NONE_OPEN
from amberbox.core.mode import HOLD, UNKNOWN, Given, Input, Kind, Result, ResultType
from amberbox.core.options import describe
from amberbox.core.samples import Samples
from amberbox.core.types import IntArray
from amberbox.core.yaml_nodes import parse_yaml

if TYPE_CHECKING:
    from hypothesis import settings
    from hypothesis.strategies import DrawFn, SearchStrategy


_FILE_KEYS = frozenset(
    {"name", "monitor", "description", "mappings", "arguments", "states", "stale_after"}
)
_OUTPUT_KEYS = frozenset(
    {"name", "type", "expected", "result", "severity", "for", "heal", "flapping"}
    | {"description", "hint"}
)
_FLAGS = ("COLUMNS", "PER_INPUT", "TIMED", "SEES_SILENCE", "PARTS")


@dataclass(frozen=True)
class SampleModeFile:
    """A mode file like the sample; for each mapping its inputs and its results."""

    config: Any
    inputs: Sequence[Sequence[str]]
    bools: Sequence[int]
    """How many bool outputs each mapping has."""

    def results(self, module: ModuleType) -> list[Result]:
        """Return all results that its mappings have with this configuration."""
        results_of = ModeContract.of(module).results_of
        if results_of is None:
            return list(module.RESULTS)
        mappings = zip(self.inputs, self.bools, strict=True)
        found = (results_of(self.config, len(texts), bools) for texts, bools in mappings)
        return [*module.RESULTS, *(result for results in found for result in results)]


def module_problems(module: ModuleType, name: str) -> list[str]:
    """Return the problems of the names that a mode defines, of their documentation and of its
    sample.
    """
    wanted = ("Config", "ACCEPTS", "RESULTS", "SAMPLE", "evaluate")
    missing = [n for n in wanted if not hasattr(module, n)]
    if missing:
        return [f"{name}: the module does not define {n}" for n in missing]
    found = [*_declared_problems(module), *_result_problems(module.RESULTS)]
    found += _config_problems(module.Config)
    if found:
        return [f"{name}: {what}" for what in found]
    try:
        mode_file(module, name)
    except AssertionError as error:
        return [str(error)]
    return []


def _declared_problems(module: Any) -> Iterator[str]:
    if not (module.__doc__ or "").strip():
        yield "the module has no docstring; its first line is shown to users"
    if not callable(module.evaluate):
        yield "evaluate is no function"
    accepts, kinds = module.ACCEPTS, get_args(Kind)
    if not isinstance(accepts, tuple) or not accepts or set(accepts) - set(kinds):
        yield f"ACCEPTS must be a tuple of {', '.join(kinds)}"
    elif "probe" in accepts and not (hasattr(module, "PROBE") or hasattr(module, "probe_of")):
        yield "it accepts probes and says neither PROBE nor probe_of"
    for flag in _FLAGS:
        if not isinstance(getattr(module, flag, False), bool):
            yield f"{flag} must be True or False"


def _result_problems(results: Any) -> Iterator[str]:
    if not isinstance(results, tuple) or not all(isinstance(r, Result) for r in results):
        yield "RESULTS must be a tuple of Result"
        return
    names = [result.name for result in results]
    if len(set(names)) < len(names):
        yield "RESULTS has a name twice"
    for result in results:
        if result.type not in get_args(ResultType):
            yield f"the result '{result.name}' has the unknown type '{result.type}'"
        if not result.doc:
            yield f"the result '{result.name}' has no doc"


def _config_problems(config: Any) -> Iterator[str]:
    is_frozen = dataclasses.is_dataclass(config) and vars(config)["__dataclass_params__"].frozen
    if not is_frozen or not isinstance(config, type):
        yield "Config is not a frozen dataclass"
        return
    yield from (f"the argument '{row.key}' has no doc" for row in describe(config) if not row.doc)


def mode_file(module: ModuleType, name: str, text: str = "") -> SampleModeFile:
    """Read a mode file for a mode, by default its ``SAMPLE``; raise AssertionError."""
    problems: list[Problem] = []
    root = parse_yaml(text or module.SAMPLE, f"{name}.SAMPLE", problems)
    entries = (root.mapping if root is not None else None) or {}
    assert not problems, "\n".join(map(str, problems))
    _assert_keys(entries, _FILE_KEYS, f"{name}.SAMPLE")
    monitor = entries["monitor"].text if "monitor" in entries else ""
    assert monitor == name, f"{name}.SAMPLE: must have the line 'monitor: {name}'"
    assert "name" in entries, f"{name}.SAMPLE: the key 'name' is missing"
    arguments = entries.get("arguments") or parse_yaml("{}", name, problems)
    assert arguments is not None
    config = build(module.Config, arguments, problems, "arguments")
    assert config is not None, "\n".join(map(str, problems))
    mappings = [_plain_mapping(node.plain()) for node in entries["mappings"].items or ()]
    assert mappings, f"{name}.SAMPLE: there are no mappings"
    inputs = [mapping["inputs"] for mapping in mappings]
    bools = [sum(o.get("type") == "bool" for o in mapping["outputs"]) for mapping in mappings]
    file = SampleModeFile(config, inputs, bools)
    results = file.results(module)
    for output in (output for mapping in mappings for output in mapping["outputs"]):
        _assert_bound(output, results, f"{name}.SAMPLE: output '{output.get('name')}'")
    return file


def _assert_keys(found: Mapping[str, Any], known: frozenset[str], where: str) -> None:
    assert set(found) <= known, f"{where}: unknown keys {sorted(set(found) - known)}"


def _plain_mapping(entry: Any) -> dict[str, Any]:
    inner = entry.get("mapping", entry)
    _assert_keys(inner, frozenset({"inputs", "outputs"}), "mapping")
    outputs = [output.get("output", output) for output in inner["outputs"]]
    for output in outputs:
        _assert_keys(output, _OUTPUT_KEYS, "output")
    return {"inputs": inner["inputs"], "outputs": outputs}


def _assert_bound(output: Mapping[str, Any], declared: Sequence[Result], where: str) -> None:
    assert output.get("name"), f"{where} has no name"
    kind = {"double": "float"}.get(output["type"], output["type"])
    wanted = output.get("result", output["name"])
    named = [result for result in declared if result.name == wanted]
    assert named or "result" not in output, f"{where}: there is no result '{wanted}'"
    fitting = {"int": ("int", "float")}.get(kind, (kind,))
    found = [result for result in named or declared if result.type in fitting]
    assert found, f"{where}: no result of the type {kind}"


T0_NS = 1_700_000_000 * NS
TICK_NS = NS // 20
_STEP_NS = TICK_NS // 5
_LIST_PARTS = dict.fromkeys(("count", "finite", "min", "max", "mean"), "float")
_NUMBERS = (0.0, -0.0, 1.0, 2.0, 2.5, -3.0, 50.0, 1e6, 1e300, np.nan, np.inf, -np.inf)
_WHOLE = (0, 1, 2, 3, 4, 7, 50, 100, 200, 255)
_TEXTS = ("", "ok", "error 3", "ERROR", "nan", "ä", "[")
_DTYPES: Mapping[str, Sequence[type]] = {
    "float": (np.float64, np.float32),
    "int": (np.int64, np.uint8),
    "bool": (np.bool_,),
    "string": (object,),
}


@dataclass(frozen=True, eq=False)
class SampleSeries:
    """Samples of one variable; ``values`` are masked or hold None where unknown."""

    times_ns: IntArray
    values: np.ndarray[Any, Any]

    def __repr__(self) -> str:
        return f"{((self.times_ns - T0_NS) / NS).tolist()}: {self.values.tolist()}"


@dataclass(frozen=True)
class InputSeries:
    """All samples of one input, by the name of their place."""

    name: str
    series: Mapping[str, SampleSeries]

    def empty(self) -> Input:
        """Return the input before any sample."""
        made = Input(self.name)
        made.parts = {n[6:]: Samples() for n in self.series if n.startswith("parts ")}
        if "samples" not in self.series:
            made.samples = made.flow.rows
        return made

    def whole(self) -> Input:
        """Return the input with all samples."""
        made = self.empty()
        for name, series in self.series.items():
            samples_at(made, name).extend(series.times_ns, series.values)
        return made


def samples_at(entry: Input, name: str) -> Samples:
    """Return the samples of an input by the name of their place."""
    if name.startswith("parts "):
        return entry.parts[name[6:]]
    found: Samples = getattr(entry if hasattr(entry, name) else entry.flow, name)
    return found


@dataclass(frozen=True, eq=False)
class SampledWorld:
    """Inputs of one call, the instants to evaluate them, and where their samples are cut."""

    inputs: Sequence[InputSeries]
    instants: IntArray
    cuts: Sequence[int]

    def __repr__(self) -> str:
        at = ((self.instants - T0_NS) / NS).tolist()
        return f"World(at {at}, cuts {list(self.cuts)}, {list(self.inputs)})"


class GrowingInput:
    """An input to which samples are added little by little, as in a live record."""

    def __init__(self, given: InputSeries, cuts: Sequence[int]) -> None:
        self.input = given.empty()
        self._given, self._cuts = given, cuts
        self._done = dict.fromkeys(given.series, 0)

    def feed_until(self, now_ns: int) -> None:
        """Add all samples up to an instant, in batches."""
        for name, series in self._given.series.items():
            end = int(series.times_ns.searchsorted(now_ns, "right"))
            ends = [cut for cut in self._cuts if self._done[name] < cut < end]
            for stop in (*ends, end):
                part = slice(self._done[name], stop)
                place = samples_at(self.input, name)
                place.extend(series.times_ns[part], series.values[part])
                self._done[name] = stop

    def forget_before(self, time_ns: int) -> None:
        """Drop the samples before the history that the mode needs."""
        for name in self._given.series:
            samples_at(self.input, name).forget_before(time_ns)


def sampled_worlds(
    module: ModuleType, file: SampleModeFile, text: bool, parts: Mapping[str, str]
) -> SearchStrategy[SampledWorld]:
    """Return a strategy that draws worlds fit for a mode."""
    from hypothesis import strategies as st

    texts = file.inputs[0][:1] if ModeContract.of(module).per_input else file.inputs[0]
    names = [*texts, *ModeContract.of(module).reads_of(file.config)]
    kinds = ("float", "int", "bool", *(["string"] if text else []))

    @st.composite
    def worlds(draw: DrawFn) -> SampledWorld:
        accepted = [module.ACCEPTS if n < len(texts) else ("variable",) for n in range(len(names))]
        inputs = [
            InputSeries(name, _series_of(draw, draw(st.sampled_from(some)), kinds, parts))
            for name, some in zip(names, accepted, strict=True)
        ]
        ticks = draw(st.lists(st.integers(0, 200), min_size=1, max_size=6, unique=True))
        instants = np.array(sorted(ticks), np.int64) * TICK_NS + T0_NS
        cuts = sorted(draw(st.sets(st.integers(1, 30), max_size=4)))
        return SampledWorld(inputs, instants, cuts)

    return worlds()


def _series_of(
    draw: DrawFn, kind: str, kinds: Sequence[str], parts: Mapping[str, str]
) -> Mapping[str, SampleSeries]:
    """Draw the samples of one input: values, parts and stamps share the times of its rows."""
    from hypothesis import strategies as st

    times = _times(draw)
    value_kind = {"probe": "bool", "list": "float"}.get(kind) or draw(st.sampled_from(kinds))
    named = {**parts, **(_LIST_PARTS if kind == "list" else {})}
    series = {f"parts {name}": _series(draw, times, type_) for name, type_ in named.items()}
    if kind != "item":
        series["samples"] = _series(draw, times, value_kind)
    jitter = draw(st.lists(st.sampled_from([0, 1, 1000]), min_size=len(times), max_size=len(times)))
    series["stamps"] = SampleSeries(times, times - np.array(jitter, np.int64))
    series["rows"] = SampleSeries(times, np.arange(1, len(times) + 1))
    if draw(st.booleans()):
        received = _times(draw)
        series["received"] = SampleSeries(received, np.arange(len(received)) * 3 + 1)
        series["last_ns"] = SampleSeries(received, received - _STEP_NS)
    if draw(st.booleans()):
        gaps = _times(draw)
        open_ = np.arange(len(gaps)) % 2 == 0
        series["gap_from_ns"] = SampleSeries(gaps, np.where(open_, gaps, NONE_OPEN))
    return series


def _times(draw: DrawFn) -> IntArray:
    """Draw times over ten seconds: periodic, or irregular."""
    from hypothesis import strategies as st

    if draw(st.booleans()):
        start, stop = sorted(draw(st.tuples(st.integers(0, 900), st.integers(0, 1000))))
        step = draw(st.sampled_from([10, 40, 100]))
        return np.arange(start, stop, step, dtype=np.int64) * _STEP_NS + T0_NS
    places = draw(st.lists(st.integers(0, 1000), max_size=12))
    return np.array(sorted(places), np.int64) * _STEP_NS + T0_NS


def _series(draw: DrawFn, times: IntArray, kind: str) -> SampleSeries:
    from hypothesis import strategies as st

    dtype = draw(st.sampled_from(_DTYPES[kind]))
    pool: Sequence[Any] = {"float": _NUMBERS, "string": _TEXTS, "bool": (False, True)}.get(
        kind, _WHOLE
    )
    few = draw(st.lists(st.sampled_from(pool), min_size=1, max_size=8))
    with np.errstate(over="ignore"):
        pattern = np.array([*few, None], object)[:-1]
        values: np.ndarray[Any, Any] = np.resize(pattern, len(times)).astype(dtype)
    null = np.array([draw(st.booleans()) for _ in range(min(len(times), 6))], bool)
    if not len(null) or draw(st.booleans()):
        return SampleSeries(times, values)
    null = np.resize(null, len(times))
    if dtype is object:
        values[null] = None
        return SampleSeries(times, values)
    return SampleSeries(times, np.ma.MaskedArray(values, null))


def kit_settings(examples: int) -> settings:
    """Return how kits run: so many examples, as slow as may be, and none is kept."""
    from hypothesis import HealthCheck, settings

    return settings(
        max_examples=examples,
        deadline=None,
        database=None,
        report_multiple_bugs=False,
        suppress_health_check=list(HealthCheck),
    )


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
    received = _ns(times_s if received_s is None else received_s)
    made.flow.received.extend(received, np.arange(1, len(received) + 1))
    made.flow.last_ns.extend(received, received)
    made.flow.rows.extend(received, np.arange(1, len(received) + 1))
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
    """Check a mode: its definitions, its sample, and its function on generated samples.

    ``configs`` are further configurations to try beside the one of the sample. With ``text`` its
    inputs may also be texts. ``parts`` are the names and types (``bool int float string``) of the
    measurements of its probes, or of the columns of its items. Raises AssertionError.
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
    file: SampleModeFile,
    kinds: tuple[bool, Mapping[str, str]],
    examples: int,
    returned: set[str],
) -> None:
    from hypothesis import given

    @kit_settings(examples)
    @given(sampled_worlds(module, file, *kinds))
    def check(world: SampledWorld) -> None:
        with np.errstate(all="ignore"):
            returned.update(_Check(module, file).run(world))

    check()


class _Check:
    """One configuration of a mode on one world of samples."""

    def __init__(self, module: ModuleType, file: SampleModeFile) -> None:
        self.mode = ModeContract.of(module)
        self.config = file.config
        self.declared: dict[str, Result] = {r.name: r for r in file.results(module)}
        self.history_ns = round(self.mode.looks_back_s(self.config) * NS)

    def run(self, world: SampledWorld) -> Collection[str]:
        """Check everything; return the names of the results."""
        one_by_one = self._whole(world)
        self._check_columns(world, one_by_one)
        self._check_feeding(world, one_by_one)
        self._check_silence(world)
        self._check_explanations(one_by_one)
        self._check_reasons(world)
        return {name for results in one_by_one for name in results}

    def evaluate(self, inputs: Sequence[Input], now: Any) -> Mapping[str, Any]:
        found: Mapping[str, Any] = self.mode.evaluate(self.config, inputs, now)
        undeclared = set(found) - set(self.declared)
        assert not undeclared, f"results that RESULTS does not have: {sorted(undeclared)}"
        return found

    def _whole(self, world: SampledWorld) -> Sequence[Mapping[str, Any]]:
        """Evaluate twice at each instant with all samples; check that the inputs are unchanged."""
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

    def _check_columns(self, world: SampledWorld, expected: Sequence[Mapping[str, Any]]) -> None:
        if not self.mode.columns:
            return
        inputs = [given.whole() for given in world.inputs]
        found = self.evaluate(inputs, world.instants)
        rows = [self._plain(_row(found, row)) for row in range(len(world.instants))]
        assert _bits(rows) == _bits(expected), f"at once {rows}, one by one {expected}"

    def _check_feeding(self, world: SampledWorld, expected: Sequence[Mapping[str, Any]]) -> None:
        """Evaluate as in live operation: samples are added in parts, and old ones are dropped."""
        inputs = [GrowingInput(given, world.cuts) for given in world.inputs]
        found = []
        for now in world.instants.tolist():
            for entry in inputs:
                entry.feed_until(now)
                entry.forget_before(now - self.history_ns)
            found.append(self._plain(self.evaluate([entry.input for entry in inputs], now)))
        assert _bits(found) == _bits(expected), f"in parts {found}, at once {expected}"

    def _check_silence(self, world: SampledWorld) -> None:
        """Check that no result is nominal before any sample."""
        inputs = [given.empty() for given in world.inputs]
        found = self._plain(self.evaluate(inputs, int(world.instants[0])))
        for name, value in found.items():
            result = self.declared[name]
            well = result.type == "bool" and value in (HOLD, int(result.nominal))
            assert not well, f"{name} is {value} before there is any sample"

    def _check_explanations(self, found: Sequence[Mapping[str, Any]]) -> None:
        explanations = (self.mode.explain, self.mode.explain_unknown)
        for explain in filter(None, explanations):
            for results in found:
                known = {name: self._known(name, value) for name, value in results.items()}
                assert isinstance(explain(self.config, known), str)

    def _check_reasons(self, world: SampledWorld) -> None:
        """Check that reasons are texts at any instant: of several inputs only one may be known."""
        reason = self.mode.reason
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
