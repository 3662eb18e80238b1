"""Models of ``kind: components``: types with modes, constraints and transitions, and how parts are
joined.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import floor, log10, prod
from pathlib import Path
from typing import Literal, TypeAlias

from amberbox.core.config import Finding, build, raise_errors
from amberbox.core.errors import Problem, UsageError, did_you_mean
from amberbox.core.expression import Expression, ExpressionError
from amberbox.core.expressions.tree import AddressNode, ComparisonNode, ConstantNode, walk
from amberbox.core.options import option
from amberbox.core.yaml_nodes import Node, load_yaml
from amberbox.diagnosis.consistency.integers import Equality, Net, equalities

Value: TypeAlias = bool | int | float | str
Domain: TypeAlias = "Sequence[Value] | None"  # None: every integer
Names: TypeAlias = Sequence[str]

MOST_COMPONENTS = 2_000
MOST_STEPS = 1_000
MOST_CANDIDATES = 1_000
MOST_TRANSITIONS = 200  # of a type
LONGEST_CONSTRAINT = 600
MOST_VALUES = 100  # of a port
MOST_MODES = 100  # of a type
MOST_COMBINATIONS = 10_000  # of the values of a constraint's ports
_MOST_IN_A_FILE = 100_000
_LONGEST_S = 3_600.0
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]*")
_COLUMN = re.compile(r"[A-Za-z_]\w*\.[A-Za-z_]\w*", re.ASCII)
_PORT = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
IDLE = ("none", "no_command", "noCommand", "idle")
"""Values that a command port has in a step without a command to it, if they are among its own."""
ANY = "*"


@dataclass(frozen=True)
class Mode:
    """A way in which a component behaves."""

    nominal: bool = option(False, "whether this is no fault")
    probability: float | None = option(None, "of a fault; 0.001 if not given")
    constraints: list[Expression] = option([], "what holds between the ports in this mode")

    def check(self) -> Iterator[Finding]:
        """Yield a problem of the probability."""
        if self.probability is not None and self.nominal:
            yield "probability", "a nominal mode has no probability"
        elif self.probability is not None and not 1e-100 <= self.probability < 1:
            yield "probability", "is not between 1e-100 and 1"

    @property
    def rank(self) -> int:
        """Return how improbable the fault is, in powers of ten, at least 1.

        Source: Livingstone 2.
        """
        return max(1, floor(0.5 - log10(self.probability or 0.001)))


@dataclass(frozen=True)
class Transition:
    """A change of mode that is no fault of its own: commanded, or caused."""

    to: str = option(doc="the mode after it")
    source: str | list[str] = option(ANY, "the mode or modes before it", aliases=("from",))
    when: Expression | None = option(None, "condition over ports and commands; always without")

    @property
    def sources(self) -> Sequence[str]:
        """Return the modes before it; ``*`` is any."""
        return [self.source] if isinstance(self.source, str) else self.source


@dataclass(frozen=True)
class ComponentType:
    """What components of one kind have in common."""

    modes: dict[str, Mode] = option(doc="by name; at least one is nominal")
    ports: dict[str, list[Value] | Literal["int"]] = option({}, "by name: the values, or int")
    transitions: list[Transition] = option([], "how modes change besides by faults")


@dataclass(frozen=True)
class Step:
    """Commands, and what was observed after they had acted."""

    observe: Mapping[str, Value] = option({}, "values by component.port")
    commands: Mapping[str, Value] = option({}, "values by component.port")


@dataclass(frozen=True)
class Binding:
    """Where the value of a port comes from while a robot runs."""

    value: Expression = option(doc="expression over the record")
    max_age: float = option(5.0, "older samples are not known any more", unit="s")
    values: dict[str, Value] = option({}, "value of the port by result, where they differ")

    def check(self) -> Iterator[Finding]:
        """Yield a problem of the age."""
        if not 0 < self.max_age <= _LONGEST_S:
            yield "max_age", f"is not between 0 and {_LONGEST_S:g} s"


@dataclass(frozen=True)
class ComponentFile:
    """The keys of a model of components."""

    kind: Literal["components"] = option(doc="what the model is made of")
    types: dict[str, ComponentType] = option(doc="by name")
    components: dict[str, str] = option(doc="type by name")
    connections: list[list[str]] = option([], "ports that have the same value: component.port")
    initial: dict[str, str] = option({}, "mode by component before the first step")
    steps: list[Step] = option([], "commands and observations; a diagnosis agrees with all of them")
    candidates: int = option(50, "most states that are remembered of steps before the history")
    history: int = option(10, "steps that are looked at again with each new one; 0: all")
    observe: dict[str, Expression | Binding] = option({}, "by component.port, from the record")
    commands: dict[str, Expression | Binding] = option({}, "by component.port, from the record")
    period: float = option(1.0, "time between two steps from the record", unit="s")
    settle: float = option(1.0, "how long an observed value has been the same to count", unit="s")
    maps_to: dict[str, list[str]] = option(
        {}, "failure modes of fmea.yaml by component=mode or component"
    )

    def check(self) -> Iterator[Finding]:
        """Yield problems of the numbers."""
        if not 1 <= self.candidates <= MOST_CANDIDATES:
            yield "candidates", f"is not between 1 and {MOST_CANDIDATES:,}"
        if not 0 <= self.history <= MOST_STEPS:
            yield "history", f"is not between 0 and {MOST_STEPS:,}"
        if not 0.1 <= self.period <= _LONGEST_S:
            yield "period", f"is not between 0.1 and {_LONGEST_S:g} s"
        if not 0 <= self.settle <= _LONGEST_S:
            yield "settle", f"is not between 0 and {_LONGEST_S:g} s"


@dataclass(frozen=True, slots=True)
class Excluded:
    """Combinations of the values of ports that a constraint excludes."""

    ports: Names
    rows: Sequence[Sequence[Value | None]]


@dataclass(frozen=True, slots=True)
class Guard:
    """When a transition happens: the combinations of values of ports, None being no value."""

    ports: Names
    rows: Mapping[Sequence[Value | None], bool]


@dataclass(frozen=True, slots=True)
class Change:
    """A transition: the modes before it, the mode after it, and when it happens."""

    sources: frozenset[str]
    to: str
    guard: Guard


@dataclass(frozen=True)
class Components:
    """Components by name with their types, joined by nets: ports with one value."""

    types: Mapping[str, ComponentType]
    components: Mapping[str, str]
    """Types by name."""
    constraints: Mapping[tuple[str, str], Sequence[Excluded | Equality]]
    """By type and mode."""
    nets: Mapping[str, Net]
    """By component.port."""
    domains: Mapping[Net, Domain]
    steps: Sequence[Step]
    changes: Mapping[str, Sequence[Change]]
    """By type."""
    commanded: frozenset[Net]
    """Nets that have a value only while there is a command, or an observation of it."""
    initial: Mapping[str, str]
    """Mode by component before the first step, as far as it is known."""
    is_timed: bool
    """Whether modes change from step to step."""
    file: ComponentFile

    @property
    def candidates(self) -> int:
        """Return how many states are remembered at most."""
        return self.file.candidates

    @property
    def history(self) -> int:
        """Return how many steps are looked at again; 0 for all."""
        return self.file.history

    @cached_property
    def observe(self) -> Mapping[str, Binding]:
        """Return where observations come from while a robot runs."""
        return {name: _binding(of) for name, of in self.file.observe.items()}

    @cached_property
    def commands(self) -> Mapping[str, Binding]:
        """Return where commands come from while a robot runs."""
        return {name: _binding(of) for name, of in self.file.commands.items()}

    @property
    def observations(self) -> Sequence[Mapping[str, Value]]:
        """Return what was observed in each step."""
        return [step.observe for step in self.steps]

    @cached_property
    def faults(self) -> Mapping[str, tuple[str, str]]:
        """Return component and mode of each fault, by ``component=mode``."""
        return {
            f"{name}={mode}": (name, mode)
            for name, kind in self.components.items()
            for mode, what in self.types[kind].modes.items() if not what.nominal
        }  # fmt: skip

    def mode(self, fault: str) -> Mode:
        """Return the mode of a fault."""
        name, mode = self.faults[fault]
        return self.types[self.components[name]].modes[mode]

    @cached_property
    def inputs(self) -> frozenset[Net]:
        """Return the nets whose values come from outside.

        None of their ports is constrained in every mode that has constraints.
        """
        made: set[Net] = set()
        for name, kind in self.components.items():
            constrained = [
                {port for one in self.constraints[kind, mode] for port in one.ports}
                for mode, what in self.types[kind].modes.items() if what.constraints
            ]  # fmt: skip
            for port in set.intersection(*constrained) if constrained else ():
                made.add(self.nets[f"{name}.{port}"])
        return frozenset(self.nets.values()) - made - self.commanded

    def idle(self, net: Net) -> Value | None:
        """Return the value of a net without a command; None for none."""
        return next((value for value in self.domains[net] or () if value in IDLE), None)


def load_components(path: Path) -> Components:
    """Return a model; raises ConfigurationError with everything that is wrong in the file."""
    problems: list[Problem] = []
    node = load_yaml(path, problems)
    raise_errors(problems)
    assert node is not None
    file = build(ComponentFile, node, problems)
    raise_errors(problems)
    assert file is not None
    reading = _Reading(file, node)
    raise_errors(reading.problems)
    return reading.model


def read_value(text: str, name: str, model: Components, option_name: str = "--observe") -> Value:
    """Return the value of a port that a text stands for; raises UsageError."""
    if name not in model.nets:
        near = did_you_mean(name, model.nets)
        raise UsageError(f"{option_name}: there is no port '{name}'{near}")
    domain = model.domains[model.nets[name]]
    if domain is None:
        if re.fullmatch(r"[-+]?\d{1,18}", text):
            return int(text)
        raise UsageError(f"{option_name}: {name} is a whole number, not '{text}'")
    values = {value_text(value): value for value in domain}
    if text not in values:
        near = did_you_mean(text, values)
        raise UsageError(
            f"{option_name}: {name} has no value '{text}'{near}", f"its values: {', '.join(values)}"
        )
    return values[text]


def _binding(of: Expression | Binding) -> Binding:
    return of if isinstance(of, Binding) else Binding(of)


def value_text(value: Value) -> str:
    """Return a value as it is written in a model."""
    return str(value).lower() if isinstance(value, bool) else str(value)


class _Reading:
    """The model of a file, and what is wrong with it beyond keys and types."""

    def __init__(self, file: ComponentFile, node: Node) -> None:
        self.problems: list[Problem] = []
        assert node.mapping is not None
        self._file, self._top = file, node.mapping
        self._combinations = 0
        constraints = {
            (name, mode): self._constraints(name, kind, mode, node)
            for name, kind in file.types.items()
            for mode, node in self._modes(name, kind)
        }
        self._check_names()
        types = {name: self._with_commands(name, kind) for name, kind in file.types.items()}
        changes = {name: self._changes(name, kind) for name, kind in types.items()}
        ports = {
            f"{name}.{port}": None if values == "int" else values
            for name, kind in file.components.items()
            if kind in types
            for port, values in types[kind].ports.items()
        }
        nets = self._joined(ports)
        domains = {nets[name]: domain for name, domain in ports.items()}
        self._check_steps(ports)
        self._check_initial()
        self._check_bindings(ports)
        self._check_maps()
        is_timed = bool(file.initial or file.commands)
        is_timed |= any(kind.transitions for kind in types.values())
        self.model = Components(
            types, file.components, constraints, nets, domains, file.steps, changes,
            self._commanded(nets, constraints, changes), file.initial,
            is_timed or any(step.commands for step in file.steps), file,
        )  # fmt: skip

    def _say(self, node: Node, where: str, what: str, hint: str = "") -> None:
        self.problems.append(node.problem(where, what, hint))

    def _modes(self, name: str, kind: ComponentType) -> Iterator[tuple[str, Node]]:
        """Yield the modes of a type with their places, once the type has been checked."""
        place = (self._top["types"].mapping or {})[name]
        assert place.mapping is not None
        where = f"types.{name}"
        if not any(mode.nominal for mode in kind.modes.values()):
            self._say(place, where, "no mode is nominal", "say nominal: true of one")
        if len(kind.modes) > MOST_MODES:
            self._say(place, where, f"has more than {MOST_MODES} modes")
        for port, values in kind.ports.items():
            said = f"{where}.ports.{port}"
            if not _PORT.fullmatch(port):
                self._say(place, said, "the name of a port has letters, digits and _ only")
            if values != "int" and not 0 < len(values) <= MOST_VALUES:
                self._say(place, said, f"has no values, or more than {MOST_VALUES}")
            if values != "int" and len({*values}) < len(values):
                self._say(place, said, "has a value twice")
        for mode_name, node in (place.mapping["modes"].mapping or {}).items():
            if not _NAME.fullmatch(mode_name):
                self._say(node, f"{where}.modes", f"'{mode_name}' is no name")
            yield mode_name, node

    def _constraints(
        self, type_name: str, kind: ComponentType, mode: str, place: Node
    ) -> list[Excluded | Equality]:
        found: list[Excluded | Equality] = []
        where = f"types.{type_name}.modes.{mode}"
        listed = (place.mapping or {}).get("constraints")
        nodes = (listed.items or ()) if listed is not None else ()
        for constraint, node in zip(kind.modes[mode].constraints, nodes, strict=True):
            try:
                found += self._compiled(constraint, kind)
            except ExpressionError as error:
                self._say(node, where, str(error.what), error.hint)
            except ValueError as error:
                self._say(node, where, f"'{constraint.text[:80]}': {error}")
        return found

    def _compiled(
        self, constraint: Expression, kind: ComponentType
    ) -> Sequence[Excluded | Equality]:
        """Return what a constraint says; raises ValueError or ExpressionError."""
        ports, domains = self._read(constraint, kind)
        finite = [values for values in domains if values is not None]
        if len(finite) < len(ports):
            if finite:
                raise ValueError("has both int ports and ports with listed values")
            return equalities(constraint)
        rows = _evaluated(constraint, ports, finite)
        return [Excluded(ports, [row for row, holds in rows if not holds])]

    def _read(self, read: Expression, kind: ComponentType) -> tuple[Names, Sequence[Domain]]:
        """Return the ports that an expression reads, with their values, after bounding it."""
        if len(read.text) > LONGEST_CONSTRAINT:
            raise ValueError(f"is longer than {LONGEST_CONSTRAINT} characters")
        if read.needs_history:
            raise ValueError("looks back in time")
        ports = [name for name in read.addresses() if name in kind.ports]
        domains = [kind.ports[name] for name in ports]
        finite = [values for values in domains if values != "int"]
        words = {word for values in kind.ports.values() if values != "int" for word in values}
        for name in read.addresses():
            if name not in kind.ports and (name not in words or len(finite) < len(ports)):
                known = [*kind.ports, *(word for word in words if isinstance(word, str))]
                near = did_you_mean(name, known)
                raise ValueError(f"there is no port and no value '{name}'{near}")
        count = prod(map(len, finite))
        self._combinations += count
        if count > MOST_COMBINATIONS or self._combinations > _MOST_IN_A_FILE:
            raise ValueError(
                f"its ports have {count:,} combinations of values: at most {MOST_COMBINATIONS:,} "
                f"in a constraint and {_MOST_IN_A_FILE:,} in a file can be looked at"
            )
        return ports, [None if values == "int" else values for values in domains]

    def _transitions(self, name: str) -> Iterator[tuple[Transition, Node, str]]:
        """Yield the transitions of a type, each with its place and where it is."""
        place = (self._top["types"].mapping or {})[name].mapping or {}
        nodes = (place["transitions"].items or ()) if "transitions" in place else ()
        transitions = self._file.types[name].transitions
        for number, (one, node) in enumerate(zip(transitions, nodes, strict=True)):
            yield one, node, f"types.{name}.transitions[{number}]"

    def _with_commands(self, name: str, kind: ComponentType) -> ComponentType:
        """Return a type with the commands that its transitions read as further ports."""
        words = {word for values in kind.ports.values() if values != "int" for word in values}
        commands: dict[str, dict[Value, None]] = {}
        for one, node, where in self._transitions(name):
            for command, value in _compared(one.when) if one.when is not None else ():
                if command in kind.ports or command in words:
                    continue
                if not _PORT.fullmatch(command):
                    self._say(node, where, f"there is no port '{command}'")
                commands.setdefault(command, {})[value] = None
        if len(kind.transitions) > MOST_TRANSITIONS:
            place = (self._top["types"].mapping or {})[name]
            self._say(place, f"types.{name}", f"has more than {MOST_TRANSITIONS} transitions")
        ports = {command: _command_values([*values]) for command, values in commands.items()}
        return replace(kind, ports={**kind.ports, **ports})

    def _changes(self, name: str, kind: ComponentType) -> list[Change]:
        found: list[Change] = []
        for one, node, where in self._transitions(name):
            sources = kind.modes.keys() if ANY in one.sources else one.sources
            for mode in (*sources, one.to):
                if mode not in kind.modes:
                    near = did_you_mean(mode, kind.modes)
                    self._say(node, where, f"there is no mode '{mode}'{near}")
            try:
                guard = self._guard(one.when, kind)
            except ExpressionError as error:
                self._say(node, f"{where}.when", str(error.what), error.hint)
            except ValueError as error:
                assert one.when is not None
                self._say(node, f"{where}.when", f"'{one.when.text[:80]}': {error}")
            else:
                found.append(Change(frozenset(sources), one.to, guard))
        return found

    def _guard(self, when: Expression | None, kind: ComponentType) -> Guard:
        """Return when a transition happens; raises ValueError or ExpressionError."""
        if when is None:
            return Guard([], {(): True})
        ports, domains = self._read(when, kind)
        known = [values for values in domains if values is not None]
        if len(known) < len(domains):
            raise ValueError("reads int ports; a condition reads ports with listed values")
        rows = [[*values, None] for values in known]
        return Guard(ports, dict(_evaluated(when, ports, rows)))

    def _commanded(
        self,
        nets: Mapping[str, Net],
        constraints: Mapping[tuple[str, str], Sequence[Excluded | Equality]],
        changes: Mapping[str, Sequence[Change]],
    ) -> frozenset[Net]:
        """Return the nets of commands: named as such, or read by nothing but conditions."""
        named = {name for step in self._file.steps for name in step.commands}
        named |= self._file.commands.keys()
        guards: set[str] = set()
        others = {name for step in self._file.steps for name in step.observe}
        others |= self._file.observe.keys()
        for name, kind in self._file.components.items():
            for change in changes.get(kind, ()):
                guards |= {f"{name}.{port}" for port in change.guard.ports}
            for (of, _), found in constraints.items():
                ports = (port for one in found for port in one.ports)
                others |= {f"{name}.{port}" for port in ports} if of == kind else set()
        read = {nets[name] for name in others if name in nets}
        silent = {nets[name] for name in guards if name in nets} - read
        shared = {net for net in silent if sum(net == one for one in nets.values()) > 1}
        return frozenset((silent - shared) | {nets[name] for name in named if name in nets})

    def _check_initial(self) -> None:
        places = (self._top["initial"].mapping or {}) if "initial" in self._top else {}
        for name, mode in self._file.initial.items():
            where = f"initial.{name}"
            if name not in self._file.components:
                near = did_you_mean(name, self._file.components)
                self._say(places[name], where, f"there is no component '{name}'{near}")
                continue
            kind = self._file.types.get(self._file.components[name])
            if kind is not None and mode not in kind.modes:
                near = did_you_mean(mode, kind.modes)
                self._say(places[name], where, f"there is no mode '{mode}'{near}")

    def _check_bindings(self, ports: Mapping[str, Domain]) -> None:
        for key, bound in (("observe", self._file.observe), ("commands", self._file.commands)):
            places = (self._top[key].mapping or {}) if key in self._top else {}
            for name, of in bound.items():
                where, place = f"{key}.{name}", places[name]
                if not self._is_port(name, ports, place, key):
                    continue
                if key == "commands" and ports[name] is None:
                    self._say(place, where, "is an int port, and no command")
                for value in _binding(of).values.values():
                    self._check_value(value, ports[name], place, f"{where}.values")
                for address in _binding(of).value.addresses():
                    if not _COLUMN.fullmatch(address):
                        what = f"'{address}' is no variable of the record: item.variable"
                        self._say(place, where, what)

    def _check_maps(self) -> None:
        places = (self._top["maps_to"].mapping or {}) if "maps_to" in self._top else {}
        known = [*self._file.components]
        for name, kind in self._file.components.items():
            if kind in self._file.types:
                modes = self._file.types[kind].modes.items()
                known += [f"{name}={mode}" for mode, what in modes if not what.nominal]
        for name in self._file.maps_to:
            if name not in known:
                what = f"there is no component and no fault '{name}'{did_you_mean(name, known)}"
                self._say(places[name], "maps_to", what, "write component, or component=mode")

    def _check_names(self) -> None:
        places = self._top["components"].mapping or {}
        if len(places) > MOST_COMPONENTS:
            self._say(self._top["components"], "components", f"are more than {MOST_COMPONENTS:,}")
        for name, kind in self._file.components.items():
            where = f"components.{name}"
            if not _NAME.fullmatch(name):
                self._say(places[name], where, "is no name: letters, digits, _ . and -")
            if kind not in self._file.types:
                near = did_you_mean(kind, self._file.types)
                self._say(places[name], where, f"there is no type '{kind}'{near}")

    def _joined(self, ports: Mapping[str, Domain]) -> dict[str, Net]:
        """Return the net of each port; ports that are connected have the same."""
        net = {name: number for number, name in enumerate(ports)}
        members = {number: [name] for name, number in net.items()}
        places = self._top["connections"].items or () if "connections" in self._top else ()
        for number, (ends, place) in enumerate(zip(self._file.connections, places, strict=True)):
            where = f"connections[{number}]"
            if len(ends) < 2:
                self._say(place, where, "connects fewer than two ports")
            known = [end for end in ends if self._is_port(end, ports, place, where)]
            for end in known[1:]:
                if ports[end] != ports[known[0]]:
                    self._say(place, where, f"{known[0]} and {end} have different values")
                first, other = net[known[0]], net[end]
                if first != other:
                    net |= dict.fromkeys(members[other], first)
                    members[first] += members.pop(other)
        return net

    def _is_port(self, name: str, ports: Mapping[str, Domain], place: Node, where: str) -> bool:
        if name in ports:
            return True
        what = f"there is no port '{name}'{did_you_mean(name, ports)}"
        self._say(place, where, what, "a port is named component.port")
        return False

    def _check_steps(self, ports: Mapping[str, Domain]) -> None:
        if len(self._file.steps) > MOST_STEPS:
            self._say(self._top["steps"], "steps", f"are more than {MOST_STEPS:,}")
        nodes = (self._top["steps"].items or ()) if "steps" in self._top else ()
        for number, (step, node) in enumerate(zip(self._file.steps, nodes, strict=True)):
            for key, given in (("observe", step.observe), ("commands", step.commands)):
                listed = (node.mapping or {}).get(key)
                places = (listed.mapping or {}) if listed is not None else {}
                where = f"steps[{number}].{key}"
                for name, value in given.items():
                    if not self._is_port(name, ports, places[name], where):
                        continue
                    self._check_value(value, ports[name], places[name], f"{where}.{name}")
                    if key == "commands" and ports[name] is None:
                        self._say(places[name], where, f"{name} is an int port, and no command")

    def _check_value(self, value: Value, domain: Domain, place: Node, where: str) -> None:
        if domain is None:
            if type(value) is not int:
                self._say(place, where, f"'{value_text(value)}' is no whole number")
            return
        if not any(value == one and type(value) is type(one) for one in domain):
            texts = list(map(value_text, domain))
            near = did_you_mean(value_text(value), texts)
            what = f"there is no value '{value_text(value)}'{near}"
            self._say(place, where, what, f"its values: {', '.join(texts)}")


def _evaluated(
    read: Expression, ports: Names, domains: Sequence[Sequence[Value | None]]
) -> Iterator[tuple[tuple[Value | None, ...], bool]]:
    """Yield the combinations of values, and whether an expression holds with them."""
    words = {name: name for name in read.addresses()}
    for row in product(*domains):
        result = read.evaluate(words | dict(zip(ports, row, strict=True)))
        if result is not None and not isinstance(result, bool):
            raise ValueError("is no condition")
        yield row, bool(result)


def _command_values(read: Sequence[Value]) -> list[Value]:
    """Return the values of a command of which conditions read some."""
    if all(isinstance(value, bool) for value in read):
        return [False, True]
    return [*read, IDLE[0]] if all(isinstance(value, str) for value in read) else [*read]


def _compared(condition: Expression) -> Iterator[tuple[str, Value]]:
    """Yield the names in comparisons such as ``name == value``, each with the value."""
    for part in walk(condition.tree):
        if not isinstance(part, ComparisonNode) or not isinstance(part.operands[0], AddressNode):
            continue
        for operand in part.operands[1:]:
            if isinstance(operand, AddressNode):
                yield part.operands[0].name, operand.name
            elif isinstance(operand, ConstantNode) and isinstance(operand.value, bool | int | str):
                yield part.operands[0].name, operand.value
