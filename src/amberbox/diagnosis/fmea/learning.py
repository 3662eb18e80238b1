"""Learn the numbers of an analysis from situations whose cause is known, as proposals.

Each number that is there is a prior: ``detects`` a beta distribution that weighs as much as
``weight`` repairs, ``rate`` and ``leak`` a gamma and a beta distribution that weigh as much as half
a failure (Jeffreys). So no number becomes 0 or 1 by a few cases. A symptom is new where Fisher's
exact test, one-sided and corrected for the number of tests (Bonferroni), says that it comes with a
mode more often than without it.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from amberbox.core.expressions.tree import output_of
from amberbox.core.yaml_nodes import Node
from amberbox.diagnosis.fmea.model import (
    Fmea,
    FmeaReferences,
    SizeDistribution,
    SizeScale,
    SymptomLink,
    links_by_mode,
)
from amberbox.diagnosis.fmea.parser import (
    ExpandedComponent,
    LinkFile,
    ParsedFmea,
    child_node,
)

WEIGHT = 10.0
"""How many repairs the present ``detects`` is worth."""
HALF = 0.5
"""How many failures, or false alarms, the present rate or leak is worth."""
FEWEST_SIZES = 5
FEWEST_NEW = 3
"""Repairs in which a new symptom was present."""
SURE = 0.05
_MOVED, _RATE_MOVED, _SIZES_MOVED = 0.01, 0.1, 0.1
_SHOWN = 3

Kind: TypeAlias = Literal["detects", "size", "symptom", "rate", "leak"]


@dataclass(frozen=True, slots=True)
class SeenSymptom:
    """Whether a symptom was present, and its largest size if that is known."""

    present: bool
    size: float | None = None


@dataclass(frozen=True, slots=True)
class Situation:
    """Some time of which it is known what was broken; ``faults`` are empty if nothing was.

    ``seen`` are the symptoms that were known. ``name`` is the mission or diagnosis, empty if there
    was none.
    """

    faults: frozenset[str]
    length_s: float
    seen: Mapping[str, SeenSymptom]
    name: str = ""


@dataclass(frozen=True, slots=True)
class Proposal:
    """A number of the analysis that should be another one, with the reason.

    ``node`` is what changes in the file: the symptom of a mode, the mode (``rate``, ``symptom``),
    or the entry of a symptom, None without one (``leak``). ``value`` is as the file writes it.
    """

    kind: Kind
    mode: str
    symptom: str
    now: str
    value: str
    reason: str
    node: Node | None = None


@dataclass(slots=True)
class _Count:
    """In how many situations a symptom was there, and in which (their names)."""

    there: int = 0
    of: int = 0
    names: dict[str, None] = field(default_factory=dict)
    sizes: list[float] = field(default_factory=list)

    def take(self, seen: SeenSymptom, name: str) -> None:
        """Count a situation."""
        self.there += seen.present
        self.of += 1
        if name:
            self.names[name] = None
        if seen.present and seen.size is not None and math.isfinite(seen.size):
            self.sizes.append(seen.size)

    @property
    def where(self) -> str:
        """Return the situations as text."""
        names = list(self.names)
        left = len(names) - _SHOWN
        return ", ".join(names[:_SHOWN]) + (f" and {left} more" if left > 0 else "")


@dataclass(frozen=True, slots=True)
class _WrittenLink:
    """A symptom of a mode as the file writes it once, with what it is for each component."""

    node: Node
    mode: str
    of: list[tuple[str, SymptomLink]]

    @property
    def symptom(self) -> str:
        """Return the symptom as its type has it."""
        mode, link = self.of[0]
        component, slash, rest = link.symptom.partition("/")
        own = slash and len(self.of) > 1 and component == mode.partition("#")[0]
        return f"<component>/{rest}" if own else link.symptom


@dataclass(frozen=True, slots=True)
class _WrittenMode:
    """A mode as the file writes it once: of which components, and its ids there."""

    node: Node
    mode: str
    ids: list[str]
    parts: list[ExpandedComponent]

    @property
    def name(self) -> str:
        """Return its name without the type."""
        return self.mode.partition("#")[2]


def learn(
    sheet: ParsedFmea,
    fmea: Fmea,
    situations: Sequence[Situation],
    hours: float,
    known: FmeaReferences | None = None,
    weight: float = WEIGHT,
) -> list[Proposal]:
    """Return proposals for an analysis, in the order of its file.

    ``hours`` is the time of operation in which the situations arose, ``weight`` how many repairs
    the present ``detects`` is worth.
    """
    causes = _Causes.of(fmea)
    written = list(_written_links(sheet, fmea))
    modes = list(_written_modes(sheet))
    found: list[Proposal] = []
    for link in written:
        count = _count_link(link, situations, causes)
        found += _detects(link, count, weight)
        found += _size(link, count, fmea)
    new = list(_new_symptoms(modes, situations, causes, fmea, known))
    found += (proposal for proposal, _ in new)
    found += _rates(modes, fmea, situations, hours)
    explained = {pair for _, pairs in new for pair in pairs}
    found += _leaks(sheet, fmea, situations, causes, explained)
    return found


@dataclass(frozen=True, slots=True)
class _Causes:
    """What each mode explains: its symptoms, and those of modes that follow from it.

    ``losses`` are the symptoms of functions that are lost with it.
    """

    explains: Mapping[str, frozenset[str]]
    losses: Mapping[str, frozenset[str]]

    @classmethod
    def of(cls, fmea: Fmea) -> _Causes:
        """Return them for an analysis."""
        own: dict[str, frozenset[str]] = {}
        losses: dict[str, frozenset[str]] = {}
        for name, links in links_by_mode(fmea).items():
            own[name] = frozenset(link.symptom for link in links)
            below = links[len(fmea.modes[name].symptoms) :]
            losses[name] = frozenset(link.symptom for link in below)
        explains = {
            name: frozenset[str]().union(*(own[mode] for mode in _reached(fmea, name)))
            for name in fmea.modes
        }
        return cls(explains, losses)

    def is_alone(self, mode: str, symptom: str, faults: Collection[str]) -> bool:
        """Return whether no other of the faults, and no loss by the mode, explains a symptom."""
        others = (other for other in faults if other != mode)
        return symptom not in self.losses[mode] and not any(
            symptom in self.explains[other] for other in others
        )

    def explain(self, symptom: str, faults: Iterable[str]) -> bool:
        """Return whether one of the faults explains a symptom."""
        return any(symptom in self.explains[fault] for fault in faults)


def _reached(fmea: Fmea, mode: str) -> set[str]:
    """Return a mode and those that may follow from it."""
    reached, waiting = {mode}, [mode]
    while waiting:
        more = [one.mode for one in fmea.modes[waiting.pop()].leads_to if one.mode not in reached]
        reached.update(more)
        waiting += more
    return reached


def _written_links(sheet: ParsedFmea, fmea: Fmea) -> Iterator[_WrittenLink]:
    """Yield the symptoms of modes, each once as the file writes it."""
    found: dict[tuple[int, int], _WrittenLink] = {}
    for part, name in _parts(sheet):
        mode_id = f"{part.component}#{name}"
        links = {link.symptom: link for link in fmea.modes[mode_id].symptoms}
        node = child_node(part.mode_node(name), "symptoms")
        for place, entry in enumerate(part.modes[name].symptoms):
            given = entry.symptom if isinstance(entry, LinkFile) else entry
            names = (f"{part.component}.{given}", given, f"{mode_id}.{place}")
            link = next((links[one] for one in names if one in links), None)
            if link is not None:
                at = child_node(node, place)
                written = found.setdefault(at.span, _WrittenLink(at, f"{part.type}#{name}", []))
                written.of.append((mode_id, link))
    yield from found.values()


def _parts(sheet: ParsedFmea) -> Iterator[tuple[ExpandedComponent, str]]:
    for part in sheet.parts:
        for name in part.modes:
            yield part, name


def _written_modes(sheet: ParsedFmea) -> list[_WrittenMode]:
    """Return the modes, each once as the file writes it."""
    found: dict[tuple[int, int], _WrittenMode] = {}
    for part, name in _parts(sheet):
        node = part.mode_node(name)
        mode = found.setdefault(node.span, _WrittenMode(node, f"{part.type}#{name}", [], []))
        mode.ids.append(f"{part.component}#{name}")
        mode.parts.append(part)
    return list(found.values())


def _count_link(link: _WrittenLink, situations: Iterable[Situation], causes: _Causes) -> _Count:
    """Count in how many repairs of the mode the symptom was there.

    A repair counts if it took so long that the symptom must have come, and if nothing else
    explains the symptom.
    """
    count = _Count()
    for one in situations:
        for mode, of in link.of if one.faults else ():
            seen = one.seen.get(of.symptom)
            if (
                mode in one.faults
                and seen is not None
                and one.length_s >= of.within_s
                and causes.is_alone(mode, of.symptom, one.faults)
            ):
                count.take(seen, one.name)
    return count


def _detects(link: _WrittenLink, count: _Count, weight: float) -> Iterator[Proposal]:
    now = link.of[0][1].detects
    if not count.of or any(of.detects != now for _, of in link.of):
        return
    new = (now * weight + count.there) / (weight + count.of)
    new = min(0.999, max(0.001, new))
    if abs(new - now) >= _MOVED:
        reason = (
            f"there in {count.there} of {count.of} repairs ({count.where}); "
            f"{now:g} counts as {weight:g} repairs"
        )
        yield Proposal("detects", link.mode, link.symptom, f"{now:g}", f"{new:.3g}", reason,
                       link.node)  # fmt: skip


def _size(link: _WrittenLink, count: _Count, fmea: Fmea) -> Iterator[Proposal]:
    symptom, size = link.of[0][1].symptom, link.of[0][1].size
    scale = fmea.symptoms[symptom].scale
    if scale is None or len(count.sizes) < FEWEST_SIZES:
        return
    new = fitted(count.sizes, scale, size.kind if size else "normal")
    if size is not None:
        pairs = zip(scale.shares(size), scale.shares(new), strict=True)
        if sum(abs(p - q) for p, q in pairs) / 2 < _SIZES_MOVED:
            return
    reason = (
        f"{len(count.sizes)} sizes from {min(count.sizes):.3g} to {max(count.sizes):.3g} "
        f"({count.where})"
    )
    now = size_text(size) if size else "any"
    yield Proposal("size", link.mode, link.symptom, now, size_text(new), reason, link.node)


def fitted(
    sizes: Sequence[float], scale: SizeScale, kind: Literal["uniform", "normal"]
) -> SizeDistribution:
    """Return the distribution of a kind that some sizes speak for; it is never of width 0.

    The ends of a uniform one are estimated without bias, a normal one has room for the next size.
    """
    least = scale.edges[0] / 4
    if kind == "uniform":
        low, high = min(sizes), max(sizes)
        room = max((high - low) / (len(sizes) - 1), least / 2)
        return SizeDistribution("uniform", low - room, high + room)
    spread = statistics.stdev(sizes) * math.sqrt(1 + 1 / len(sizes))
    return SizeDistribution("normal", statistics.fmean(sizes), max(spread, least))


def size_text(size: SizeDistribution) -> str:
    """Return a distribution as the file writes it."""
    return f"{{{size.kind}: [{size.a:.3g}, {size.b:.3g}]}}"


Pair: TypeAlias = tuple[str, str]
"""A mode and a symptom."""


def _new_symptoms(
    modes: Sequence[_WrittenMode],
    situations: Sequence[Situation],
    causes: _Causes,
    fmea: Fmea,
    known: FmeaReferences | None,
) -> Iterator[tuple[Proposal, list[Pair]]]:
    """Yield symptoms that a mode should list, with what they explain for each component."""
    tables: list[tuple[_WrittenMode, str, list[Pair], _Count, _Count]] = []
    for mode in modes:
        own = [one for one in situations if not one.faults.isdisjoint(mode.ids)]
        for pattern, pairs in _candidates(mode, own, causes, fmea, known).items():
            with_it, without = _compare(pairs, situations, causes)
            if with_it.there >= FEWEST_NEW and without.of:
                tables.append((mode, pattern, pairs, with_it, without))
    for mode, pattern, pairs, with_it, without in tables:
        chance = fisher(with_it.there, with_it.of, without.there, without.of)
        if chance > SURE / len(tables):
            continue
        detects = (with_it.there + 1) / (with_it.of + 2)
        reason = (
            f"there in {with_it.there} of {with_it.of} repairs ({with_it.where}), in "
            f"{without.there} of {without.of} other situations; p = {chance:.2g} by Fisher's exact "
            f"test, at most {SURE / len(tables):.2g} as {len(tables)} were tested"
        )
        value = f"{{symptom: {pattern}, detects: {detects:.2g}}}"
        yield Proposal("symptom", mode.mode, pattern, "not listed", value, reason, mode.node), pairs


def _candidates(
    mode: _WrittenMode,
    situations: Iterable[Situation],
    causes: _Causes,
    fmea: Fmea,
    known: FmeaReferences | None,
) -> dict[str, list[Pair]]:
    """Return symptoms that were there and that the mode does not explain, as it would list them.

    A symptom of the component itself is one of all components of its type; one of a sister is not.
    """
    types = {name: component.type for name, component in fmea.components.items()}
    watched = None if known is None else {*known.watched, *fmea.symptoms}
    own = {mode_id.partition("#")[0]: mode_id for mode_id in mode.ids}
    found: dict[str, list[Pair]] = {}
    for one in situations:
        for symptom, seen in one.seen.items():
            place = output_of(symptom)
            if not seen.present or place is None or (watched and symptom not in watched):
                continue
            pattern = symptom
            if place[0] in own and len(own) > 1:
                pattern = f"<component>/{place[1]}/{place[2]}"
            elif len(own) > 1 and types.get(place[0]) == types[next(iter(own))]:
                continue
            named = [(of, pattern.replace("<component>", name)) for name, of in own.items()]
            if not any(text in causes.explains[of] for of, text in named):
                found[pattern] = named
    return found


def _compare(
    pairs: Sequence[Pair], situations: Iterable[Situation], causes: _Causes
) -> tuple[_Count, _Count]:
    """Count situations with and without a mode in which nothing explains the symptom."""
    with_it, without = _Count(), _Count()
    for one in situations:
        for mode, symptom in pairs:
            seen = one.seen.get(symptom)
            if seen is None or causes.explain(symptom, one.faults):
                continue
            (with_it if mode in one.faults else without).take(seen, one.name)
    return with_it, without


def fisher(there: int, of: int, there_without: int, of_without: int) -> float:
    """Return how probable so many of all that were there are with the mode, if it did not matter.

    Fisher's exact test, one-sided.
    """
    total, all_there = of + of_without, there + there_without
    ways = sum(
        math.comb(of, k) * math.comb(of_without, all_there - k)
        for k in range(there, min(of, all_there) + 1)
    )
    return ways / math.comb(total, all_there)


def _rates(
    modes: Iterable[_WrittenMode], fmea: Fmea, situations: Sequence[Situation], hours: float
) -> Iterator[Proposal]:
    """Yield rates; a single failure changes none."""
    for mode in modes:
        if any(part.modes[mode.name].rate is None for part in mode.parts):
            continue
        now = mode.parts[0].modes[mode.name].rate
        if not now:
            continue
        names = [
            one.name for one in situations for of in mode.ids
            if of in one.faults and not _followed(fmea, of, one.faults)
        ]  # fmt: skip
        exposure_h = hours * len(mode.ids)
        new = (HALF + len(names)) / (HALF / now + exposure_h)
        if exposure_h and len(names) != 1 and abs(new / now - 1) >= _RATE_MOVED:
            reason = (
                f"{len(names)} failures in {exposure_h:.3g} h; {now:g} counts as half a failure in "
                f"{HALF / now:.3g} h"
            )
            yield Proposal("rate", mode.mode, "", f"{now:g}", f"{new:.2g}", reason, mode.node)


def _followed(fmea: Fmea, mode: str, faults: Collection[str]) -> bool:
    """Return whether a mode may have followed from another one that was there."""
    return any(mode in _reached(fmea, other) for other in faults if other != mode)


def _leaks(
    sheet: ParsedFmea,
    fmea: Fmea,
    situations: Sequence[Situation],
    causes: _Causes,
    explained: Collection[Pair],
) -> Iterator[Proposal]:
    named = _named_symptoms(sheet)
    for symptom, of in fmea.symptoms.items():
        node = named.get(symptom)
        if of.condition is not None and node is None:
            continue  # written out at its mode: it has no entry
        count = _Count()
        for one in situations:
            seen = one.seen.get(symptom)
            is_new = any((fault, symptom) in explained for fault in one.faults)
            if seen is not None and not is_new and not causes.explain(symptom, one.faults):
                count.take(seen, one.name if seen.present else "")
        now = of.leak
        if count.there < 2 or not now:
            continue
        new = (HALF + count.there) / (HALF / now + count.of)
        if new / now - 1 >= _RATE_MOVED:
            reason = (
                f"there without a cause in {count.there} of {count.of} situations"
                f"{f' ({count.where})' if count.where else ''}; {now:g} counts as half a false "
                f"alarm in {HALF / now:.3g}"
            )
            yield Proposal("leak", "", symptom, f"{now:g}", f"{new:.2g}", reason, node)


def _named_symptoms(sheet: ParsedFmea) -> dict[str, Node]:
    """Return the entries of symptoms in the file, by id."""
    top = child_node(sheet.root, "symptoms")
    found = {name: child_node(top, name) for name in sheet.symptoms}
    for part in sheet.parts:
        for name in part.symptoms:
            place = child_node(part.node, "symptoms", name)
            found[name if "/" in name else f"{part.component}.{name}"] = place
    return found
