"""The numbers of an FMEA that the covering engine reasons with, also as arrays and bit masks."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.needs import Needs, cycles
from amberbox.core.types import UNKNOWN_FAULT


class FunctionGates:
    """The functions over the components that can fail; sets of both are bit masks.

    ``support[f]`` are the components that function f depends on, ``alone[c]`` the functions that
    are lost when component c alone is lost.
    """

    def __init__(self, functions: Sequence[tuple[str, Needs]], components: Sequence[str]) -> None:
        self._needs = [needs for _, needs in functions]
        self._function_bits = {name: 1 << place for place, (name, _) in enumerate(functions)}
        self._component_bits = {name: 1 << place for place, name in enumerate(components)}
        order = _in_order(dict(functions), self._function_bits)
        self.support = [0] * len(functions)
        losers = [0] * len(functions)
        for place in order:
            own = self._component_bits.get(functions[place][0], 0)
            names = self._needs[place].names()
            self.support[place] = own | _union(self._of(name, self.support) for name in names)
            losers[place] = own | self._alone(self._needs[place], losers)
        self.alone = _transposed(losers, len(components))
        self._hard = [place for place in order if self.support[place] != losers[place]]
        self._memory: dict[int, int] = {0: 0}

    def lost(self, down: int) -> int:
        """Return the functions that are lost while these components are down."""
        known = self._memory.get(down)
        if known is None:
            if len(self._memory) > 100_000:
                self._memory = {0: 0}
            known = self._memory[down] = self._lost(down)
        return known

    def _lost(self, down: int) -> int:
        lost = _union(self.alone[place] for place in bits(down))
        for place in self._hard:
            if not lost >> place & 1 and (down & self.support[place]).bit_count() > 1:
                lost |= self._loses(place, down, lost) << place
        return lost

    def _loses(self, place: int, down: int, lost: int) -> bool:
        def is_up(name: str) -> bool:
            gone = self._component_bits.get(name, 0) & down
            return not gone and not self._function_bits.get(name, 0) & lost

        return not self._needs[place].met(is_up)

    def _of(self, name: str, masks: Sequence[int]) -> int:
        function = self._function_bits.get(name)
        inherited = 0 if function is None else masks[function.bit_length() - 1]
        return inherited | self._component_bits.get(name, 0)

    def _alone(self, needs: Needs, losers: Sequence[int]) -> int:
        """Return the components each of which alone makes the needs fail."""
        parts = [
            self._of(part, losers) if isinstance(part, str) else self._alone(part, losers)
            for part in needs.parts
        ]
        spare = len(parts) - needs.at_least
        if spare == 0:
            return _union(parts)
        return _union(
            1 << place
            for place in bits(_union(parts))
            if sum(part >> place & 1 for part in parts) > spare
        )


def bits(mask: int) -> Iterator[int]:
    """Yield the places of the bits that are set, from low to high."""
    while mask:
        low = mask & -mask
        yield low.bit_length() - 1
        mask ^= low


def _union(masks: Iterator[int] | Sequence[int]) -> int:
    result = 0
    for mask in masks:
        result |= mask
    return result


def _transposed(masks: Sequence[int], width: int) -> list[int]:
    columns = [0] * width
    for row, mask in enumerate(masks):
        for place in bits(mask):
            columns[place] |= 1 << row
    return columns


def _in_order(needs: Mapping[str, Needs], bit: Mapping[str, int]) -> list[int]:
    """Return the indices of the functions, each after those that it needs."""
    order: list[int] = []
    done: set[str] = set()
    waiting = list(needs)
    while waiting:
        name = waiting[-1]
        first = [n for n in needs[name].names() if n in needs and n not in done]
        if name in done or not first:
            waiting.pop()
            if name not in done:
                done.add(name)
                order.append(bit[name].bit_length() - 1)
        else:
            waiting += first
    return order


LARGEST_PRIOR = 1 - 1e-12

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class LinkArrays:
    """Links by place, as arrays; ``log_miss`` is the logarithm of 1 - detects."""

    cause: Ints
    sign: Ints
    log_miss: Floats
    by_sign: tuple[tuple[tuple[int, float], ...], ...]
    by_cause: tuple[tuple[tuple[int, float], ...], ...]

    @classmethod
    def of(cls, triples: Iterable[tuple[int, int, float]], causes: int, signs: int) -> LinkArrays:
        """Collect (cause, sign, detects)."""
        rows = [row for row in triples if row[2] > 0]
        by_sign: list[list[tuple[int, float]]] = [[] for _ in range(signs)]
        by_cause: list[list[tuple[int, float]]] = [[] for _ in range(causes)]
        for cause, sign, detects in rows:
            by_sign[sign].append((cause, detects))
            by_cause[cause].append((sign, detects))
        return cls(
            np.array([row[0] for row in rows], np.int64),
            np.array([row[1] for row in rows], np.int64),
            np.array([log_miss(row[2]) for row in rows], np.float64),
            tuple(map(tuple, by_sign)),
            tuple(map(tuple, by_cause)),
        )

    def folded(self, absent: NDArray[np.bool_], causes: int) -> Floats:
        """Return per cause the logarithm of the chance that no absent symptom shows."""
        chosen = absent[self.sign]
        weights = self.log_miss[chosen]
        sums: Floats = np.bincount(self.cause[chosen], weights, causes).astype(np.float64)
        return sums


Cumulated = tuple[float, ...]
"""The probability of a size up to each bin, when a cause shows a symptom; 0 for bin 0."""


@dataclass(frozen=True, slots=True)
class GradedCauses:
    """The causes of a symptom with sizes: (place, detects, cumulated sizes)."""

    bins: int
    modes: tuple[tuple[int, float, Cumulated], ...]
    functions: tuple[tuple[int, float, Cumulated], ...]


TimedLinks = tuple[tuple[float, tuple[float, float] | None], ...]
"""The links of a mode to a symptom, one or more: (1 - detects, after_s)."""


@dataclass(frozen=True, slots=True)
class ConsequencePlaces:
    """A consequence, with the places of both modes."""

    cause: int
    effect: int
    p: float
    after_s: tuple[float, float] | None


@dataclass(frozen=True, slots=True)
class ExclusiveCluster:
    """Modes that are connected by excluding each other.

    ``distinct`` are those that a search must tell apart: all, unless each excludes all others;
    then those that lead to others or follow from them.
    """

    modes: tuple[int, ...]
    distinct: frozenset[int]


@dataclass(frozen=True, slots=True)
class JointModes:
    """Modes, by place, that exclude each other or lead to each other.

    ``excludes`` are the modes that each excludes, ``exclusive`` the same with itself, ``cluster``
    is the one that it belongs to. ``causes`` are the modes that lead to each, ``effects`` those to
    which each leads. ``priors`` are those of all modes.
    """

    excludes: Mapping[int, frozenset[int]]
    exclusive: Mapping[int, frozenset[int]]
    cluster: Mapping[int, ExclusiveCluster]
    causes: Mapping[int, tuple[ConsequencePlaces, ...]]
    effects: Mapping[int, tuple[ConsequencePlaces, ...]]
    priors: tuple[float, ...]

    @classmethod
    def of(cls, model: Model) -> JointModes:
        """Resolve the names of a model."""
        excludes: dict[int, set[int]] = {}
        for place, mode in enumerate(model.modes):
            for name in mode.excludes:
                other = model.mode_place(name)
                if other != place:
                    excludes.setdefault(place, set()).add(other)
                    excludes.setdefault(other, set()).add(place)
        effects, causes = _consequences(model)
        priors = tuple(min(mode.prior, LARGEST_PRIOR) for mode in model.modes)
        closed = {place: frozenset(others) for place, others in excludes.items()}
        exclusive = {place: others | {place} for place, others in closed.items()}
        clusters = {m: one for one in _clusters(closed, {*causes, *effects}) for m in one.modes}
        return cls(closed, exclusive, clusters, causes, effects, priors)

    def clusters_of(self, modes: Iterable[int]) -> tuple[ExclusiveCluster, ...]:
        """Return the clusters of modes that exclude each other to which some of these belong."""
        if not self.cluster:
            return ()
        near = {one.modes: one for mode in modes if (one := self.cluster.get(mode))}
        return tuple(near.values())

    def origins(self, modes: Iterable[int]) -> set[int]:
        """Return all modes that lead to some of these, directly or not."""
        return _reached(modes, lambda mode: (one.cause for one in self.causes.get(mode, ())))

    def results(self, modes: Iterable[int]) -> set[int]:
        """Return all modes that follow from some of these, directly or not."""
        return _reached(modes, lambda mode: (one.effect for one in self.effects.get(mode, ())))


@dataclass(frozen=True, slots=True, eq=False)
class ModelTables:
    """The arrays of a model for the search, by place; ``unknown`` is the unknown mode's, or -1.

    ``component`` is the place of the component that a mode takes down, -1 for none.
    ``pairs`` are (component, function) where the one alone loses the other. ``graded`` are the
    causes of each symptom of which some cause gives a size, ``timed`` those of each symptom of
    which some cause gives a time. ``joint`` is about modes that are not independent.

    ``log_odds`` of a mode that others lead to is the most that these can make of it.
    """

    log_odds: Floats
    component: tuple[int, ...]
    modes: LinkArrays
    functions: LinkArrays
    gates: FunctionGates
    component_count: int
    modes_of: tuple[tuple[int, ...], ...]
    pair_component: Ints
    pair_function: Ints
    unknown: int
    graded: Mapping[int, GradedCauses]
    timed: Mapping[int, Mapping[int, TimedLinks]]
    joint: JointModes

    @classmethod
    def of(cls, model: Model) -> ModelTables:
        """Compile a model."""
        names = list(dict.fromkeys(mode.component for mode in model.modes if mode.takes_down))
        places = {name: place for place, name in enumerate(names)}
        component = [places[m.component] if m.takes_down else -1 for m in model.modes]
        gates = FunctionGates([(f.id, f.needs) for f in model.functions], names)
        pairs = [(c, f) for c, mask in enumerate(gates.alone) for f in bits(mask)]
        component += [-1] * (len(model.mode_ids) - len(model.modes))
        return cls(
            _log_odds(model),
            tuple(component),
            _links(model, model.mode_places),
            _links(model, model.function_places),
            gates,
            len(names),
            _modes_of(component, len(names)),
            np.array([pair[0] for pair in pairs], np.int64),
            np.array([pair[1] for pair in pairs], np.int64),
            -1 if model.unknown is None else len(model.modes),
            _graded(model),
            _timed(model),
            JointModes.of(model),
        )


def log_miss(detects: float) -> float:
    """Return the logarithm of 1 - detects."""
    return math.log1p(-detects) if detects < 1 else -math.inf


def _log_odds(model: Model) -> Floats:
    priors = [mode.prior for mode in model.modes]
    if model.unknown is not None:
        priors.append(model.unknown.prior)
    chance = np.minimum(np.array(priors, np.float64), LARGEST_PRIOR)
    with np.errstate(divide="ignore"):
        odds: Floats = np.log(chance) - np.log1p(-chance)
    for place, causes in _consequences(model)[1].items():
        odds[place] = log_odds_with(float(chance[place]), [one.p for one in causes])
    return odds


def log_odds_with(prior: float, chances: Sequence[float]) -> float:
    """Return the logarithm of the weight of a mode to which others lead, against its absence.

    Its absence counts ``1 - prior``, without what it says about the others.
    """
    absent = (1.0 - prior) * math.prod(1.0 - p for p in chances)
    return math.log(1.0 - absent) - math.log1p(-prior) if absent < 1 else -math.inf


def _links(model: Model, causes: dict[str, int]) -> LinkArrays:
    triples = [
        (causes[link.cause], model.sign_places[link.symptom], link.detects)
        for link in model.links
        if link.cause in causes
    ]
    return LinkArrays.of(triples, len(causes), len(model.signs))


def _reached(modes: Iterable[int], near: Callable[[int], Iterable[int]]) -> set[int]:
    found: set[int] = set()
    waiting = list(modes)
    while waiting:
        more = set(near(waiting.pop())) - found
        found |= more
        waiting += more
    return found


def _clusters(
    excludes: Mapping[int, frozenset[int]], following: Collection[int]
) -> Iterator[ExclusiveCluster]:
    left = dict(excludes)
    while left:
        waiting = [next(iter(left))]
        found: set[int] = set()
        while waiting:
            mode = waiting.pop()
            if mode not in found:
                found.add(mode)
                waiting += left.pop(mode)
        is_complete = all(len(excludes[mode]) == len(found) - 1 for mode in found)
        distinct = found.intersection(following) if is_complete else found
        yield ExclusiveCluster(tuple(sorted(found)), frozenset(distinct))


Consequences = dict[int, tuple[ConsequencePlaces, ...]]


def _consequences(model: Model) -> tuple[Consequences, Consequences]:
    """Return the consequences by their cause, and by their effect."""
    by_cause: Consequences = {}
    by_effect: Consequences = {}
    for one in model.leads_to:
        cause, effect = model.mode_place(one.cause), model.mode_place(one.effect)
        resolved = ConsequencePlaces(cause, effect, one.p, one.after_s)
        by_cause[cause] = (*by_cause.get(cause, ()), resolved)
        by_effect[effect] = (*by_effect.get(effect, ()), resolved)
    return by_cause, by_effect


def _graded(model: Model) -> dict[int, GradedCauses]:
    graded: dict[int, tuple[list[Any], list[Any]]] = {
        model.sign_places[link.symptom]: ([], []) for link in model.links if link.sizes
    }
    for link in model.links:
        place = model.sign_places[link.symptom]
        if place not in graded or not link.detects:
            continue
        bins = model.signs[place].bins
        sizes = link.sizes or (1 / bins,) * bins
        sums = (total if total < 1 - 1e-12 else 1.0 for total in accumulate(sizes[:-1]))
        cumulated = (0.0, *sums, 1.0)
        is_loss = link.cause in model.function_places
        causes = model.function_places if is_loss else model.mode_places
        graded[place][is_loss].append((causes[link.cause], link.detects, cumulated))
    return {
        place: GradedCauses(model.signs[place].bins, tuple(modes), tuple(functions))
        for place, (modes, functions) in graded.items()
    }


def _timed(model: Model) -> dict[int, dict[int, TimedLinks]]:
    timed: dict[int, dict[int, TimedLinks]] = {
        model.sign_places[link.symptom]: {} for link in model.links if link.after_s is not None
    }
    for link in model.links:
        of = timed.get(model.sign_places[link.symptom])
        if of is not None and link.cause in model.mode_places and link.detects:
            place = model.mode_places[link.cause]
            of[place] = (*of.get(place, ()), (1.0 - link.detects, link.after_s))
    return timed


def _modes_of(component: Iterable[int], count: int) -> tuple[tuple[int, ...], ...]:
    modes: list[list[int]] = [[] for _ in range(count)]
    for mode, place in enumerate(component):
        if place >= 0:
            modes[place].append(mode)
    return tuple(map(tuple, modes))


UNKNOWN = UNKNOWN_FAULT  # the mode that stands for everything that is not in the FMEA


@dataclass(frozen=True, slots=True)
class Mode:
    """A failure mode ``component#mode`` with its prior probability.

    ``takes_down``: while it is present, its component does not serve those that need it.
    ``excludes`` are modes that are never present together with it; one side is enough.
    ``is_unlisted``: it stands for the faults of its component that are not in the FMEA; answers
    count it as the unknown mode.
    """

    id: str
    prior: float
    takes_down: bool = False
    criticality: float = 0.0
    excludes: frozenset[str] = frozenset()
    is_unlisted: bool = False

    @property
    def component(self) -> str:
        """Return the component that fails."""
        return self.id.partition("#")[0]


@dataclass(frozen=True, slots=True)
class Sign:
    """A symptom that can be seen: ``leak`` is how probable it shows without any cause.

    ``read_cost_s`` is what reading it on demand costs, None when it cannot be read on demand.
    ``bins``: a present symptom has one of so many sizes, from 1 (small) on; 0 if it has none.
    """

    id: str
    leak: float = 0.0
    read_cost_s: float | None = 0.0
    bins: int = 0


@dataclass(frozen=True, slots=True)
class Function:
    """Something that is lost when its needs are not met.

    A function named like a component is that component's service: it is also lost when a mode
    takes the component down. A name that is no function and has no mode is always up.
    """

    id: str
    needs: Needs


@dataclass(frozen=True, slots=True)
class Link:
    """A cause shows a symptom with probability ``detects``.

    ``cause`` is a failure mode, or a function: then its loss is the cause. Two links from one
    cause to one symptom are two independent ways to show it. ``sizes`` are the probabilities of the
    symptom's bins when the cause shows it, empty if all are equally probable. ``after_s``: it
    begins so long after a failure mode does (from, to); None if no matter when.
    """

    cause: str
    symptom: str
    detects: float
    sizes: tuple[float, ...] = ()
    after_s: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Consequence:
    """A failure mode makes another one follow with probability ``p``, ``after_s`` later."""

    cause: str
    effect: str
    p: float
    after_s: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Unknown:
    """The failure mode for all faults that are not in the FMEA, with the prior ``prior``.

    It shows any symptom with probability ``detects``. Which symptoms it would show is unknown, so
    an absent symptom is no evidence against it; ``denies`` above 0 makes each absent symptom count
    like an absent symptom of a cause with that probability. With a large ``detects`` it explains
    two simultaneous faults more cheaply than the two known faults do; with the default the two
    faults keep most of their probability.

    It may look like three or more known modes that begin within ``together_s`` of each other, like
    each with probability ``looks_like``; 0: it never does.
    """

    prior: float = 1e-3
    detects: float = 0.05
    denies: float = 0.0
    looks_like: float = 0.0
    together_s: float = 10.0


@dataclass(frozen=True)
class Model:
    """Failure modes, symptoms, functions and the links between them; checked, never changed.

    Raises UsageError for probabilities outside 0..1, names given twice or not at all, sizes that
    are no distribution over a symptom's bins, and needs or consequences that go in a circle. A
    prior of 1 counts as 1 - 1e-12.
    """

    modes: tuple[Mode, ...]
    signs: tuple[Sign, ...]
    links: tuple[Link, ...]
    functions: tuple[Function, ...] = ()
    unknown: Unknown | None = Unknown()
    leads_to: tuple[Consequence, ...] = ()

    def __post_init__(self) -> None:
        self._check_names()
        self._check_grades()
        for circle in cycles({function.id: function.needs for function in self.functions}):
            raise UsageError(f"needs go in a circle: {' -> '.join((*circle, circle[0]))}")
        for mode in self.modes:
            _probability(mode.prior, f"prior of {mode.id}")
        for sign in self.signs:
            _probability(sign.leak, f"leak of {sign.id}")
        for link in self.links:
            _probability(link.detects, f"detects of {link.cause} for {link.symptom}")
        if self.unknown is not None:
            for name in ("prior", "detects", "denies", "looks_like"):
                _probability(getattr(self.unknown, name), f"{name} of {UNKNOWN}")

    @cached_property
    def tables(self) -> ModelTables:
        """Return the model as arrays and masks, made at first use."""
        return ModelTables.of(self)

    @cached_property
    def mode_ids(self) -> tuple[str, ...]:
        """Return the ids of the modes by their place; the unknown one is the last."""
        own = tuple(mode.id for mode in self.modes)
        return own if self.unknown is None else (*own, UNKNOWN)

    @cached_property
    def mode_places(self) -> dict[str, int]:
        """Return the place of each mode, the unknown one included."""
        return {name: place for place, name in enumerate(self.mode_ids)}

    @cached_property
    def unlisted(self) -> frozenset[str]:
        """Return the modes that stand for faults that are not in the FMEA, but UNKNOWN itself."""
        return frozenset(mode.id for mode in self.modes if mode.is_unlisted)

    @cached_property
    def sign_places(self) -> dict[str, int]:
        """Return the place of each symptom."""
        return {sign.id: place for place, sign in enumerate(self.signs)}

    @cached_property
    def function_places(self) -> dict[str, int]:
        """Return the place of each function."""
        return {function.id: place for place, function in enumerate(self.functions)}

    def mode_place(self, name: str) -> int:
        """Return the index of a mode; raise UsageError when there is none."""
        if name not in self.mode_places:
            near = did_you_mean(name, self.mode_ids)
            raise UsageError(f"there is no failure mode '{name}'{near}")
        return self.mode_places[name]

    def _check_names(self) -> None:
        _unique((mode.id for mode in self.modes), "failure mode", {UNKNOWN})
        _unique((sign.id for sign in self.signs), "symptom")
        _unique((function.id for function in self.functions), "function")
        causes = {mode.id for mode in self.modes} | set(self.function_places)
        for link in self.links:
            if link.cause not in causes:
                near = did_you_mean(link.cause, causes)
                raise UsageError(f"there is no cause '{link.cause}' of {link.symptom}{near}")
            if link.symptom not in self.sign_places:
                near = did_you_mean(link.symptom, self.sign_places)
                raise UsageError(f"there is no symptom '{link.symptom}' of {link.cause}{near}")

    def _check_grades(self) -> None:
        for link in self.links:
            bins = self.signs[self.sign_places[link.symptom]].bins
            if link.sizes and (
                len(link.sizes) != bins or min(link.sizes) < 0 or abs(sum(link.sizes) - 1) > 1e-6
            ):
                what = f"the sizes of {link.symptom} by {link.cause} are no distribution"
                raise UsageError(f"{what} over its {bins} bins")
            if link.after_s is not None and link.cause in self.function_places:
                raise UsageError(f"the loss of {link.cause} has no time: leave out its after_s")
        for mode in self.modes:
            for name in mode.excludes:
                self.mode_place(name)
        for one in self.leads_to:
            _probability(one.p, f"chance that {one.cause} leads to {one.effect}")
            for name in (one.cause, one.effect):
                self.mode_place(name)
        follows: dict[str, list[str]] = {one.cause: [] for one in self.leads_to}
        for one in self.leads_to:
            follows[one.cause].append(one.effect)
        needs = {cause: Needs(len(names), tuple(names)) for cause, names in follows.items()}
        for circle in cycles(needs):
            raise UsageError(f"consequences go in a circle: {' -> '.join((*circle, circle[0]))}")


def _unique(names: Iterable[str], kind: str, taken: set[str] | None = None) -> None:
    seen = set(taken or ())
    for name in names:
        if name in seen:
            raise UsageError(f"the {kind} '{name}' is there twice")
        seen.add(name)


def _probability(value: float, what: str) -> None:
    if not 0.0 <= value <= 1.0:
        raise UsageError(f"the {what} is {value:g}, no probability", "give a number from 0 to 1")
