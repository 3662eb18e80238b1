"""Combinational circuits in the format of the ISCAS benchmarks (``.bench``)."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from itertools import product
from pathlib import Path

from amberbox.core.config import raise_errors
from amberbox.core.errors import Problem
from amberbox.diagnosis.consistency.satisfiability import Solver

_PORT = re.compile(r"(INPUT|OUTPUT)\s*\(\s*([^\s(),=]+)\s*\)", re.IGNORECASE)
_GATE = re.compile(r"([^\s(),=]+)\s*=\s*(\w+)\s*\(([^()]*)\)")
_KINDS = {"AND", "NAND", "OR", "NOR", "XOR", "XNOR", "NOT", "BUFF", "BUF"}
_MOST_INPUTS_OF_XOR = 12
_LONGEST = 20_000_000  # bytes of a file


@dataclass(frozen=True, slots=True)
class Gate:
    """A gate; it has the name of the signal that it makes."""

    kind: str
    inputs: Sequence[str]


@dataclass(frozen=True, slots=True)
class Circuit:
    """Gates by name, and the names of the circuit's inputs and outputs."""

    inputs: Sequence[str]
    outputs: Sequence[str]
    gates: Mapping[str, Gate]


def read_circuit(path: Path) -> Circuit:
    """Read a circuit; raises ConfigurationError with every line that is none of the format."""
    reading = _Reading(str(path))
    try:
        text = path.read_bytes()[:_LONGEST].decode()
    except OSError as error:
        reading.say(1, f"cannot be read: {error.strerror}")
    except UnicodeDecodeError:
        reading.say(1, "is not UTF-8 text")
    else:
        for number, line in enumerate(text.splitlines(), 1):
            reading.take(number, line.partition("#")[0].strip())
        reading.check()
    raise_errors(reading.problems)
    return Circuit(list(reading.ports["INPUT"]), list(reading.ports["OUTPUT"]), reading.gates)


class _Reading:
    """What was read so far, and what is wrong with it."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.problems: list[Problem] = []
        self.ports: dict[str, dict[str, int]] = {"INPUT": {}, "OUTPUT": {}}  # name to line
        self.gates: dict[str, Gate] = {}
        self.lines: dict[str, int] = {}

    def say(self, line: int, what: str, where: str = "file") -> None:
        self.problems.append(Problem(self.file, line, where, what))

    def take(self, number: int, line: str) -> None:
        """Take one line, without its comment."""
        if port := _PORT.fullmatch(line):
            self.ports[port[1].upper()].setdefault(port[2], number)
        elif gate := _GATE.fullmatch(line):
            self._add(
                number, gate[1], gate[2].upper(), [name.strip() for name in gate[3].split(",")]
            )
        elif line:
            self.say(number, f"is neither a port nor a gate: {line[:60]!r}")

    def _add(self, number: int, name: str, kind: str, inputs: list[str]) -> None:
        single = kind in ("NOT", "BUF", "BUFF")
        if kind not in _KINDS:
            self.say(number, f"there is no kind of gate {kind[:20]!r}", name)
        elif not all(inputs) or (single and len(inputs) > 1):
            self.say(number, "has not the inputs of its kind", name)
        elif kind in ("XOR", "XNOR") and len(inputs) > _MOST_INPUTS_OF_XOR:
            self.say(number, f"has more than {_MOST_INPUTS_OF_XOR} inputs", name)
        elif name in self.gates:
            self.say(number, "is made twice", name)
        self.gates[name], self.lines[name] = Gate(kind, inputs), number

    def check(self) -> None:
        """Say which signals nothing makes, or more than one thing."""
        made = self.gates.keys() | self.ports["INPUT"].keys()
        for name, gate in self.gates.items():
            for source in gate.inputs:
                if source and source not in made:
                    self.say(self.lines[name], f"nothing makes {source[:60]!r}", name)
            if name in self.ports["INPUT"]:
                self.say(self.lines[name], "is an input, too", name)
        sources = {name: set(gate.inputs) & self.gates.keys() for name, gate in self.gates.items()}
        try:
            TopologicalSorter(sources).prepare()
        except CycleError as error:
            name = error.args[1][0]
            self.say(self.lines[name], "is made from itself", name)
        for name, line in self.ports["OUTPUT"].items():
            if name not in made:
                self.say(line, "nothing makes it", name)


def encode(
    circuit: Circuit, solver: Solver, faults: Mapping[str, int], observed: Mapping[str, bool]
) -> None:
    """Add what a circuit says of one observation; a gate with its fault says nothing.

    ``faults`` are literals by gate: several observations share them.
    """
    signals = {name: solver.variable() for name in (*circuit.inputs, *circuit.gates)}
    for name, value in observed.items():
        solver.add([signals[name] if value else -signals[name]])
    for name, gate in circuit.gates.items():
        inputs = [signals[source] for source in gate.inputs]
        for clause in _clauses(gate.kind, inputs, signals[name]):
            solver.add([faults[name], *clause])


def _clauses(kind: str, inputs: Sequence[int], output: int) -> Iterator[list[int]]:
    if kind in ("NAND", "NOR", "XNOR", "NOT"):
        output = -output
    if kind in ("AND", "NAND", "OR", "NOR"):
        sign = 1 if kind in ("AND", "NAND") else -1
        yield [*(-sign * signal for signal in inputs), sign * output]
        for signal in inputs:
            yield [sign * signal, -sign * output]
        return
    for values in product((True, False), repeat=len(inputs)):
        differ = [
            -signal if value else signal for signal, value in zip(inputs, values, strict=True)
        ]
        yield [*differ, output if sum(values) % 2 else -output]
