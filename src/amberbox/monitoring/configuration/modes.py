"""Mode files made into plans: the function, its arguments, inputs, outputs and states."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

from amberbox.blackbox.folder.robot import RobotConfig
from amberbox.core.config import build
from amberbox.core.errors import AmberboxError, Problem
from amberbox.core.expression import Expression
from amberbox.core.ids import derive_id
from amberbox.core.mode import Result
from amberbox.core.nodes import Node
from amberbox.monitoring.configuration.files import (
    MappingOptions,
    ModeFile,
    legacy_note,
)
from amberbox.monitoring.configuration.functions import Functions, function_of, unknown_function
from amberbox.monitoring.configuration.inputs import InputError, Inputs
from amberbox.monitoring.configuration.outputs import bind_outputs, output_type, repeated
from amberbox.monitoring.configuration.predecessor import translated
from amberbox.monitoring.configuration.rates import filter_problems
from amberbox.monitoring.configuration.tree import ModeSource
from amberbox.monitoring.plan import InputPlan, MappingPlan, ModePlan, OutputPlan


@dataclass(frozen=True)
class Bench:
    """What is needed to make plans of mode files."""

    functions: Functions
    inputs: Inputs
    robot: RobotConfig
    problems: list[Problem]


def plan_mode(source: ModeSource, bench: Bench) -> ModePlan:
    """Make the plan of a mode file; one that cannot run says why in its ``problem``."""
    name = _name(source)
    plan = ModePlan(derive_id(name), name, None, problem=source.problem)
    if source.node is None:
        return plan if plan.problem else replace(plan, problem=f"{source.path} cannot be read")
    own = list(_renamed(plan, source.node))
    node = translated(name, source.node, bench.functions, bench.robot.id, own)
    file = build(ModeFile, node, own, "", legacy_note)
    made = _made(plan, file, node, bench, own) if file is not None else plan
    bench.problems.extend(own)
    first = next((problem for problem in own if problem.is_error), None)
    return made if first is None else replace(made, problem=made.problem or first.what)


def _made(
    plan: ModePlan, file: ModeFile, node: Node, bench: Bench, problems: list[Problem]
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


def _name(source: ModeSource) -> str:
    given = ((source.node.mapping or {}) if source.node else {}).get("name")
    return given.text.strip() if given is not None and given.text.strip() else source.path.stem


def _plan(
    plan: ModePlan, file: ModeFile, node: Node, bench: Bench, problems: list[Problem]
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
    if config is None:
        return replace(plan, module=module, mappings=_outlines(file, node, problems))
    mappings = _Mappings(module, config, bench.inputs, problems).of(file, node)
    plan = replace(plan, module=module, config=config, mappings=mappings)
    problems.extend(_time_problems(module, config, node))
    problems.extend(filter_problems(plan, node, bench.inputs.recorded))
    return replace(plan, states=_states(file.states, plan, node, problems))


def _time_problems(module: Any, config: Any, node: Node) -> Iterator[Problem]:
    """Ask a monitor what it says of time; raise what it raises."""
    if hasattr(module, "timed"):
        module.timed(config)
    seconds = module.history_s(config) if hasattr(module, "history_s") else 0.0
    if not 0 <= seconds < float("inf"):
        what = f"its monitor looks back {seconds:g} s, which cannot be"
        yield _at(node, "monitor").problem("monitor", what)


def _function(
    name: str, file: ModeFile, node: Node, functions: Functions, problems: list[Problem]
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


def _outlines(file: ModeFile, node: Node, problems: list[Problem]) -> tuple[MappingPlan, ...]:
    """Return the outputs of a mode that cannot run: what can be told of them is judged."""
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
    config: Any
    inputs: Inputs
    problems: list[Problem]

    def of(self, file: ModeFile, node: Node) -> tuple[MappingPlan, ...]:
        """Return all mappings of a file."""
        entries = _entries(node)
        if not file.mappings:
            self.problems.append(_at(node, "mappings").problem("mappings", "there are none"))
        self._repeated(file, entries)
        return tuple(
            self._mapping(mapping, entry, f"mappings[{index}]")
            for index, (mapping, entry) in enumerate(zip(file.mappings, entries, strict=True))
        )

    def _repeated(self, file: ModeFile, entries: Sequence[Node]) -> None:
        """Note outputs whose name is taken: addresses must tell them apart."""
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
            getattr(self.module, "PER_INPUT", False),
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
        """Return what the monitor finds out, which may depend on how many inputs there are."""
        results_of = getattr(self.module, "results_of", None)
        bools = sum(output.type == "bool" for output in mapping.outputs)
        found: Sequence[Result] = (
            self.module.RESULTS if results_of is None else results_of(self.config, inputs, bools)
        )
        return found

    def _reads(self, node: Node, where: str) -> tuple[InputPlan, ...]:
        """Return the inputs that the arguments name."""
        reads = getattr(self.module, "reads", None)
        found: list[InputPlan] = []
        for text in () if reads is None else reads(self.config):
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
    """Judge the conditions of fault states: they read outputs of their mode."""
    names = [output.name for mapping in plan.mappings for output in mapping.outputs]
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
