"""The causal graph of an explanation: causes, paths over lost functions, symptoms in words."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis, Symptom
from amberbox.diagnosis.covering.hypotheses import NO_FAULT
from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.fmea.findings import causes_of
from amberbox.diagnosis.fmea.model import DependencyStructure, Fmea, SymptomLink
from amberbox.diagnosis.report.explanation import (
    CausalGraph,
    CausalPath,
    GraphEdge,
    GraphNode,
    NodeMark,
    SeenSymptom,
)
from amberbox.diagnosis.report.wording import (
    FALSE_ALARM,
    NS,
    WORTH_SHOWING,
    FaultNames,
    clock,
    sort_modes,
)


@dataclass(frozen=True, slots=True)
class LostFunctions:
    """Functions and components lost with a set of faults, and along which path."""

    structure: DependencyStructure
    down: frozenset[str]
    lost: frozenset[str]

    @classmethod
    def of(
        cls, fmea: Fmea, structure: DependencyStructure, faults: Collection[str]
    ) -> LostFunctions:
        """Take the components down that the faults take down, and all that falls with them."""
        modes = [fmea.modes[fault] for fault in faults if fault in fmea.modes]
        down = frozenset(mode.component for mode in modes if mode.takes_down)
        return cls(structure, down, structure.lost(down))

    def origins(self, name: str) -> tuple[str, ...]:
        """Return the components whose failure is necessary for a loss.

        If any of several would be sufficient alone, all of them that lead to the loss are returned.
        """
        leading = [start for start in sorted(self.down) if self.path(start, name)]
        decisive = [
            start for start in leading if name not in self.structure.lost(self.down - {start})
        ]
        return tuple(decisive or leading)

    def path(self, start: str, end: str) -> tuple[str, ...]:
        """Return the shortest path from a component to a lost function, both included, else ()."""
        came_from = {start: ""}
        waiting = deque([start])
        while waiting and end not in came_from:
            name = waiting.popleft()
            for user in self.structure.users.get(name, ()):
                if user in self.lost and user not in came_from:
                    came_from[user] = name
                    waiting.append(user)
        return _back(came_from, end) if end in came_from else ()


def _back(came_from: dict[str, str], end: str) -> tuple[str, ...]:
    way = [end]
    while came_from[way[-1]]:
        way.append(came_from[way[-1]])
    return tuple(reversed(way))


@dataclass(frozen=True, slots=True)
class CausalPaths:
    """Finds how a set of faults shows a symptom."""

    names: FaultNames
    structure: DependencyStructure

    @classmethod
    def of(cls, names: FaultNames) -> CausalPaths:
        """Turn the needs of an FMEA round, once."""
        return cls(names, DependencyStructure.of(names.fmea.needs()))

    def losses(self, faults: Collection[str]) -> LostFunctions:
        """Return the functions and components that the faults take out of service."""
        return LostFunctions.of(self.names.fmea, self.structure, faults)

    def to(self, symptom: str, faults: Collection[str]) -> tuple[CausalPath, ...]:
        """Return every way, direct ones first."""
        return (*self._direct(symptom, faults), *self._by_loss(symptom, faults))

    def _direct(self, symptom: str, faults: Collection[str]) -> Iterator[CausalPath]:
        found = causes_of(self.names.fmea, symptom)
        for fault in sort_modes(faults):
            if fault == UNKNOWN:
                other = self.names.fmea.other.detects
                yield CausalPath(fault, (), f"{self.names.mode(fault)} can show anywhere", other)
            mode = self.names.fmea.modes.get(fault)
            link = _link(mode.symptoms if mode else (), symptom)
            if link is not None:
                yield CausalPath(fault, (), self.names.mode(fault), link.detects)
            elif fault in found:
                yield CausalPath(fault, (), self.names.mode(fault), found[fault])

    def _by_loss(self, symptom: str, faults: Collection[str]) -> Iterator[CausalPath]:
        losses = self.losses(faults)
        functions = self.names.fmea.functions
        for name in sorted(losses.lost & functions.keys()):
            link = _link(functions[name].symptoms, symptom)
            if link is None:
                continue
            for origin in losses.origins(name):
                yield from self._along(losses.path(origin, name), faults, link.detects)

    def _along(
        self, path: tuple[str, ...], faults: Collection[str], detects: float
    ) -> Iterator[CausalPath]:
        text = " -> ".join(self.names.part(name) for name in path)
        for fault in sort_modes(faults):
            mode = self.names.fmea.modes.get(fault)
            if mode is not None and mode.takes_down and mode.component == path[0]:
                yield CausalPath(fault, path, text, detects)


def _link(links: Collection[SymptomLink], symptom: str) -> SymptomLink | None:
    return next((link for link in links if link.symptom == symptom), None)


@dataclass(frozen=True, slots=True)
class SymptomDescriptions:
    """Describes symptoms: the observations of each, and how faults cause it."""

    names: FaultNames
    paths: CausalPaths
    found: Mapping[str, tuple[Symptom, ...]]
    first_ns: int | None
    weights: Mapping[str, float]

    @classmethod
    def of(
        cls, names: FaultNames, diagnosis: Diagnosis, symptoms: Iterable[Symptom],
        weights: Mapping[str, float],
    ) -> SymptomDescriptions:  # fmt: skip
        """Sort findings by symptom; time counts from the first symptom of the diagnosis."""
        found: dict[str, list[Symptom]] = {}
        for symptom in symptoms:
            if symptom.state == "present":
                found.setdefault(symptom.id, []).append(symptom)
        known = {name: tuple(sorted(of, key=_order)) for name, of in found.items()}
        counted = {name for h in diagnosis.hypotheses for name in (*h.explains, *h.unexplained)}
        named = counted | set(diagnosis.symptoms)
        onsets = [s.onset_ns for n in named for s in known.get(n, ()) if s.onset_ns is not None]
        return cls(names, CausalPaths.of(names), known, min(onsets, default=None), weights)

    def seen(self, symptom_id: str, hypotheses: Sequence[Hypothesis]) -> SeenSymptom:
        """Describe a symptom with the ways in which any of the hypotheses shows it."""
        found = self.found.get(symptom_id, ())
        paths: dict[CausalPath, None] = {}
        for hypothesis in hypotheses:
            paths.update(dict.fromkeys(self.paths.to(symptom_id, hypothesis.faults)))
        onset = found[0].onset_ns if found else None
        reason = next((s.reason for s in found if s.reason), "")
        return SeenSymptom(
            symptom_id,
            self.names.symptom(symptom_id, reason),
            next((s.address for s in found if s.address), symptom_id),
            onset,
            None if onset is None or self.first_ns is None else (onset - self.first_ns) / NS,
            tuple(dict.fromkeys(address for s in found for address, _, _ in s.evidence)),
            tuple(paths),
            reason,
            _gone_ns(found),
            self.weights.get(symptom_id, 0.0),
        )

    def in_time(
        self, symptoms: Iterable[str], hypotheses: Sequence[Hypothesis]
    ) -> tuple[SeenSymptom, ...]:
        """Describe symptoms in order of onset, those without a time last."""
        seen = [self.seen(name, hypotheses) for name in dict.fromkeys(symptoms)]
        return tuple(sorted(seen, key=lambda s: (s.onset_ns is None, s.onset_ns or 0, s.id)))

    def worst_first(
        self, symptoms: Iterable[str], hypotheses: Sequence[Hypothesis]
    ) -> tuple[SeenSymptom, ...]:
        """Describe symptoms: present ones first, then in order of importance."""
        seen = self.in_time(symptoms, hypotheses)
        return tuple(sorted(seen, key=lambda s: (s.gone_ns is not None, -round(s.weight, 6))))


def _gone_ns(found: Iterable[Symptom]) -> int | None:
    """Return when the last observation of a symptom disappeared, None if one is still present."""
    ends = [symptom.gone_ns for symptom in found]
    known = [end_ns for end_ns in ends if end_ns is not None]
    return max(known) if known and len(known) == len(ends) else None


def _order(symptom: Symptom) -> tuple[bool, int, str]:
    return (symptom.onset_ns is None, symptom.onset_ns or 0, symptom.source)


CAUSES = 12
SYMPTOMS = 30

Groups = Sequence[tuple[AmbiguityGroup, Sequence[Hypothesis]]]


def build_causal_graph(descriptions: SymptomDescriptions, groups: Groups) -> CausalGraph:
    """Return the boxes and arrows of the leading groups; at most 12 causes and 30 symptoms."""
    leading = list(groups[0][1]) if groups else []
    others = (members for group, members in groups[1:] if group.probability >= WORTH_SHOWING)
    hypotheses = [*leading, *(hypothesis for members in others for hypothesis in members)]
    marks = _marks(leading, hypotheses)
    causes, symptoms = _causes(hypotheses), _in_time(descriptions, marks)
    shown_causes, shown = causes[:CAUSES], symptoms[:SYMPTOMS]
    edges = _edges(descriptions, hypotheses, leading, shown_causes, shown)
    lost = dict.fromkeys(n for e in edges for n in (e.start, e.end) if n.startswith("lost:"))
    nodes = (
        *(_cause(descriptions, name, hypotheses, leading) for name in shown_causes),
        *(_loss(descriptions, node) for node in lost),
        *(_symptom(descriptions, name, marks[name]) for name in shown),
    )
    return CausalGraph(nodes, edges, len(causes) - len(shown_causes), len(symptoms) - len(shown))


def _causes(hypotheses: Sequence[Hypothesis]) -> list[str]:
    """Return the failure modes, those of the leading hypotheses first."""
    named = (sort_modes(hypothesis.faults) or [NO_FAULT] for hypothesis in hypotheses)
    return list(dict.fromkeys(fault for faults in named for fault in faults))


def _marks(leading: Sequence[Hypothesis], hypotheses: Sequence[Hypothesis]) -> dict[str, NodeMark]:
    """Return the symptoms with their marks: explained, unexplained, or expected but absent."""
    marks: dict[str, NodeMark] = {name: "present" for h in leading for name in h.explains}
    for hypothesis in (*leading, *hypotheses):
        for name in (*hypothesis.unexplained, *hypothesis.explains):
            marks.setdefault(name, "unexplained")
    for hypothesis in leading:
        for name in hypothesis.contradicted:
            marks.setdefault(name, "contradicted")
    return marks


def _in_time(descriptions: SymptomDescriptions, marks: Mapping[str, NodeMark]) -> list[str]:
    """Put symptoms in order of onset, absent ones last."""
    seen = descriptions.in_time(
        (name for name, mark in marks.items() if mark != "contradicted"), ()
    )
    missing = (name for name, mark in marks.items() if mark == "contradicted")
    return [*(symptom.id for symptom in seen), *missing]


def _cause(
    descriptions: SymptomDescriptions,
    name: str,
    hypotheses: Sequence[Hypothesis],
    leading: Sequence[Hypothesis],
) -> GraphNode:
    has = [h for h in hypotheses if name in h.faults or (name == NO_FAULT and not h.faults)]
    text = FALSE_ALARM if name == NO_FAULT else descriptions.names.mode(name)
    mark: NodeMark = "leading" if any(h in leading for h in has) else ""
    probability = min(1.0, sum(h.probability for h in has))
    small = name if name in descriptions.names.fmea.modes else ""
    return GraphNode(f"cause:{name}", "cause", text, small, mark, probability)


def _loss(descriptions: SymptomDescriptions, node: str) -> GraphNode:
    name = node.removeprefix("lost:")
    return GraphNode(node, "lost", descriptions.names.part(name), name)


def _symptom(descriptions: SymptomDescriptions, name: str, mark: NodeMark) -> GraphNode:
    seen = descriptions.seen(name, ())
    since = "" if seen.onset_ns is None else f"{clock(seen.onset_ns)}  "
    return GraphNode(f"symptom:{name}", "symptom", seen.text, f"{since}{seen.address}", mark)


def _edges(
    descriptions: SymptomDescriptions,
    hypotheses: Sequence[Hypothesis],
    leading: Sequence[Hypothesis],
    causes: Sequence[str],
    symptoms: Sequence[str],
) -> tuple[GraphEdge, ...]:
    """Return every arrow once; those of leading hypotheses are marked."""
    edges: dict[tuple[str, str], GraphEdge] = {}
    for hypothesis in sorted(hypotheses, key=lambda h: h not in leading):
        leads = hypothesis in leading
        shows = dict.fromkeys(hypothesis.explains, False)
        shows |= dict.fromkeys(hypothesis.contradicted if leads else (), True)
        for symptom, missing in shows.items():
            for way in (
                descriptions.paths.to(symptom, hypothesis.faults) if symptom in symptoms else ()
            ):
                for edge in _along(way, symptom, missing, leads) if way.fault in causes else ():
                    edges.setdefault((edge.start, edge.end), edge)
    return tuple(edges.values())


def _along(way: CausalPath, symptom: str, missing: bool, leads: bool) -> Iterator[GraphEdge]:
    stops = [f"cause:{way.fault}", *(f"lost:{name}" for name in way.via), f"symptom:{symptom}"]
    for place, start in enumerate(stops[:-1]):
        last = place == len(stops) - 2
        yield GraphEdge(start, stops[place + 1], missing and last, leads)
