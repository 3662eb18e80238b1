"""Made-up samples for the contract of monitor modes: with all that a real record has in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.flow import NONE_OPEN
from amberbox.core.mode import Input
from amberbox.core.samples import Samples
from amberbox.core.types import IntArray
from amberbox.testing._mode_files import ModeFile

if TYPE_CHECKING:
    from hypothesis.strategies import DrawFn, SearchStrategy

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
class Series:
    """Samples of one variable; ``values`` are masked or hold None where unknown."""

    times_ns: IntArray
    values: np.ndarray[Any, Any]

    def __repr__(self) -> str:
        return f"{((self.times_ns - T0_NS) / NS).tolist()}: {self.values.tolist()}"


@dataclass(frozen=True)
class Given:
    """All there will ever be of one input, by the name of the place it goes to."""

    name: str
    series: Mapping[str, Series]

    def empty(self) -> Input:
        """Return the input before there is any sample."""
        made = Input(self.name)
        made.parts = {n[6:]: Samples() for n in self.series if n.startswith("parts ")}
        if "samples" not in self.series:
            made.samples = made.flow.rows
        return made

    def whole(self) -> Input:
        """Return the input with all samples."""
        made = self.empty()
        for name, series in self.series.items():
            place_of(made, name).extend(series.times_ns, series.values)
        return made


def place_of(entry: Input, name: str) -> Samples:
    """Return the samples of an input by the name of their place."""
    if name.startswith("parts "):
        return entry.parts[name[6:]]
    found: Samples = getattr(entry if hasattr(entry, name) else entry.flow, name)
    return found


@dataclass(frozen=True, eq=False)
class World:
    """Inputs of one call, the instants to look at them, and where their samples are cut."""

    inputs: Sequence[Given]
    instants: IntArray
    cuts: Sequence[int]

    def __repr__(self) -> str:
        at = ((self.instants - T0_NS) / NS).tolist()
        return f"World(at {at}, cuts {list(self.cuts)}, {list(self.inputs)})"


class Feeding:
    """An input whose samples come little by little, as the record does."""

    def __init__(self, given: Given, cuts: Sequence[int]) -> None:
        self.input = given.empty()
        self._given, self._cuts = given, cuts
        self._done = dict.fromkeys(given.series, 0)

    def feed_until(self, now_ns: int) -> None:
        """Take everything up to an instant, in batches."""
        for name, series in self._given.series.items():
            end = int(series.times_ns.searchsorted(now_ns, "right"))
            ends = [cut for cut in self._cuts if self._done[name] < cut < end]
            for stop in (*ends, end):
                part = slice(self._done[name], stop)
                place = place_of(self.input, name)
                place.extend(series.times_ns[part], series.values[part])
                self._done[name] = stop

    def forget_before(self, time_ns: int) -> None:
        """Forget what the history that the mode asked for does not reach."""
        for name in self._given.series:
            place_of(self.input, name).forget_before(time_ns)


def sampled_worlds(
    module: ModuleType, file: ModeFile, text: bool, parts: Mapping[str, str]
) -> SearchStrategy[World]:
    """Return a strategy that draws worlds fit for a mode."""
    from hypothesis import strategies as st

    texts = file.inputs[0][:1] if getattr(module, "PER_INPUT", False) else file.inputs[0]
    reads = getattr(module, "reads", None)
    names = [*texts, *(reads(file.config) if reads else ())]
    kinds = ("float", "int", "bool", *(["string"] if text else []))

    @st.composite
    def worlds(draw: DrawFn) -> World:
        accepted = [module.ACCEPTS if n < len(texts) else ("variable",) for n in range(len(names))]
        inputs = [
            Given(name, _series_of(draw, draw(st.sampled_from(some)), kinds, parts))
            for name, some in zip(names, accepted, strict=True)
        ]
        ticks = draw(st.lists(st.integers(0, 200), min_size=1, max_size=6, unique=True))
        instants = np.array(sorted(ticks), np.int64) * TICK_NS + T0_NS
        cuts = sorted(draw(st.sets(st.integers(1, 30), max_size=4)))
        return World(inputs, instants, cuts)

    return worlds()


def _series_of(
    draw: DrawFn, kind: str, kinds: Sequence[str], parts: Mapping[str, str]
) -> Mapping[str, Series]:
    """Draw what one input has: values, parts and stamps share the times of its rows."""
    from hypothesis import strategies as st

    times = _times(draw)
    value_kind = {"probe": "bool", "list": "float"}.get(kind) or draw(st.sampled_from(kinds))
    named = {**parts, **(_LIST_PARTS if kind == "list" else {})}
    series = {f"parts {name}": _series(draw, times, type_) for name, type_ in named.items()}
    if kind != "item":
        series["samples"] = _series(draw, times, value_kind)
    jitter = draw(st.lists(st.sampled_from([0, 1, 1000]), min_size=len(times), max_size=len(times)))
    series["stamps"] = Series(times, times - np.array(jitter, np.int64))
    series["rows"] = Series(times, np.arange(1, len(times) + 1))
    if draw(st.booleans()):
        heard = _times(draw)
        series["received"] = Series(heard, np.arange(len(heard)) * 3 + 1)
        series["last_ns"] = Series(heard, heard - _STEP_NS)
    if draw(st.booleans()):
        gaps = _times(draw)
        open_ = np.arange(len(gaps)) % 2 == 0
        series["gap_from_ns"] = Series(gaps, np.where(open_, gaps, NONE_OPEN))
    return series


def _times(draw: DrawFn) -> IntArray:
    """Draw times over ten seconds: steady, or as it comes."""
    from hypothesis import strategies as st

    if draw(st.booleans()):
        start, stop = sorted(draw(st.tuples(st.integers(0, 900), st.integers(0, 1000))))
        step = draw(st.sampled_from([10, 40, 100]))
        return np.arange(start, stop, step, dtype=np.int64) * _STEP_NS + T0_NS
    places = draw(st.lists(st.integers(0, 1000), max_size=12))
    return np.array(sorted(places), np.int64) * _STEP_NS + T0_NS


def _series(draw: DrawFn, times: IntArray, kind: str) -> Series:
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
        return Series(times, values)
    null = np.resize(null, len(times))
    if dtype is object:
        values[null] = None
        return Series(times, values)
    return Series(times, np.ma.MaskedArray(values, null))
