"""Bind the inputs and outputs of a mode: to variables or probes, and to its results.

It also parses ``expected:`` of an output.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Any, Literal

from amberbox.blackbox.columns.variables import (
    ColumnAddress,
    find_addresses,
    guessed_column,
    names_of,
    tables_of,
)
from amberbox.core.detector_items import PREFIX, copied_item
from amberbox.core.errors import AmberboxError, Problem, did_you_mean
from amberbox.core.mode import Result
from amberbox.core.names import has_item_form, item_name
from amberbox.core.probe import SOURCE, ProbeOrder
from amberbox.core.types import ItemSchema
from amberbox.core.yaml_nodes import Node, scalar
from amberbox.monitoring.component_files import MonitorFunctions, OutputOptions
from amberbox.monitoring.plan import Expectation, InputPlan, OutputPlan
from amberbox.monitoring.recorded_items import (
    RecordedItem,
    RecordedItems,
    chosen_place,
)

OWN_ITEMS = ("amberbox_",)  # prefix of items that the box writes itself
_SHORT_MOST = 6


class InputError(Exception):
    """An input text that matches nothing, or is ambiguous."""


@dataclass
class InputBinder:
    """Resolves input texts in one robot folder."""

    recorded: RecordedItems
    functions: MonitorFunctions
    unknown_items: set[str] = field(default_factory=set)
    """Items whose variables are not known before they have been recorded."""

    def of(
        self, text: str, module: ModuleType, config: Any, kinds: Sequence[str] | None = None
    ) -> list[InputPlan]:
        """Return the inputs that a text names for a mode; several if it has ``*``.

        ``kinds`` are the kinds allowed, by default those that the mode accepts. Raises InputError.
        """
        accepts = tuple(kinds or module.ACCEPTS)
        found = self._items(text) + self._variables(text)
        fitting = [plan for plan in found if plan.kind in accepts]
        if not fitting and "probe" in accepts:
            return [self._probe(text, module, config)]
        if not fitting and not found:
            fitting = [plan for plan in self._short(text) if plan.kind in accepts]
        if not fitting:
            raise InputError(self._nothing(text, found, accepts))
        unique = {plan.address: self._copied(plan) for plan in fitting}
        if len(unique) > 1 and "*" not in text:
            shown = " or ".join([*unique][:_SHORT_MOST])
            raise InputError(f"'{text}' is ambiguous: {shown}")
        return list(unique.values())

    def _copied(self, plan: InputPlan) -> InputPlan:
        """Return the input that stands for an item of the detectors: the watcher's copy of it."""
        if plan.kind == "probe" or not self.recorded.is_of_detectors(plan.item):
            return plan
        return replace(plan, item=copied_item(plan.item))

    def _items(self, text: str) -> list[InputPlan]:
        """Find items by their name, or by their topic as configured."""
        plain = text.strip("/")
        found = [i for i in self.recorded.items if i.name == text or i.topic.strip("/") == plain]
        if found or not has_item_form(text):
            return [InputPlan(text, "item", item.name) for item in found]
        item = self._above(text)
        if item is not None:
            self._table(item, text)
        is_there = item is not None or self._is_open(text)
        return [InputPlan(text, "item", text)] if is_there else []

    def _above(self, name: str) -> RecordedItem | None:
        """Return the configured item that ``ITEM__PATH`` is a child table of, if it is one's."""
        items = [item for item in self.recorded.items if name.startswith(f"{item.name}__")]
        is_table = has_item_form(name) and name not in self.recorded.by_name
        return max(items, key=lambda item: len(item.name), default=None) if is_table else None

    def _table(self, item: RecordedItem, name: str) -> ItemSchema | None:
        """Return the variables of a child table; None where they are not known yet.

        Raises InputError where the item's variables are known, and this is none of its tables.
        """
        schema = self.recorded.schema(item)
        if schema is None:
            self.unknown_items.add(item.name)
            return None
        tables = tables_of(item.name, schema)
        if name not in tables:
            near = did_you_mean(name, tables) or _some(list(tables), "no tables")
            raise InputError(f"{item.name} has no table '{name}'{near}")
        return tables[name]

    def _is_open(self, text: str) -> bool:
        """Return whether a name may be an item that no block names."""
        names = (*(f"{name}_" for name in (*self.recorded.open, SOURCE)), *OWN_ITEMS)
        names += (PREFIX,) if self.recorded.awaits_detectors else ()
        stored = self.recorded.stored(text.partition(".")[0].partition("/")[0])
        return text.startswith(names) or stored is not None

    def _variables(self, text: str) -> list[InputPlan]:
        """Find variables by ``ITEM.VARIABLE``, ``ITEM/PATH`` or ``TOPIC/PATH``."""
        found: list[InputPlan] = []
        for item in self.recorded.items:
            for path in _paths_in(text, item):
                found += self._in_item(text, item, path)
        name, path = _split(text)
        if found or not path or name in self.recorded.by_name:
            return found
        above = self._above(name)
        schema = None if above is None else self._table(above, name)
        if schema is not None:
            return _of_places(text, _checked(text, name, path, schema))
        is_there = above is not None or self._is_open(text)
        return self._in_open_item(text, name, path) if is_there else []

    def _in_item(self, text: str, item: RecordedItem, path: str) -> list[InputPlan]:
        schema = self.recorded.schema(item)
        if schema is not None:
            return _of_places(text, _checked(text, item.name, path, schema))
        if chosen_place(item, path) is False:
            near = did_you_mean(path, item.chosen)
            what = f"'{path}' is not among the variable_names of {item.name}{near}"
            raise InputError(f"{what} (black_box.yaml: add it there)")
        return self._guess(text, item.name, path)

    def _in_open_item(self, text: str, name: str, path: str) -> list[InputPlan]:
        schema = self.recorded.stored(name)
        if schema is not None:
            return _of_places(text, _checked(text, name, path, schema))
        return self._guess(text, name, path)

    def _guess(self, text: str, item: str, path: str) -> list[InputPlan]:
        if "*" in path:
            what = f"nobody can know yet how many '{path}' there are in {item}"
            raise InputError(f"{what}: write them one by one")
        self.unknown_items.add(item)
        return _of_places(text, [guessed_column(item, path)])

    def _short(self, text: str) -> list[InputPlan]:
        """Find a variable by the end of its name, among the known ones."""
        found: list[InputPlan] = []
        for item in self.recorded.items:
            schema = self.recorded.schema(item)
            if schema is not None and "*" not in text:
                found += _of_places(text, find_addresses(schema, item.name, text))
        return found

    def _probe(self, text: str, module: ModuleType, config: Any) -> InputPlan:
        probe_of = getattr(module, "probe_of", None)
        try:
            kind, subject = probe_of(config, text) if probe_of else (module.PROBE, text)
        except AmberboxError as error:
            raise InputError(error.what) from error
        if kind not in self.functions.probes:
            near = did_you_mean(kind, self.functions.probes)
            raise InputError(f"there is no probe '{kind}'{near}")
        order = ProbeOrder(kind, subject)
        return InputPlan(text, "probe", order.item, probe=order)

    def _nothing(self, text: str, found: Sequence[InputPlan], accepts: Sequence[str]) -> str:
        """Return why a text is no input."""
        if found:
            wanted = " or ".join(_WORDS[kind] for kind in accepts)
            return f"'{text}' is {_WORDS[found[0].kind]}, this monitor takes {wanted}"
        items = [*(item.name for item in self.recorded.items), *self.recorded.detectors]
        topics = [item.topic for item in self.recorded.items]
        near = did_you_mean(text, [*items, *topics]) or did_you_mean(_split(text)[0], items)
        if not near and text.startswith("/") and self.recorded.open:
            near = f"; write {item_name(self.recorded.open[0], text)}: its block does not list it"
        return f"nothing that is recorded is called '{text}'{near}"


_WORDS = {
    "item": "an item",
    "variable": "a variable",
    "list": "a list of numbers",
    "probe": "the subject of a probe",
}


def _of_places(text: str, places: Sequence[ColumnAddress]) -> list[InputPlan]:
    return [InputPlan(text, p.kind, p.item, p.variable, p.number) for p in places]


def _checked(text: str, item: str, path: str, schema: ItemSchema) -> list[ColumnAddress]:
    places = find_addresses(schema, item, path)
    if places:
        return places
    if "*" in path and any(child in path for child in schema.children):
        raise InputError(f"how many rows '{path}' has changes: write 0, 1, ... for '*'")
    names = names_of(schema)
    raise InputError(f"{item} has no variable '{path}'{did_you_mean(path, names) or _some(names)}")


def _some(names: Sequence[str], nothing: str = "none") -> str:
    return f"; it has {', '.join(names[:8]) or nothing}{' ...' if len(names) > 8 else ''}"


def _split(text: str) -> tuple[str, str]:
    """Split at the first ``.`` or ``/`` after the beginning."""
    places = [place for place in (text.find(".", 1), text.find("/", 1)) if place > 0]
    return (text[: min(places)], text[min(places) + 1 :]) if places else (text, "")


def _paths_in(text: str, item: RecordedItem) -> Iterator[str]:
    """Yield the path of a variable where a text begins with an item's name or topic."""
    for name in dict.fromkeys((item.name, item.topic, item.topic.strip("/"))):
        if text.startswith((f"{name}.", f"{name}/")) and len(text) > len(name) + 1:
            yield text[len(name) + 1 :]
            return


Type = Literal["bool", "int", "float", "string"]
_COMPARISON = re.compile(r"(>=|<=|==|!=|>|<)\s*(.+)")
_RANGE = re.compile(r"(.+?)\.\.(.+)")
_BOOLS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}


def expectation(expected: Any, kind: Type, result: Result) -> Expectation:
    """Return the expectation of an output; raise ValueError with the problem.

    Without ``expected`` a bool expects the nominal value of its result, others nothing.
    """
    if expected is None:
        return Expectation(result.nominal) if kind == "bool" else Expectation()
    if isinstance(expected, Mapping):
        return _limits(expected, kind)
    if isinstance(expected, list):
        raise ValueError("expected a value, got a list")
    if isinstance(expected, str) and kind != "bool":
        compared, span = _COMPARISON.fullmatch(expected), _RANGE.fullmatch(expected)
        if compared:
            return _compared(compared[1], scalar(compared[2].strip()), kind)
        if span and kind != "string":
            return _within(scalar(span[1].strip()), scalar(span[2].strip()), kind)
    relation = result.relation if kind in ("int", "float") else "=="
    return Expectation(_value(expected, kind), relation)


def _compared(relation: Any, value: Any, kind: Type) -> Expectation:
    if kind == "string" and relation not in ("==", "!="):
        raise ValueError(f"a text cannot be compared with {relation}")
    return Expectation(_value(value, kind), relation)


def _limits(expected: Mapping[str, Any], kind: Type) -> Expectation:
    if kind not in ("int", "float"):
        raise ValueError(f"limits are for numbers, this output is of type {kind}")
    unknown = sorted(set(expected) - {"min", "max"})
    if unknown or not expected:
        raise ValueError("a range has the keys min and max")
    low, high = expected.get("min"), expected.get("max")
    if low is None:
        return Expectation(_value(high, kind), "<=")
    if high is None:
        return Expectation(_value(low, kind), ">=")
    return _within(low, high, kind)


def _within(low: Any, high: Any, kind: Type) -> Expectation:
    first, last = _value(low, kind), _value(high, kind)
    assert isinstance(first, int | float) and isinstance(last, int | float)
    if first > last:
        raise ValueError(f"nothing lies between {first} and {last}")
    return Expectation(first, "within", float(last))


def _value(value: Any, kind: Type) -> bool | int | float | str:
    if kind == "string":
        return str(value).lower() if isinstance(value, bool) else str(value)
    if kind == "bool":
        found = _BOOLS.get(value.lower()) if isinstance(value, str) else value
        if not isinstance(found, bool):
            raise ValueError(f"a bool is true or false, not {value}")
        return found
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"expected a number, got '{value}'")
    if kind == "int" and value != int(value):
        raise ValueError(f"a whole number is never {value}")
    return value


_NUMBERS = ("int", "float")
Report = Callable[[str, str], None]  # called with a key (or nothing) and the problem


@dataclass(frozen=True)
class ResultBinding:
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
    """Bind each output to a result; outputs without a result become problems.

    An output is bound by its ``result:``, else by its name, else by its type in order. With
    ``per_input`` there are as many of a result as there are ``inputs``.
    """
    chosen = _chosen(outputs, results, inputs if per_input else 0)
    plans = []
    for index, output in enumerate(outputs):
        place = f"{where}.outputs[{index}]"
        report = _reporter(nodes[index], place, problems)
        binding = chosen[index]
        if isinstance(binding, str):
            report("result" if output.result else "", binding)
        elif (plan := _plan(output, binding, inputs if per_input else 1, report)) is not None:
            plans.append(plan)
    return plans


def output_type(output: OutputOptions) -> Type:
    """Return the type, ``double`` being another word for ``float``."""
    return "float" if output.type == "double" else output.type


def _reporter(node: Node, where: str, problems: list[Problem]) -> Report:
    def report(key: str, what: str) -> None:
        inner = (node.mapping or {}).get("output", node)
        place = (inner.mapping or {}).get(key, inner)
        problems.append(place.problem(f"{where}.{key}" if key else where, what))

    return report


def _plan(
    output: OutputOptions, binding: ResultBinding, inputs: int, report: Report
) -> OutputPlan | None:
    kind = output_type(output)
    if binding.place is None and inputs > 1 and kind != "bool":
        report("", f"there are {inputs} inputs: give one output of type {output.type} for each")
        return None
    try:
        expected = expectation(output.expected, kind, binding.result)
    except ValueError as error:
        report("expected", str(error))
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
) -> list[ResultBinding | str]:
    """Return the binding of each output, or its problem."""
    by_name = {result.name: result for result in results}
    named = {
        index: by_name.get(output.result or output.name.strip())
        for index, output in enumerate(outputs)
    }
    found: dict[int, ResultBinding | str] = {}
    for result in results:
        places = [index for index, bound in named.items() if bound is result]
        found |= _spread(places, result, inputs)
    for index, output in enumerate(outputs):
        if output.result and named[index] is None:
            near = did_you_mean(output.result, by_name)
            found[index] = f"the monitor has no result '{output.result}'{near}"
    taken = {
        binding.result.name for binding in found.values() if isinstance(binding, ResultBinding)
    }
    free = [result for result in results if result.name not in taken]
    rest = [index for index in range(len(outputs)) if index not in found]
    found |= _by_type(outputs, rest, free, inputs, results)
    return [_fitting(outputs[index], found[index]) for index in range(len(outputs))]


def _spread(places: Sequence[int], result: Result, inputs: int) -> dict[int, ResultBinding | str]:
    """Bind outputs to one result: one for each input, or one for all.

    ``inputs`` is 0 where the monitor takes all of them together.
    """
    if not places:
        return {}
    if inputs > 1 and len(places) == inputs:
        return {index: ResultBinding(result, place) for place, index in enumerate(places)}
    what = f"shows '{result.name}', as another output does"
    what += f"; one for each of the {inputs} inputs would be right" if inputs > 1 else ""
    rest: dict[int, ResultBinding | str] = dict.fromkeys(places[1:], what)
    return {places[0]: ResultBinding(result, 0 if inputs == 1 else None), **rest}


def _by_type(
    outputs: Sequence[OutputOptions],
    rest: Sequence[int],
    free: Sequence[Result],
    inputs: int,
    results: Sequence[Result],
) -> dict[int, ResultBinding | str]:
    """Bind the remaining outputs: k-th bool to k-th bool result; numbers to the remaining
    numbers.
    """
    found: dict[int, ResultBinding | str] = {}
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
) -> dict[int, ResultBinding | str]:
    """Bind a number to any number that is left, or report that nothing produces the output."""
    fitting = [result for result in left if {result.type, output_type(output)} <= set(_NUMBERS)]
    if fitting:
        left.remove(fitting[0])
        return _spread([index], fitting[0], inputs)
    gives = ", ".join(f"{result.name} ({result.type})" for result in results)
    return {index: f"nothing produces the output '{output.name}': the monitor gives {gives}"}


def _fitting(output: OutputOptions, binding: ResultBinding | str) -> ResultBinding | str:
    if isinstance(binding, str):
        return binding
    kinds = {output_type(output), binding.result.type}
    if len(kinds) == 1 or kinds <= set(_NUMBERS):
        return binding
    result = binding.result
    return f"'{output.name}' is of type {output.type}, the result '{result.name}' is {result.type}"


def repeated(names: Sequence[str]) -> Iterator[int]:
    """Yield the indices of names that occurred before."""
    seen: set[str] = set()
    for index, name in enumerate(names):
        if name in seen:
            yield index
        seen.add(name)
