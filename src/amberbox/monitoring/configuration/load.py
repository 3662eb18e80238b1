"""From the files of a robot folder to the plan that the engine runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from amberbox.blackbox.folder.folder import RobotFolder
from amberbox.core.config import build
from amberbox.core.errors import Problem
from amberbox.core.ids import derive_id
from amberbox.monitoring.configuration.dependencies import (
    Named,
    read_dependencies,
    with_dependencies,
)
from amberbox.monitoring.configuration.files import ComponentFile, legacy_note
from amberbox.monitoring.configuration.functions import find_functions
from amberbox.monitoring.configuration.inputs import Inputs
from amberbox.monitoring.configuration.modes import Bench, plan_mode
from amberbox.monitoring.configuration.parts import part_problems
from amberbox.monitoring.configuration.recorded import Recorded
from amberbox.monitoring.configuration.recovery import with_recovery
from amberbox.monitoring.configuration.tree import FOLDER, ComponentSource, Tree, read_tree
from amberbox.monitoring.plan import ComponentPlan, ModePlan, Plan

BROKEN = "configuration"
"""Name of the mode that stands in for those of a component file that cannot be read."""
_SHOWN = 12
"""So many items are named in a note."""


def load_plan(folder: RobotFolder, *, own: bool = True) -> tuple[Plan, list[Problem]]:
    """Return what is to be monitored of a robot, and all that is wrong with its files.

    What cannot run stays in the plan with its problem, so that its status is ``unknown``. Opens
    no device and no socket; raises nothing for files that are wrong. Without ``own``, monitors and
    probes that the folder brings along are not imported: their modes cannot run, but have outputs.
    """
    problems: list[Problem] = []
    tree = read_tree(folder.path / FOLDER, problems)
    plan = Plan(folder.robot.id, folder.config_hash)
    if not tree.components and not tree.unlisted and tree.recovery is None:
        return plan, problems
    functions = find_functions(folder.path, own=own)
    bench = Bench(functions, Inputs(Recorded(folder), functions), folder.robot, problems)
    components = _components(tree, bench)
    for mode in tree.unlisted:
        plan_mode(mode, bench)
    components = with_recovery(tree.recovery, components, problems)
    plans = with_dependencies(components, problems)
    problems.extend(part_problems(components))
    problems.extend(_not_known_yet(bench.inputs, folder))
    once = dict.fromkeys(problems)  # a mode file may be listed by many components
    told = sorted(once, key=lambda problem: (problem.file, problem.line))
    return replace(plan, components=tuple(plans)), told


def _components(tree: Tree, bench: Bench) -> list[Named]:
    """Make the plans of all component files; of two with one id the first one counts."""
    found: dict[str, Named] = {}
    for source in tree.components:
        entry = _component(source, bench)
        first = found.setdefault(entry.plan.id, entry)
        if first is not entry:
            what = f"there is another component '{entry.plan.id}' in {first.node.file}"
            bench.problems.append(source.node.problem("component_name", what))
    return list(found.values())


def _component(source: ComponentSource, bench: Bench) -> Named:
    own: list[Problem] = []
    file = build(ComponentFile, source.node, own, "", legacy_note)
    dependencies = read_dependencies(source.node, own)
    bench.problems.extend(own)
    modes = tuple(_modes(source, bench))
    plan = ComponentPlan(derive_id(source.name), source.name, modes, file=source.node.file)
    if plan.id != plan.name:
        what = f"is '{plan.id}' in addresses"
        problem = source.node.problem("component_name", what, is_error=False)
        bench.problems.append(problem)
    if file is None or dependencies is None:
        first = next(problem for problem in own if problem.is_error)
        what = f"{first.where}: {first.what} ({first.file}:{first.line})"
        broken = ModePlan(BROKEN, BROKEN, None, problem=what)
        stems = (*(mode.path.stem for mode in source.modes), BROKEN)
        return Named(replace(plan, modes=(*modes, broken)), None, source.node, stems)
    plan = replace(
        plan,
        policy=file.policy,
        part_of=derive_id(file.part_of) if file.part_of else "",
        description=file.description,
        recovery_actions=tuple(file.recovery_actions),
    )
    stems = tuple(mode.path.stem for mode in source.modes)
    return Named(plan, file, source.node, stems, dependencies)


def _modes(source: ComponentSource, bench: Bench) -> Iterator[ModePlan]:
    """Yield the plans of a component's modes; a name that is taken gets a number and a problem."""
    seen: dict[str, int] = {}
    for entry in source.modes:
        plan = plan_mode(entry, bench)
        seen[plan.id] = seen.get(plan.id, 0) + 1
        if seen[plan.id] > 1:
            what = f"{source.name} has several modes called '{plan.name}'"
            node = entry.node or source.node
            bench.problems.append((node.mapping or {}).get("name", node).problem("name", what))
            plan = replace(plan, id=f"{plan.id}_{seen[plan.id]}", problem=plan.problem or what)
        yield plan


def _not_known_yet(inputs: Inputs, folder: RobotFolder) -> Iterator[Problem]:
    names: Sequence[str] = sorted(inputs.unknown_items)
    if names:
        more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
        shown = f"{', '.join(names[:_SHOWN])}{more}"
        what = f"variables of {shown} are judged when they have been recorded"
        yield Problem(str(folder.path / FOLDER), 1, "inputs", what, is_error=False)
