"""The tree of a robot's components: each with its modes, outputs, ages and what it needs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from amberbox.core.clock import NS
from amberbox.fleet.services.status import Known
from amberbox.fleet.state.facts import ComponentFacts, Facts, OutputFacts
from amberbox.fleet.state.said import SaidOutput
from amberbox.fleet.state.standing import Moment, Standing
from amberbox.fleet.state.views import (
    Component,
    Condition,
    Mode,
    Need,
    Output,
    StatusTree,
)

_NOTHING = OutputFacts("")


def status_tree(known: Known, facts: Facts) -> StatusTree:
    """Put statuses and what the folder says into a tree; what is in no folder stands at the end."""
    by_name: dict[str, list[Standing]] = {}
    for status in known.statuses:
        by_name.setdefault(status.said.component, []).append(status)
    planned = {component.id for component in facts.components}
    extra = [ComponentFacts(name, name) for name in by_name if name not in planned]
    levels = {(s.said.component, s.said.mode): s.said.level for s in known.statuses}
    components = [
        _component(one, by_name.get(one.id, ()), levels, known.when)
        for one in (*facts.components, *extra)
    ]
    offset_ns = known.when.offset_ns
    offset_s = None if offset_ns is None else round(offset_ns / NS, 6)
    return StatusTree(
        known.robot.id, known.link is not None, known.silence, facts.note, offset_s, components,
        known.status,
    )  # fmt: skip


def _component(
    facts: ComponentFacts,
    statuses: Sequence[Standing],
    levels: Mapping[tuple[str, str], str],
    when: Moment,
) -> Component:
    own = next((status for status in statuses if not status.said.mode), None)
    needs = [
        Need(need.name, need.component, levels.get((need.component, need.mode), "unknown"))
        for need in facts.needs
    ]
    return Component(
        facts.id, facts.name, facts.depth, facts.description, facts.part_of, needs, facts.rule,
        facts.recovery_actions, None if own is None else _condition(own, when),
        [_mode(status, facts, when) for status in statuses if status.said.mode],
    )  # fmt: skip


def _condition(status: Standing, when: Moment) -> Condition:
    said = status.said
    for_s = max(said.measured_ns - said.since_ns, 0) / NS if said.since_ns else 0.0
    return Condition(
        said.level, said.state, said.reason, said.blocked_by, when.at(said.measured_ns),
        when.at(said.since_ns), round(when.age_ns(status) / NS, 3), round(for_s, 3),
    )  # fmt: skip


def _mode(status: Standing, facts: ComponentFacts, when: Moment) -> Mode:
    mode = status.said.mode
    planned = {output.name: output for output in facts.outputs.get(mode, ())}
    outputs = [_output(said, planned.get(said.name, _NOTHING)) for said in status.said.outputs]
    return Mode(mode, facts.names.get(mode, mode), _condition(status, when), outputs)


def _output(said: SaidOutput, facts: OutputFacts) -> Output:
    return Output(
        said.name,
        said.type,
        said.shown,
        facts.expected,
        facts.severity,
        facts.description,
        facts.unit,
    )
