"""Redundant groups: which member of a group of like components differs from the others.

Members, such as the wheels of a robot, are compared with the median of their group, in one or more
quantities, while the group moves; at rest all look alike. What is normal for each is learnt: sign
and ratio of its values, and how far from the median they are. The idea is that of SFDD as modified
by Mitrevski and Ploeger (DX 2019): members that disagree are a conflict, at least one is faulty.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.core.config import Finding
from amberbox.core.contracts import LearntState, MissionRows, Row, Score, ScoreReason
from amberbox.core.errors import AmberboxError
from amberbox.core.options import option
from amberbox.detection.channels import (
    CLIP,
    LARGEST,
    Floats,
    Sample,
    add_count,
    as_floats,
    as_number,
    center_and_spread,
    learn_channels,
)
from amberbox.detection.learnt_options import (
    only_value_errors,
    options_from_json,
    options_to_json,
)

_MOST_SAMPLES = 20_000
_MOVES = 0.1  # of the largest nominal motion
_LEAST_SPREAD = 0.02  # of the largest nominal values of a quantity
_CORRELATED = 0.5
_USUAL = 3.0  # times the 95 % quantile: larger values do not count for the ratio


@dataclass(frozen=True, slots=True)
class GroupOptions:
    """Like components, and the quantities that are compared."""

    members: Mapping[str, Sequence[str]] = option(
        doc="the variables of each member, ITEM.VARIABLE, the same quantities in the same order"
    )
    moves: float | None = option(
        None, "the group moves where the median of the first quantity is larger; learnt by default"
    )

    def check(self) -> Iterator[Finding]:
        """Refuse members that cannot be compared."""
        if len(self.members) < 2:
            yield "members", "a group needs at least two members"
        if len({len(variables) for variables in self.members.values()}) > 1:
            yield "members", "all members need the same quantities in the same order"
        if not all(self.members.values()):
            yield "members", "a member has no variable"
        if self.moves is not None and not self.moves >= 0:
            yield "moves", "must not be negative"


@dataclass(frozen=True, slots=True)
class RedundantOptions:
    """The groups."""

    groups: Mapping[str, GroupOptions] = option({}, "groups by name")
    smoothing: float = option(0.1, "weight of the newest message in the score; 1 for no smoothing")

    def check(self) -> Iterator[Finding]:
        """Refuse to have no group, and values outside their ranges."""
        if not self.groups:
            yield "groups", "declare at least one group"
        if not 0 < self.smoothing <= 1:
            yield "smoothing", "must lie above 0, and be 1 at most"


Config = RedundantOptions
SAMPLE = """\
groups:
  wheels:
    members:
      front_left: [wheel_1.velocity, wheel_1.current]
      front_right: [wheel_2.velocity, wheel_2.current]
      rear: [wheel_3.velocity, wheel_3.current]
"""


class Detector:
    """Scores each group by how much its odd member differs."""

    version = 1

    def __init__(self, config: RedundantOptions) -> None:
        self.config = config
        self.counts: dict[str, int] = {}
        self._groups: dict[str, _Group] = {}

    def fit(self, missions: Sequence[MissionRows]) -> None:
        """Learn sign, ratio and deviation of each member."""
        groups: dict[str, _Group] = {}
        for name, options in self.config.groups.items():
            wanted = [variable for own in options.members.values() for variable in own]
            channels = learn_channels(missions, {}, wanted, wanted)
            places = [
                [channels.names[channels.position(variable)] for variable in own]
                for own in options.members.values()
            ]
            groups[name] = _Group(tuple(options.members), places)
            groups[name].learn(missions, options.moves, name)
        self._groups = groups

    def begin(self, at_ns: int) -> None:
        """Forget the messages before a mission."""
        for group in self._groups.values():
            group.begin()

    def observe(self, row: Row) -> Sequence[Score]:
        """Compare the members of the groups that a message is about."""
        scores = []
        for name, group in self._groups.items():
            if group.hold(row, self.counts) and group.compare(self.config.smoothing):
                scores.append(Score(row.at_ns, name, group.score))
        return scores

    def tick(self, now_ns: int) -> Sequence[Score]:
        """Return no scores: silence changes none."""
        return ()

    def explain(self, series: str) -> ScoreReason:
        """Return the odd member, the quantity in which it differs most, and the conflict."""
        return self._groups[series].explain(series)

    def learnt(self) -> LearntState:
        """Return what was learnt of each group."""
        values: list[dict[str, Any]] = []
        arrays: dict[str, NDArray[Any]] = {}
        for number, (name, group) in enumerate(self._groups.items()):
            values.append({"name": name, "members": group.members, "places": group.places})
            arrays |= {f"{number}_{key}": array for key, array in group.arrays().items()}
        options = options_to_json(self.config)
        return LearntState({"options": options, "groups": values}, arrays)

    @only_value_errors()
    def restore(self, state: LearntState) -> None:
        """Restore what was learnt."""
        self.config = options_from_json(Config, state.values["options"])
        groups = {}
        for number, values in enumerate(state.values["groups"]):
            places = [[(str(i), str(v)) for i, v in own] for own in values["places"]]
            group = _Group(tuple(map(str, values["members"])), places)
            prefix = f"{number}_"
            group.restore(
                {k[len(prefix) :]: v for k, v in state.arrays.items() if k.startswith(prefix)}
            )
            groups[str(values["name"])] = group
        self._groups = groups

    def snapshot(self) -> dict[str, Any]:
        """Return the values held, and the smoothed deviations."""
        return {name: group.snapshot() for name, group in self._groups.items()}

    @only_value_errors()
    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Continue a mission."""
        for name, group in self._groups.items():
            group.resume(snapshot[name])


class _Group:
    """The members of a group: arrays are (members, quantities)."""

    def __init__(
        self, members: tuple[str, ...], places: Sequence[Sequence[tuple[str, str]]]
    ) -> None:
        self.members, self.places = members, places
        shape = self._shape = len(members), len(places[0])
        self.gain, self.center, self.spread = np.ones(shape), np.zeros(shape), np.ones(shape)
        self.moves = 0.0
        self._items: dict[str, list[tuple[str, int, int]]] = {}
        for m, own in enumerate(places):
            for q, (item, variable) in enumerate(own):
                self._items.setdefault(item, []).append((variable, m, q))
        self.begin()

    def begin(self) -> None:
        """Forget all values."""
        self._held = np.full(self._shape, np.nan)
        self._squares = np.zeros(self._shape)
        self.score = 0.0

    def hold(self, row: Row, counts: dict[str, int]) -> bool:
        """Hold the values of a message; return whether it is about the group."""
        own = self._items.get(row.item)
        if own is None:
            return False
        for variable, m, q in own:
            value = row.values.get(variable, np.nan)
            if abs(value) <= LARGEST:
                self._held[m, q] = value
            else:
                self._held[m, q] = np.nan
                add_count(counts, "values of members that are missing or not finite")
        return True

    def learn(self, missions: Sequence[MissionRows], moves: float | None, name: str) -> None:
        """Learn from the instants at which all members are known."""
        sample: Sample[Floats] = Sample(_MOST_SAMPLES)
        for mission in missions:
            self.begin()
            for row in mission:
                if self.hold(row, {}) and np.isfinite(self._held).all():
                    sample.add(self._held.copy())
        self.begin()
        if len(sample.values) < 2:
            raise AmberboxError(
                f"the members of '{name}' are never known together in the nominal missions",
                "give missions in which all of them send",
            )
        values = np.array(sample.values)  # (samples, members, quantities)
        first = np.abs(values[:, :, 0])
        self.moves = float(_MOVES * np.quantile(np.median(first, axis=1), 0.95))
        if moves is not None:
            self.moves = moves
        values = values[np.median(first, axis=1) > self.moves]
        if len(values) < 2:
            raise AmberboxError(
                f"the group '{name}' never moves in the nominal missions",
                "give missions in which it does, or set 'moves' lower",
            )
        for m, q in np.ndindex(*self._shape):
            self.gain[m, q] = _gain(values[:, m, q], values[:, 0, q])
        aligned = values * self.gain
        middle = np.median(aligned, axis=1)
        for m, q in np.ndindex(*self._shape):
            center, spread = center_and_spread(aligned[:, m, q] - middle[:, q])
            least = _LEAST_SPREAD * float(np.quantile(np.abs(middle[:, q]), 0.95))
            self.center[m, q], self.spread[m, q] = center, max(spread, least)

    def compare(self, smoothing: float) -> bool:
        """Compare the members; return whether they could be compared."""
        aligned = self._held * self.gain
        known = np.isfinite(aligned)
        middle = _medians(aligned, known)
        enough = known.sum(axis=0) >= 2
        if not (enough[0] and abs(middle[0]) > self.moves):
            return False
        deviation = (aligned - middle - self.center) / self.spread
        deviation = np.where(known & enough, deviation, 0.0)
        squares = np.minimum(np.abs(deviation), CLIP) ** 2
        self._squares = self._squares + smoothing * (squares - self._squares)
        self.score = float(self._of_members().max())
        return True

    def _of_members(self) -> Floats:
        return np.asarray(np.sqrt(self._squares.mean(axis=1)))

    def explain(self, name: str) -> ScoreReason:
        """Return the odd member and the conflict."""
        scores = self._of_members()
        odd = int(np.argmax(scores))
        item, variable = self.places[odd][int(np.argmax(self._squares[odd]))]
        total = float(scores.sum()) or 1.0
        order = np.argsort(-scores, kind="stable")
        shares = tuple((self.members[m], float(scores[m]) / total) for m in order)
        differ = scores >= scores[odd] / 2
        if len(self.members) == 2:
            differ[:] = True
        suspects = tuple(
            member for member, is_odd in zip(self.members, differ, strict=True) if is_odd
        )
        text = (
            f"{self.members[odd]} differs from the group '{name}', most in {item}.{variable}: "
            f"{scores[odd]:.3g} standard deviations"
        )
        conflict = tuple(
            f"{of}.{name}"
            for places, is_odd in zip(self.places, differ, strict=True)
            for of, name in (places if is_odd else ())
        )
        return ScoreReason(
            "odd_one_out", item, variable, text, shares, suspects=suspects, conflict=conflict
        )

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return what was learnt."""
        found = {"gain": self.gain, "center": self.center, "spread": self.spread}
        return {**found, "moves": np.array([self.moves])}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Restore what was learnt."""
        found = [as_floats(arrays[key], self._shape) for key in ("gain", "center", "spread")]
        self.gain, self.center, self.spread = found
        self.moves = float(as_floats(arrays["moves"], (1,))[0])
        if not (self.spread > 0).all():
            raise ValueError("a spread is not above 0")

    def snapshot(self) -> dict[str, Any]:
        """Return the values held, None where none is known, and the smoothed deviations."""
        held = [[None if np.isnan(v) else v for v in own] for own in self._held.tolist()]
        return {"held": held, "squares": self._squares.tolist(), "score": self.score}

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Restore what ``snapshot`` returned."""
        self.begin()
        held = np.array(snapshot["held"], float)
        if held.shape != self._shape:
            raise ValueError("a group of another size")
        self._held = held
        self._squares = as_floats(np.array(snapshot["squares"], float), self._shape)
        self.score = as_number(snapshot["score"], 0.0)


def _gain(values: Floats, reference: Floats) -> float:
    """Return the factor that makes the values like the reference; 1 if they are not alike."""
    usual = np.abs(values) <= _USUAL * np.quantile(np.abs(values), 0.95)
    values, reference = values[usual], reference[usual]
    squares = float((values * values).sum())
    product = float((values * reference).sum())
    scale = (squares * float((reference * reference).sum())) ** 0.5
    if not 0 < scale < np.inf or abs(product) < _CORRELATED * scale:
        return 1.0
    return product / squares


def _medians(values: Floats, known: NDArray[np.bool_]) -> Floats:
    """Return the median of the known values of each column; NaN where there is none."""
    ordered = np.sort(values, axis=0)  # what is not known comes last
    counts = known.sum(axis=0)
    columns = np.arange(values.shape[1])
    low = ordered[np.maximum(counts - 1, 0) // 2, columns]
    upper = np.minimum(counts // 2, values.shape[0] - 1)
    return np.asarray((low + ordered[upper, columns]) / 2)
