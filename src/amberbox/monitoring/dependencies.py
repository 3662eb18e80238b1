"""Dependencies between components as files state them: needs, ``part_of``, recovery actions.

The restarts of the predecessor's ``recovery_config.yaml`` become recovery actions of components.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from amberbox.core.config import build
from amberbox.core.errors import Problem, did_you_mean
from amberbox.core.needs import Needs, all_of, parse_needs
from amberbox.core.yaml_nodes import Node
from amberbox.monitoring.component_files import ComponentFileOptions, RecoveryOptions
from amberbox.monitoring.plan import ComponentPlan, DependencyPlan, ModePlan

NO_MODE = "none"
_KEY = "dependencies"


@dataclass(frozen=True)
class Dependencies:
    """The needs of a component by its file: the node of each name, and how many are needed.

    ``needs`` is None where all are needed.
    """

    nodes: Mapping[str, Node] = field(default_factory=dict)
    needs: Needs | None = None


@dataclass(frozen=True)
class ComponentEntry:
    """A component with its file, and the names that its modes go by."""

    plan: ComponentPlan
    file: ComponentFileOptions | None
    node: Node
    stems: tuple[str, ...] = ()
    dependencies: Dependencies = Dependencies()


def read_dependencies(file: Node, problems: list[Problem]) -> Dependencies | None:
    """Read the dependencies of a component file; None if something is wrong with them."""
    node = (file.mapping or {}).get(_KEY)
    if node is None:
        return Dependencies()
    if node.items is not None and all(_is_name(entry) for entry in node.items):
        return Dependencies(_by_name(node))
    if _is_name(node):
        what = f"expected a list, got {node.kind} '{node.text}'"
        problems.append(node.problem(_KEY, what, f"write it as a list: [{node.text}]"))
        return None
    needs = parse_needs(node, problems, _KEY)
    if needs is None:
        return None
    needs_all = needs == all_of(*needs.names())
    return Dependencies(_by_name(node), None if needs_all else needs)


def _is_name(node: Node) -> bool:
    return node.mapping is None and node.items is None and node.value is not None


def _by_name(node: Node) -> dict[str, Node]:
    """Return the names in order, each with the node of its first entry."""
    found: dict[str, Node] = {}
    for entry in _names_in(node):
        found.setdefault(entry.text, entry)
    return found


def _names_in(node: Node) -> Iterator[Node]:
    for key, value in (node.mapping or {}).items():
        if key != "at_least":
            yield from _names_in(value)
    for entry in node.items or ():
        if _is_name(entry):
            yield entry
        else:
            yield from _names_in(entry)


@dataclass(frozen=True)
class MonitorReference:
    """A reference to a mode that gives the state of a dependency, or to an output of it."""

    component: ComponentPlan
    mode: ModePlan
    output: str = ""


class ComponentNames:
    """Components and modes by the names used in files."""

    def __init__(self, components: Sequence[ComponentEntry]) -> None:
        self._components = {entry.plan.name: entry for entry in components}
        self._components |= {entry.plan.id: entry for entry in components}

    def component(self, name: str) -> ComponentPlan | None:
        """Return a component by its name or id."""
        entry = self._components.get(name)
        return entry.plan if entry else None

    def near(self, name: str) -> str:
        """Suggest a component."""
        return did_you_mean(name, self._components)

    def judge(self, text: str) -> MonitorReference | str:
        """Return the monitor of ``COMPONENT/MODE`` or ``COMPONENT/MODE/OUTPUT``, or the problem."""
        parts = text.split("/")
        if len(parts) not in (2, 3):
            return f"'{text}' is no monitor: write COMPONENT/MODE, or none"
        entry = self._components.get(parts[0])
        if entry is None:
            return f"there is no component '{parts[0]}'{self.near(parts[0])}"
        modes = dict(zip(entry.stems, entry.plan.modes, strict=True))
        modes |= {mode.id: mode for mode in entry.plan.modes}
        modes |= {mode.name: mode for mode in entry.plan.modes}
        mode = modes.get(parts[1])
        if mode is None:
            return f"{entry.plan.id} has no mode '{parts[1]}'{did_you_mean(parts[1], modes)}"
        outputs = [output.name for output in mode.outputs]
        if len(parts) == 3 and parts[2] not in outputs:
            near = did_you_mean(parts[2], outputs)
            return f"{parts[0]}/{parts[1]} has no output '{parts[2]}'{near}"
        return MonitorReference(entry.plan, mode, parts[2] if len(parts) == 3 else "")


def with_dependencies(
    components: Sequence[ComponentEntry], problems: list[Problem]
) -> list[ComponentPlan]:
    """Return the components with their edges; report unknown names and cycles."""
    names = ComponentNames(components)
    plans = [
        replace(
            entry.plan,
            dependencies=tuple(_edges(entry, names, problems)),
            needs=entry.dependencies.needs,
        )
        for entry in components
    ]
    # Remove the edge that closes each cycle, and report it; one that a mode judges may stay.
    nodes = {entry.plan.id: entry.node for entry in components}
    by_id = {plan.id: plan for plan in plans}
    for cycle in _cycles(
        {
            plan.id: [t for edge in plan.dependencies for t in _targets(edge, by_id)]
            for plan in plans
        }
    ):
        last, first = cycle[-1], cycle[0]
        what = f"needs itself: {' -> '.join((*cycle, first))}"
        node = (nodes[last].mapping or {}).get("dependencies", nodes[last])
        problems.append(node.problem("dependencies", what))
        edges = tuple(
            replace(edge, component=None, mode="", output="", problem=what)
            if first in _targets(edge, by_id) and edge.judged and not edge.mode
            else edge
            for edge in by_id[last].dependencies
        )
        by_id[last] = replace(by_id[last], dependencies=edges)
    return [by_id[plan.id] for plan in plans]


def _edges(
    entry: ComponentEntry, names: ComponentNames, problems: list[Problem]
) -> Iterator[DependencyPlan]:
    if entry.file is None:
        return
    monitors = entry.file.dependency_monitors
    by_kind = {"heartbeat": monitors.heartbeat, "functional": monitors.functional}
    nodes = entry.dependencies.nodes
    for name in nodes:
        judged = [(kind, of[name]) for kind, of in by_kind.items() if name in of]
        if not judged:
            yield _plain_edge(name, nodes[name], names, problems)
        for kind, text in judged:
            yield _Edge(name, kind, _place(entry.node, kind, name), names, problems).made(text)
    for kind, of in by_kind.items():
        for name in of:
            if name not in nodes:
                place, where = _place(entry.node, kind, name), f"dependency_monitors.{kind}.{name}"
                what = f"'{name}' is not among the dependencies{did_you_mean(name, nodes)}"
                problems.append(place.problem(where, what))


def _place(node: Node, *keys: str) -> Node:
    for key in ("dependency_monitors", *keys):
        node = (node.mapping or {}).get(key, node)
    return node


def _plain_edge(
    name: str, node: Node, names: ComponentNames, problems: list[Problem]
) -> DependencyPlan:
    component = names.component(name)
    if component is not None:
        return DependencyPlan(name, "", component.id)
    what = f"there is no component '{name}'{names.near(name)}"
    problems.append(node.problem("dependencies", what, "write its file, or take it out"))
    return DependencyPlan(name, problem=what)


@dataclass(frozen=True)
class _Edge:
    """One dependency with a monitor."""

    name: str
    kind: str
    node: Node
    names: ComponentNames
    problems: list[Problem]

    def made(self, text: str) -> DependencyPlan:
        """Return the edge: its state is given by an output, a mode, the component, or nothing."""
        component = self.names.component(self.name)
        edge = DependencyPlan(self.name, self.kind, component.id if component else None)  # type: ignore[arg-type]  # kinds are keys of the file
        if text == NO_MODE:
            self._note_missing(component, "nobody judges it")
            return replace(edge, judged=False)
        judge = self.names.judge(text)
        if isinstance(judge, str):
            self._report(judge)
            return edge if component else replace(edge, problem=judge)
        output = judge.output or self._output_of(judge)
        if output is None:
            outputs = [output.name for output in judge.mode.outputs]
            what = f"{text} has no output '{self.name}'{did_you_mean(self.name, outputs)}"
            self._report(what, f"write {text}/OUTPUT; outputs: {', '.join(outputs)}")
            return edge if edge.component else replace(edge, problem=what)
        shown = f"{text}/{output}" if output and not judge.output else text
        self._note_missing(component, f"{shown} speaks for it")
        return replace(edge, component=judge.component.id, mode=judge.mode.id, output=output)

    def _output_of(self, judge: MonitorReference) -> str | None:
        """Return the output of the dependency's name, '' for the whole mode, None for neither."""
        outputs = [output.name for output in judge.mode.outputs]
        if self.name in outputs:
            return self.name
        is_its_own = judge.component is self.names.component(self.name)
        return "" if is_its_own or len(outputs) <= 1 else None

    def _note_missing(self, component: ComponentPlan | None, but: str) -> None:
        if component is None:
            what = f"there is no component '{self.name}': {but}{self.names.near(self.name)}"
            self._report(what, is_error=False)

    def _report(self, what: str, hint: str = "", *, is_error: bool = True) -> None:
        where = f"dependency_monitors.{self.kind}.{self.name}"
        self.problems.append(self.node.problem(where, what, hint, is_error=is_error))


def _targets(edge: DependencyPlan, by_id: Mapping[str, ComponentPlan]) -> list[str]:
    """Return the component that an edge leads to, if it is the component itself that counts."""
    if edge.component is not None and not edge.mode and edge.component in by_id:
        return [edge.component]
    return [plan.id for plan in by_id.values() if edge.name in (plan.id, plan.name)]


def _cycles(graph: Mapping[str, Sequence[str]]) -> Iterator[tuple[str, ...]]:
    """Yield the path from where each back edge leads to where it begins (depth first)."""
    done: set[str] = set()
    for start in graph:
        if start in done:
            continue
        path: list[str] = [start]
        waiting = [iter(graph[start])]
        while waiting:
            target = next(waiting[-1], None)
            if target is None:
                waiting.pop()
                done.add(path.pop())
            elif target in path:
                yield tuple(path[path.index(target) :])
            elif target not in done and target in graph:
                path.append(target)
                waiting.append(iter(graph[target]))


def part_problems(components: Sequence[ComponentEntry]) -> Iterator[Problem]:
    """Yield the problems of the tree: ``part_of`` unknown components, and cycles."""
    above = {entry.plan.id: entry.plan.part_of for entry in components}
    for entry in components:
        place = (entry.node.mapping or {}).get("part_of", entry.node)
        wanted = entry.plan.part_of
        if wanted and wanted not in above:
            what = f"there is no component '{wanted}'{did_you_mean(wanted, above)}"
            yield place.problem("part_of", what)
        elif wanted and entry.plan.id in _all_above(entry.plan.id, above):
            yield place.problem("part_of", f"{entry.plan.id} is a part of itself")


def _all_above(name: str, above: Mapping[str, str]) -> list[str]:
    found: list[str] = []
    while (name := above.get(name, "")) and name not in found:
        found.append(name)
    return found


def with_recovery(
    root: Node | None, components: Sequence[ComponentEntry], problems: list[Problem]
) -> list[ComponentEntry]:
    """Return the components with their recovery actions; report invalid entries."""
    if root is None or root.value is None:
        return list(components)
    if root.mapping is None:
        problems.append(root.problem("file", f"expected components, got {root.kind}"))
        return list(components)
    names = ComponentNames(components)
    restarts: dict[str, RecoveryOptions] = {}
    for name, node in root.mapping.items():
        options = build(RecoveryOptions, node, problems, name)
        if options is not None:
            problems.extend(_entry_problems(name, options, node, names))
            restarts[name] = options
    what = (
        f"{len(root.mapping)} restarts become recovery actions; nothing carries them out by itself"
    )
    problems.append(root.problem("file", what, is_error=False))
    return [_with_restart(entry, restarts) for entry in components]


def _with_restart(entry: ComponentEntry, restarts: Mapping[str, RecoveryOptions]) -> ComponentEntry:
    plan = entry.plan
    options = restarts.get(plan.name) or restarts.get(plan.id)
    if options is None:
        return entry
    text = _in_words(options)
    units = {**plan.restart_units, text: options.restart}
    shown = (*plan.recovery_actions, text)
    return replace(entry, plan=replace(plan, recovery_actions=shown, restart_units=units))


def _in_words(options: RecoveryOptions) -> str:
    how = f" ({options.component_type})" if options.component_type else ""
    monitor = f"{options.monitor}/{options.monitored_parameter}".rstrip("/")
    what = f"restart {options.restart}{how}" if options.restart else "restart"
    return f"{what} when {monitor} tells a fault"


def _entry_problems(
    name: str, options: RecoveryOptions, node: Node, names: ComponentNames
) -> Iterator[Problem]:
    if names.component(name) is None:
        yield node.problem(name, f"there is no component '{name}'{names.near(name)}")
    keys = node.mapping or {}
    judge = names.judge(options.monitor)
    if isinstance(judge, str):
        yield keys["monitor"].problem(f"{name}.monitor", judge)
        return
    wanted, outputs = options.monitored_parameter, [output.name for output in judge.mode.outputs]
    if wanted and wanted not in outputs:
        what = f"{options.monitor} has no output '{wanted}'{did_you_mean(wanted, outputs)}"
        yield keys["monitored_parameter"].problem(f"{name}.monitored_parameter", what)
