"""Load the plan of a robot folder: mode files are converted to plans, all problems are reported at
once.

A mode's function, arguments, inputs, outputs and states are resolved, and the sampling rate after
the filters is compared with the rate that the mode needs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import ModuleType
from typing import Any

from amberbox.blackbox.robot_folder.folder import RobotFolder
from amberbox.blackbox.robot_folder.robot_yaml import RobotConfig
from amberbox.core.config import build
from amberbox.core.contracts import ModeContract
from amberbox.core.errors import AmberboxError, ConfigurationError, Problem
from amberbox.core.expression import Expression
from amberbox.core.mode import Result
from amberbox.core.names import derive_id
from amberbox.core.yaml_nodes import Node
from amberbox.monitoring.component_files import (
    FOLDER,
    ComponentFileOptions,
    ComponentSource,
    MappingOptions,
    ModeFileOptions,
    ModeSource,
    MonitorFunctions,
    find_functions,
    function_of,
    legacy_note,
    read_tree,
    unknown_function,
)
from amberbox.monitoring.dependencies import (
    ComponentEntry,
    part_problems,
    read_dependencies,
    with_dependencies,
    with_recovery,
)
from amberbox.monitoring.legacy_mode_files import translate_mode_file
from amberbox.monitoring.mode_bindings import (
    InputBinder,
    InputError,
    bind_outputs,
    output_type,
    repeated,
)
from amberbox.monitoring.plan import (
    ComponentPlan,
    InputPlan,
    MappingPlan,
    ModePlan,
    MonitoringPlan,
    OutputPlan,
)
from amberbox.monitoring.recorded_items import RecordedItem, RecordedItems

_NEVER_KEPT = "none"
_LONG_S = 10.0  # longer windows are not compared with the rate of what was recorded
_PERIODS = 1.9  # two, less what a measured rate may be off
_SHORTEST_S = 0.1  # two instants of evaluation


def filter_problems(plan: ModePlan, node: Node, recorded: RecordedItems) -> Iterator[Problem]:
    """Yield problems where filters of ``black_box.yaml`` hide samples that a mode needs.

    Freshness, and monitors of whole items, go by the recorder's counts before any filter, so
    filters matter only to modes that use values over a time.
    """
    place = (node.mapping or {}).get("mappings", node)
    reported: set[str] = set()
    for mapping in plan.mappings:
        for entry in (*mapping.inputs, *mapping.reads):
            name = entry.item.partition("__")[0]
            item = recorded.by_name.get(name)
            found = [] if item is None else [*_complaints(plan, entry, item)]
            found = found or [(what, False) for what in _too_short(plan, entry, name, recorded)]
            for what, is_error in found:
                if what not in reported:
                    reported.add(what)
                    yield place.problem("mappings", what, is_error=is_error)


def _complaints(plan: ModePlan, entry: InputPlan, item: RecordedItem) -> Iterator[tuple[str, bool]]:
    mode, options = ModeContract.of(plan.module), item.options
    if options.keep == _NEVER_KEPT:
        yield f"{item.name} is not recorded (keep: none)", True
        return
    by_counts = mode.is_called_in_silence(plan.config) or entry.kind == "item"
    wanted_hz = wanted_rate_hz(plan.config)
    limit_hz = options.max_frequency
    if limit_hz is not None and wanted_hz is not None and wanted_hz > limit_hz:
        yield _too_slow(item, wanted_hz, limit_hz, by_counts), not by_counts
    if by_counts:
        return
    window_s = mode.looks_back_s(plan.config)
    if limit_hz is not None and 0 < window_s < 1 / limit_hz:
        yield (
            f"looks back over {window_s:g} s, but {item.name} keeps one row in "
            f"{1 / limit_hz:g} s (max_frequency)",
            True,
        )
    for key, thinned in (("change", options.change), ("transforms", options.transforms)):
        if thinned is not None and 0 < window_s < thinned.heartbeat_s:
            yield (
                f"looks back over {window_s:g} s, but while nothing changes {item.name} keeps one "
                f"row in {thinned.heartbeat_s:g} s ({key})",
                True,
            )


def _too_short(
    plan: ModePlan, entry: InputPlan, name: str, recorded: RecordedItems
) -> Iterator[str]:
    """Yield problems of windows too short for the item's rate, where that is known."""
    window_s = ModeContract.of(plan.module).shortest_window_s(plan.config)
    if entry.kind == "item" or not 0 < window_s < _LONG_S:
        return
    if window_s < _SHORTEST_S:
        yield (
            f"looks back over {window_s:g} s, but at most 20 times a second: samples between pass "
            f"unseen; make it {_SHORTEST_S:g} s or more"
        )
    rate_hz = recorded.rate_hz(name)
    if rate_hz is not None and window_s * rate_hz < _PERIODS:
        yield (
            f"looks back over {window_s:g} s, but {name} comes {rate_hz:.2g} times a second: what "
            f"changes between two samples may pass unseen; make it {2 / rate_hz:.2g} s or more"
        )


def _too_slow(item: RecordedItem, wanted_hz: float, limit_hz: float, by_counts: bool) -> str:
    what = f"expects {wanted_hz:g} Hz, {item.name} keeps at most {limit_hz:g} Hz (max_frequency)"
    return f"{what}: it counts what is received, not what is kept" if by_counts else what


def wanted_rate_hz(config: Any) -> float | None:
    """Return the rate that the arguments of a mode name, by their unit."""
    values = [
        getattr(config, field.name)
        for field in fields(config)
        if field.metadata.get("unit") == "Hz"
    ]
    each = (value.values() if isinstance(value, Mapping) else [value] for value in values)
    rates = (float(rate) for several in each for rate in several if rate is not None)
    return max(rates, default=None)


@dataclass(frozen=True)
class PlanContext:
    """The context in which plans of mode files are made."""

    functions: MonitorFunctions
    inputs: InputBinder
    robot: RobotConfig
    problems: list[Problem]
    folder: Path = Path()


def plan_mode(source: ModeSource, bench: PlanContext) -> ModePlan:
    """Make the plan of a mode file; the ``problem`` of one that cannot run is the reason."""
    given = ((source.node.mapping or {}) if source.node else {}).get("name")
    name = given.text.strip() if given is not None and given.text.strip() else source.path.stem
    plan = ModePlan(derive_id(name), name, None, problem=source.problem)
    if source.node is None:
        return plan if plan.problem else replace(plan, problem=f"{source.path} cannot be read")
    own = list(_renamed(plan, source.node))
    node = translate_mode_file(name, source.node, bench.functions, bench.robot.id, own)
    file = build(ModeFileOptions, node, own, "", legacy_note)
    made = _made(plan, file, node, bench, own) if file is not None else plan
    bench.problems.extend(own)
    first = next((problem for problem in own if problem.is_error), None)
    return made if first is None else replace(made, problem=made.problem or first.what)


def _made(
    plan: ModePlan, file: ModeFileOptions, node: Node, bench: PlanContext, problems: list[Problem]
) -> ModePlan:
    try:
        return _plan(plan, file, node, bench, problems)
    except (Exception, SystemExit) as error:  # a robot's own monitor may fail in any way
        what = f"its monitor crashed when it was asked: {type(error).__name__}: {error}"
        problems.append(_at(node, "monitor").problem("monitor", what))
        return plan


def _renamed(plan: ModePlan, node: Node) -> Iterator[Problem]:
    if plan.id != plan.name:
        yield _at(node, "name").problem("name", f"is '{plan.id}' in addresses", is_error=False)


def _plan(
    plan: ModePlan, file: ModeFileOptions, node: Node, bench: PlanContext, problems: list[Problem]
) -> ModePlan:
    stale_s = None if file.stale_after == "never" else file.stale_after
    if file.stale_after is None:
        stale_s = bench.robot.monitoring.stale_s
    plan = replace(plan, description=file.description, stale_s=stale_s)
    function = _function(plan.name, file, node, bench.functions, problems)
    if function is None:
        return replace(plan, mappings=_outlines(file, node, problems))
    try:
        module = bench.functions.load(function)
    except AmberboxError as error:
        problems.append(_at(node, "monitor").problem("monitor", error.what, error.hint))
        return replace(plan, mappings=_outlines(file, node, problems))
    arguments = (node.mapping or {}).get("arguments") or Node(node.file, node.line, None)
    config = build(module.Config, arguments, problems, "arguments")
    if config is not None:
        config = _in_folder(module, config, bench.folder, arguments, problems)
    if config is None:
        return replace(plan, module=module, mappings=_outlines(file, node, problems))
    mappings = _Mappings(module, ModeContract.of(module), config, bench.inputs, problems).of(
        file, node
    )
    plan = replace(plan, module=module, config=config, mappings=mappings)
    problems.extend(_time_problems(module, config, node))
    problems.extend(_input_problems(plan, arguments))
    problems.extend(filter_problems(plan, node, bench.inputs.recorded))
    return replace(plan, states=_states(file.states, plan, node, problems))


def _in_folder(
    module: ModuleType, config: Any, folder: Path, arguments: Node, problems: list[Problem]
) -> Any:
    """Return the arguments with what files of the folder add; None and problems for mistakes."""
    seen = ModeContract.of(module).in_folder
    if seen is None:
        return config
    try:
        return seen(config, folder)
    except ConfigurationError as error:
        problems.extend(error.problems)
    except AmberboxError as error:
        problems.append(arguments.problem("arguments", error.what, error.hint))
    return None


def _time_problems(module: Any, config: Any, node: Node) -> Iterator[Problem]:
    """Call a monitor's functions of time; yield an impossible history, and pass on their errors."""
    if hasattr(module, "timed"):
        module.timed(config)
    seconds = module.history_s(config) if hasattr(module, "history_s") else 0.0
    if not 0 <= seconds < float("inf"):
        what = f"its monitor looks back {seconds:g} s, which cannot be"
        yield _at(node, "monitor").problem("monitor", what)


def _input_problems(plan: ModePlan, arguments: Node) -> Iterator[Problem]:
    """Yield the arguments that do not fit the inputs of a mode."""
    found = ModeContract.of(plan.module).input_problems
    texts = [entry.text for mapping in plan.mappings for entry in mapping.inputs]
    for key, what in () if found is None else found(plan.config, texts):
        yield _at(arguments, key).problem(f"arguments.{key}", what)


def _function(
    name: str,
    file: ModeFileOptions,
    node: Node,
    functions: MonitorFunctions,
    problems: list[Problem],
) -> str | None:
    known = list(functions.modes)
    if file.monitor:
        if file.monitor in functions.modes:
            return file.monitor
        what = unknown_function(file.monitor, known, is_key=True)
        problems.append(_at(node, "monitor").problem("monitor", what, _known(known)))
        return None
    function = function_of(name, functions.modes)
    if function is None:
        what = unknown_function(name, known, is_key=False)
        problems.append(
            _at(node, "name").problem("name", what, f"write 'monitor:'; {_known(known)}")
        )
    return function


def _known(names: Sequence[str]) -> str:
    return f"monitors: {', '.join(names)}"


def _at(node: Node, key: str) -> Node:
    return (node.mapping or {}).get(key, node)


def _outlines(
    file: ModeFileOptions, node: Node, problems: list[Problem]
) -> tuple[MappingPlan, ...]:
    """Return the outputs of a mode that cannot run, as far as its file defines them."""
    return tuple(
        MappingPlan((), _outlined(mapping, entry, f"mappings[{index}]", problems))
        for index, (mapping, entry) in enumerate(zip(file.mappings, _entries(node), strict=True))
    )


def _outlined(
    mapping: MappingOptions, node: Node, where: str, problems: list[Problem]
) -> tuple[OutputPlan, ...]:
    """Bind outputs to results of their own names, which any monitor might have."""
    names = [
        (output.result or output.name.strip(), output_type(output)) for output in mapping.outputs
    ]
    results = [Result(name, kind, "") for name, kind in dict(names).items()]
    nodes = _at(node, "outputs").items or ()
    return tuple(bind_outputs(mapping.outputs, nodes, results, 1, False, where, problems))


def _entries(node: Node) -> list[Node]:
    return [_unwrapped(entry, "mapping") for entry in _at(node, "mappings").items or ()]


@dataclass(frozen=True)
class _Mappings:
    """Makes the mappings of one mode."""

    module: ModuleType
    mode: ModeContract
    config: Any
    inputs: InputBinder
    problems: list[Problem]

    def of(self, file: ModeFileOptions, node: Node) -> tuple[MappingPlan, ...]:
        """Return all mappings of a file."""
        entries = _entries(node)
        if not file.mappings:
            self.problems.append(_at(node, "mappings").problem("mappings", "there are none"))
        self._repeated(file, entries)
        return tuple(
            self._mapping(mapping, entry, f"mappings[{index}]")
            for index, (mapping, entry) in enumerate(zip(file.mappings, entries, strict=True))
        )

    def _repeated(self, file: ModeFileOptions, entries: Sequence[Node]) -> None:
        """Report outputs whose name is taken: addresses must be unique."""
        names = [output.name.strip() for m in file.mappings for output in m.outputs]
        nodes = [node for entry in entries for node in _at(entry, "outputs").items or ()]
        for index in repeated(names):
            what = f"there are several outputs called '{names[index]}'"
            self.problems.append(nodes[index].problem("outputs", what))

    def _mapping(self, mapping: MappingOptions, node: Node, where: str) -> MappingPlan:
        nodes = _at(node, "inputs").items or ()
        found = [
            self._input(text, entry, f"{where}.inputs[{index}]")
            for index, (text, entry) in enumerate(zip(mapping.inputs, nodes, strict=True))
        ]
        inputs = [plan for plans in found for plan in plans]
        count = len(inputs) + sum(not plans for plans in found)
        if not mapping.outputs:
            self.problems.append(node.problem(where, "has no outputs"))
        outputs = bind_outputs(
            mapping.outputs,
            _at(node, "outputs").items or (),
            self._results(mapping, count),
            count,
            self.mode.per_input,
            where,
            self.problems,
        )
        return MappingPlan(tuple(inputs), tuple(outputs), self._reads(node, where))

    def _input(self, text: str, node: Node, where: str) -> list[InputPlan]:
        try:
            return self.inputs.of(text, self.module, self.config)
        except InputError as error:
            self.problems.append(node.problem(where, str(error)))
            return []

    def _results(self, mapping: MappingOptions, inputs: int) -> Sequence[Result]:
        """Return the results of the monitor, which may depend on the number of inputs."""
        results_of = self.mode.results_of
        if results_of is None:
            return self.mode.results
        bools = sum(output.type == "bool" for output in mapping.outputs)
        return results_of(self.config, inputs, bools)

    def _reads(self, node: Node, where: str) -> tuple[InputPlan, ...]:
        """Return the inputs that the arguments name."""
        found: list[InputPlan] = []
        for text in self.mode.reads_of(self.config):
            try:
                found += self.inputs.of(text, self.module, self.config, ("variable",))
            except InputError as error:
                self.problems.append(node.problem(f"{where}, arguments", str(error)))
        return tuple(found)


def _unwrapped(node: Node, key: str) -> Node:
    entries = node.mapping or {}
    inner = entries.get(key)
    return inner if len(entries) == 1 and inner is not None and inner.mapping is not None else node


def _states(
    states: Mapping[str, Expression], plan: ModePlan, node: Node, problems: list[Problem]
) -> Mapping[str, Expression]:
    """Check the conditions of fault states: they read outputs of their mode."""
    names = [output.name for output in plan.outputs]
    found = {}
    for name, condition in states.items():
        place = _at(_at(node, "states"), name)
        try:
            found[name] = condition.resolve(names)
            if condition.kind not in ("condition", "any"):
                what = "is no condition: it gives " + condition.kind
                problems.append(place.problem(f"states.{name}", what))
            if condition.needs_history:
                what = "looks back in time; use 'for:' of the output"
                problems.append(place.problem(f"states.{name}", what))
        except AmberboxError as error:
            problems.append(place.problem(f"states.{name}", error.what, error.hint))
    return found


BROKEN = "configuration"  # mode that stands in for those of an unreadable component file
_MOST_SHOWN = 12  # items named in a note


def load_plan(folder: RobotFolder, *, own: bool = True) -> tuple[MonitoringPlan, list[Problem]]:
    """Return the monitoring plan of a robot, and all problems of its files.

    A mode that cannot run stays in the plan with its problem, so that its status is ``unknown``.
    Opens no device and no socket; raises nothing for files that are wrong. Without ``own``,
    monitors and probes that the folder brings along are not imported: their modes cannot run, but
    have outputs.
    """
    problems: list[Problem] = []
    tree = read_tree(folder.path / FOLDER, problems)
    plan = MonitoringPlan(folder.robot.id, folder.config_hash)
    if not tree.components and not tree.unlisted and tree.recovery is None:
        return plan, problems
    functions = find_functions(folder.path, own=own)
    bench = PlanContext(
        functions, InputBinder(RecordedItems(folder), functions), folder.robot, problems,
        folder.path,
    )  # fmt: skip
    found: dict[str, ComponentEntry] = {}
    for source in tree.components:
        entry = _component(source, bench)
        first = found.setdefault(entry.plan.id, entry)
        if first is not entry:
            what = f"there is another component '{entry.plan.id}' in {first.node.file}"
            bench.problems.append(source.node.problem("component_name", what))
    components = list(found.values())
    for mode in tree.unlisted:
        plan_mode(mode, bench)
    components = with_recovery(tree.recovery, components, problems)
    plans = with_dependencies(components, problems)
    problems.extend(part_problems(components))
    problems.extend(_not_known_yet(bench.inputs, folder))
    once = dict.fromkeys(problems)  # a mode file may be listed by many components
    reported = sorted(once, key=lambda problem: (problem.file, problem.line))
    return replace(plan, components=tuple(plans)), reported


def _component(source: ComponentSource, bench: PlanContext) -> ComponentEntry:
    own: list[Problem] = []
    file = build(ComponentFileOptions, source.node, own, "", legacy_note)
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
        return ComponentEntry(replace(plan, modes=(*modes, broken)), None, source.node, stems)
    plan = replace(
        plan,
        policy=file.policy,
        part_of=derive_id(file.part_of) if file.part_of else "",
        description=file.description,
        recovery_actions=tuple(file.recovery_actions),
    )
    stems = tuple(mode.path.stem for mode in source.modes)
    return ComponentEntry(plan, file, source.node, stems, dependencies)


def _modes(source: ComponentSource, bench: PlanContext) -> Iterator[ModePlan]:
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


def _not_known_yet(inputs: InputBinder, folder: RobotFolder) -> Iterator[Problem]:
    names: Sequence[str] = sorted(inputs.unknown_items)
    if names:
        more = f" and {len(names) - _MOST_SHOWN} more" if len(names) > _MOST_SHOWN else ""
        shown = f"{', '.join(names[:_MOST_SHOWN])}{more}"
        what = f"variables of {shown} are judged when they have been recorded"
        yield Problem(str(folder.path / FOLDER), 1, "inputs", what, is_error=False)
