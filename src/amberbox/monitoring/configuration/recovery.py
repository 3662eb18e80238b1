"""``recovery_config.yaml`` of the predecessor: what to restart when; shown, not carried out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from amberbox.core.config import build, did_you_mean
from amberbox.core.errors import Problem
from amberbox.core.nodes import Node
from amberbox.monitoring.configuration.dependencies import Named, Names, outputs_of
from amberbox.monitoring.configuration.files import RecoveryOptions


def with_recovery(
    root: Node | None, components: Sequence[Named], problems: list[Problem]
) -> list[Named]:
    """Return the components with what would be restarted; tell what is wrong with the entries."""
    if root is None or root.value is None:
        return list(components)
    if root.mapping is None:
        problems.append(root.problem("file", f"expected components, got {root.kind}"))
        return list(components)
    names = Names(components)
    actions: dict[str, str] = {}
    for name, node in root.mapping.items():
        options = build(RecoveryOptions, node, problems, name)
        if options is not None:
            problems.extend(_entry_problems(name, options, node, names))
            actions[name] = _in_words(options)
    what = f"{len(root.mapping)} recovery actions are shown, not carried out"
    problems.append(root.problem("file", what, is_error=False))
    return [_with_action(entry, actions) for entry in components]


def _with_action(entry: Named, actions: Mapping[str, str]) -> Named:
    action = actions.get(entry.plan.name) or actions.get(entry.plan.id)
    if action is None:
        return entry
    shown = (*entry.plan.recovery_actions, action)
    return replace(entry, plan=replace(entry.plan, recovery_actions=shown))


def _in_words(options: RecoveryOptions) -> str:
    how = f" ({options.component_type})" if options.component_type else ""
    told = f"{options.monitor}/{options.monitored_parameter}".rstrip("/")
    what = f"restart {options.restart}{how}" if options.restart else "restart"
    return f"{what} when {told} tells a fault"


def _entry_problems(
    name: str, options: RecoveryOptions, node: Node, names: Names
) -> Iterator[Problem]:
    if names.component(name) is None:
        yield node.problem(name, f"there is no component '{name}'{names.near(name)}")
    keys = node.mapping or {}
    judge = names.judge(options.monitor)
    if isinstance(judge, str):
        yield keys["monitor"].problem(f"{name}.monitor", judge)
        return
    wanted, outputs = options.monitored_parameter, outputs_of(judge.mode)
    if wanted and wanted not in outputs:
        what = f"{options.monitor} has no output '{wanted}'{did_you_mean(wanted, outputs)}"
        yield keys["monitored_parameter"].problem(f"{name}.monitored_parameter", what)
