"""``recovery_config.yaml`` of the predecessor: what to restart when; shown, not carried out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from amberbox.core.config import build, did_you_mean
from amberbox.core.errors import Problem
from amberbox.core.nodes import Node
from amberbox.monitoring.configuration.dependencies import Named, Names, outputs_of
from amberbox.monitoring.configuration.files import RecoveryOptions


def recovery_problems(root: Node | None, components: Sequence[Named]) -> list[Problem]:
    """Return what is wrong with the entries, and a note that nobody acts on them."""
    problems: list[Problem] = []
    if root is None or root.value is None:
        return problems
    if root.mapping is None:
        problems.append(root.problem("file", f"expected components, got {root.kind}"))
        return problems
    names = Names(components)
    for name, node in root.mapping.items():
        options = build(RecoveryOptions, node, problems, name)
        if options is not None:
            problems.extend(_entry_problems(name, options, node, names))
    what = f"{len(root.mapping)} recovery actions are shown, not carried out"
    problems.append(root.problem("file", what, is_error=False))
    return problems


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
