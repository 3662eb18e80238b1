"""The graph of an explanation: causes, what they cost on the way, and what is seen."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from amberbox.core.types import AmbiguityGroup, Hypothesis
from amberbox.diagnosis.covering.answer import NO_FAULT
from amberbox.diagnosis.explanation.explanation import Edge, Graph, Mark, Node, Way
from amberbox.diagnosis.explanation.names import FALSE_ALARM, in_order
from amberbox.diagnosis.explanation.seen import Sights
from amberbox.diagnosis.explanation.words import WORTH_TELLING, clock

CAUSES = 12
SYMPTOMS = 30

Groups = Sequence[tuple[AmbiguityGroup, Sequence[Hypothesis]]]


def graph_of(sights: Sights, groups: Groups) -> Graph:
    """Return the boxes and arrows of the leading groups; at most 12 causes and 30 symptoms."""
    leading = list(groups[0][1]) if groups else []
    others = (members for group, members in groups[1:] if group.probability >= WORTH_TELLING)
    hypotheses = [*leading, *(hypothesis for members in others for hypothesis in members)]
    marks = _marks(leading, hypotheses)
    causes, symptoms = _causes(hypotheses), _in_time(sights, marks)
    shown_causes, shown = causes[:CAUSES], symptoms[:SYMPTOMS]
    edges = _edges(sights, hypotheses, leading, shown_causes, shown)
    lost = dict.fromkeys(n for e in edges for n in (e.start, e.end) if n.startswith("lost:"))
    nodes = (
        *(_cause(sights, name, hypotheses, leading) for name in shown_causes),
        *(_loss(sights, node) for node in lost),
        *(_symptom(sights, name, marks[name]) for name in shown),
    )
    return Graph(nodes, edges, len(causes) - len(shown_causes), len(symptoms) - len(shown))


def _causes(hypotheses: Sequence[Hypothesis]) -> list[str]:
    """Return the failure modes, those of the leading hypotheses first."""
    named = (in_order(hypothesis.faults) or [NO_FAULT] for hypothesis in hypotheses)
    return list(dict.fromkeys(fault for faults in named for fault in faults))


def _marks(leading: Sequence[Hypothesis], hypotheses: Sequence[Hypothesis]) -> dict[str, Mark]:
    """Return the symptoms: what is explained, what is not, what should show and does not."""
    marks: dict[str, Mark] = {name: "present" for h in leading for name in h.explains}
    for hypothesis in (*leading, *hypotheses):
        for name in (*hypothesis.unexplained, *hypothesis.explains):
            marks.setdefault(name, "unexplained")
    for hypothesis in leading:
        for name in hypothesis.contradicted:
            marks.setdefault(name, "contradicted")
    return marks


def _in_time(sights: Sights, marks: Mapping[str, Mark]) -> list[str]:
    """Put what is seen in order of onset, what does not show last."""
    seen = sights.in_time((name for name, mark in marks.items() if mark != "contradicted"), ())
    missing = (name for name, mark in marks.items() if mark == "contradicted")
    return [*(symptom.id for symptom in seen), *missing]


def _cause(
    sights: Sights, name: str, hypotheses: Sequence[Hypothesis], leading: Sequence[Hypothesis]
) -> Node:
    has = [h for h in hypotheses if name in h.faults or (name == NO_FAULT and not h.faults)]
    text = FALSE_ALARM if name == NO_FAULT else sights.names.mode(name)
    mark: Mark = "leading" if any(h in leading for h in has) else ""
    probability = min(1.0, sum(h.probability for h in has))
    small = name if name in sights.names.fmea.modes else ""
    return Node(f"cause:{name}", "cause", text, small, mark, probability)


def _loss(sights: Sights, node: str) -> Node:
    name = node.removeprefix("lost:")
    return Node(node, "lost", sights.names.part(name), name)


def _symptom(sights: Sights, name: str, mark: Mark) -> Node:
    seen = sights.seen(name, ())
    since = "" if seen.onset_ns is None else f"{clock(seen.onset_ns)}  "
    return Node(f"symptom:{name}", "symptom", seen.text, f"{since}{seen.address}", mark)


def _edges(
    sights: Sights,
    hypotheses: Sequence[Hypothesis],
    leading: Sequence[Hypothesis],
    causes: Sequence[str],
    symptoms: Sequence[str],
) -> tuple[Edge, ...]:
    """Return every arrow once; those of leading hypotheses are marked."""
    edges: dict[tuple[str, str], Edge] = {}
    for hypothesis in sorted(hypotheses, key=lambda h: h not in leading):
        leads = hypothesis in leading
        shows = dict.fromkeys(hypothesis.explains, False)
        shows |= dict.fromkeys(hypothesis.contradicted if leads else (), True)
        for symptom, missing in shows.items():
            for way in sights.ways.to(symptom, hypothesis.faults) if symptom in symptoms else ():
                for edge in _along(way, symptom, missing, leads) if way.fault in causes else ():
                    edges.setdefault((edge.start, edge.end), edge)
    return tuple(edges.values())


def _along(way: Way, symptom: str, missing: bool, leads: bool) -> Iterator[Edge]:
    stops = [f"cause:{way.fault}", *(f"lost:{name}" for name in way.via), f"symptom:{symptom}"]
    for place, start in enumerate(stops[:-1]):
        last = place == len(stops) - 2
        yield Edge(start, stops[place + 1], missing and last, leads)
