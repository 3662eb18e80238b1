"""Outputs of a mapping bound to what the monitor finds out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from amberbox.core.config import did_you_mean
from amberbox.core.errors import Problem
from amberbox.core.mode import Result
from amberbox.core.nodes import Node
from amberbox.monitoring.configuration.expectations import expectation
from amberbox.monitoring.configuration.files import OutputOptions
from amberbox.monitoring.plan import OutputPlan

Type = Literal["bool", "int", "float", "string"]
_NUMBERS = ("int", "float")
Tell = Callable[[str, str], None]
"""Called with a key (or nothing) and what is wrong."""


@dataclass(frozen=True)
class Binding:
    """The result that an output shows; ``place`` is the input it is about, None for all."""

    result: Result
    place: int | None = None


def bind_outputs(
    outputs: Sequence[OutputOptions],
    nodes: Sequence[Node],
    results: Sequence[Result],
    inputs: int,
    per_input: bool,
    where: str,
    problems: list[Problem],
) -> list[OutputPlan]:
    """Bind each output to a result; those that nothing produces become problems.

    An output goes by its ``result:``, else by its name, else by its type in order. With
    ``per_input`` there are as many of a result as there are ``inputs``.
    """
    chosen = _chosen(outputs, results, inputs if per_input else 0)
    plans = []
    for index, output in enumerate(outputs):
        place = f"{where}.outputs[{index}]"
        tell = _teller(nodes[index], place, problems)
        binding = chosen[index]
        if isinstance(binding, str):
            tell("result" if output.result else "", binding)
        elif (plan := _plan(output, binding, inputs if per_input else 1, tell)) is not None:
            plans.append(plan)
    return plans


def output_type(output: OutputOptions) -> Type:
    """Return the type, ``double`` being another word for ``float``."""
    return "float" if output.type == "double" else output.type


def _teller(node: Node, where: str, problems: list[Problem]) -> Tell:
    def tell(key: str, what: str) -> None:
        inner = (node.mapping or {}).get("output", node)
        place = (inner.mapping or {}).get(key, inner)
        problems.append(place.problem(f"{where}.{key}" if key else where, what))

    return tell


def _plan(output: OutputOptions, binding: Binding, inputs: int, tell: Tell) -> OutputPlan | None:
    kind = output_type(output)
    if binding.place is None and inputs > 1 and kind != "bool":
        tell("", f"there are {inputs} inputs: give one output of type {output.type} for each")
        return None
    try:
        expected = expectation(output.expected, kind, binding.result)
    except ValueError as error:
        tell("expected", str(error))
        return None
    return OutputPlan(
        output.name.strip(),
        kind,
        replace(binding.result, unit=output.unit or binding.result.unit),
        binding.place,
        expected,
        output.severity,
        output.for_s,
        output.heal_s,
        output.flapping.changes,
        output.flapping.within,
        output.description,
        output.hint,
    )


def _chosen(
    outputs: Sequence[OutputOptions], results: Sequence[Result], inputs: int
) -> list[Binding | str]:
    """Return the binding of each output, or what is wrong."""
    by_name = {result.name: result for result in results}
    named = {
        index: by_name.get(output.result or output.name.strip())
        for index, output in enumerate(outputs)
    }
    found: dict[int, Binding | str] = {}
    for result in results:
        places = [index for index, bound in named.items() if bound is result]
        found |= _spread(places, result, inputs)
    for index, output in enumerate(outputs):
        if output.result and named[index] is None:
            near = did_you_mean(output.result, by_name)
            found[index] = f"the monitor has no result '{output.result}'{near}"
    taken = {binding.result.name for binding in found.values() if isinstance(binding, Binding)}
    free = [result for result in results if result.name not in taken]
    rest = [index for index in range(len(outputs)) if index not in found]
    found |= _by_type(outputs, rest, free, inputs, results)
    return [_fitting(outputs[index], found[index]) for index in range(len(outputs))]


def _spread(places: Sequence[int], result: Result, inputs: int) -> dict[int, Binding | str]:
    """Bind outputs to one result: one for each input, or one for all.

    ``inputs`` is 0 where the monitor takes all of them together.
    """
    if not places:
        return {}
    if inputs > 1 and len(places) == inputs:
        return {index: Binding(result, place) for place, index in enumerate(places)}
    what = f"shows '{result.name}', as another output does{_for_each(inputs)}"
    rest: dict[int, Binding | str] = dict.fromkeys(places[1:], what)
    return {places[0]: Binding(result, 0 if inputs == 1 else None), **rest}


def _for_each(inputs: int) -> str:
    return f"; one for each of the {inputs} inputs would be right" if inputs > 1 else ""


def _by_type(
    outputs: Sequence[OutputOptions],
    rest: Sequence[int],
    free: Sequence[Result],
    inputs: int,
    results: Sequence[Result],
) -> dict[int, Binding | str]:
    """Bind what is left: k-th bool to k-th bool result; numbers take what numbers are left."""
    found: dict[int, Binding | str] = {}
    left = list(free)
    for kind in ("bool", "int", "float", "string"):
        of_kind = [index for index in rest if output_type(outputs[index]) == kind]
        fitting = [result for result in left if result.type == kind]
        if inputs > 1 and len(of_kind) == inputs and fitting:
            found |= _spread(of_kind, fitting[0], inputs)
            left.remove(fitting[0])
            continue
        for index, result in zip(of_kind, fitting, strict=False):
            found |= _spread([index], result, inputs)
            left.remove(result)
    for index in rest:
        if index not in found:
            found |= _number(index, outputs[index], left, inputs, results)
    return found


def _number(
    index: int,
    output: OutputOptions,
    left: list[Result],
    inputs: int,
    results: Sequence[Result],
) -> dict[int, Binding | str]:
    """Bind a number to any number that is left, or say that nothing produces the output."""
    fitting = [result for result in left if {result.type, output_type(output)} <= set(_NUMBERS)]
    if fitting:
        left.remove(fitting[0])
        return _spread([index], fitting[0], inputs)
    gives = ", ".join(f"{result.name} ({result.type})" for result in results)
    return {index: f"nothing produces the output '{output.name}': the monitor gives {gives}"}


def _fitting(output: OutputOptions, binding: Binding | str) -> Binding | str:
    if isinstance(binding, str):
        return binding
    kinds = {output_type(output), binding.result.type}
    if len(kinds) == 1 or kinds <= set(_NUMBERS):
        return binding
    result = binding.result
    return f"'{output.name}' is of type {output.type}, the result '{result.name}' is {result.type}"


def repeated(names: Sequence[str]) -> Iterator[int]:
    """Yield the places of names that came before."""
    seen: set[str] = set()
    for index, name in enumerate(names):
        if name in seen:
            yield index
        seen.add(name)
