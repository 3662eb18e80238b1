"""Channels: the variables that a detector reads, as one vector with learnt scales.

A channel is ``item.variable``. The channels of an item are neighbours in the vector, so that a
message changes one slice of it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from amberbox.core.contracts import MissionRows, Row
from amberbox.core.errors import AmberboxError, did_you_mean

Floats = NDArray[np.float64]
T = TypeVar("T")
CLIP = 50.0
LARGEST = 1e100
"""Values beyond it count as not finite."""
MOST_CHANNELS = 200
"""More are left out: the work per message grows with the channels."""
_MOST = LARGEST**2
_MOST_VALUES = 40_000
_SPREAD = 3.29  # standard deviations between the 5 % and the 95 % quantile of a normal variable
_LEAST_FINE = 0.02


@dataclass(frozen=True, slots=True)
class _ItemChannels:
    variables: tuple[str, ...]
    known: frozenset[str]
    where: slice


class Channels:
    """Names, centres and scales of channels; makes the scaled values of a message.

    ``names`` are sorted. ``fine`` is the least difference that matters, in scaled values: half a
    step of whole numbers.
    """

    def __init__(
        self, names: Sequence[tuple[str, str]], center: Floats, spread: Floats, fine: Floats
    ) -> None:
        self.names = tuple(names)
        self.center, self.spread, self.fine = center, spread, fine
        self.items: dict[str, _ItemChannels] = {}
        for start, (item, _) in enumerate(self.names):
            if item not in self.items:
                own = tuple(variable for name, variable in self.names if name == item)
                where = slice(start, start + len(own))
                self.items[item] = _ItemChannels(own, frozenset(own), where)

    def __len__(self) -> int:
        return len(self.names)

    def position(self, address: str) -> int:
        """Return where ``item.variable`` is in the vector; raises ValueError if it is not."""
        for place, (item, variable) in enumerate(self.names):
            if f"{item}.{variable}" == address:
                return place
        raise ValueError(f"'{address}' was not learnt")

    def scaled(self, row: Row, counts: dict[str, int]) -> tuple[slice, Floats] | None:
        """Return the slice of a message's item, and its values in learnt standard deviations.

        Values are clipped to +-50; those that are absent or not finite are NaN, and counted.
        """
        item = self.items.get(row.item)
        if item is None:
            add_count(counts, "messages of items that were not learnt")
            return None
        given = row.values
        raw = np.array([given.get(name, np.nan) for name in item.variables])
        with np.errstate(all="ignore"):
            values = (raw - self.center[item.where]) / self.spread[item.where]
        values = np.minimum(np.maximum(values, -CLIP), CLIP)
        finite = np.abs(raw) <= LARGEST
        if not finite.all():
            values[~finite] = np.nan
            present = sum(name in given for name in item.variables)
            add_count(counts, "values that are not finite", present - int(finite.sum()))
            add_count(counts, "variables that are missing", len(raw) - present)
        if len(given) > len(raw) and not item.known.issuperset(given):
            add_count(counts, "variables that were not learnt", len(given.keys() - item.known))
        return item.where, values

    def learnt(self) -> tuple[list[list[str]], dict[str, Floats]]:
        """Return the names for JSON, and the arrays; for ``restored``."""
        arrays = {"center": self.center, "spread": self.spread, "fine": self.fine}
        return [list(name) for name in self.names], arrays

    @classmethod
    def restored(cls, names: Any, arrays: Mapping[str, NDArray[Any]]) -> Channels:
        """Make the channels that ``learnt`` returned; raises ValueError if they do not fit."""
        pairs = [(str(item), str(variable)) for item, variable in names]
        found = [as_floats(arrays[name], (len(pairs),)) for name in ("center", "spread", "fine")]
        if pairs != sorted(pairs) or not (found[1] > 0).all():
            raise ValueError("channels that are not sorted, or a spread that is not above 0")
        return cls(pairs, *found)

    @classmethod
    def none(cls) -> Channels:
        """Return no channels."""
        return cls((), np.zeros(0), np.ones(0), np.zeros(0))


def add_count(counts: dict[str, int], text: str, number: int = 1) -> None:
    """Count what could not be used, ``number`` times."""
    if number:
        counts[text] = counts.get(text, 0) + number


def as_floats(array: NDArray[Any], shape: tuple[int, ...]) -> Floats:
    """Return a learnt array; raises ValueError if it has another shape or is not finite."""
    found = np.ascontiguousarray(array, float)
    if found.shape != shape or not (np.abs(found) <= _MOST).all():
        raise ValueError(
            f"an array has the shape {found.shape} instead of {shape}, or is not finite"
        )
    return found


def as_number(value: Any, least: float = -_MOST) -> float:
    """Return a learnt number; raises ValueError if it is too small or too large."""
    number = float(value)
    if not least <= number <= _MOST:
        raise ValueError(f"{number} is out of range")
    return number


def learn_channels(
    missions: Iterable[MissionRows],
    counts: dict[str, int],
    wanted: Sequence[str] = (),
    required: Sequence[str] = (),
) -> Channels:
    """Return the channels of nominal missions: those ``wanted``, all if nothing is.

    A channel is wanted as ``item.variable``, in which ``*`` stands for any characters.

    Those that are ``required`` are always among them. Centre and scale of each are the median and
    the range from 5 to 95 % in standard deviations; a constant has the scale 1, and whole numbers
    at least 0.5. Raises AmberboxError where there is none, or one that is asked for is not there.
    """
    asked: dict[tuple[str, str], Sample[float] | None] = {}
    is_wanted = _matcher((*wanted, *required) if wanted else ("*",))
    for row in (row for mission in missions for row in mission):
        for variable, value in row.values.items():
            name = row.item, variable
            if name not in asked:
                asked[name] = Sample() if is_wanted(f"{row.item}.{variable}") else None
            sample = asked[name]
            if sample is not None and abs(value) <= LARGEST:
                sample.add(value)
    samples = {name: sample for name, sample in asked.items() if sample and sample.seen}
    _require(samples, wanted, required, asked)
    names = sorted(samples, key=lambda name: (".".join(name) not in required, -samples[name].seen))
    add_count(counts, f"variables beyond {MOST_CHANNELS}", max(len(names) - MOST_CHANNELS, 0))
    names = sorted(names[:MOST_CHANNELS])
    values = [np.array(samples[name].values) for name in names]
    scales = np.array([center_and_spread(sample) for sample in values])
    steps = np.array([0.5 if (sample == np.rint(sample)).all() else 0.0 for sample in values])
    center, spread = scales[:, 0].copy(), np.maximum(scales[:, 1], steps)
    return Channels(names, center, spread, np.maximum(steps / spread, _LEAST_FINE))


def _require(
    found: Iterable[tuple[str, str]],
    wanted: Sequence[str],
    required: Sequence[str],
    others: Iterable[tuple[str, str]],
) -> None:
    """Raise AmberboxError where there is no channel, or one that is wanted is not there."""
    known = {f"{item}.{variable}" for item, variable in found}
    for address in (*required, *wanted):
        if address not in known and (
            address in required or not any(map(_matcher([address]), known))
        ):
            near = did_you_mean(address, {".".join(name) for name in others})
            raise AmberboxError(
                f"the nominal missions have no numbers of '{address}'{near}",
                "write variables as ITEM.VARIABLE, as 'amberbox query' lists them",
            )
    if not known:
        raise AmberboxError(
            "the nominal missions have no numbers to learn from", "give missions with messages"
        )


def center_and_spread(values: Floats) -> tuple[float, float]:
    """Return the median, and the range from 5 to 95 % in standard deviations, never 0."""
    low, center, high = np.quantile(values, (0.05, 0.5, 0.95))
    with np.errstate(all="ignore"):
        spread = (high - low) / _SPREAD
        if not 0 < spread < np.inf:
            spread = values.std()
        if not 0 < spread < np.inf:
            spread = 1.0
    return float(center), float(spread)


def _matcher(wanted: Sequence[str]) -> Callable[[str], bool]:
    """Return whether an address is one of those wanted; ``*`` stands for any characters."""
    pattern = "|".join(".*".join(map(re.escape, text.split("*"))) for text in wanted)
    matches = re.compile(pattern, re.DOTALL).fullmatch
    return lambda address: matches(address) is not None


class Sample(Generic[T]):
    """Some of many values, evenly over all of them."""

    def __init__(self, most: int = _MOST_VALUES) -> None:
        self.values: list[T] = []
        self.seen = 0
        self._most, self._every = most, 1

    def add(self, value: T) -> None:
        """Add a value; it is kept, or it is not."""
        if self.seen % self._every == 0:
            self.values.append(value)
            if len(self.values) >= self._most:
                self.values = self.values[::2]
                self._every *= 2
        self.seen += 1
